"""The three goals: what speed is commanded when (paper table of goals; gauge protocol §3.2 and §3.4)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch

from ..backends.base import PhysicsState
from ..robots.rotation import rotate_inverse, yaw_of
from ..terrains.base import Terrain
from .suite import Suite, SuiteError

# Sub-commands as multiples of the limits (forward, lateral, yaw), in the order in which they run.
SUB_COMMANDS: dict[str, list[tuple[int, int, int]]] = {
    "diagonal_velocity": [(-1, -1, 0), (-1, 1, 0), (-1, 0, 0), (1, -1, 0), (1, 1, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0)],
    "max_velocity": [(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)],
    "target_pos_velocity": [(0, 0, 0)],
}
# What the second phase of a sub-command does with the first one's command.
_SECOND_PHASE = {"diagonal_velocity": -1.0, "max_velocity": 0.0, "target_pos_velocity": 0.0}

TARGET = "target_pos_velocity"


class GoalTable:
    """The goals of a suite as tensors, indexed by goal number (the position in ``suite.goals``)."""

    PARTS: Mapping[str, int] = {name: len(commands) for name, commands in SUB_COMMANDS.items()}
    """Number of sub-commands by name of the goal."""

    def __init__(self, suite: Suite, device: torch.device, dtype: torch.dtype) -> None:
        names = [g.name for g in suite.goals]
        unknown = [n for n in names if n not in SUB_COMMANDS]
        if unknown:
            raise SuiteError(
                f"suite '{suite.name}' has the unknown goal '{unknown[0]}'; choose from {', '.join(SUB_COMMANDS)}"
            )
        for g in suite.goals:
            wanted = 0 if g.name == TARGET else 2
            if len(g.phases) != wanted or any(phase <= 0.0 for phase in g.phases):
                raise SuiteError(
                    f"goal '{g.name}' of suite '{suite.name}' has the phases {list(g.phases)}; "
                    f"give {wanted} lengths above zero"
                )
        self.names = tuple(names)
        self.period = suite.physics.control_period
        most = max(len(c) for c in SUB_COMMANDS.values())
        table = torch.zeros(len(names), most, 3, device=device, dtype=dtype)
        for i, name in enumerate(names):
            table[i, : len(SUB_COMMANDS[name])] = torch.tensor(SUB_COMMANDS[name], device=device, dtype=dtype)
        self._table = table

        def column(values: list[float], kind: torch.dtype) -> torch.Tensor:
            return torch.tensor(values, device=device, dtype=kind)

        self._early = suite.commands.clock_offset * self.period
        double = torch.float64  # goal time is added up in double precision, as the reference does
        self.is_target = column([n == TARGET for n in names], torch.bool)
        self.parts = column([len(SUB_COMMANDS[n]) for n in names], torch.int64)
        self.duration = column([sum(g.phases) or math.inf for g in suite.goals], double)
        self.total = self.duration * self.parts
        self.steps = column(
            [round(sum(g.phases) / self.period) if g.phases else 2**62 for g in suite.goals], torch.int64
        )
        self._first = column([g.phases[0] if g.phases else math.inf for g in suite.goals], double)
        self._second = column([_SECOND_PHASE[n] for n in names], dtype)

    def over(self, goal: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
        """Whether a velocity goal has run its time [s], (N,) bool; never true for the target goal."""
        return time - self._early >= self.total[goal]

    def part(self, goal: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
        """Sub-command at a goal time [s], (N,) int64; 0 in the target goal."""
        return torch.floor((time - self._early) / self.duration[goal]).to(torch.int64)

    def velocity_command(self, goal: torch.Tensor, time: torch.Tensor, limits: torch.Tensor) -> torch.Tensor:
        """Command of the velocity goals.

        Args:
            goal: goal number, (N,) int64.
            time: goal time, which starts with one control period at the first command [s], (N,) float64.
            limits: command limits, (N, 3).

        Returns:
            Forward, lateral [m/s] and yaw [rad/s], (N, 3).
        """
        duration = self.duration[goal]
        part = torch.clamp(self.part(goal, time), max=self._table.shape[1] - 1)
        within = time - self._early - torch.where(torch.isinf(duration), torch.zeros_like(time), part * duration)
        factor = torch.where(within < self._first[goal], torch.ones_like(self._second[goal]), self._second[goal])
        return self._table[goal, part] * limits * factor[:, None]


def check_terrain(suite: Suite, terrain: Terrain, *, searched: bool) -> None:
    """Check that a terrain, a plug-in's for example, has what the goals need.

    Args:
        suite: the rules.
        terrain: any level of it.
        searched: whether its target is to be reached.

    Raises:
        SuiteError: a start, the target, or the suite's speed and time for its family is missing.
    """
    for spawn in ("level_eval", *(["level_search"] if searched else [])):
        if spawn not in terrain.spawns:
            raise SuiteError(f"terrain '{terrain.name}' has no spawn '{spawn}'; add it, or choose another terrain")
    if not searched:
        return
    if terrain.target is None:
        raise SuiteError(
            f"terrain '{terrain.name}' has no target, so no level can be searched on it; give one with --level"
        )
    for name, table in (("target_speed", suite.commands.target_speed), ("target_time", suite.commands.target_time)):
        if terrain.family not in table:
            raise SuiteError(
                f"suite '{suite.name}' has no commands.{name} for terrain family '{terrain.family}'; "
                f"it has {', '.join(sorted(table))}"
            )


def target_offset(state: PhysicsState, target: torch.Tensor, frame: str) -> torch.Tensor:
    """Target minus base position, (N, 2): in the base's own x-y plane (``body``), or the yawed horizontal one (``horizontal``)."""
    offset = target - state.base_position_w
    if frame == "body":
        return rotate_inverse(state.base_quaternion_w, offset)[:, :2]
    yaw = yaw_of(state.base_quaternion_w)
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    return torch.stack((cos * offset[:, 0] + sin * offset[:, 1], cos * offset[:, 1] - sin * offset[:, 0]), dim=1)


def target_command(
    offset: torch.Tensor, backward: torch.Tensor, speed: torch.Tensor, yaw_limit: torch.Tensor
) -> torch.Tensor:
    """Command that leads to the target: proportional turning and side-stepping, full speed ahead once it is in sight.

    Args:
        offset: see ``target_offset``, (N, 2).
        backward: whether the robot is to walk backwards, (N,) bool.
        speed: forward speed [m/s], (N,).
        yaw_limit: largest yaw rate [rad/s], (N,).

    Returns:
        Forward, lateral [m/s] and yaw [rad/s], (N, 3).
    """
    bearing = torch.atan2(offset[:, 1], offset[:, 0])
    wide = bearing.abs()
    turn = torch.where(backward, math.pi - wide, wide)
    yaw = torch.sign(bearing) * torch.minimum(2.0 * turn, yaw_limit)
    yaw = torch.where(backward, -yaw, yaw)
    facing = torch.where(backward, wide > 0.75 * math.pi, wide < 0.25 * math.pi)
    forward = torch.where(facing, torch.where(backward, -speed, speed), torch.zeros_like(speed))
    lateral = torch.sign(offset[:, 1]) * torch.clamp(offset[:, 1].abs(), max=1.0)
    lateral = torch.where(wide >= 0.25 * math.pi, lateral, torch.zeros_like(lateral))
    return torch.stack((forward, lateral, yaw), dim=1)
