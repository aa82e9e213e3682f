"""What a result says of its policy and of the feet: training physics, limits, assumptions, contact."""

from dataclasses import replace

import pytest
from gaitgauge.backends.registry import find_backend
from gaitgauge.gauge.described import UNSTATED, assumptions, command_shares, played_feet, training_physics
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.contract import standard_contract
from gaitgauge.robots import load_robot

GO2 = load_robot("go2")


def contract(**provenance):
    return standard_contract(GO2, provenance=provenance)


def test_training_physics_is_what_the_policys_file_says():
    engine = {"engine": "mujoco-warp", "version": "3.17.0", "settings": {"timestep": 0.005, "foot_condim": 3}}
    found = training_physics(contract(physics={"trained": [engine], "tuned": [{"engine": "mujoco"}]}))
    assert [(e.engine, e.version, dict(e.settings)) for e in found.trained] == [tuple(engine.values())]
    assert [e.engine for e in found.tuned] == ["mujoco"] and found.note is None


@pytest.mark.parametrize("stated", [None, 3, {"trained": [{"engine": 7}]}, {"trained": "mujoco"}])
def test_a_file_that_does_not_say_gets_a_note(stated):
    found = training_physics(contract(**({} if stated is None else {"physics": stated})))
    assert found.trained == found.tuned == () and found.note.startswith(UNSTATED)


def test_assumptions_of_importers_are_sentences():
    assert assumptions(contract()) == ()
    assert assumptions(contract(assumed="gains of the robot", assumptions=["one\nline", 3])) == (
        *("one line", "3"),
        "gains of the robot",
    )


def test_shares_beyond_the_limits_stand_beside_these():
    slow = replace(contract(), command_limits=(100.0, 100.0, 0.1))
    found = command_shares(load_suite("demo"), slow, ["flat"])
    assert found.limits == (100.0, 100.0, 0.1) and dict(found.beyond) == {"yaw": 1.0}


@pytest.mark.parametrize(("asked", "dimension"), [(None, 6), (3, 3), (4, 4)])
def test_feet_are_the_models_or_the_suites(asked, dimension):
    suite = load_suite("demo")
    suite = replace(suite, physics=replace(suite.physics, foot_condim=asked))
    feet = played_feet(suite, GO2, find_backend("mujoco", "cpu"))
    assert feet.dimension == (dimension,)
    assert feet.torsion == (0.0 if dimension == 3 else pytest.approx(0.02, abs=0.02)) and (feet.torsion > 0) == (
        dimension > 3
    )
