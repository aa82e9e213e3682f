"""Numbers that follow from a robot's MuJoCo model: joint ranges, mass, the span of its feet. Imports MuJoCo when asked."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from .base import Robot
from .body_plan import default_pose, robot_model


def joint_ranges(robot: Robot) -> NDArray[np.float64]:
    """Lower and upper limit of every joint in the robot's order [rad], (J, 2); infinite where a joint has none."""
    model = robot_model(robot)
    ids = [model.joint(name).id for name in robot.joint_names]
    return np.where(model.jnt_limited[ids, None], model.jnt_range[ids], [-np.inf, np.inf])


def model_joint_order(robot: Robot) -> list[int]:
    """The robot's joints in the order in which the model has them behind the free joint: indices into ``joint_names``."""
    model = robot_model(robot)
    address = [int(model.joint(name).qposadr[0]) for name in robot.joint_names]
    return sorted(range(robot.num_joints), key=address.__getitem__)


def stance_span(robot: Robot) -> float:
    """Largest horizontal distance between two feet in the default pose [m]: the diagonal stance span."""
    _, data = default_pose(robot)
    feet = [data.geom(name).xpos[:2] for name in robot.foot_geoms]
    return float(max(np.linalg.norm(a - b) for a, b in combinations(feet, 2)))


def total_mass(robot: Robot) -> float:
    """Mass of the whole robot [kg]."""
    return float(robot_model(robot).body_mass.sum())
