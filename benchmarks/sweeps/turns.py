"""Turns on the spot that a policy has to correct by what it feels: an own penalty, worlds at both ends of the feet's torsion, a task.

    PYTHONPATH=benchmarks/sweeps gaitgauge sweep benchmarks/sweeps/feet-by-world.toml

Where feet resist turning in some worlds and turn freely in others, one answer to a commanded yaw rate is wrong in all of them. A
policy can feel the difference: by the gyroscope, and by joints that stay behind their targets.
"""

from dataclasses import replace
from weakref import WeakSet

import torch
from gaitgauge.backends.base import Randomization
from gaitgauge.training.configuration import Ramp
from gaitgauge.training.environment.configuration import OwnEvent, OwnReward
from gaitgauge.training.environment.environment import TrainingEnvironment
from gaitgauge.training.environment.step_inputs import StepInputs
from gaitgauge.training.tasks import find_task

SHARE_AT_EACH_END = 0.4
"""Worlds with free feet, and as many with the model's; torsion is uniform in the rest."""
SLOWEST_TURN = 0.2
"""Commanded yaw rate from which a turn on the spot counts [rad/s]."""
LARGEST_ERROR = 1.0
"""Error of the yaw rate from which ``turn_error`` grows no more [rad/s]."""
_SPREAD: WeakSet[TrainingEnvironment] = WeakSet()


def turn_error(inputs: StepInputs) -> torch.Tensor:
    """Absolute error of the yaw rate in turns on the spot, at most ``LARGEST_ERROR`` [rad/s], (N,).

    Unlike ``yaw_tracking`` it has the same slope at half and at one and a half times the commanded rate.
    """
    linear, yaw = inputs.command[:, :2], inputs.command[:, 2]
    turns = (linear.square().sum(dim=1) < 0.01) & (yaw.abs() > SLOWEST_TURN)
    error = (yaw - inputs.base_angular_velocity_b[:, 2]).abs().clamp(max=LARGEST_ERROR)
    return torch.where(turns, error, 0.0)


def feet_at_both_ends(environment: TrainingEnvironment, done: torch.Tensor) -> None:
    """Give each world a factor on its feet's torsional and rolling friction, once: 0, 1 or, in the rest, between."""
    if environment in _SPREAD:
        return
    _SPREAD.add(environment)
    generator = torch.Generator(device=done.device).manual_seed(environment.cfg.seed)
    drawn = torch.rand(done.shape[0], generator=generator, device=done.device)
    between = (drawn - SHARE_AT_EACH_END) / (1.0 - 2.0 * SHARE_AT_EACH_END)
    environment.backend.randomize(Randomization(foot_torsion=between.clamp(0.0, 1.0)))


_MOE = find_task("go2-moe-cts")
_SETTINGS = _MOE.environment
MOE_TURNS = replace(
    _MOE,
    environment=replace(
        _SETTINGS,
        rewards=replace(
            _SETTINGS.rewards,
            yaw_tracking=1.5,
            own=(OwnReward(name="turn_error", function="turns:turn_error", weight=-2.0),),
        ),
        commands=replace(
            _SETTINGS.commands,
            stationary_probability=Ramp(start=0.15, end=0.15),
            stationary_yaw_probability=0.75,
            stationary_longest=4.0,
        ),
        events=(OwnEvent(name="feet_at_both_ends", function="turns:feet_at_both_ends"),),
    ),
)
"""Go2 on all terrains with turns on the spot in 11 % of the draws, 30 % on level ground, and a price on their error."""
