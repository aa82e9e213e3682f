"""Open loop and model comparison on the C engine, and energies that can be worked out by hand."""

import math

import numpy as np
import pytest
import torch
from gaitgauge.backends import ResetState, make_backend
from gaitgauge.backends.base import DESCRIPTION_KEYS, Randomization
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.contract import standard_contract
from gaitgauge.robots import load_robot
from gaitgauge.robots.anatomy.body_plan import total_mass
from gaitgauge.studies.consistency.models import compare_models, entry_names
from gaitgauge.studies.consistency.open_loop import (
    DURATION,
    TESTS,
    EnergyMeter,
    Trajectory,
    angle_between,
    compare_trajectories,
    open_loop_scene,
    replay,
)
from gaitgauge.studies.consistency.variants import parse_variant

GO2 = load_robot("go2")
SUITE = load_suite("robogauge-1.1")
CONTRACT = standard_contract(GO2)
MASS = total_mass(GO2)


def standing_targets(steps):
    return np.tile(np.asarray(GO2.default_joint_position), (steps, len(TESTS), 1))


def test_energy_is_that_of_mechanics():
    scene = open_loop_scene(SUITE, GO2, CONTRACT)
    meter, backend = EnergyMeter(scene), make_backend("mujoco", scene)

    def energy(height=1.0, **velocity):
        position = torch.tensor([0.0, 0.0, height], dtype=torch.float64).repeat(3, 1)
        upright = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).repeat(3, 1)
        tensors = {k: torch.tensor(v, dtype=torch.float64).expand(3, -1) for k, v in velocity.items()}
        backend.reset(ResetState(base_position=position, base_quaternion=upright, **tensors))
        return meter.measure(backend.state)

    low = energy()
    assert low.shape == (3,)
    assert energy(height=3.0) - low == pytest.approx(MASS * 9.81 * 2.0)
    assert energy(base_linear_velocity=[3.0, 4.0, 0.0]) - low == pytest.approx(0.5 * MASS * 25.0)
    # one hip alone at a speed: the rotor's 0.01 kg m² and the leg's own inertia about the hip
    spinning = energy(joint_velocity=[2.0, *[0.0] * 11]) - low
    assert spinning.min() > 0.5 * 0.01 * 4.0


def test_energy_is_kept_in_free_fall_without_motors():
    scene = open_loop_scene(SUITE, GO2, CONTRACT)
    meter, backend = EnergyMeter(scene), make_backend("mujoco", scene)
    position = torch.tensor([0.0, 0.0, 20.0], dtype=torch.float64).repeat(3, 1)
    backend.reset(
        ResetState(
            base_position=position, base_quaternion=torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).repeat(3, 1)
        )
    )
    before = meter.measure(backend.state)
    for _ in range(50):
        backend.step(None)
    after = meter.measure(backend.state)
    # semi-implicit Euler falls g dt t / 2 too far: m g times that, 1.5 J of the 700 J that were turned over
    assert after - before == pytest.approx(-MASS * 9.81 * 9.81 * 0.002 * 1.0 / 2, abs=0.05)


def test_an_engine_agrees_with_itself_and_another_timestep_does_not():
    settings = {"suite": SUITE, "robot": GO2, "contract": CONTRACT, "friction": 0.6}
    targets = standing_targets(60)
    first, description = replay(parse_variant("mujoco"), targets, **settings)
    second, _ = replay(parse_variant("mujoco"), targets, **settings)
    other, other_description = replay(parse_variant("mujoco@timestep=0.004"), targets, **settings)
    period, weight = SUITE.physics.control_period, 9.81 * MASS
    same = compare_trajectories(first, second, period=period, weight=weight)
    assert all(v == 0.0 for test in same.values() for v in test["largest"].values())
    found = compare_trajectories(first, other, period=period, weight=weight)
    # free fall: semi-implicit Euler with a step h falls g h t / 2 further; 4 ms against 2 ms over 1.2 s
    assert found["air"]["end"]["position"] == pytest.approx(9.81 * 0.002 * 1.2 / 2, rel=1e-2)
    assert found["stand"]["support"] == pytest.approx([1.0, 1.0], abs=0.3)
    assert set(description) == set(DESCRIPTION_KEYS)
    models = compare_models(GO2, {"mujoco": description, "other": other_description}, "mujoco")
    assert all(row["variants"]["other"]["relative"] == 0.0 for row in models["fields"].values())


def test_resting_feet_carry_the_weight():
    steps = round(DURATION / SUITE.physics.control_period)
    run, _ = replay(
        parse_variant("mujoco"), standing_targets(steps), suite=SUITE, robot=GO2, contract=CONTRACT, friction=0.6
    )
    found = compare_trajectories(run, run, period=SUITE.physics.control_period, weight=9.81 * MASS)
    assert found["stand"]["support"] == pytest.approx([1.0, 1.0], abs=1e-3)


