"""Robots as data: the machine's MuJoCo model, joints, gains, limits and feet. Nothing here knows an engine."""

from .base import JointParameters, Robot
from .checks.checking import check_robot
from .loading import RobotError, load_robot_file
from .registry import load_robot, robot_names

__all__ = ["JointParameters", "Robot", "RobotError", "check_robot", "load_robot", "load_robot_file", "robot_names"]
