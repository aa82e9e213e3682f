"""The suite for two legs: its metrics on motions of known answer, its measure, and what must not pay."""

import math
from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest
import torch
from gaitgauge.backends.conformance.soles import HEIGHT, two_soles
from gaitgauge.gauge.evaluate import Request
from gaitgauge.gauge.ground_rules import build_terrain, heavier, longer
from gaitgauge.gauge.instants import Instants, MetricConstants, SampledState
from gaitgauge.gauge.metric_rules import GO2_MASS
from gaitgauge.gauge.metrics import find_metric
from gaitgauge.gauge.suite import load_suite
from gaitgauge.gauge.suited import measured
from gaitgauge.gauge.support import Soles
from gaitgauge.policy.contract import History, ObservationTerm, standard_contract
from gaitgauge.policy.native import StoredNetwork, save_policy
from gaitgauge.policy.networks.architectures import MlpNetwork
from gaitgauge.robots import load_robot
from gaitgauge.robots.anatomy.body_plan import body_plan
from tiny_runs import evaluate

ROBOT, SUITE = two_soles(), load_suite("gaitgauge-biped-1")
WEIGHT = 12.6 * 9.81
DOUBLE = {"device": torch.device("cpu"), "dtype": torch.float64}
CONSTANTS = MetricConstants(rules=SUITE.metrics, robot=ROBOT, weight=WEIGHT, **DOUBLE)


# ---- the support polygon ----------------------------------------------------------------------------------------------


def test_corners_of_soles_follow_the_pose():
    model = mujoco.MjModel.from_xml_path(str(ROBOT.mjcf))
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    data.qpos[:3], data.qpos[3:7] = random.normal(size=3), [0.8, 0.3, -0.4, 0.3]
    data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
    data.qpos[7:] = random.uniform(-0.5, 0.5, 6)
    mujoco.mj_kinematics(model, data)
    rows = [torch.tensor(values)[None] for values in (data.qpos[:3], data.qpos[3:7], data.qpos[7:])]
    left, right = Soles(ROBOT, **DOUBLE).corners(*rows)[0].numpy()
    box = data.geom("right_sole")
    under = [[0.09 * a, 0.04 * b, -0.01] for a in (-1, 1) for b in (-1, 1)]
    np.testing.assert_allclose(right, box.xpos + np.array(under) @ box.xmat.reshape(3, 3).T, atol=1e-9)
    ankle = data.body("left_foot")
    # spheres of 2 cm at x -0.06 and 0.12, y up to 0.04, z -0.04
    under = [[x, y, -0.06] for x in (-0.08, 0.14) for y in (-0.06, 0.06)]
    np.testing.assert_allclose(left, ankle.xpos + np.array(under) @ ankle.xmat.reshape(3, 3).T, atol=1e-9)


@pytest.mark.parametrize(
    ("point", "carries", "depth"),
    [
        ((0.5, 0.5), (True, False), 0.5),  # the middle of a square
        ((0.5, 0.2), (True, False), 0.2),
        ((0.5, -0.3), (True, False), -0.3),  # outside
        ((2.0, 0.5), (True, True), 0.5),  # between two squares that carry
        ((2.0, 0.5), (False, True), -1.0),
        ((3.5, 0.9), (True, True), 0.1),
    ],
)
def test_depth_in_the_polygon_of_the_feet_that_carry(point, carries, depth):
    square = torch.tensor([[x, y, 0.0] for x in (0.0, 1.0) for y in (0.0, 1.0)], dtype=torch.float64)
    corners = torch.stack((square, square + torch.tensor([3.0, 0.0, 0.0])))[None]
    found = Soles(ROBOT, **DOUBLE).depth(torch.tensor([point], dtype=torch.float64), corners, torch.tensor([carries]))
    assert float(found) == pytest.approx(depth)


def stands(pressure=(0.0, 0.0), left=0.5, quaternion=(1.0, 0.0, 0.0, 0.0)) -> Instants:
    """Return the robot flat on its soles with the ground's pressure at a place, ``left`` the share of the left foot."""
    fields = {
        "base_position_w": [0.0, 0.0, HEIGHT],
        "base_quaternion_w": quaternion,
        "joint_position": ROBOT.default_joint_position,
        "ground_force_w": [0.0, 0.0, WEIGHT],
        "ground_moment_w": [0.0, 0.0, 0.0],
        "contact_center_w": [*pressure, 0.0],
        "foot_normal_force": [left * WEIGHT, (1.0 - left) * WEIGHT],
    }
    one, three = torch.ones(1, dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64)
    return Instants(
        state=SampledState({k: torch.tensor([v], dtype=torch.float64) for k, v in fields.items()}),
        command=three,
        limits=three + 1.0,
        friction=one,
        torque_before=three,
        torque_known=one > 0,
        constants=CONSTANTS,
    )


@pytest.mark.parametrize(
    ("instant", "value"),
    [
        # soles reach from -0.08 to 0.14 m (left) and -0.06 to 0.12 m; half a sole is 0.06 and 0.04 m wide, 0.05 m on average
        (stands((0.03, 0.0)), 1.0),
        (stands((-0.04, 0.11), left=1.0), 0.04 / 0.05),
        (stands((0.13, 0.11), left=1.0), 0.01 / 0.05),
        (stands((0.03, -0.15), left=0.0), 0.0),
        (stands((0.03, -0.11), left=0.03), 0.04 / 0.05),  # a foot under 5 % of the weight does not carry
    ],
)
def test_the_support_margin_of_a_robot_that_stands(instant, value):
    assert float(find_metric("support_margin").function(instant)) == pytest.approx(value, abs=1e-6)


