"""The motion to record on a hung robot, and recordings of simulated robots with known parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from ...robots import JointParameters, Robot
from .log import Array, Log, joint_ranges, make_log
from .rig import FixedRig, acting_parameters, at_rows, held_targets, num_steps


@dataclass(frozen=True, kw_only=True)
class Chirp:
    """A sine of rising frequency on all joints at once, around the middle of a comfortable pose."""

    seconds: Annotated[float, Field(gt=0.0)] = 20.0
    """Length [s]."""
    last: Annotated[float, Field(gt=0.0)] = 5.0
    """Frequency at the end [Hz]; it begins at 0.1 Hz."""
    amplitude: Annotated[float, Field(gt=0.0)] = 0.35
    """Largest change of a target [rad], less where a joint's range is narrow."""
    rate: Annotated[float, Field(gt=0.0)] = 500.0
    """Commands per second [Hz]."""

    def targets(self, robot: Robot, time: Array) -> Array:
        """Return the targets at some times [rad], (T, J): around the default pose, left legs against right ones."""
        ranges, pose = joint_ranges(robot), np.asarray(robot.default_joint_position)
        room = np.minimum(pose - ranges[:, 0], ranges[:, 1] - pose)
        reach = np.minimum(self.amplitude, 0.8 * room.clip(0.0))
        phase = 0.1 * time + (self.last - 0.1) / (2.0 * self.seconds) * time**2
        signs = np.where(np.arange(len(pose)) // 3 % 2 == 0, 1.0, -1.0)
        found: Array = pose + np.sin(2.0 * np.pi * phase)[:, None] * reach * signs
        return found


def simulated_log(
    robot: Robot,
    parameters: JointParameters,
    *,
    chirp: Chirp = Chirp(),
    stiffness: float = 25.0,
    damping: float = 1.0,
    noise: tuple[float, float, float] = (1e-3, 0.05, 0.1),
    jitter: float = 2e-4,
    seed: int = 0,
    name: str = "simulated.npz",
) -> Log:
    """Return a recording of a simulated robot that hangs by its trunk.

    Args:
        parameters: the robot's true constants; ``delay``, factors and offsets act.
        stiffness: kp that is sent to the motors [N·m/rad]; ``damping`` likewise [N·m·s/rad].
        noise: standard deviations of position [rad], velocity [rad/s] and torque [N·m].
        jitter: standard deviation of the time of a row [s].
    """
    random = np.random.default_rng(seed)
    count = round(chirp.seconds * chirp.rate)
    time = np.sort(np.arange(count) / chirp.rate + random.normal(0.0, jitter, count))
    time = np.maximum.accumulate(time - time[0]) + np.arange(count) * 1e-9
    gains = {"stiffness": np.full(robot.num_joints, stiffness), "damping": np.full(robot.num_joints, damping)}
    series = {"time": time, "target": chirp.targets(robot, time)}
    still = make_log(name, robot, series | gains | {"position": series["target"], "held": "hung"})
    acting = acting_parameters(still, parameters)
    targets = held_targets(still, parameters.delay or 0.0, num_steps(still)) + np.asarray(
        parameters.target_offset or 0.0
    )
    rig = FixedRig(robot, acting, threads=1)
    try:
        motion = rig.run([acting], targets[None], [(still.target[0], np.zeros(robot.num_joints))])[:, 0]
    finally:
        rig.close()
    for key, values, scale in zip(("position", "velocity", "torque"), at_rows(still, motion), noise, strict=True):
        series[key] = values + random.normal(0.0, scale, values.shape)
    return make_log(name, robot, series | gains | {"held": "hung"})
