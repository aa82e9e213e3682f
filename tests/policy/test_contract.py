import json
from dataclasses import replace

import pytest
from gaitgauge.policy.comparing import difference, other_width
from gaitgauge.policy.contract import (
    ContractError,
    History,
    ObservationTerm,
    PolicyContract,
    check_robot,
    standard_contract,
)
from gaitgauge.robots import load_robot

GO2_HASH = "a39d917c21f5da0f009218783dcf44cabfcd6e01b12999d81604a0d806afa182"


@pytest.fixture(scope="module")
def contract() -> PolicyContract:
    return standard_contract(load_robot("go2"))


def changed(contract: PolicyContract, **changes: object) -> dict:
    return {**json.loads(contract.to_json()), **changes}


def test_standard_contract_follows_the_published_interface(contract):
    assert contract.observation_width == contract.frame_width == 45
    assert contract.action_scale == (0.25,) * 12
    assert set(contract.stiffness) == {20.0}
    assert set(contract.damping) == {0.5}
    assert contract.control_period == 0.02
    assert contract.command_limits == (2.0, 1.0, 2.0)
    assert contract.default_joint_position == (0.1, 0.8, -1.5, -0.1, 0.8, -1.5, 0.1, 1.0, -1.5, -0.1, 1.0, -1.5)
    assert standard_contract(load_robot("go2"), history=History(length=5)).observation_width == 225


def test_hash_is_stable(contract):
    # Results and checkpoints bear this digest: it may only change together with the schema version.
    assert contract.hash == GO2_HASH


def test_json_round_trip_keeps_contract_and_hash(contract):
    again = PolicyContract.from_json(contract.to_json())
    assert again == contract
    assert again.hash == contract.hash


def test_hash_ignores_provenance_and_number_types(contract):
    assert replace(contract, provenance={"run": "x"}).hash == contract.hash
    assert replace(contract, stiffness=(20,) * 12).hash == contract.hash
    assert replace(contract, stiffness=(21,) * 12).hash != contract.hash


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"stiffness": [20.0] * 11}, "stiffness"),
        ({"stiffness": [float("nan")] * 12}, "stiffness"),
        ({"damping": "0.5"}, "damping"),
        ({"stiffness": [-20.0] * 12}, r"stiffness\[0\] is -20.0; it must be greater than or equal to 0"),
        ({"stiffness": [1e300] * 12}, r"stiffness\[0\] is 1e\+300; it must be less than or equal to 10000"),
        ({"damping": [-0.5] * 12}, r"damping\[0\] is -0.5"),
        ({"damping": [1e9] * 12}, r"damping\[0\] is"),
        ({"action_scale": [1e300] * 12}, r"action_scale\[0\] is"),
        ({"action_clip": 1e300}, "action_clip is"),
        ({"default_joint_position": [99.0] * 12}, r"default_joint_position\[0\] is 99.0"),
        ({"control_period": -0.02}, "control_period is -0.02"),
        ({"control_period": 1e-300}, "control_period is 1e-300; it must be greater than or equal to 0.0005"),
        ({"control_period": 1e9}, "control_period is"),
        ({"command_limits": [-2, 1, 2]}, r"command_limits\[0\] is -2; it must be greater than or equal to 0"),
        ({"command_limits": [1e300, 1, 2]}, r"command_limits\[0\] is"),
        ({"target_range": [[1.0, -1.0]] * 12}, "target_range of 'FL_hip_joint' is 1 to -1 rad; it must rise"),
        ({"target_range": [[-1e300, 1.0]] * 12}, "target_range"),
        ({"observation": [{"name": "command", "scale": [1e300]}]}, r"observation\[0\].scale\[0\] is"),
        (
            {"observation": [{"name": "command", "scale": [1.0], "clip": [1.0, -1.0, 1.0]}]},
            r"observation\[0\].clip",
        ),
        ({"action_scale": [True] * 12}, "action_scale"),
        ({"control_period": 0}, "control_period"),
        ({"command_limits": [1, 1]}, "command_limits"),
        ({"joint_names": ["a"] * 12}, "joint_names"),
        ({"joint_names": "FL_hip_joint"}, "joint_names"),
        ({"robot": 3}, "robot"),
        ({"schema_version": 2}, "schema_version"),
        ({"observation": []}, "observation"),
        ({"observation": 3}, "observation"),
        ({"observation": [{"name": {}, "scale": [1.0]}]}, r"observation\[0\].name is"),
        ({"action_clip": 10**400}, "action_clip"),
        ({"target_range": [1.0] * 12}, "target_range"),
        ({"observation": [{"name": "smell", "scale": [1.0]}]}, "smell"),
        ({"observation": [{"name": "command", "scale": [1.0, 2.0]}]}, "observation.command.scale"),
        ({"observation": [{"name": "command"}]}, "scale"),
        ({"observation": [{"name": "command", "scale": [1.0], "weight": 1}]}, "weight"),
        (
            {"observation": [{"name": "command", "scale": [1.0], "clip": -1}]},
            r"observation\[0\].clip is -1; it must be greater than 0",
        ),
        ({"history": {"length": 10**9}}, "history.length is 1000000000; it must be less than or equal to 1000"),
        ({"history": {"length": True}}, "history.length is True"),
        (
            {"provenance": {"a": [[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]}},
            "nested too deep",
        ),
        ({"joint_names": ["a\x1b[31m"] * 12}, "joint_names"),
        ({"stiffness": {"a": "x" * 10_000}}, "stiffness"),
        ({"observation": [{"name": "command", "scale": [1.0]}] * 2}, "twice"),
        ({"history": {"length": 0}}, "history.length"),
        ({"history": {"order": "upwards"}}, "history.order"),
        ({"history": {"start": "ones"}}, "history.start"),
        ({"history": 5}, "history"),
        ({"target_range": [[-1.0, 1.0]]}, "target_range"),
        ({"gains": 1}, "gains"),
        ({"provenance": "me"}, "provenance"),
    ],
)
def test_malformed_contracts_are_refused_by_name(contract, changes, named):
    with pytest.raises(ContractError, match=named) as caught:
        PolicyContract.from_dict(changed(contract, **changes))
    assert str(caught.value).isprintable() and len(str(caught.value)) < 300


