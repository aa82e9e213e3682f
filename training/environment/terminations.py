"""End episodes. Each rule is a function of ``StepInputs`` and the settings to a mask of worlds; ``TERMINATIONS`` names them. An end is a
failure, or a time-out: the learner then bootstraps the missing future. A failure lowers the level, unless the physics failed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from .configuration import TerminationConfiguration
from .own_terms import resolve_own
from .rewards import commanded_to_move, progress_share
from .step_inputs import StepInputs

STUCK_SHORTFALL = 0.9
"""Share of the commanded speed that is missing of late from which a robot counts as stuck."""

Rule = Callable[[StepInputs, TerminationConfiguration], torch.Tensor]


def time_out(inputs: StepInputs, settings: TerminationConfiguration) -> torch.Tensor:
    """Return True where the longest episode is over."""
    return inputs.episode_length >= inputs.max_episode_length


def left_tile(inputs: StepInputs, settings: TerminationConfiguration) -> torch.Tensor:
    """Return True where the robot has left its tile behind."""
    return inputs.distance > inputs.leave_distance


def trunk_contact(inputs: StepInputs, settings: TerminationConfiguration) -> torch.Tensor:
    """Return True where the ground presses on the trunk, head and chin apart, harder than ``trunk_contact`` newtons."""
    assert settings.trunk_contact is not None
    return inputs.trunk_contact_force_w.norm(dim=-1) > settings.trunk_contact


def tilt(inputs: StepInputs, settings: TerminationConfiguration) -> torch.Tensor:
    """Return True where the base leans by more than ``tilt`` radians."""
    assert settings.tilt is not None
    return inputs.upright < math.cos(settings.tilt)


def low(inputs: StepInputs, settings: TerminationConfiguration) -> torch.Tensor:
    """Return True where the base is lower than ``low`` metres over the ground."""
    assert settings.low is not None
    return inputs.base_height < settings.low


def stuck(inputs: StepInputs, settings: TerminationConfiguration) -> torch.Tensor:
    """Return True where nearly all of the commanded speed has been missing for about ``stuck`` seconds: an average that began at 0 has
    come to ``STUCK_SHORTFALL`` after this much time at a standstill.
    """
    assert settings.stuck is not None
    missing = torch.where(commanded_to_move(inputs.command), 1.0 - progress_share(inputs), 0.0).nan_to_num(0.0)
    inputs.shortfall.lerp_(missing, 1.0 - (1.0 - STUCK_SHORTFALL) ** (inputs.period / settings.stuck))
    return (inputs.shortfall > STUCK_SHORTFALL) & (inputs.progress >= settings.stuck_from) & inputs.can_be_stuck


def diverged(inputs: StepInputs, settings: TerminationConfiguration) -> torch.Tensor:
    """Return True where the physics has diverged: no fault of the policy."""
    return inputs.diverged


_TIME_OUTS = (time_out, left_tile)
TERMINATIONS: dict[str, Rule] = {f.__name__: f for f in (*_TIME_OUTS, trunk_contact, tilt, low, stuck, diverged)}
"""All rules by name: time-outs, then failures. A rule is left out where its setting, of the same name, is None; ``own`` adds more."""


@dataclass(frozen=True, kw_only=True)
class Ends:
    """Ends of episodes, with their reasons."""

    failed: torch.Tensor
    """(N,) bool."""
    time_out: torch.Tensor
    """Ends that are no failure, (N,) bool."""
    by_rule: torch.Tensor
    """Worlds that each rule ends, (N, rules) bool; no time-outs beside a failure."""


class Terminations:
    """The rules in use."""

    def __init__(self, configuration: TerminationConfiguration) -> None:
        """Choose the rules. Raises ConfigurationError: a rule of one's own is not there."""
        self._settings = configuration
        used = {name: rule for name, rule in TERMINATIONS.items() if getattr(configuration, name, True) is not None}
        own = resolve_own(
            configuration.own,
            "environment.termination.own",
            taken=TERMINATIONS,
            gives=lambda inputs, found: found.shape == inputs.command.shape[:1] and found.dtype is torch.bool,
            rule="it must be true or false for each world, (N,) bool",
        )
        time_outs = {*(f.__name__ for f in _TIME_OUTS), *(term.name for term in configuration.own if term.time_out)}
        # Time-outs first, so that each sort is neighbouring columns.
        rules = dict(sorted((used | own).items(), key=lambda rule: rule[0] not in time_outs))
        self.names: tuple[str, ...] = tuple(rules)
        self._rules = list(rules.values())
        self._time_outs = len(time_outs)

    def __call__(self, inputs: StepInputs) -> Ends:
        """Return the ends of every world's episode, and set ``inputs.failed``."""
        flags = torch.stack([rule(inputs, self._settings) for rule in self._rules], dim=1)
        time_outs, failures = flags[:, : self._time_outs], flags[:, self._time_outs :]
        inputs.failed = failed = failures.any(dim=1)
        alone = time_outs & ~failed[:, None]
        return Ends(failed=failed, time_out=alone.any(dim=1), by_rule=torch.cat((alone, failures), dim=1))
