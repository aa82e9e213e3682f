"""What is commanded when: order, clocks and the way to the target."""

import math
from dataclasses import replace
from itertools import groupby

import pytest
import torch
from gaitgauge.backends import PhysicsState
from gaitgauge.gauge.goals import Schedule, check_terrain, target_command, target_offset
from gaitgauge.gauge.suite import SuiteError, load_suite
from gaitgauge.terrains.registry import make_terrain
from scipy.spatial.transform import Rotation
from scripted_gauge import ground

REFERENCE, OWN = load_suite("robogauge-1.1"), load_suite("gaitgauge-1")
LEVELLED = (1.0, 1.0, 1.5)
# Paper table of goals in the reference's order, as signs of the limits.
DIAGONALS = [(-1, -1), (-1, 1), (-1, 0), (1, -1), (1, 1), (1, 0), (0, -1), (0, 1)]
AXES = [(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)]


def schedule(suite):
    return Schedule(suite, torch.device("cpu"), torch.float64)


def commands(suite, name, limits=LEVELLED):
    """Command at every commanded step of a goal, sub-command after sub-command, as the rollout reads them."""
    table = schedule(suite)
    out = []
    for part, steps in enumerate(table.sub_commands[name]):
        rows = table.first_row(name, part) + torch.arange(len(steps) + 1)
        found = table.commands(rows, torch.tensor([limits], dtype=torch.float64)).tolist()
        assert found[0] == [0.0, 0.0, 0.0]  # while the robot settles
        out += [tuple(round(v, 9) + 0.0 for v in command) for command in found[1:]]
    return out


def runs(sequence):
    return [(key, len(list(group))) for key, group in groupby(sequence)]


def test_goals_run_in_alphabetical_order():
    for suite in (REFERENCE, OWN):
        assert schedule(suite).names == (
            "diagonal_velocity",
            "max_velocity",
            "target_pos_velocity",
        )


def test_the_own_suite_gives_every_phase_its_exact_length():
    expected = []
    for x, y in DIAGONALS:
        expected += [(x, y, 0.0)] * 150 + [(-x, -y, 0.0)] * 150
    assert commands(OWN, "diagonal_velocity") == expected
    expected = []
    for x, y, yaw in AXES:
        expected += [(x, y, 1.5 * yaw)] * 250 + [(0.0, 0.0, 0.0)] * 100
    assert commands(OWN, "max_velocity") == expected


def test_the_references_clock_ends_phases_one_step_early_and_wanders_with_its_rounding():
    """The clock starts with one period at the first step and adds up rounding errors, as the published one does."""
    lengths = [count for _, count in runs(commands(REFERENCE, "diagonal_velocity"))]
    # the last phase but two and the last but one have the same command
    assert lengths == [149, 151, *[150] * 9, 149, 150, 300, 150]
    lengths = [count for _, count in runs(commands(REFERENCE, "max_velocity"))]
    assert lengths == [*[250, 100] * 5, 249, 100]


def test_the_references_goals_have_the_same_sequence_of_commands():
    expected = [c for c, _ in groupby(c for x, y in DIAGONALS for c in ((x, y, 0.0), (-x, -y, 0.0)))]
    assert [c for c, _ in runs(commands(REFERENCE, "diagonal_velocity"))] == expected
    assert [c for c, _ in runs(commands(REFERENCE, "max_velocity", (2.0, 1.0, 2.0)))][:2] == [(-2.0, 0, 0), (0, 0, 0)]


def test_a_clock_that_ran_for_whole_sub_commands_leaks_the_next_command():
    """After six sub-commands of 300 steps each the rounding errors have brought the clock one step ahead."""
    assert schedule(REFERENCE).sub_commands["diagonal_velocity"][5][-1] == (0.0, -1.0, 0.0)  # the seventh, (0, -)
    assert schedule(OWN).sub_commands["diagonal_velocity"][5][-1] == (-1.0, 0.0, 0.0)  # the sign-inverted sixth, (+, 0)


def test_the_references_clock_takes_a_step_from_the_last_sub_command_of_each_goal():
    for suite, short in ((REFERENCE, 1), (OWN, 0)):
        table = schedule(suite)
        assert [len(p) for p in table.sub_commands["diagonal_velocity"]] == [300] * 7 + [300 - short]
        assert [len(p) for p in table.sub_commands["max_velocity"]] == [350] * 5 + [350 - short]


def test_the_table_has_no_commands_for_the_target():
    table = schedule(REFERENCE)
    assert table.target_steps == {"slope": 1000, "wave": 1000, "stairs": 1500, "obstacle": 1500}
    row = table.first_row("target_pos_velocity", 0) + torch.arange(1501)
    assert not table.commands(row, torch.ones(1, 3, dtype=torch.float64)).any()


# ---- towards the target -----------------------------------------------------------------------------------------------