@pytest.mark.parametrize("axis", [(1.0, 0.0), (0.0, 1.0), (0.6, 0.8)])
def test_uprightness_counts_roll_and_pitch_alike(axis):
    half = 0.5 * 0.3
    tilted = stands(quaternion=(math.cos(half), math.sin(half) * axis[0], math.sin(half) * axis[1], 0.0))
    assert float(find_metric("upright").function(tilted)) == pytest.approx(1.0 - math.sin(0.3))


def test_arms_neither_dilute_power_nor_have_limits():
    g1 = load_robot("g1")
    constants = MetricConstants(rules=SUITE.metrics, robot=g1, weight=1.0, **DOUBLE)
    legs = [j for j, name in enumerate(g1.joint_names) if any(part in name for part in ("hip", "knee", "ankle"))]
    assert constants.motors.tolist() == constants.limits[0].tolist() == legs
    everything = replace(SUITE.metrics, motors="all")
    assert MetricConstants(rules=everything, robot=g1, weight=1.0, **DOUBLE).motors == slice(None)


# ---- the measure --------------------------------------------------------------------------------------------------------


def test_steps_and_bars_rise_to_a_third_of_the_leg_and_masses_grow_with_the_robot():
    g1 = load_robot("g1")
    leg = body_plan(g1).leg_length
    steps = build_terrain(SUITE.ground, g1, "stairs_fd", 10).boxes
    assert steps[1].center[2] - steps[0].center[2] == pytest.approx(leg / 3.0, rel=0.001)
    assert 2.0 * build_terrain(SUITE.ground, g1, "obstacle", 10).boxes[0].half_size[2] == pytest.approx(
        leg / 3.0, rel=0.001
    )
    assert heavier(SUITE.ground, g1) == pytest.approx(body_plan(g1).mass / GO2_MASS)
    mine = measured(SUITE, g1)
    assert mine.commands.target_radius == pytest.approx(0.1 * longer(SUITE.ground, g1)) and mine.digest == SUITE.digest
    plain = load_suite("gaitgauge-1")
    assert plain.ground is None and measured(plain, g1) is plain and heavier(None, g1) == 1.0


# ---- what must not pay --------------------------------------------------------------------------------------------------


def march(legs: dict[str, float]) -> dict[str, list[float]]:
    """Return weights and offsets of a linear policy for the G1: a clock moves the left leg's joints, its opposite the right one's."""
    names = load_robot("g1").joint_names
    row = [[0.0, 0.0] for _ in names]
    for joint, size in legs.items():
        for side, sign in (("left", 1.0), ("right", -1.0)):
            row[names.index(f"{side}_{joint}_joint")] = [sign * size, 0.0]
    return {"weight": row, "bias": [0.0] * len(names)}


def held(legs: dict[str, float]) -> dict[str, list[float]]:
    """Return a policy that holds joints of both legs away from the default pose [units of action]."""
    names = load_robot("g1").joint_names
    return {
        "weight": [[0.0, 0.0] for _ in names],
        "bias": [next((size for joint, size in legs.items() if joint in name), 0.0) for name in names],
    }


CHEATS = {
    "standing": held({}),
    "crouching": held({"hip_pitch": -3.0, "knee": 6.0, "ankle_pitch": -3.0}),
    "falling": held({"hip_pitch": 4.0}),
    "huge": held({"hip": 100.0, "knee": -100.0}),
    "marching": march({"hip_pitch": -0.4, "knee": 0.8, "ankle_pitch": -0.4}),
}
MOMENT = """
extends = "gaitgauge-biped-1"
name = "moment"

[matrix]
terrains = ["flat"]
frictions = [0.6]
payloads = [0.0]
seeds = [0]
"""


@pytest.fixture(scope="module")
def score(tmp_path_factory):
    folder = tmp_path_factory.mktemp("biped")
    (folder / "moment.toml").write_text(MOMENT)
    g1 = load_robot("g1")
    clock = ObservationTerm(name="gait_phase", scale=(1.0,), period=0.7)
    contract = replace(standard_contract(g1, history=History()), observation=(clock,))

    def play(name):
        arguments = {"frame_width": 2, "num_actions": 29, "hidden": [4]}
        state = {k: torch.zeros_like(v) for k, v in MlpNetwork(**arguments).state_dict().items()}
        first, _, last, bias = state
        # the hidden layer passes the clock's waves and their negatives on: elu(x) - elu(-x) is odd in x
        state[first][:] = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        weight = torch.tensor(CHEATS[name]["weight"])
        state[last][:] = torch.stack((weight[:, 0], -weight[:, 0], weight[:, 1], -weight[:, 1]), dim=1)
        state[bias][:] = torch.tensor(CHEATS[name]["bias"])
        path = folder / f"{name}.gauge.pt"
        save_policy(path, contract, StoredNetwork(architecture="mlp", arguments=arguments, state_dict=state))
        return evaluate(Request(policy=str(path), suite=str(folder / "moment.toml"), threads=1), folder / f"run-{name}")

    return cache(play)


@pytest.mark.slow
@pytest.mark.parametrize("name", CHEATS)
def test_a_cheat_scores_next_to_nothing(score, name):
    assert score(name).score < 0.1  # public policies have 0.2 to 0.5 on level ground
