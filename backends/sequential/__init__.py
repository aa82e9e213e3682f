"""What engines on the CPU share that hold one world in one object: the loop over worlds, the motor law, the readout."""

from .backend import SequentialBackend
from .robot import Link, RobotModel, Shape, read_robot
from .world import Base, Contact, World

__all__ = ["Base", "Contact", "Link", "RobotModel", "SequentialBackend", "Shape", "World", "read_robot"]
