"""Pay for progress where there is something to climb: own reward terms and commands, and tasks that use them.

    PYTHONPATH=benchmarks/sweeps gaitgauge train climb_pay:DREAMWAQ_CLIMB

``progress`` of the project has weight 0 in these tasks; an own term with its weight (1.5) replaces it.
"""

import math
from dataclasses import replace

import torch
from gaitgauge.training.environment.commands import CommandDraw, CommandGenerator
from gaitgauge.training.environment.configuration import OwnReward
from gaitgauge.training.environment.rewards import commanded_to_move, progress, progress_share
from gaitgauge.training.environment.step_inputs import StepInputs
from gaitgauge.training.tasks import Task, find_task

SATURATION = 0.5
"""Share of the commanded speed from which ``progress_held_up`` pays no more."""
LEVEL_INTERVAL = 3.0
"""Time between two draws on level ground [s]; elsewhere it is ``commands.interval``, 5 s."""
REVERSAL_PROBABILITY = 0.5
"""Chance that a command on level ground is followed by its opposite."""


def progress_where_it_climbs(inputs: StepInputs) -> torch.Tensor:
    """``progress`` on every tile but the level one, 0 there, (N,).

    ``StepInputs`` does not hold the kind of tile. ``leave_distance`` is infinite on tiles without an edge, and the level tile is
    the only one of those, so that it tells the two apart exactly.
    """
    return torch.where(inputs.leave_distance < math.inf, progress(inputs), 0.0)


def progress_held_up(inputs: StepInputs) -> torch.Tensor:
    """Progress up to half of the commanded speed, over that half, within ±1, on every tile, (N,): the full pay is for a robot that is
    not held up, and how fast it is beyond that is left to the tracking terms.
    """
    share = torch.clamp(progress_share(inputs) * (1.0 / SATURATION), -1.0, 1.0)
    return torch.where(commanded_to_move(inputs.command), share, 0.0)


class LevelGroundReversals(CommandGenerator):
    """Commands that on tiles without an edge last at most ``LEVEL_INTERVAL`` and are followed by their opposite every other time."""

    def draw(
        self,
        uniform: dict[str, torch.Tensor],
        *,
        kind: torch.Tensor,
        progress: torch.Tensor,
        episode_length: torch.Tensor,
        issued: torch.Tensor,
        command: torch.Tensor,
        extreme: torch.Tensor,
    ) -> CommandDraw:
        """Draw as ``CommandGenerator`` does, then reverse some on level ground: half of these turn back straight and hold their
        heading, the others reverse the yaw rate too.
        """
        drawn = super().draw(
            uniform,
            kind=kind,
            progress=progress,
            episode_length=episode_length,
            issued=issued,
            command=command,
            extreme=extreme,
        )
        ranges = self.ranges(kind, progress)
        level = ~self._ends[kind]
        # Crossings are for tiles with an edge, so that their numbers are free here.
        chance, straight, _ = uniform["command_crossing"].unbind(1)
        moving = command.square().sum(dim=1) > 0.01
        turns = level & moving & (episode_length > 0) & (chance < REVERSAL_PROBABILITY)
        ahead = straight < 0.5
        opposite = torch.clamp(-command, ranges.low, ranges.high)
        opposite = torch.cat((opposite[:, :2], torch.where(ahead, 0.0, opposite[:, 2])[:, None]), dim=1)
        longest = round(LEVEL_INTERVAL / self._period)
        return CommandDraw(
            command=torch.where(turns[:, None], opposite, drawn.command),
            steps=torch.where(level, drawn.steps.clamp(max=longest), drawn.steps),
            extreme=torch.where(turns, extreme, drawn.extreme),
            holds_heading=torch.where(turns, ahead, drawn.holds_heading),
        )


def _paid_by(task: str, function: str) -> Task:
    """A task of the project with another pay for progress."""
    found = find_task(task)
    settings, weight = found.environment, found.environment.rewards.progress
    own = (OwnReward(name=function, function=f"climb_pay:{function}", weight=weight),)
    rewards = replace(settings.rewards, progress=0.0, own=own)
    return replace(found, environment=replace(settings, rewards=rewards))


DREAMWAQ_CLIMB = _paid_by("go2-dreamwaq", "progress_where_it_climbs")
MOE_CLIMB = _paid_by("go2-moe-cts", "progress_where_it_climbs")
MOE_HELD_UP = _paid_by("go2-moe-cts", "progress_held_up")
