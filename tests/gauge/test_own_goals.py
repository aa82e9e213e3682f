"""Goals that are data: what a suite of one's own commands over time."""

import csv
import json

import pytest
import torch
from gaitgauge.gauge.evaluate import Request, evaluate, prepare
from gaitgauge.gauge.goals import Schedule, command_name
from gaitgauge.gauge.suite import SuiteError, load_suite

SLALOM = """
extends = "{base}"
name = "slalom"
push = false

[[goals]]
name = "slalom"
sub_commands = [
  [{{ seconds = 0.2, velocity = [1.0, 0.0, 0.0] }}, {{ seconds = 0.1, velocity = [0.5, 0.0, -1.0] }}],
  [{{ seconds = 0.2, velocity = [-0.5, 1.0, 0.0] }}],
]

[[goals]]
name = "target_pos_velocity"

[matrix]
terrains = ["flat"]
frictions = [0.6]
payloads = [0.0]
seeds = [0, 1]

[metrics]
interval = 10
"""


@pytest.fixture
def suite_file(tmp_path):
    def write(text: str = SLALOM, base: str = "gaitgauge-1") -> str:
        path = tmp_path / "slalom.toml"
        path.write_text(text.format(base=base))
        return str(path)

    return write


def test_phases_follow_each_other_as_multiples_of_the_limits(suite_file):
    schedule = Schedule(load_suite(suite_file()), torch.device("cpu"), torch.float64)
    first, second = schedule.sub_commands["slalom"]
    assert first == ((1.0, 0.0, 0.0),) * 10 + ((0.5, 0.0, -1.0),) * 5 and second == ((-0.5, 1.0, 0.0),) * 10
    rows = schedule.first_row("slalom", 0) + torch.tensor([0, 10, 11])
    commands = schedule.commands(rows, torch.tensor([2.0, 1.0, 1.5], dtype=torch.float64))
    assert commands.tolist() == [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [1.0, 0.0, -1.5]]
    assert command_name("slalom", 1) == "slalom 2"


@pytest.mark.parametrize("base", ["gaitgauge-1", pytest.param("robogauge-1.1", marks=pytest.mark.slow)])
def test_a_suite_with_goals_of_its_own_is_played_and_scored(suite_file, tmp_path, base):
    request = Request(policy="pretrained", suite=suite_file(base=base), pipeline="multi")
    result = evaluate(request, tmp_path / "run")
    assert 0.0 < result.score < 1.0
    [row] = result.environments
    assert row.runs[0].commands.keys() == {"slalom 1", "slalom 2"}
    lines = list(csv.DictReader((tmp_path / "run" / "episodes.csv").open()))
    assert [r["command"] for r in lines if r["seed"] == "1"] == ["all", "slalom 1", "slalom 2"]
    assert json.loads((tmp_path / "run" / "results.json").read_text())["score"] == result.score


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("sub_commands = [", "unknown = [", "unknown field 'goals"),
        ("velocity = [1.0,", "velocity = [1.5,", "commands 1.5 times a limit"),
        (
            'name = "slalom"\nsub',
            'name = "slalom"\nphases = [1.0]\nsub',
            "has phases or sub_commands that it cannot have",
        ),
        ('name = "slalom"\nsub', 'name = "max_velocity"\nphases = [1.0, 1.0]\nsub', "that it cannot have"),
        (
            'name = "target_pos_velocity"',
            'name = "joystick"',
            "the goal 'joystick' has no commands; give it sub_commands",
        ),
        (
            'name = "target_pos_velocity"',
            'name = "slalom_wide"\nsub_commands = [[{{ seconds = 1.0, velocity = [1.0, 0.0, 0.0] }}]]',
            "goals must differ in their first word",
        ),
    ],
)
def test_goals_that_cannot_be_played_are_refused(suite_file, old, new, sentence):
    with pytest.raises(SuiteError, match=sentence):
        load_suite(suite_file(SLALOM.replace(old, new)))


@pytest.mark.parametrize(
    ("text", "pipeline", "terrains", "sentence"),
    [
        (
            SLALOM.replace('name = "target_pos_velocity"', 'name = "max_velocity"\nphases = [1.0, 1.0]'),
            "stress",
            ("wave",),
            "no level",
        ),
        (SLALOM[: SLALOM.index("[[goals]]")] + SLALOM[SLALOM.rindex("[[goals]]") :], "stress", ("flat",), "no quality"),
    ],
)
def test_a_suite_without_a_goal_that_the_run_needs_is_refused(suite_file, text, pipeline, terrains, sentence):
    request = Request(policy="pretrained", suite=suite_file(text), pipeline=pipeline, terrains=terrains)
    with pytest.raises(SuiteError, match=f"so it (searches|measures) {sentence}"):
        prepare(request)
