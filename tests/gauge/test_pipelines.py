"""The environments of pipelines."""

import pytest
from gaitgauge.gauge.pipelines import make_environments
from gaitgauge.gauge.suite import SuiteError, load_suite

REFERENCE, OWN = load_suite("robogauge-1.1"), load_suite("gaitgauge-1")


def matrix(suite, **choices):
    arguments = {"terrains": suite.matrix.terrains, "frictions": None, "payloads": None, "level": None, **choices}
    return make_environments(suite, **arguments)


def test_the_reference_has_63_environments():
    found = matrix(REFERENCE)
    assert len(found) == 63 == len({e.key for e in found})
    assert {e.payload for e in found} == {0.0}
    assert sum(e.searched for e in found) == 54
    assert [e.level for e in found if e.terrain == "flat"] == [0] * 9


def test_the_own_suite_has_payload_on_an_axis_of_its_own():
    found = matrix(OWN)
    assert len(found) == 7 * (9 + 4)
    pairs = {(e.friction, e.payload) for e in found if e.terrain == "wave"}
    assert pairs == {(f, 0.0) for f in OWN.matrix.frictions} | {(0.6, p) for p in (-1.0, 0.0, 1.0, 2.0, 3.0)}


@pytest.mark.parametrize(
    ("choices", "pairs"),
    [
        ({"frictions": [0.2, 0.6]}, [(0.2, 0.0), (0.6, 0.0)]),
        ({"payloads": [3.0]}, [(0.6, 3.0)]),
        ({"frictions": [0.2], "payloads": [1.0, 3.0]}, [(0.2, 1.0), (0.2, 3.0)]),
        ({"frictions": [0.25]}, [(0.25, 0.0)]),
        ({"payloads": [5.0]}, [(0.6, 5.0)]),
        ({"frictions": [0.6, 0.6], "payloads": [1.0, 1.0]}, [(0.6, 1.0)]),
    ],
)
def test_chosen_frictions_and_payloads_of_the_own_suite(choices, pairs):
    found = matrix(OWN, terrains=["wave"], **choices)
    assert [(e.friction, e.payload) for e in found] == pairs


def test_the_reference_crosses_payloads_with_frictions():
    assert len(matrix(REFERENCE, terrains=["wave"], payloads=[0.0, 2.0])) == 18


@pytest.mark.parametrize("level", [0, 11, -1])
def test_levels_that_do_not_exist_are_refused(level):
    with pytest.raises(SuiteError, match=f"level {level} does not exist; choose 1 to 10"):
        matrix(REFERENCE, level=level)


def test_keys_tell_close_frictions_apart():
    one, other = matrix(REFERENCE, terrains=["wave"], frictions=[0.6, 0.60000001])
    assert one.key == "wave-f0.6-m0"
    assert one.key != other.key
