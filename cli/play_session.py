"""Play one robot with a policy on one terrain, step by step, with commands from outside, for every viewer."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray

from ..backends.base import PhysicsState, Randomization, Scene
from ..backends.registry import make_backend
from ..gauge.goals import target_command, target_offset
from ..gauge.motors import joint_parameters
from ..gauge.suite import Suite
from ..policy.base import Policy
from ..policy.foreign.adapters import AT_ONCE, doubt
from ..robots import Robot
from ..robots.anatomy.body_plan import model_joint_order
from ..robots.rotation import from_yaw, in_heading, tilt
from ..studies.walking import Walk
from ..terrains.base import Terrain
from .errors import UserError

Command = tuple[float, float, float]
"""Forward, lateral [m/s] and yaw [rad/s] speed."""

_SPEED_OVER = 0.3
"""Time over which the measured speed is averaged [s]."""
_SETTLE = 0.4
"""Time after a reset in which the command is to stand [s]."""
_FALLEN_TILT = 1.4
"""Tilt of the base at which the robot starts again [rad]."""
_LONG_DOWN = 1.0
"""Time for which a fallen robot is shown [s]."""

_TOUR: tuple[tuple[Command, float], ...] = (
    ((0.5, 0.0, 0.0), 3.0),
    ((0.5, 0.0, 0.6), 3.0),
    ((0.0, 0.6, 0.0), 2.0),
    ((0.0, 0.0, -0.6), 2.5),
    ((0.75, 0.0, 0.0), 2.5),
    ((-0.4, 0.0, 0.0), 2.0),
    ((0.0, 0.0, 0.0), 1.5),
)
"""A walk that shows every direction: shares of the command limits, and time [s]."""


@dataclass(frozen=True, kw_only=True)
class Readout:
    """Describe one robot at one instant, for people."""

    label: str
    """Name of the policy."""
    place: str
    """Terrain and level."""
    friction: float
    """Friction coefficient of the ground."""
    time: float
    """Total simulated time [s]."""
    command: Command
    """Command to the policy."""
    speed: Command
    """Speed of the base in its own heading, averaged over a moment."""
    falls: int
    """Number of falls."""
    arrivals: int
    """Number of arrivals at the target."""


@cache  # once for each policy
def _doubt(policy: Policy) -> None:
    """Warn that a policy may be run otherwise than it was made for."""
    logging.getLogger(__name__).warning("'%s': the robot falls at once; %s", policy.path, doubt(policy.contract))


def clip(command: Command, limits: Command) -> Command:
    """Return a command within limits."""
    forward, lateral, yaw = (max(-most, min(most, value)) for value, most in zip(command, limits, strict=True))
    return forward, lateral, yaw


def beyond(command: Command, limits: Command) -> str | None:
    """Return a sentence on the parts of a command beyond the limits of a policy, None where all are within."""
    parts = [
        f"{name} {value:g} {unit} (it was made for at most {most:g})"
        for name, unit, value, most in zip(
            ("forward", "sideways", "turning"), ("m/s", "m/s", "rad/s"), command, limits, strict=True
        )
        if abs(value) > most
    ]
    return f"the policy's contract clips the command: {', '.join(parts)}" if parts else None


class PlaySession:
    """Play a robot without end: it starts again after a fall and at the target."""

    def __init__(
        self,
        policy: Policy,
        robot: Robot,
        terrain: Terrain,
        *,
        suite: Suite,
        backend: str,
        device: str,
        friction: float,
        seed: int,
        label: str = "policy",
    ) -> None:
        """Build the world and put the robot at the start.

        ``suite`` gives the physics, the robot's joint constants, and the speeds at which a robot goes its own way.

        Raises:
            BackendError: the engine cannot do this.
            ContractError: the policy is not for this robot.
            RobotError: the robot lacks the suite's joint parameters.
            UserError: the policy's control period is no multiple of the physics step.
        """
        period = policy.contract.control_period
        physics = replace(suite.physics, substeps=max(1, round(period / suite.physics.timestep)))
        if abs(physics.control_period - period) > 1e-9:
            raise UserError(
                f"the policy's control period is {period:g} s, no multiple of the physics step of {physics.timestep:g} s"
            )
        self.policy, self.robot, self.terrain, self.period, self.label = policy, robot, terrain, period, label
        self.limits = policy.contract.command_limits
        """Largest commands of the policy's contract."""
        self._own_limits = clip(suite.command_limits(terrain.family), self.limits)
        self._speed = min(suite.commands.target_speed.get(terrain.family, 0.5 * self._own_limits[0]), self.limits[0])
        self._model_order = model_joint_order(robot)
        scene = Scene(
            robot=robot,
            parameters=joint_parameters(suite, robot, policy.contract),
            terrains=(terrain,),
            terrain_index=(0,),
            physics=physics,
        )
        self.backend = make_backend(backend, scene, device=device)
        self._walk = Walk(policy, self.backend, session=policy.session(1, device=str(self.backend.device)))
        self.set_friction(friction)
        self._random = np.random.default_rng(seed)
        self.time = 0.0
        """Total simulated time [s]."""
        self.falls = 0
        self.arrivals = 0
        self.reset()

    @property
    def state(self) -> PhysicsState:
        """Return the state of the one world."""
        return self.backend.state

    def set_friction(self, friction: float) -> None:
        """Change the ground's friction coefficient."""
        self.friction = friction
        self.backend.randomize(Randomization(friction=self._walk.tensor([friction])))

    def reset(self) -> None:
        """Put the robot back to the start, turned a little at random."""
        pose = self.terrain.spawns["level_search"]
        x, y, z = pose.position
        yaw = self._walk.tensor([pose.yaw + self._random.uniform(-0.05, 0.05)])
        self._walk.reset(self._walk.tensor([[x, y, z + self.robot.stand_height]]), from_yaw(yaw))
        self.since_reset = 0.0
        """Simulated time since the robot was put to the start [s]."""
        self._down = 0.0
        self._command = self._speed_now = (0.0, 0.0, 0.0)

    def step(self, command: Command) -> None:
        """Advance one control period; a command beyond the limits of the policy is clipped."""
        if self.since_reset < _SETTLE:
            command = (0.0, 0.0, 0.0)
        limited = self._command = clip(command, self.limits)
        self._walk.step(self._walk.tensor([limited]))
        self.time += self.period
        self.since_reset += self.period
        self._measure()
        self._start_again()

    def _measure(self) -> None:
        """Follow the speed of the base: an exponential average, which a trunk that swings at every step does not shake."""
        state = self.state
        velocity = in_heading(state.base_quaternion_w[0], state.base_linear_velocity_w[0])
        now = (*velocity.tolist(), float(state.base_angular_velocity_b[0, 2]))
        share = min(1.0, self.period / _SPEED_OVER)
        forward, lateral, yaw = (old + share * (new - old) for old, new in zip(self._speed_now, now, strict=True))
        self._speed_now = (forward, lateral, yaw)

    def readout(self) -> Readout:
        """Return the readout of this instant."""
        level = f" level {self.terrain.level}" if self.terrain.level else ""
        return Readout(
            label=self.label,
            place=f"{self.terrain.name}{level}",
            friction=self.friction,
            time=self.time,
            command=self._command,
            speed=self._speed_now,
            falls=self.falls,
            arrivals=self.arrivals,
        )

    def _start_again(self) -> None:
        """Reset once the robot has lain on the ground for a while, or has reached the target."""
        if self.tilt > _FALLEN_TILT or bool(self.state.diverged[0]):
            self._down += self.period
            if self._down >= _LONG_DOWN or bool(self.state.diverged[0]):
                self.falls += 1
                if self.since_reset - self._down < _SETTLE + AT_ONCE:
                    _doubt(self.policy)
                self.reset()
            return
        self._down = 0.0
        if self.terrain.target is not None and self.target_distance < 0.15:
            self.arrivals += 1
            self.reset()

    @property
    def tilt(self) -> float:
        """Return the angle between the base's z axis and the world's [rad]."""
        return float(tilt(self.state.base_quaternion_w[0]))

    @property
    def target_distance(self) -> float:
        """Return the horizontal distance from the base to the terrain's target [m]; infinite without one."""
        if self.terrain.target is None:
            return math.inf
        x, y, _ = self.state.base_position_w[0].tolist()
        return math.hypot(self.terrain.target[0] - x, self.terrain.target[1] - y)

    def position(self) -> NDArray[np.float64]:
        """Return the positions of the free joint and of the robot's joints, in MuJoCo's order: (7 + J,)."""
        state = self.state
        parts = (state.base_position_w[0], state.base_quaternion_w[0], state.joint_position[0, self._model_order])
        return torch.cat([p.double() for p in parts]).cpu().numpy()

    def autopilot(self) -> Command:
        """Return the command to the target where there is one, else of a tour that shows every direction."""
        if self.terrain.target is not None:
            offset = target_offset(self.state, self._walk.tensor([self.terrain.target]), "horizontal")
            command = target_command(
                offset,
                torch.tensor([self.terrain.backward], device=offset.device),
                torch.full_like(offset[:, 0], self._speed),
                torch.full_like(offset[:, 0], self._own_limits[2]),
            )
            forward, lateral, yaw = command[0].tolist()
            return forward, lateral, yaw
        at = (self.since_reset - _SETTLE) % sum(seconds for _, seconds in _TOUR)
        for shares, seconds in _TOUR:
            if at < seconds:
                most = self._own_limits
                return shares[0] * most[0], shares[1] * most[1], shares[2] * most[2]
            at -= seconds
        return 0.0, 0.0, 0.0

    def close(self) -> None:
        """Free the physics."""
        self.backend.close()
