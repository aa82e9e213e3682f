"""What robots in a scenario are told at every control step."""

from __future__ import annotations

import torch

from ...backends.base import PhysicsState
from ...robots.rotation import yaw_of
from .scenario import Scenario

_AHEAD = 1.5
"""How far ahead on the line the operator looks [m]."""
_TURN_GAIN = 2.0
"""Yaw speed for each radian off [1/s], the gauge's own on the way to its target."""
_FASTEST_TURN = 1.0
"""Largest yaw speed of the operator [rad/s]."""


class Timeline:
    """Each robot's place in the scenario's commands."""

    def __init__(self, scenario: Scenario, period: float, line: tuple[float, float, float]) -> None:
        """Begin with the first phase.

        Args:
            period: control period [s].
            line: x, y [m] and heading [rad] of the line that steering keeps to.
        """
        phases = scenario.commands
        self._velocities = [phase.velocity for phase in phases]
        self._lengths = [phase.steps(period) for phase in phases]
        self._limits = [float("inf") if phase.until_x is None else phase.until_x for phase in phases]
        self._steer = [phase.steer for phase in phases]
        self._line = line
        self._phase: torch.Tensor | None = None

    def next(self, state: PhysicsState) -> torch.Tensor:
        """Commands of the coming control step: forward, lateral [m/s] and yaw [rad/s], (N, 3); zero where they are over."""
        position = state.base_position_w
        if self._phase is None:
            self._phase = torch.zeros(len(position), dtype=torch.int64, device=position.device)
            self._done = torch.zeros_like(self._phase)
            self._tables = [
                torch.tensor([*rows, end], device=position.device)
                for rows, end in (
                    (self._lengths, 2**62),
                    (self._limits, float("inf")),
                    (self._steer, False),
                )
            ]
            self._commands = torch.tensor(
                [*self._velocities, (0.0, 0.0, 0.0)], device=position.device, dtype=position.dtype
            )
        lengths, limits, steer = self._tables
        ends = (self._done >= lengths[self._phase]) | (position[:, 0] >= limits[self._phase])
        self._phase += ends
        self._done = torch.where(ends, 0, self._done) + 1
        command = self._commands[self._phase]
        steered = steer[self._phase]
        if bool(steered.any()):
            command = torch.where(steered[:, None], torch.cat((command[:, :2], self._turn(state)), dim=1), command)
        return command

    @property
    def over(self) -> torch.Tensor:
        """Whether a robot's commands are over, (N,) bool."""
        assert self._phase is not None
        return self._phase >= len(self._lengths)

    def _turn(self, state: PhysicsState) -> torch.Tensor:
        """Yaw speed with which an operator brings the robot back to its line, (N, 1) [rad/s]."""
        x, y, yaw = self._line
        offset = state.base_position_w - torch.tensor([x, y, 0.0], device=state.base_position_w.device)
        cos, sin = torch.cos(torch.tensor(yaw)), torch.sin(torch.tensor(yaw))
        aside = cos * offset[:, 1] - sin * offset[:, 0]
        wanted = yaw - torch.atan2(aside, torch.full_like(aside, _AHEAD))
        off = wanted - yaw_of(state.base_quaternion_w)
        off = torch.atan2(torch.sin(off), torch.cos(off))
        return torch.clamp(_TURN_GAIN * off, -_FASTEST_TURN, _FASTEST_TURN)[:, None]
