"""The benchmark that watches for legs that strike each other: poses whose contacts are known."""

import mujoco
import pytest
from gaitgauge.robots.registry import load_robot
from leg_contacts import self_contacts


@pytest.mark.parametrize(
    ("changed", "pairs"),
    [
        ({}, set()),
        # hips 0.0465 m from the middle and 0.0955 m wide, legs 0.311 m long: at 0.4 rad inwards the front feet, of radius
        # 0.022 m, are 0.0465 + 0.0955 cos 0.4 - 0.311 sin 0.4 = 0.013 m from the middle, the calves' lower ends 0.03 m
        ({"FL_hip_joint": -0.4, "FR_hip_joint": 0.4}, {"FL–FR"}),
        ({"FL_hip_joint": -0.2, "FR_hip_joint": 0.2}, set()),
    ],
)
def test_feet_that_meet(changed, pairs):
    robot = load_robot("go2")
    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    data = mujoco.MjData(model)
    for name, angle in zip(robot.joint_names, robot.default_joint_position, strict=True):
        data.qpos[model.joint(name).qposadr[0]] = changed.get(name, angle)
    assert self_contacts(model, data) == pairs