def test_missing_field_and_bad_json(contract):
    data = changed(contract)
    del data["damping"]
    with pytest.raises(ContractError, match="it lacks damping"):
        PolicyContract.from_dict(data)
    with pytest.raises(ContractError, match="JSON"):
        PolicyContract.from_json("{")
    with pytest.raises(ContractError, match="table"):
        PolicyContract.from_json("[]")
    for text in ("[" * 100_000, '{"robot": ' * 1000, "9" * 5000, " " * 2_000_000):
        with pytest.raises(ContractError, match="contract is not"):
            PolicyContract.from_json(text)


def test_check_robot_gives_the_joint_map(contract):
    robot = load_robot("go2")
    assert check_robot(contract, robot) == tuple(range(12))
    order = (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8)
    permuted = replace(contract, joint_names=tuple(robot.joint_names[i] for i in order))
    assert check_robot(permuted, robot) == order


def test_check_robot_refuses_other_joints_and_robots(contract):
    robot = load_robot("go2")
    renamed = replace(contract, joint_names=("tail", *contract.joint_names[1:]))
    with pytest.raises(ContractError, match=r"tail.*FL_hip_joint"):
        check_robot(renamed, robot)
    with pytest.raises(ContractError, match="'a1'"):
        check_robot(replace(contract, robot="a1"), robot)


def test_difference_names_the_fields(contract):
    assert difference(contract, replace(contract, provenance={"run": "x"})) == ""
    other = replace(
        contract,
        control_period=0.01,
        history=History(length=5),
        observation=(*contract.observation[:-1], ObservationTerm(name="last_action", scale=(2.0,))),
    )
    lines = difference(contract, other).splitlines()
    assert sorted(line.partition(":")[0] for line in lines) == [
        "control_period",
        "history.length",
        "observation.last_action.scale",
    ]
    assert "control_period: 0.02 -> 0.01" in lines


def test_a_width_that_is_some_frames_says_how_to_write_them():
    one = replace(standard_contract(load_robot("go2")), history=History(length=1))
    sentence = other_width(one, 225)
    assert "observation has 45 (base_angular_velocity_b 3, projected_gravity_b 3, command 3, " in sentence
    assert sentence.endswith("; 5 frames are 225: history = { length = 5 }")
    assert other_width(one, 47).endswith("last_action 12)")
