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

    def __init__(
        self, scenario: Scenario, period: float, line: tuple[float, float, float], position: torch.Tensor
    ) -> None:
        """Begin with the first phase.

        Args:
            period: control period [s].
            line: x, y [m] and heading [rad] of the line that steering keeps to.
            position: of the robots (N, 3), for their number and what they are kept in.
        """
        phases, device = scenario.commands, position.device
        limits = [float("inf") if phase.until_x is None else phase.until_x for phase in phases]
        columns = (
            [*(phase.steps(period) for phase in phases), 2**62],
            [*limits, float("inf")],
            [*(phase.steer for phase in phases), False],
        )
        self._tables = [torch.tensor(column, device=device) for column in columns]  # the last row: all is over
        velocities = [*(phase.velocity for phase in phases), (0.0, 0.0, 0.0)]
        self._commands = torch.tensor(velocities, device=device, dtype=position.dtype)
        self._line, self._last = line, len(phases)
        self._phase = torch.zeros(len(position), dtype=torch.int64, device=device)
        self._done = torch.zeros_like(self._phase)

    def next(self, state: PhysicsState) -> torch.Tensor:
        """Commands of the coming control step: forward, lateral [m/s] and yaw [rad/s], (N, 3); zero where they are over."""
        position = state.base_position_w
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
        return self._phase >= self._last

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
