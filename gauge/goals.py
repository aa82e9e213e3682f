"""The three goals and their commands over time (paper table of goals; gauge protocol §3.2 and §3.4)."""

from __future__ import annotations

import math

import torch

from ..backends.base import PhysicsState
from ..robots.rotation import rotate_inverse, yaw_of
from ..terrains.base import Terrain
from .commands import Command
from .suite import Suite, SuiteError

# Sub-commands as multiples of the limits (forward, lateral, yaw), in the order in which they run.
SUB_COMMANDS: dict[str, list[tuple[int, int, int]]] = {
    "diagonal_velocity": [(-1, -1, 0), (-1, 1, 0), (-1, 0, 0), (1, -1, 0), (1, 1, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0)],
    "max_velocity": [(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)],
    "target_pos_velocity": [(0, 0, 0)],
}
# Factor of the second phase of a sub-command on the command of the first one.
_SECOND_PHASE = {"diagonal_velocity": -1.0, "max_velocity": 0.0}

TARGET = "target_pos_velocity"

LATERAL_SPEED = 1.0
"""Largest lateral speed on the way to the target [m/s]."""

_AXES = ("x", "y", "yaw")


def command_name(goal: str, part: int) -> str:
    """Return the name of a goal's sub-command for readers: ``max_velocity -x``, ``diagonal_velocity +x+y``, of one's own ``slalom 1``."""
    if goal not in SUB_COMMANDS:
        return f"{goal} {part + 1}"
    signs = SUB_COMMANDS[goal][part]
    axes = "".join(f"{'+' if sign > 0 else '-'}{axis}" for sign, axis in zip(signs, _AXES, strict=True) if sign)
    return f"{goal} {axes}" if axes else goal


def count_sub_commands(suite: Suite, goal: str) -> int:
    """Return the number of sub-commands of a suite's goal; one for the goal that ends at its target."""
    return len(SUB_COMMANDS[goal]) if goal in SUB_COMMANDS else len(suite.goal(goal).sub_commands)


class Schedule:
    """The commands of every goal of a suite at every control step, worked out in advance.

    A sub-command runs from one reset to the next. A goal's clock runs through its sub-commands, starts with one
    control period at the first commanded step, stands still while the robot settles, and adds up rounding errors in double
    precision, as the reference's does.
    """

    def __init__(self, suite: Suite, device: torch.device, dtype: torch.dtype) -> None:
        """Work out the commands."""
        self.names = tuple(g.name for g in suite.goals)
        """Goals in the order in which an episode runs them."""
        period = suite.physics.control_period
        self.target_steps = {family: round(t / period) for family, t in suite.commands.target_time.items()}
        """Control steps that the target goal may take, by terrain family."""
        early = suite.commands.clock_offset * period
        self.sub_commands: dict[str, tuple[tuple[Command, ...], ...]] = {
            g.name: ((),)
            if g.name == TARGET
            else tuple(tuple(p.velocity for p in row for _ in range(p.steps(period))) for row in g.sub_commands)
            if g.sub_commands
            else _velocity_commands(g.name, g.phases, period, early)
            for g in suite.goals
        }
        """Commands of each sub-command of each goal, one for each step, as multiples of the limits; none for the target goal."""
        # One long table: zeros for the target goal (its commands follow from the state), then every sub-command, each after a row
        # of zeros for the time in which the robot settles.
        zero = (0.0, 0.0, 0.0)
        rows: list[Command] = [zero] * (1 + max(self.target_steps.values(), default=0))
        self._first: dict[tuple[str, int], int] = {}
        for name, sub_commands in self.sub_commands.items():
            for number, commands in enumerate(sub_commands):
                self._first[name, number] = 0 if name == TARGET else len(rows)
                rows += [] if name == TARGET else [zero, *commands]
        self._rows = torch.tensor(rows, device=device, dtype=dtype)

    def first_row(self, goal: str, sub_command: int) -> int:
        """Return the first row of a sub-command in the table that ``commands`` reads."""
        return self._first[goal, sub_command]

    def commands(self, row: torch.Tensor, limits: torch.Tensor) -> torch.Tensor:
        """Return the commands of the velocity goals, zero for the target goal: forward, lateral [m/s] and yaw [rad/s], (N, 3).

        Args:
            row: ``first_row`` of each sub-command, plus the number of the commanded step from 1 on, or 0 while settling, (N,) int64.
            limits: command limits, (N, 3).
        """
        return self._rows.index_select(0, row) * limits


