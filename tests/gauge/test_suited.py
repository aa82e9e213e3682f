"""Commands within what a policy was made for, and its own control period."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from gaitgauge.gauge.coverage import coverage, notes
from gaitgauge.gauge.pipelines import make_environments
from gaitgauge.gauge.suite import Suite, SuiteError, load_suite
from gaitgauge.gauge.suited import beyond_in_words, changes, other_measure, shares_beyond, suited
from gaitgauge.policy.contract import PolicyContract, standard_contract
from gaitgauge.robots import load_robot
from sample_results import sample

GO2 = load_robot("go2")
PUBLISHED = load_suite("robogauge-1.1")


def contract(*limits: float, period: float = 0.02) -> PolicyContract:
    forward, lateral, yaw = limits
    return replace(standard_contract(GO2), command_limits=(forward, lateral, yaw), control_period=period)


def own(folder: Path, commands: str) -> Suite:
    file = folder / "own.toml"
    file.write_text(f'extends = "robogauge-1.1"\nname = "own"\nversion = "1"\n[commands]\n{commands}\n')
    return load_suite(str(file))


def test_a_published_suite_keeps_its_commands_and_counts_those_beyond():
    """On flat ground it asks for 2 m/s, 1 m/s and 2 rad/s in full, on stairs for other speeds: all of an axis, or none."""
    assert suited(PUBLISHED, contract(1.0, 1.0, 1.0)) is PUBLISHED
    assert PUBLISHED.commands.flat == (2.0, 1.0, 2.0)
    assert shares_beyond(PUBLISHED, {"flat"}, (1.0, 1.0, 1.0)) == {"forward": 1.0, "yaw": 1.0}
    assert shares_beyond(PUBLISHED, {"flat"}, (2.0, 1.0, 2.0)) == {}
    forward, lateral, yaw = PUBLISHED.commands.levelled
    assert forward < 2.0
    mixed = shares_beyond(PUBLISHED, {"flat", "stairs_fd"}, (forward, lateral, yaw))
    assert mixed["forward"] == pytest.approx(0.5)  # the same goals on both
    said = beyond_in_words((1.0, 0.4, 1.0), {"forward": 1.0, "lateral": 0.25})
    assert said == (
        "the suite asks for more than the policy was made for: 100 % of the commands forward (made for 1 m/s), "
        "25 % of the commands sideways (made for 0.4 m/s)"
    )
    assert beyond_in_words((1.0, 0.4, 1.0), {}) is None


def test_a_suite_of_shares_goes_by_the_policys_limits(tmp_path):
    speeds = "target_speed = { flat = 1.0, slope = 0.5, stairs = 0.5, obstacle = 0.5, wave = 0.5 }"
    suite = own(tmp_path, f'beyond = "scale"\nflat = [1.0, 0.5, 1.0]\nlevelled = [0.5, 0.5, 0.5]\n{speeds}')
    found = suited(suite, contract(1.5, 0.4, 1.0))
    assert found.commands.flat == (1.5, 0.2, 1.0)
    assert found.commands.levelled == (0.75, 0.2, 0.5)
    assert found.commands.target_speed["stairs"] == 0.75
    assert found.digest == suite.digest
    assert changes(found) == []
    with pytest.raises(
        SuiteError, match="command limit is 0 for sideways, and suite 'own' measures by the policy's own limits"
    ):
        suited(suite, contract(1.5, 0.0, 1.0))
    with pytest.raises(SuiteError, match=r"commands.beyond is 'scale', .* of a policy's limits; 2 is above 1"):
        own(tmp_path, 'beyond = "scale"')


def test_clipped_commands_make_a_result_custom(tmp_path):
    suite = own(tmp_path, 'beyond = "clip"')
    assert suite.digest != PUBLISHED.digest
    found = suited(suite, contract(1.0, 2.0, 1.0))
    assert found.commands.flat == (1.0, 1.0, 1.0)
    assert found.digest == suite.digest
    environments = make_environments(suite, terrains=suite.matrix.terrains, frictions=None, payloads=None, level=None)
    covered = coverage(found, environments, suite.matrix.seeds)
    assert covered.kind == "custom"
    assert covered.text == "commands clipped to the policy's limits (forward 1 of 2 m/s, turning 1 of 2 rad/s)"
    assert coverage(suited(suite, contract(2.0, 1.0, 2.0)), environments, suite.matrix.seeds).kind == "complete"


def test_a_policy_of_another_period_is_played_at_its_own():
    found = suited(PUBLISHED, contract(2.0, 1.0, 2.0, period=0.01))
    assert found.physics.control_period == pytest.approx(0.01)
    assert found.physics.timestep == PUBLISHED.physics.timestep
    assert changes(found) == ["control period 0.01 s of the policy, not 0.02 s"]
    slow = suited(PUBLISHED, contract(2.0, 1.0, 2.0, period=0.04))
    assert slow.metrics.interval >= slow.physics.substeps
    assert suited(PUBLISHED, contract(2.0, 1.0, 2.0, period=0.0173)) is PUBLISHED  # and is refused later


def test_no_suite_file_says_how_it_was_written(tmp_path):
    file = tmp_path / "own.toml"
    file.write_text('extends = "robogauge-1.1"\nname = "own"\nversion = "1"\n[written]\nname = "other"\n')
    with pytest.raises(SuiteError, match="written"):
        load_suite(str(file))


def test_notes_say_what_was_asked_beyond_the_limits():
    result = sample()
    beyond = replace(result.commands, limits=(1.0, 0.4, 1.0), beyond={"forward": 0.5})
    assert any("50 % of the commands forward" in note for note in notes(replace(result, commands=beyond)))


@pytest.mark.parametrize(
    ("suite", "robot", "said"),
    [("robogauge-1.1.8", "anymal_c", True), ("robogauge-1.1.8", "go1", False), ("gaitgauge-1", "anymal_c", False)],
)
def test_a_suite_of_fixed_measure_says_what_it_does_to_a_heavy_robot(suite, robot, said):
    sentence = other_measure(load_suite(suite), load_robot(robot))
    assert bool(sentence) == said
    if sentence:
        assert sentence.startswith("robogauge-1.1.8 judges torque and power as a Go2's") and "gaitgauge-1" in sentence
