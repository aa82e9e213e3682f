"""Finds parts of a robot that strike each other, from its joint angles alone; the options of an engine do not matter."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...robots.base import Robot


class SelfContact:
    """Finds poses in which parts of a robot overlap that do not in its default pose, of all that its own file lets meet."""

    def __init__(self, robot: Robot) -> None:
        """Load the robot's own file, in which there is nothing but the robot."""
        self._model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
        self._data = mujoco.MjData(self._model)
        self._joints = [int(self._model.joint(name).qposadr[0]) for name in robot.joint_names]
        self._always: frozenset[tuple[int, int]] = frozenset()
        self._always = frozenset(self._overlapping(np.asarray(robot.default_joint_position)))

    def pairs(self, joint_position: NDArray[np.floating]) -> set[str]:
        """Return the names of the geoms that overlap in a pose, (J,) [rad], two and two with a dash between them."""
        found = self._overlapping(joint_position) - self._always
        return {"–".join(sorted(self._model.geom(geom).name for geom in pair)) for pair in found}

    def touching(self, joint_position: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return whether any parts overlap in poses, (T, J) [rad]; False for a pose that is not finite; (T,)."""
        finite = np.isfinite(joint_position).all(axis=1)
        poses = zip(joint_position, finite, strict=True)
        touching = [known and bool(self._overlapping(pose) - self._always) for pose, known in poses]
        return np.array(touching, dtype=np.bool_)

    def _overlapping(self, joint_position: NDArray[np.floating]) -> set[tuple[int, int]]:
        """Return the pairs of geoms that overlap in a pose."""
        self._data.qpos[self._joints] = joint_position
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)
        if not self._data.ncon:  # nearly always
            return set()
        contacts = self._data.contact
        return {(int(a), int(b)) for a, b in contacts.geom[contacts.dist < 0.0]}
