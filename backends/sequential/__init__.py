"""Share the loop over worlds, the motor law and the readout among engines on the CPU that hold each world in an object."""

from .backend import SequentialBackend
from .robot import Link, RobotModel, Shape, read_robot
from .world import Base, Contact, World

__all__ = ["Base", "Contact", "Link", "RobotModel", "SequentialBackend", "Shape", "World", "read_robot"]