def _velocity_commands(
    name: str, phases: tuple[float, ...], period: float, early: float
) -> tuple[tuple[Command, ...], ...]:
    """Return the commands of a velocity goal's sub-commands, step by step. The clock ends the last one, which may be a step short.

    Args:
        phases: length of both phases of a sub-command [s].
        period: control period [s].
        early: how much the clock is read early [s].
    """
    signs, duration, second = SUB_COMMANDS[name], sum(phases), _SECOND_PHASE[name]
    total, steps = duration * len(signs), round(duration / period)
    found: list[tuple[Command, ...]] = []
    time = 0.0
    for _ in signs:
        commands: list[Command] = []
        for _ in range(steps):
            time += period
            if time - early >= total:
                return (*found, tuple(commands))
            at = math.floor((time - early) / duration)
            factor = 1.0 if time - early - at * duration < phases[0] else second
            x, y, yaw = signs[at] if at < len(signs) else (0, 0, 0)
            commands.append((factor * x + 0.0, factor * y + 0.0, factor * yaw + 0.0))  # no negative zeros
        found.append(tuple(commands))
    return tuple(found)


def check_goals(suite: Suite, *, searched: bool, judged: bool) -> None:
    """Check that a suite has the goals that a run needs.

    Args:
        suite: the suite.
        searched: a highest level is searched, by walks to the target.
        judged: quality is measured, by commanded velocities.

    Raises:
        SuiteError: it has none of a kind.
    """
    names = {goal.name for goal in suite.goals}
    if searched and TARGET not in names:
        raise SuiteError(
            f"suite '{suite.name}' has no goal '{TARGET}', so it searches no level; choose another suite, or give 'evaluate' a --level"
        )
    if judged and not names - {TARGET}:
        raise SuiteError(
            f"suite '{suite.name}' has no goal but '{TARGET}', so it measures no quality; add a goal, or use --pipeline level"
        )


def check_terrain(suite: Suite, terrain: Terrain, *, searched: bool) -> None:
    """Check that a terrain, a plug-in's for example, has what the goals need.

    Args:
        terrain: any level of it.
        searched: the target is to be reached.

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
    """Return the target minus base position, (N, 2): in the plane of the base (``body``) or the yawed horizontal one (``horizontal``)."""
    offset = target - state.base_position_w
    if frame == "body":
        return rotate_inverse(state.base_quaternion_w, offset)[:, :2]
    yaw = yaw_of(state.base_quaternion_w)
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    return torch.stack((cos * offset[:, 0] + sin * offset[:, 1], cos * offset[:, 1] - sin * offset[:, 0]), dim=1)


def target_command(
    offset: torch.Tensor, backward: torch.Tensor, speed: torch.Tensor, yaw_limit: torch.Tensor
) -> torch.Tensor:
    """Return a command that leads to the target: proportional turning and side-stepping, full speed ahead once it is in sight.

    Returns forward, lateral [m/s] and yaw [rad/s], (N, 3).

    Args:
        offset: see ``target_offset``, (N, 2).
        backward: robots that walk backwards, (N,) bool.
        speed: forward speed [m/s], (N,).
        yaw_limit: largest yaw rate [rad/s], (N,).
    """
    sideways = offset[:, 1]
    bearing = torch.atan2(sideways, offset[:, 0])
    wide = bearing.abs()
    turn = torch.where(backward, math.pi - wide, wide)
    yaw = torch.sign(bearing) * torch.minimum(2.0 * turn, yaw_limit)
    facing = turn < 0.25 * math.pi
    lateral = torch.clamp(sideways, -LATERAL_SPEED, LATERAL_SPEED) * (wide >= 0.25 * math.pi)
    direction = 1.0 - 2.0 * backward
    return torch.stack((direction * speed * facing, lateral, direction * yaw), dim=1)
