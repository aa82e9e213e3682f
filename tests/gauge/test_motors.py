"""Gains: whose a policy is played with, and what is said of it."""

from dataclasses import replace

import pytest
from gaitgauge.gauge.motors import gains_note, joint_parameters
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.contract import ContractError, ObservationTerm, kind_of_observations, standard_contract
from gaitgauge.robots import RobotError
from scripted_gauge import GO2

OWN, REFERENCE = load_suite("gaitgauge-1"), load_suite("robogauge-1.1")
USUAL = standard_contract(GO2)
STIFF = replace(USUAL, stiffness=(80.0,) * 12, damping=(5.0,) * 12)


def test_a_contract_of_80_and_5_is_played_with_80_and_5():
    """It was played with 20 and 0.5 in silence."""
    played = joint_parameters(OWN, GO2, STIFF)
    assert set(played.stiffness) == {80.0} and set(played.damping) == {5.0}
    assert replace(played, stiffness=(20.0,) * 12, damping=(0.5,) * 12) == GO2.parameters["gauge"]
    assert "played with kp 80 N·m/rad and kd 5 N·m·s/rad, as the policy's contract says" in gains_note(OWN, GO2, STIFF)


def test_the_reference_keeps_its_gains_and_says_so():
    assert joint_parameters(REFERENCE, GO2, STIFF) == GO2.parameters["gauge"]
    assert gains_note(REFERENCE, GO2, STIFF) == (
        "played with kp 20 N·m/rad and kd 0.5 N·m·s/rad, as robogauge-1.1 plays every policy; this one was made for "
        "kp 80 N·m/rad and kd 5 N·m·s/rad"
    )


def test_nothing_is_said_where_all_agree():
    for suite in (OWN, REFERENCE):
        assert joint_parameters(suite, GO2, USUAL) == GO2.parameters["gauge"]
        assert gains_note(suite, GO2, USUAL) is None


def test_gains_go_to_the_joints_that_they_are_for():
    order = tuple(reversed(USUAL.joint_names))
    contract = replace(USUAL, joint_names=order, stiffness=tuple(float(n) for n in range(1, 13)))
    played = joint_parameters(OWN, GO2, contract)
    assert dict(zip(GO2.joint_names, played.stiffness, strict=True)) == dict(
        zip(order, contract.stiffness, strict=True)
    )
    assert "kp 1 to 12 N·m/rad" in gains_note(OWN, GO2, contract)


def test_a_robot_without_the_suite_s_parameters_is_one_sentence():
    suite = replace(OWN, parameters="heavy")
    for ask in (joint_parameters, gains_note):
        with pytest.raises(
            RobotError, match=r"suite 'gaitgauge-1' needs the joint parameters 'heavy', .*; it has gauge"
        ):
            ask(suite, GO2, USUAL)


# ---- what a robot can measure -----------------------------------------------------------------------------------------


def test_a_base_linear_velocity_is_privileged():
    """It was read exactly, without noise and without a mark; ``test_cheats.py`` has the name of its score."""
    told = replace(
        USUAL, observation=(ObservationTerm(name="base_linear_velocity_b", scale=(2.0,)), *USUAL.observation)
    )
    assert (kind_of_observations(USUAL), kind_of_observations(told)) == ("measurable", "privileged")


@pytest.mark.parametrize("name", ["base_height", "foot_contact_force", "friction"])
def test_what_else_no_robot_measures_is_refused(name):
    with pytest.raises(ContractError, match="unknown observation term"):
        ObservationTerm(name=name, scale=(1.0,))