def trajectory(steps=10, drift=0.0, turn=0.0):
    time = np.arange(1, steps + 1)
    shape = (steps, len(TESTS))
    position = np.zeros((*shape, 3))
    position[..., 0] = drift * time[:, None]
    quaternion = np.zeros((*shape, 4))
    quaternion[..., 0], quaternion[..., 3] = math.cos(turn / 2), math.sin(turn / 2)
    return Trajectory(
        position=position,
        quaternion=quaternion,
        joints=np.full((*shape, 12), drift),
        ground_force=np.full(shape, 75.0),
        energy=np.full(shape, drift),
    )


def test_curves_and_marks():
    found = compare_trajectories(trajectory(), trajectory(drift=0.02, turn=0.3), period=0.1, weight=150.0)["walk"]
    assert found["time"] == pytest.approx([0.1 * i for i in range(1, 11)])
    assert found["curves"]["position"] == pytest.approx([0.02 * i for i in range(1, 11)])
    assert found["end"]["angle"] == pytest.approx(0.3)
    assert found["end"]["joints"] == pytest.approx(0.02)
    assert found["end"]["energy"] == pytest.approx(0.02)
    assert found["apart"] == {"0.01": pytest.approx(0.1), "0.1": pytest.approx(0.6)}
    stand = compare_trajectories(trajectory(), trajectory(), period=0.1, weight=150.0)["stand"]
    assert stand["support"] == [0.5, 0.5]


def test_a_diverged_engine_is_apart_and_has_no_numbers():
    broken = trajectory()
    broken.position[5:] = np.nan
    found = compare_trajectories(trajectory(), broken, period=0.1, weight=1.0)["walk"]
    assert found["end"]["position"] is None
    assert found["apart"]["0.1"] == pytest.approx(0.6)


def test_opposite_quaternions_are_the_same_turn():
    half = math.sqrt(0.5)
    turn = np.array([[half, half, 0.0, 0.0]])
    assert angle_between(turn, -turn) == pytest.approx([0.0])
    assert angle_between(np.array([[1.0, 0, 0, 0]]), turn) == pytest.approx([math.pi / 2])


def test_models_differ_where_randomization_made_them():
    scene = open_loop_scene(SUITE, GO2, CONTRACT)
    plain, heavy = make_backend("mujoco", scene), make_backend("mujoco", scene)
    ones = torch.ones(3, dtype=torch.float64)
    plain.randomize(Randomization(friction=0.6 * ones))
    heavy.randomize(
        Randomization(friction=0.5 * ones, base_mass_offset=2.0 * ones, stiffness_scale=torch.full((3, 12), 1.5))
    )
    first, second = plain.describe(), heavy.describe()
    assert first["total_mass"] == pytest.approx([MASS])
    assert first["contact_friction"] == pytest.approx([0.6] * 4)
    assert first["stiffness"] == pytest.approx([20.0] * 12)
    assert first["damping"] == pytest.approx([0.5] * 12)
    assert first["joint_armature"] == pytest.approx([0.01] * 12)
    assert first["torque_limit"] == [math.inf] * 12  # this suite has no torque limits
    found = compare_models(GO2, {"a": first, "b": second, "mute": None}, "a")
    differing = {k for k, row in found["fields"].items() if not row["variants"]["b"]["agrees"]}
    assert differing == {"total_mass", "body_mass", "stiffness", "contact_friction"}
    mass = found["fields"]["body_mass"]["variants"]["b"]
    assert mass["entry"] == "base_link"
    assert mass["largest"] == pytest.approx(2.0)
    assert found["not_described"] == ["mute"]
    assert first["contact_dimension"] == [6.0] * 4 and first["contact_torsion"] == pytest.approx([0.02] * 4)
    free = compare_models(GO2, {"a": first, "free": first | {"contact_torsion": [0.0] * 4}}, "a")
    torsion = free["fields"]["contact_torsion"]["variants"]["free"]
    assert torsion["values"] == pytest.approx([0.02, 0.0]) and not torsion["agrees"]
    for key, values in first.items():
        assert len(entry_names(key, GO2)) == len(values), key


def test_a_limit_that_only_one_has_is_no_small_matter():
    found = compare_models(GO2, {"a": {"torque_limit": [math.inf] * 12}, "b": {"torque_limit": [20.0] * 12}}, "a")
    row = found["fields"]["torque_limit"]["variants"]["b"]
    assert not row["agrees"] and row["relative"] is None
    short = compare_models(GO2, {"a": {"stiffness": [1.0] * 12}, "b": {"stiffness": [1.0]}}, "a")
    assert not short["fields"]["stiffness"]["variants"]["b"]["agrees"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mujoco-warp", "newton"])
def test_warp_engines_hold_the_same_model(name):
    scene = open_loop_scene(SUITE, GO2, CONTRACT)
    descriptions = {}
    for engine in ("mujoco", name):
        backend = make_backend(engine, scene)
        backend.randomize(Randomization(friction=torch.full((3,), 0.6, dtype=backend.dtype)))
        descriptions[engine] = backend.describe()
        assert set(descriptions[engine]) == set(DESCRIPTION_KEYS)
    found = compare_models(GO2, descriptions, "mujoco")
    assert all(row["variants"][name]["agrees"] for row in found["fields"].values()), found
