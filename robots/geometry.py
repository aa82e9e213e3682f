"""Numbers that follow from a robot's MuJoCo model: joint ranges, mass, the span of its feet. Imports MuJoCo when asked."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from .base import Robot


def joint_ranges(robot: Robot) -> NDArray[np.float64]:
    """Lower and upper limit of every joint in the robot's order [rad], (J, 2)."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    return np.array([model.joint(name).range for name in robot.joint_names])


def stance_span(robot: Robot) -> float:
    """Largest horizontal distance between two feet in the default pose [m]: the diagonal stance span."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    data = mujoco.MjData(model)
    for name, angle in zip(robot.joint_names, robot.default_joint_position, strict=True):
        data.joint(name).qpos[0] = angle
    mujoco.mj_kinematics(model, data)
    feet = [data.site(name).xpos[:2] for name in robot.foot_names]
    return float(max(np.linalg.norm(a - b) for a, b in combinations(feet, 2)))


def total_mass(robot: Robot) -> float:
    """Mass of the whole robot [kg]."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    return float(model.body_mass.sum())
