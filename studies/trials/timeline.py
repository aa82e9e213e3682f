"""Give the robots in a scenario their commands at every control step."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from ...backends.base import PhysicsState
from ...robots.rotation import yaw_of
from .scenario import Leg, Scenario

_AHEAD = 1.5
"""How far ahead on the line the operator looks [m]."""
_TURN_GAIN = 2.0
"""Yaw speed for each radian off [1/s], the gauge's own on the way to its target."""
_FASTEST_TURN = 1.0
"""Largest yaw speed of the operator [rad/s]."""


class Timeline:
    """Each robot's place in its scenario's commands."""

    def __init__(self, scenarios: Sequence[Scenario], period: float, position: torch.Tensor) -> None:
        """Begin with the first phase.

        Args:
            scenarios: one for each robot.
            period: control period [s].
            position: of the robots (N, 3), for what numbers are kept in.
        """
        longest = 1 + max(len(scenario.commands) for scenario in scenarios)

        def table(values: Callable[[Leg], object], last: object, like: torch.Tensor | None = None) -> torch.Tensor:
            rows = [[values(phase) for phase in scenario.commands] for scenario in scenarios]
            filled = [
                row + [last] * (longest - len(row)) for row in rows
            ]  # from the first of these rows on all is over
            return torch.tensor(filled, device=position.device, dtype=None if like is None else like.dtype)

        self._lengths = table(lambda phase: phase.steps(period), 2**62)
        self._limits = table(lambda p: float("inf") if p.until_x is None else p.until_x, float("inf"), position)
        self._steer = table(lambda phase: phase.steer, False)
        self._commands = table(lambda phase: phase.velocity, (0.0, 0.0, 0.0), position)
        lines = [(s.start.x, s.start.y, s.start.yaw) for s in scenarios]
        self._line = torch.tensor(lines, device=position.device, dtype=position.dtype)
        self._last = torch.tensor([len(scenario.commands) for scenario in scenarios], device=position.device)
        self._robots = torch.arange(len(scenarios), device=position.device)
        self._phase, self._done = torch.zeros_like(self._last), torch.zeros_like(self._last)

    def next(self, state: PhysicsState) -> torch.Tensor:
        """Commands of the coming control step: forward, lateral [m/s] and yaw [rad/s], (N, 3); zero where they are over."""
        at = (self._robots, self._phase)
        ends = (self._done >= self._lengths[at]) | (state.base_position_w[:, 0] >= self._limits[at])
        self._phase += ends
        self._done = torch.where(ends, 0, self._done) + 1
        at = (self._robots, self._phase)
        command, steered = self._commands[at], self._steer[at]
        if bool(steered.any()):
            command = torch.where(steered[:, None], torch.cat((command[:, :2], self._turn(state)), dim=1), command)
        return command

    @property
    def over(self) -> torch.Tensor:
        """Return whether a robot's commands are over, (N,) bool."""
        return self._phase >= self._last

    def _turn(self, state: PhysicsState) -> torch.Tensor:
        """Yaw speed with which an operator brings the robot back to its line, (N, 1) [rad/s]."""
        x, y, yaw = self._line.unbind(1)
        position = state.base_position_w
        aside = torch.cos(yaw) * (position[:, 1] - y) - torch.sin(yaw) * (position[:, 0] - x)
        wanted = yaw - torch.atan2(aside, torch.full_like(aside, _AHEAD))
        off = wanted - yaw_of(state.base_quaternion_w)
        off = torch.atan2(torch.sin(off), torch.cos(off))
        return torch.clamp(_TURN_GAIN * off, -_FASTEST_TURN, _FASTEST_TURN)[:, None]
