"""Quality by direction and command, and the scores of known policies beside a score."""

from dataclasses import replace
from pathlib import Path

import pytest
from gaitgauge.gauge.report.breakdown import breakdown, command_label, own_parts
from gaitgauge.gauge.report.references import comparable, reference_table, references_for
from gaitgauge.gauge.result import Coverage, Run, read_result
from gaitgauge.gauge.store import StoreError
from gaitgauge.gauge.suite import load_suite
from sample_results import PIPELINES, sample
from sample_results import row as sample_row


def row(terrain, *runs):
    found = {seed: Run(columns={"quality": 0.5}, commands=run) for seed, run in enumerate(runs)}
    return sample_row(terrain, runs=found)


def test_means_over_seeds_and_environments_then_over_terrains():
    rows = [
        row("flat", {"max_velocity +x": 0.8, "max_velocity -y": 0.6}, {"max_velocity +x": 0.6}),
        row("flat", {"max_velocity +x": 0.4, "diagonal_velocity +x-y": 0.2}),
        row("wave", {"max_velocity +x": 0.1}),
        row("wave"),  # nothing was played
    ]
    found = breakdown(rows)
    assert found["command"]["full speed, then stop: forward"] == {
        "mean": pytest.approx((0.6 + 0.1) / 2),
        "flat": pytest.approx(0.6),
        "wave": pytest.approx(0.1),
    }
    forward, right = found["direction"]["forward"], found["direction"]["right"]
    assert forward["flat"] == pytest.approx((0.8 + 0.6 + 0.4 + 0.2) / 4)
    assert right == {"mean": pytest.approx(0.4), "flat": pytest.approx(0.4)}
    assert list(found["direction"]) == ["forward", "right"]
    assert breakdown([row("flat", {}), row("wave")]) == {}


def test_labels_of_commands():
    assert command_label("diagonal_velocity -x+y") == "there and back: backward and left"
    assert command_label("max_velocity -yaw") == "full speed, then stop: turning right"
    assert command_label("target_pos_velocity") == "to the target"
    assert command_label("own_goal +z") == "own goal +z"


def test_commands_of_a_suite_s_own_goals_are_told():
    result = sample()
    suite = load_suite("gaitgauge-biped-1")
    of = replace(result.suite, name=suite.name, digest=suite.digest)
    parts = own_parts(replace(result, suite=of))
    assert command_label("walk 3", parts) == "walk: 0.5 backward, then standing"
    assert (
        command_label("turn 1", parts)
        == "turn: 0.7 forward and 0.7 turning left, then 0.7 forward and 0.7 turning right"
    )
    found = breakdown([row("flat", {"walk 1": 0.8, "turn 1": 0.4, "walk 4": 0.2})], parts)
    assert found["direction"]["forward"]["flat"] == pytest.approx(0.6) and list(found["direction"]) == [
        "forward",
        "left",
        "turning left",
    ]
    assert next(iter(found["command"])) == "walk: forward, then standing"
    assert own_parts(replace(result, suite=replace(of, digest="0" * 64))) == {}, "other rules"


def result(suite="robogauge-1.1", version="1.1.0", kind="complete", score=0.6, sha="ab", **other):
    found = sample("base", **PIPELINES["base"])
    return replace(
        found,
        suite=replace(found.suite, name=suite, version=version),
        coverage=Coverage(kind=kind, text=kind),
        score=score,
        policy=replace(found.policy, file_sha256=sha),
        **other,
    )


def test_references_are_of_the_same_suite_and_beside_whole_runs_alone():
    scores = [r.score for r in references_for(result())]
    assert scores == [0.7319, 0.6739, 0.5148, 0.0801, 0.0331]
    ours = next(r for r in reference_table().reference if r.file_sha256)
    assert [r.score for r in references_for(result(sha=ours.file_sha256))] == [0.6739, 0.5148, 0.0801, 0.0331]
    newer = [r.score for r in references_for(result(suite="robogauge-1.1.8", version="1.0.0"))]
    assert newer == [0.7316, 0.6984, 0.6929, 0.6828, 0.6713, 0.5786, 0.5379, 0.5174, 0.5054]
    for other in ({"suite": "quick"}, {"version": "2.0.0"}, {"kind": "part"}, {"score": None}, {"backend": "newton"}):
        assert not references_for(result(**other))
    for reference in reference_table().reference:
        assert load_suite(reference.suite).version == reference.version, "the suite has moved on"


def test_references_that_were_measured_here_are_those_of_the_cards():
    folder = Path(__file__).parents[2] / "docs/data/scorecards"
    cards = [read_result(path, StoreError) for path in folder.glob("*.json*")]
    found = {(card.suite.name, card.policy.file_sha256): card for card in cards}
    measured = [r for r in reference_table().reference if r.file_sha256]
    for reference in measured:
        card = found[reference.suite, reference.file_sha256]
        assert card.complete, f"the card of {reference.policy} on {reference.suite} is of {card.coverage.text}"
        assert (reference.score, reference.robot) == (round(card.score, 4), card.robot)
        assert reference.interval == (card.score_interval and tuple(round(end, 4) for end in card.score_interval))
    current = {(name, sha) for (name, sha), c in found.items() if c.suite.version == load_suite(name).version}
    assert {(r.suite, r.file_sha256) for r in measured} == current, "a card of a suite as it is now gives a reference"


def test_which_scores_compare_is_said_with_an_example_that_does_not():
    demo = comparable(result(suite="demo", version="1.0.0"))
    assert demo == (
        "this score compares only with scores of demo 1.0.0 for the robot go2 on the engine mujoco; other suites have other "
        "scales: pretrained has 0.8210 on demo 1.0.0 and 0.7319 on robogauge-1.1 1.1.0"
    )
    go1 = comparable(result(robot="go1"))
    assert go1 == (
        "this score compares only with scores of robogauge-1.1 1.1.0 for the robot go1 on the engine mujoco; other suites have "
        "other scales: pretrained-go1 has 0.6826 on robogauge-1.1 1.1.0 and 0.6645 on gaitgauge-1 1.1.0"
    )
    assert comparable(result(robot="mine")).endswith("for the robot mine on the engine mujoco")
    assert [r.policy for r in references_for(result(robot="go1"))] == ["pretrained-go1"]
    part = replace(result(), coverage=Coverage(kind="part", text="2 of 7 terrains"))
    assert comparable(part).startswith(
        "this score compares only with runs of the same part (2 of 7 terrains) of robogauge-1.1"
    )
