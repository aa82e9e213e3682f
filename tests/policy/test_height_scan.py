"""A policy that sees the ground: points, order, age and noise by hand, and where such a policy is refused or marked."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from gaitgauge.gauge.play.noise import make_stream
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.base import PolicyError
from gaitgauge.policy.contract import (
    ContractError,
    ObservationTerm,
    PolicyContract,
    kind_of_observations,
    standard_contract,
)
from gaitgauge.policy.export.files import ExportError, deploy_settings
from gaitgauge.policy.foreign.deploy_yaml import read_deploy
from gaitgauge.policy.foreign.isaac_lab import read_env
from gaitgauge.policy.ground import Ground
from gaitgauge.policy.observation import ObservationBuilder
from gaitgauge.robots import load_robot
from gaitgauge.terrains.base import Terrain
from gaitgauge.terrains.shapes import Box
from gaitgauge.training.algorithms.symmetry import build_mirror
from gaitgauge.training.environment.environment import TrainingEnvironment
from gaitgauge.training.tasks import find_task

GO2 = load_robot("go2")
STEP = Terrain(name="step", family="step", boxes=(Box(center=(1.0, 0.0, 0.1), half_size=(0.75, 5.0, 0.1)),))
"""Floor up to x = 0.25 m, then 0.2 m higher."""
SCAN = ObservationTerm(name="height_scan", scale=(2.0,), reference=(0.3,), clip=1.0, size=(0.4, 0.2), spacing=0.2)
SEEING = replace(standard_contract(GO2), observation=(SCAN,))


def state(x: float, y: float, yaw: float, height: float = 0.5) -> SimpleNamespace:
    half = torch.tensor([0.5 * yaw], dtype=torch.float64)
    quaternion = torch.stack((half.cos(), 0 * half, 0 * half, half.sin()), dim=1)
    return SimpleNamespace(
        base_position_w=torch.tensor([[x, y, height]], dtype=torch.float64), base_quaternion_w=quaternion
    )


def scan(contract: PolicyContract, *states: SimpleNamespace, delay: float = 0.0) -> list[list[float]]:
    """What the policy sees in one state after the other."""
    ground = Ground.of(contract, [STEP], torch.zeros(1, dtype=torch.int64), delay=delay)
    builder = ObservationBuilder(contract, GO2, 1, ground=ground)
    nothing = torch.zeros(1, 3), torch.zeros(1, 12)
    return [[round(v, 4) for v in builder.build(s, *nothing)[0].tolist()] for s in states]  # type: ignore[arg-type]


def test_heights_below_a_grid_that_turns_with_the_robot():
    """0.5 m over the floor is 2 · (0.5 − 0.3) = 0.4; over the step, 0.2 m higher, 0."""
    # points at x −0.2, 0, 0.2 about x = 0.1: the last one is on the step; rows for y −0.1 and 0.1
    assert scan(SEEING, state(0.1, 0.0, 0.0)) == [[0.4, 0.4, 0.0, 0.4, 0.4, 0.0]]
    across = replace(SEEING, observation=(replace(SCAN, fastest="y"),))
    assert scan(across, state(0.1, 0.0, 0.0)) == [[0.4, 0.4, 0.4, 0.4, 0.0, 0.0]]
    # turned to the left by a right angle, its right side, y = −0.1, looks along x; twice, its back
    turn = torch.pi / 2
    assert scan(SEEING, state(0.2, 0.0, turn), state(0.1, 0.0, 2 * turn)) == [
        [0.0] * 3 + [0.4] * 3,
        [0.0, 0.4, 0.4] * 2,
    ]
    assert scan(SEEING, state(0.1, 0.0, 0.0, height=3.0)) == [[1.0] * 6]  # clipped


def test_the_map_is_some_time_old_and_a_reset_begins_anew():
    places = [state(0.1, 0.0, 0.0), state(-2.0, 0.0, 0.0), state(-2.0, 0.0, 0.0)]
    floor, edge = [0.4] * 6, [0.4, 0.4, 0.0] * 2
    assert scan(SEEING, *places, delay=0.04) == [edge, edge, edge]
    assert scan(SEEING, *places, delay=0.02) == [edge, edge, floor]
    ground = Ground.of(SEEING, [STEP], torch.zeros(1, dtype=torch.int64), delay=0.02)
    builder = ObservationBuilder(SEEING, GO2, 1, ground=ground)
    builder.build(places[0], torch.zeros(1, 3), torch.zeros(1, 12))  # type: ignore[arg-type]
    builder.reset()
    assert builder.build(places[1], torch.zeros(1, 3), torch.zeros(1, 12))[0].tolist() == pytest.approx(floor)  # type: ignore[arg-type]


def test_it_is_exteroceptive_and_needs_a_ground():
    blind = standard_contract(GO2)
    assert (kind_of_observations(blind), kind_of_observations(SEEING)) == ("measurable", "exteroceptive")
    told = replace(SEEING, observation=(SCAN, ObservationTerm(name="base_linear_velocity_b", scale=(1.0,))))
    assert kind_of_observations(told) == "privileged"
    assert PolicyContract.from_json(SEEING.to_json()) == SEEING and SEEING.observation_width == 6
    with pytest.raises(ContractError, match=r"observes the ground \(height_scan\), which nothing shows it here"):
        ObservationBuilder(SEEING, GO2, 1)
    with pytest.raises(ContractError, match="has 10201 points; at most 1000 are"):
        replace(SCAN, size=(10.0, 10.0), spacing=0.1)
    with pytest.raises(ExportError, match="controller has no map of the ground"):
        deploy_settings(SEEING, GO2)


def test_noise_of_the_map_leaves_all_other_noise_as_it_is():
    noise, at = load_suite("gaitgauge-1").noise, torch.arange(4)
    blind, seeing = (make_stream(noise, 12, 4, torch.device("cpu"), scan=n).draw(at) for n in (0, 6))
    for name, values in blind[0].items():
        torch.testing.assert_close(seeing[0][name], values, rtol=0.0, atol=0.0)
    assert torch.equal(blind[1], seeing[1]) and seeing[0].keys() - blind[0].keys() == {"height_scan"}
    assert 0.01 < seeing[0]["height_scan"].abs().max() <= 0.02
    published = make_stream(load_suite("robogauge-1.1").noise, 12, 4, torch.device("cpu"), scan=6)
    published.assign(0, SimpleNamespace(seed=1))  # type: ignore[arg-type]
    assert "height_scan" not in published.draw(at * 0)[0]


def test_a_policy_that_sees_the_ground_can_be_trained():
    task = find_task("go2-flat", ["environment.num_envs=2", "environment.observations.policy=height_scan"])
    environment = TrainingEnvironment(task.environment, backend="mujoco", device="cpu")
    try:
        contract = environment.contract
        assert contract.observation_width == 45 + 187 and contract.observation[-1].reference == (0.5,)
        observations = environment.get_observations()["policy"]
        seen = observations[:, 45:] - (environment.parts.inputs.base_position_w[:, 2:] - 0.5)
        assert seen.abs().max() < 0.25  # level ground, noise of 0.05 m, a map of 0.06 s ago
        mirror = build_mirror(task.environment.observations, contract=contract, robot=GO2)
        row = torch.arange(45.0, 232.0)[None].expand(2, -1)
        image = mirror.policy(torch.cat((observations[:, :45], row), dim=1))[0, 45:]
        # 17 points along the heading are a row of the grid; 11 rows change their order
        torch.testing.assert_close(image, row[0].view(11, 17).flip(0).flatten())
    finally:
        environment.close()


def env(**scanner):
    term = {
        "func": "mdp.observations:height_scan",
        "params": {"sensor_cfg": {"name": "height_scanner"}},
        "clip": [-1.0, 1.0],
    }
    grid = {"func": "isaaclab.sensors.ray_caster.patterns.patterns:grid_pattern", "resolution": 0.2, "size": [0.4, 0.2]}
    action = {
        "class_type": "isaaclab.envs.mdp.actions.joint_actions:JointPositionAction",
        "joint_names": [".*"],
        "scale": 0.25,
    }
    motors = {"joint_names_expr": [".*"], "stiffness": 20.0, "damping": 0.5}
    robot = {"spawn": {"usd_path": "go2.usd"}, "init_state": {"joint_pos": {".*": 0.0}}, "actuators": {"legs": motors}}
    sensor = {
        "pattern_cfg": grid | {"ordering": "yx"},
        "offset": {"pos": [0.0, 0.0, 20.0]},
        "attach_yaw_only": True,
    } | scanner
    return {
        "sim": {"dt": 0.005}, "decimation": 4, "actions": {"joint_pos": action}, "commands": {},
        "observations": {"policy": {"height_scan": term}}, "scene": {"robot": robot, "height_scanner": sensor},
    }  # fmt: skip


def test_a_deploy_file_has_the_usual_grid_and_says_so():
    settings = deploy_settings(standard_contract(GO2), GO2)
    settings["observations"]["height_scanner"] = {"params": {}, "clip": [-1.0, 1.0], "scale": 1.0, "history_length": 1}
    contract = read_deploy(settings, Path("deploy.yaml"), GO2)
    found = contract.observation[-1]
    assert found == ObservationTerm(name="height_scan", scale=(1.0,), reference=(0.5,), clip=(1.0,))
    assert contract.provenance["assumed"].startswith(
        "the height scan's usual grid, 1.6 by 1 m, 0.1 m apart, x first, less 0.5 m"
    )


def test_isaac_labs_height_scanner_is_read():
    (found,) = read_env(env(), Path("env.yaml"), None).observation
    assert found == replace(SCAN, scale=(1.0,), reference=(0.5,), clip=(1.0,), fastest="y")
    with pytest.raises(
        PolicyError, match="has a height scan that is no grid about the base which turns with the heading"
    ):
        read_env(env(offset={"pos": [0.3, 0.0, 20.0]}), Path("env.yaml"), None)
