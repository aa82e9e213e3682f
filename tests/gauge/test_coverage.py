"""What a result may call itself: the whole suite, a part of it, or something of one's own."""

from dataclasses import replace

import pytest
from gaitgauge.gauge.coverage import coverage, score_label, suite_label
from gaitgauge.gauge.pipelines import make_environments
from gaitgauge.gauge.result import AxisCoverage
from gaitgauge.gauge.suite import load_suite
from sample_results import PIPELINES, read, sample

REFERENCE, OWN = load_suite("robogauge-1.1"), load_suite("gaitgauge-1")


def covered(suite, *, seeds=None, pipeline="stress", **choices):
    arguments = {"terrains": suite.matrix.terrains, "frictions": None, "payloads": None, "level": None, **choices}
    environments = make_environments(suite, **arguments)
    return coverage(suite, environments, suite.matrix.seeds if seeds is None else seeds, pipeline=pipeline)


@pytest.mark.parametrize("name", ["robogauge-1.1", "gaitgauge-1", "demo", "mid", "quick"])
def test_all_of_a_suite_is_complete(name):
    found = covered(load_suite(name))
    assert (found.kind, found.text, found.levels) == ("complete", "complete", ())
    assert not any(
        axis.missing or axis.foreign for axis in (found.terrains, found.frictions, found.payloads, found.seeds)
    )


def test_all_of_a_suite_named_one_by_one_is_complete():
    matrix = REFERENCE.matrix
    found = covered(REFERENCE, frictions=matrix.frictions[::-1], payloads=(0.0,), seeds=(2, 0, 1))
    assert found.kind == "complete"
    assert found.environments == (63, 63)


@pytest.mark.parametrize(
    ("suite", "choices", "text"),
    [
        (REFERENCE, {"terrains": ["wave", "obstacle"], "frictions": [0.6]}, "2 of 7 terrains, 1 of 9 frictions"),
        (REFERENCE, {"seeds": [1]}, "1 of 3 seeds"),
        (OWN, {"frictions": OWN.matrix.frictions}, "1 of 5 payloads"),
        (OWN, {"payloads": [3.0]}, "1 of 9 frictions, 1 of 5 payloads"),
        (REFERENCE, {"terrains": ["wave"], "pipeline": "level"}, "1 of 7 terrains, levels alone"),
    ],
)
def test_a_part_says_which(suite, choices, text):
    found = covered(suite, **choices)
    assert (found.kind, found.text) == ("part", text)


def test_a_part_is_data_too():
    found = covered(REFERENCE, terrains=["wave"], frictions=[0.4, 0.6], seeds=[0, 2])
    assert found.environments == (2, 63)
    assert found.frictions == AxisCoverage(played=(0.4, 0.6), missing=(0.2, 0.3, 0.5, 0.7, 0.8, 0.9, 1.0), foreign=())
    assert found.seeds == AxisCoverage(played=(0, 2), missing=(1,), foreign=())
    assert found.terrains.played == ("wave",)


@pytest.mark.parametrize(
    ("suite", "choices", "text"),
    [
        (REFERENCE, {"frictions": [9.0]}, "friction 9"),
        (REFERENCE, {"terrains": ["wave"], "frictions": [9.0, 0.6]}, "further friction 9, 1 of 7 terrains"),
        (REFERENCE, {"seeds": [77]}, "seed 77"),
        (REFERENCE, {"seeds": [0, 1, 2, 3]}, "further seed 3"),
        (REFERENCE, {"payloads": [0.0, 2.5]}, "further payload 2.5 kg"),
        (REFERENCE, {"terrains": [*REFERENCE.matrix.terrains, "bars"]}, "further terrain bars"),
        (REFERENCE, {"level": 5}, "level 5 given, not searched for"),
        (
            OWN,
            {"frictions": OWN.matrix.frictions, "payloads": OWN.matrix.payloads},
            "pairs of friction and payload that the suite does not have",
        ),
    ],
)
def test_values_that_the_suite_does_not_have_make_a_run_custom(suite, choices, text):
    found = covered(suite, **choices)
    assert (found.kind, found.text) == ("custom", text)


def test_only_a_complete_run_carries_the_suites_name_and_a_bare_score():
    def named(**choices):
        found = replace(sample("base", **PIPELINES["base"]), coverage=covered(REFERENCE, **choices))
        return suite_label(found), score_label(found)

    assert named() == ("robogauge-1.1 1.1.0, complete", "score")
    assert named(terrains=["wave"]) == ("a part of robogauge-1.1 1.1.0", "score of a part (1 of 7 terrains)")
    assert named(seeds=[9]) == ("custom, after robogauge-1.1 1.1.0", "score of a custom run (seed 9)")


def test_results_from_before_are_not_taken_for_complete():
    data = sample("base", **PIPELINES["base"]).to_data()
    del data["coverage"]
    data["schema"] = 2
    old = read(data)
    assert old.coverage.kind == "unknown" and not old.complete
    assert "unknown" in suite_label(old)
    assert score_label(old) != "score"
