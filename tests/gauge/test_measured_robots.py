"""Evaluations under a measured parameter set: gains that act, the measured delay, what is recorded."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from gaitgauge.backends.base import BackendError, PhysicsOptions, Scene
from gaitgauge.backends.registry import make_backend
from gaitgauge.gauge.evaluate import identity, prepare
from gaitgauge.gauge.motors import gains_note, joint_parameters
from gaitgauge.gauge.play.control_step import fixed_delay
from gaitgauge.gauge.request import Request
from gaitgauge.robots import RobotError, load_robot
from gaitgauge.robots.loading import robot_digest
from gaitgauge.robots.motor_network import MotorNetwork, save_motor_network
from gaitgauge.robots.sets import find_set, network_text, set_text
from gaitgauge.terrains.registry import make_terrain

GO2 = load_robot("go2", check=False)
MEASURED = {
    "stiffness": GO2.parameters["gauge"].stiffness,
    "damping": GO2.parameters["gauge"].damping,
    "torque_limit": GO2.parameters["gauge"].torque_limit,
    "driving_torque_limit": GO2.parameters["gauge"].driving_torque_limit,
    "full_torque_speed": GO2.parameters["gauge"].full_torque_speed,
    "no_load_speed": GO2.parameters["gauge"].no_load_speed,
    "armature": [0.02] * 12,
    "joint_damping": [0.05] * 12,
    "friction_loss": [0.3] * 12,
    "stiffness_factor": [1.0, 1.0, 0.8] * 4,
    "damping_factor": [1.1] * 12,
    "target_offset": [0.01] * 12,
    "delay": 0.0064,
}


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(set_text(GO2, "mine", MEASURED, "made for a test", notes=["a remark"]), encoding="utf-8")
    return path


def test_a_written_set_is_read_back(file):
    name, found = find_set(GO2, str(file))
    assert name == "mine" and found.measured == "made for a test" and found.delay == 0.0064
    assert found.stiffness_factor == (1.0, 1.0, 0.8) * 4 and found.torque_limit == GO2.parameters["gauge"].torque_limit
    assert find_set(GO2, f"{file}:mine")[1] == found
    with pytest.raises(RobotError, match="holds mine, not 'other'"):
        find_set(GO2, f"{file}:other")
    with pytest.raises(RobotError, match=r"no parameter set 'nope'; it has gauge, .* or give FILE.toml"):
        find_set(GO2, "nope")


def test_motors_that_a_suite_cannot_call_are_refused_before_anything_is_played(tmp_path):
    weights = {"weight_0": np.zeros((1, 2)), "bias_0": np.zeros(1)}
    network = MotorNetwork(kind="feed-forward", arrays=weights)
    save_motor_network(network, tmp_path / "net.npz")
    text = network_text(GO2, "net", GO2.parameters["gauge"], network, passive=True)
    (tmp_path / "net.toml").write_text(text, encoding="utf-8")
    with pytest.raises(BackendError, match="a call every 5 ms, which physics steps of 2 ms"):
        prepare(Request(policy="pretrained", suite="demo", parameters=str(tmp_path / "net.toml")))


def test_an_evaluation_plays_the_set_and_records_it(file):
    nominal = prepare(Request(policy="pretrained", suite="demo"))
    asked = prepare(Request(policy="pretrained", suite="demo", parameters=str(file)))
    contract = asked.policy.contract
    acting = joint_parameters(asked.suite, asked.robot, contract)
    usual = joint_parameters(nominal.suite, nominal.robot, contract)
    assert acting.stiffness == pytest.approx([k * f for k, f in zip(usual.stiffness, (1.0, 1.0, 0.8) * 4, strict=True)])
    assert acting.damping == pytest.approx([1.1 * d for d in usual.damping]) and acting.stiffness_factor is None
    assert acting.armature == (0.02,) * 12 and asked.suite.digest == nominal.suite.digest
    assert gains_note(asked.suite, asked.robot, contract) == "measured motors: made for a test"
    assert "parameters" not in identity(nominal) and len(identity(asked)["parameters"]) == 64


def test_measured_sets_do_not_change_which_robot_it_is(file):
    more = replace(GO2, parameters={**GO2.parameters, "mine": find_set(GO2, str(file))[1]})
    assert robot_digest(more) == robot_digest(GO2)


def scene_of(file, **physics):
    found = find_set(GO2, str(file))[1].commanded((20.0,) * 12, (0.5,) * 12)
    flat = (make_terrain("flat", None),)
    return Scene(robot=GO2, parameters=found, terrains=flat, terrain_index=(0, 0), physics=PhysicsOptions(**physics))


def test_a_measured_delay_takes_the_place_of_the_latency(file):
    cpu = torch.device("cpu")
    assert fixed_delay(scene_of(file), 2, cpu).tolist() == [3, 3]  # 6.4 ms at 2 ms steps
    nominal = replace(scene_of(file), parameters=GO2.parameters["gauge"])
    assert fixed_delay(nominal, 2, cpu) is None
    with pytest.raises(BackendError, match=r"a delay of 6.4 ms; a control period, 4 ms, is the most"):
        fixed_delay(scene_of(file, substeps=2), 2, cpu)


def test_an_offset_acts_in_the_engine(file):
    backend = make_backend("mujoco", scene_of(file))
    backend.reset(replace(backend.standing(), held_target=None))
    start = backend.state.joint_position.clone()
    backend.step(start, substeps=1)
    expected = torch.tensor([0.2, 0.2, 0.16] * 4, dtype=torch.float64)  # kp · factor · offset
    torch.testing.assert_close(backend.state.joint_torque[0], expected, atol=1e-9, rtol=0.0)


@pytest.mark.parametrize("between", [".", "/", " "])
def test_a_set_is_read_back_whatever_joints_and_provenance_hold(tmp_path, between):
    names = tuple(name.removesuffix("_joint").replace("_", between) for name in GO2.joint_names)
    robot = replace(GO2, joint_names=names)
    own, values = GO2.parameters["gauge"], tuple(0.01 + 0.001 * i for i in range(12))
    fields = ("stiffness", "damping", "torque_limit", "joint_damping", "friction_loss")
    mine = {field: getattr(own, field) for field in fields} | {"armature": values}
    text = set_text(robot, "mine", mine, 'two\nlines "of" it')
    file = tmp_path / "mine.toml"
    file.write_text(text)
    found = find_set(robot, str(file))[1]
    assert found.armature == pytest.approx(values) and found.measured == 'two\nlines "of" it'
