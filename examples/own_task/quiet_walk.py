"""A task of one's own: a robot that carries something that must not fall off, in gusts of wind.

    PYTHONPATH=examples/own_task gaitgauge train quiet_walk:TASK --iterations 400

It is ``go2-flat`` with a reward, an end of episodes, an observation and an event more. Each is a function; the settings
name it, so that a run that is resumed finds it again.
"""

import math
from dataclasses import replace

import torch
from gaitgauge.training.environment.configuration import (
    OwnEvent,
    OwnObservation,
    OwnReward,
    OwnTermination,
    TerminationConfiguration,
)
from gaitgauge.training.environment.environment import TrainingEnvironment
from gaitgauge.training.environment.observations import ObservationInputs
from gaitgauge.training.environment.step_inputs import StepInputs
from gaitgauge.training.tasks import find_task

LARGEST_TILT = 0.5
"""Angle from which the load slides off [rad]."""
WIND = 20.0
"""Largest force of the wind [N]."""


def soft_landing(inputs: StepInputs) -> torch.Tensor:
    """Sum of the feet's squared downward speeds close to the ground [m²/s²], (N,)."""
    down = inputs.foot_velocity_w[..., 2].clamp(max=0.0)
    return (down.square() * (inputs.foot_height < 0.05)).sum(dim=1)


def load_lost(inputs: StepInputs, settings: TerminationConfiguration) -> torch.Tensor:
    """The load has slid off, (N,) bool."""
    return inputs.upright < math.cos(LARGEST_TILT)


def base_height(inputs: ObservationInputs) -> torch.Tensor:
    """Height of the base over the middle of the scan, (N, 1)."""
    middle = inputs.ground[:, inputs.ground.shape[1] // 2]
    return (inputs.state.base_position_w[:, 2] - middle)[:, None]


def gust(environment: TrainingEnvironment, begun: torch.Tensor) -> None:
    """Another sideways wind in every world, about once in two seconds; ``begun`` are worlds that start an episode."""
    if environment.common_step_counter % 100 == 0:
        force = torch.zeros(environment.num_envs, 3, device=environment.device)
        force[:, 1].uniform_(-WIND, WIND)
        environment.backend.apply_force(force)


_BASE = find_task("go2-flat")
_SETTINGS = _BASE.environment
TASK = replace(
    _BASE,
    title="Unitree Go2 carries a load in gusts of wind",
    environment=replace(
        _SETTINGS,
        rewards=replace(
            _SETTINGS.rewards,
            own=(OwnReward(name="soft_landing", function="quiet_walk:soft_landing", weight=-0.5),),
        ),
        termination=replace(
            _SETTINGS.termination, own=(OwnTermination(name="load_lost", function="quiet_walk:load_lost"),)
        ),
        observations=replace(
            _SETTINGS.observations, own=(OwnObservation(name="base_height", function="quiet_walk:base_height"),)
        ),
        events=(OwnEvent(name="gust", function="quiet_walk:gust"),),
    ),
    # Mirror images know the entries of the standard observations only.
    training=replace(_BASE.training, algorithm=replace(_BASE.training.algorithm, symmetry="none")),
)