def towards(angle, distance, *, backward=False, speed=0.8):
    """Command with the target at a bearing [deg] and distance [m] in the body frame."""
    radians = math.radians(angle)
    offset = torch.tensor([[distance * math.cos(radians), distance * math.sin(radians)]], dtype=torch.float64)
    limit = torch.tensor([1.5], dtype=torch.float64)
    speeds = torch.tensor([speed], dtype=torch.float64)
    return target_command(offset, torch.tensor([backward]), speeds, limit)[0].tolist()


@pytest.mark.parametrize(
    ("angle", "distance", "expected"),
    [
        (0.0, 3.0, (0.8, 0.0, 0.0)),
        (10.0, 3.0, (0.8, 0.0, 2 * math.radians(10))),
        (-10.0, 0.2, (0.8, 0.0, -2 * math.radians(10))),
        (44.0, 3.0, (0.8, 0.0, 1.5)),  # twice the bearing is 1.536, above the limit
        (46.0, 3.0, (0.0, 1.0, 1.5)),
        (90.0, 0.3, (0.0, 0.3, 1.5)),
        (-135.0, 0.4, (0.0, -0.4 * math.sin(math.radians(45)), -1.5)),
    ],
)
def test_walking_forward(angle, distance, expected):
    assert towards(angle, distance) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("angle", "distance", "expected"),
    [
        (170.0, 2.0, (-0.8, 2.0 * math.sin(math.radians(170)), -2 * math.radians(10))),
        (-170.0, 2.0, (-0.8, -2.0 * math.sin(math.radians(170)), 2 * math.radians(10))),
        (136.0, 3.0, (-0.8, 1.0, -1.5)),
        (134.0, 0.5, (0.0, 0.5 * math.sin(math.radians(134)), -1.5)),
        (20.0, 2.0, (0.0, 0.0, -1.5)),
    ],
)
def test_walking_backward(angle, distance, expected):
    assert towards(angle, distance, backward=True) == pytest.approx(expected, abs=1e-9)


def state_at(position, roll=0.0, pitch=0.0, yaw=0.0):
    turn = Rotation.from_euler("xyz", [roll, pitch, yaw])
    turned = torch.from_numpy(turn.as_quat(scalar_first=True))[None]
    state = object.__new__(PhysicsState)
    state.base_position_w = torch.tensor([position], dtype=torch.float64)
    state.base_quaternion_w = turned
    return state


def test_offsets_of_an_upright_robot_agree_in_both_frames():
    state = state_at((1.0, 2.0, 0.3), yaw=math.pi / 2)
    target = torch.tensor([[1.0, 5.0, 0.7]], dtype=torch.float64)
    for frame in ("body", "horizontal"):
        assert target_offset(state, target, frame)[0].tolist() == pytest.approx([3.0, 0.0], abs=1e-12)


def test_height_leaks_into_the_bodys_frame_alone():
    """Nose down by 20 degrees, the target 0.4 m below: the body's x axis sees it 0.4 sin 20° further ahead."""
    state = state_at((0.0, 0.0, 1.0), pitch=math.radians(20))
    target = torch.tensor([[1.0, 0.0, 0.6]], dtype=torch.float64)
    ahead = math.cos(math.radians(20)) + 0.4 * math.sin(math.radians(20))
    assert target_offset(state, target, "body")[0].tolist() == pytest.approx([ahead, 0.0])
    assert target_offset(state, target, "horizontal")[0].tolist() == pytest.approx([1.0, 0.0])


def test_a_robot_on_its_nose_reaches_a_far_target_in_the_body_frame_alone():
    state = state_at((0.0, 0.0, 0.3), pitch=math.pi / 2)
    target = torch.tensor([[2.0, 0.0, 0.3]], dtype=torch.float64)
    assert torch.hypot(*target_offset(state, target, "body")[0]) < REFERENCE.commands.target_radius
    assert torch.hypot(*target_offset(state, target, "horizontal")[0]) == pytest.approx(2.0)
    assert REFERENCE.commands.target_distance == "body"
    assert OWN.commands.target_distance == "horizontal"


# ---- terrains -----------------------------------------------------------------------------------------------------------


def test_the_gauges_own_terrains_have_all_that_goals_need():
    for suite in (REFERENCE, OWN):
        for name in suite.matrix.terrains:
            check_terrain(suite, make_terrain(name, 0 if name == "flat" else 5), searched=name != "flat")


def test_terrains_that_lack_what_a_goal_needs_are_refused():
    with pytest.raises(SuiteError, match="terrain 'flat' has no target, so no level can be searched on it"):
        check_terrain(REFERENCE, ground(), searched=True)
    strange = replace(ground((1.0, 0.0, 0.0)), family="gravel", name="gravel")
    with pytest.raises(
        SuiteError, match=r"no commands.target_speed for terrain family 'gravel'; it has obstacle, slope"
    ):
        check_terrain(REFERENCE, strange, searched=True)
    check_terrain(REFERENCE, strange, searched=False)
    with pytest.raises(SuiteError, match="terrain 'gravel' has no spawn 'level_eval'"):
        check_terrain(REFERENCE, replace(strange, spawns={}), searched=False)
