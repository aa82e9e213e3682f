"""Reward terms. Each is a function of ``StepInputs`` that returns one number per world, unweighted; ``REWARD_TERMS`` names them.

Formulas follow the paper's table of rewards in the reading of the published code; where they differ,
``docs/reference/training-settings.md`` names the choice.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch

from ...robots.rotation import projected_gravity
from ..configuration import Ramp
from .gait_rewards import GAIT_TERMS
from .own_terms import resolve_own
from .reward_configuration import RewardWeights
from .schedules import RampTable
from .step_inputs import StepInputs
from .terrain_configuration import TileConfiguration

SLOWEST_COMMAND = 0.1
"""Commanded speed below which nothing is asked of a robot's progress [m/s]."""
SLOWEST_TURN, LARGEST_TURN_ERROR = 0.2, 1.0
"""Commanded yaw rate from which a turn on the spot is judged, and the error from which its penalty grows no more [rad/s]."""


def linear_tracking(inputs: StepInputs) -> torch.Tensor:
    """exp(−(Δvx²/σx + Δvy²/σy)), body frame. The paper multiplies by sigma; the code divides, and so does this."""
    error = (inputs.command[:, :2] - inputs.base_linear_velocity_b[:, :2]).square() / inputs.sigma[:, :2]
    return torch.exp(-error.sum(dim=1))


def yaw_tracking(inputs: StepInputs) -> torch.Tensor:
    """exp(−Δωz²/σw)."""
    error = inputs.command[:, 2] - inputs.base_angular_velocity_b[:, 2]
    return torch.exp(-error.square() / inputs.sigma[:, 2])


def turn_error(inputs: StepInputs) -> torch.Tensor:
    """Absolute error of the yaw rate [rad/s], averaged over ``turn_error_time``, at most ``LARGEST_TURN_ERROR``; 0 but for turns on the
    spot of ``SLOWEST_TURN`` or more.
    """
    yaw, error = inputs.command[:, 2], inputs.turn_error
    if error is None:
        error = yaw - inputs.base_angular_velocity_b[:, 2]
    turns = ~commanded_to_move(inputs.command) & (yaw.abs() >= SLOWEST_TURN)
    return torch.where(turns, error.abs().clamp(max=LARGEST_TURN_ERROR), 0.0)


def progress(inputs: StepInputs) -> torch.Tensor:
    """Velocity along the commanded direction, seen from the commanded heading, over the commanded speed, within ±1; 0 below
    ``SLOWEST_COMMAND``.
    """
    return torch.where(commanded_to_move(inputs.command), progress_share(inputs), 0.0)


def progress_share(inputs: StepInputs) -> torch.Tensor:
    """Share of the commanded speed that the robot has along the command, within ±1; without a meaning below ``SLOWEST_COMMAND``. A robot
    that turned away from the commanded heading has to make its way from where it is.
    """
    command, wanted = inputs.command[:, :2], inputs.commanded_heading_xy
    (forward, lateral), (x, y) = inputs.base_linear_velocity_b[:, :2].unbind(1), inputs.heading_xy.unbind(1)
    # Cosine and sine of the angle from the commanded heading to the robot's own.
    cos, sin = x * wanted[:, 0] + y * wanted[:, 1], y * wanted[:, 0] - x * wanted[:, 1]
    along = (cos * forward - sin * lateral) * command[:, 0] + (sin * forward + cos * lateral) * command[:, 1]
    return torch.clamp(along / command.square().sum(dim=1).clamp_min(SLOWEST_COMMAND**2), -1.0, 1.0)


def commanded_to_move(command: torch.Tensor) -> torch.Tensor:
    """Return True where the linear command is fast enough to ask for progress, (N,) bool."""
    return command[:, :2].square().sum(dim=1) >= SLOWEST_COMMAND**2


def vertical_velocity(inputs: StepInputs) -> torch.Tensor:
    """vz² in the body frame [m²/s²]."""
    return inputs.base_linear_velocity_b[:, 2].square()


def roll_pitch_rate(inputs: StepInputs) -> torch.Tensor:
    """ωx² + ωy² [rad²/s²]."""
    return inputs.base_angular_velocity_b[:, :2].square().sum(dim=1)


def joint_acceleration(inputs: StepInputs) -> torch.Tensor:
    """Sum of squared joint accelerations [rad²/s⁴]."""
    return inputs.joint_acceleration.square().sum(dim=1)


def joint_power(inputs: StepInputs) -> torch.Tensor:
    """Sum of absolute mechanical powers [W]."""
    return (inputs.joint_torque * inputs.joint_velocity).abs().sum(dim=1)


def torque(inputs: StepInputs) -> torch.Tensor:
    """Sum of squared torques [N²·m²]."""
    return inputs.joint_torque.square().sum(dim=1)


def base_height(inputs: StepInputs) -> torch.Tensor:
    """Squared error of the base's height [m²]."""
    return (inputs.base_height - inputs.base_height_target).square()


def action_rate(inputs: StepInputs) -> torch.Tensor:
    """Sum of squared first differences of the raw actions."""
    return (inputs.action - inputs.previous_action).square().sum(dim=1)


def action_smoothness(inputs: StepInputs) -> torch.Tensor:
    """Sum of squared second differences of the raw actions."""
    change = torch.sub(inputs.action, inputs.previous_action, alpha=2.0) + inputs.second_previous_action
    return change.square().sum(dim=1)


def collision(inputs: StepInputs) -> torch.Tensor:
    """Number of thighs, calves and what hangs on them in contact."""
    return inputs.touching_bodies


def base_collision(inputs: StepInputs) -> torch.Tensor:
    """1 while the base touches something."""
    return inputs.base_touching


def joint_limits(inputs: StepInputs) -> torch.Tensor:
    """Sum of the angles beyond the soft limits [rad]. The paper counts joints; the code's angle has a slope to follow."""
    below = (inputs.soft_lower - inputs.joint_position).clamp_min(0.0)
    above = (inputs.joint_position - inputs.soft_upper).clamp_min(0.0)
    return (below + above).sum(dim=1)


def joint_speed_limits(inputs: StepInputs) -> torch.Tensor:
    """Sum of the joint speeds beyond the soft limits of the motors [rad/s]."""
    return (inputs.joint_velocity.abs() - inputs.soft_speed).clamp_min(0.0).sum(dim=1)


def foot_regulation(inputs: StepInputs) -> torch.Tensor:
    """Sum over the feet of squared horizontal speed times exp(−height/length)."""
    speed = inputs.foot_velocity_w[..., :2].square().sum(dim=-1)
    height = inputs.foot_height.clamp_min(0.0)
    return (speed * torch.exp(height * (-1.0 / inputs.foot_height_length))).sum(dim=1)


def hip_regulation(inputs: StepInputs) -> torch.Tensor:
    """Sum of absolute hip deviations from the standing pose [rad]."""
    deviation = inputs.joint_position - inputs.default_joint_position
    return deviation[:, inputs.hip_joints].abs().sum(dim=1)


def hip_symmetry(inputs: StepInputs) -> torch.Tensor:
    """|vx*| / ‖command‖ · Σ |left hip − mirror image of the right one|, angles from the standing pose [rad]; 0 for the zero command."""
    deviation = (inputs.joint_position - inputs.default_joint_position)[:, inputs.hip_pairs]
    asymmetry = (deviation[..., 0] - inputs.hip_signs * deviation[..., 1]).abs().sum(dim=1)
    share = inputs.command[:, 0].abs() / inputs.command.norm(dim=1).clamp_min(1e-6)
    return share * asymmetry


def roll(inputs: StepInputs) -> torch.Tensor:
    """Squared sideways component of gravity."""
    return projected_gravity(inputs.base_quaternion_w)[:, 1].square()


def torque_change(inputs: StepInputs) -> torch.Tensor:
    """Sum of squared torque changes since the last control step [N²·m²]; 0 in the first of an episode, before which no torque is known."""
    before = inputs.previous_joint_torque
    return (inputs.joint_torque - before).square().sum(dim=1) * (before != 0).any(dim=1)


def stand_still(inputs: StepInputs) -> torch.Tensor:
    """Sum of absolute deviations from the standing pose [rad], under the zero command alone."""
    still = inputs.command.abs().sum(dim=1) < 1e-6
    return (inputs.joint_position - inputs.default_joint_position).abs().sum(dim=1) * still


def termination(inputs: StepInputs) -> torch.Tensor:
    """1 for an episode that ends as a failure."""
    return inputs.failed.float()


RewardTerm = Callable[[StepInputs], torch.Tensor]

REWARD_TERMS: Mapping[str, RewardTerm] = {
    f.__name__: f
    for f in (
        linear_tracking,
        yaw_tracking,
        turn_error,
        progress,
        vertical_velocity,
        roll_pitch_rate,
        joint_acceleration,
        joint_power,
        torque,
        base_height,
        action_rate,
        action_smoothness,
        collision,
        base_collision,
        joint_limits,
        joint_speed_limits,
        foot_regulation,
        hip_regulation,
        hip_symmetry,
        roll,
        torque_change,
        stand_still,
        termination,
        *GAIT_TERMS,
    )
}
"""All terms by the names of their weights in ``RewardWeights``, which adds those of one's own."""


PAID_BY_TILE = ("linear_tracking", "yaw_tracking", "progress", "vertical_velocity", "roll_pitch_rate")
"""Terms with a factor for each kind of tile, under the same name in ``TileConfiguration``."""


class RewardFunction:
    """Weighted sum of the terms with a weight other than zero."""

    def __init__(
        self,
        configuration: RewardWeights,
        control_period: float,
        kind: torch.Tensor,
        tiles: Sequence[TileConfiguration],
    ) -> None:
        """Choose the terms and put their weights on the device of ``kind``, the kind of tile of each world, (N,) int64, out of ``tiles``.
        Raises ConfigurationError: a term of one's own is not there.
        """
        device = kind.device
        own = resolve_own(
            configuration.own,
            "environment.rewards.own",
            taken=REWARD_TERMS,
            gives=lambda inputs, found: found.shape == inputs.command.shape[:1],
            rule="it must be one number for each world, (N,)",
        )
        weights: dict[str, Ramp | float] = {name: getattr(configuration, name) for name in REWARD_TERMS}
        weights |= {term.name: term.weight for term in configuration.own}
        used = {name: weight for name, weight in weights.items() if weight != 0.0}
        self.names: tuple[str, ...] = tuple(used)
        terms = {**REWARD_TERMS, **own}
        self._terms = [terms[name] for name in self.names]
        self._weights = RampTable(list(used.values()), device)
        # The termination penalty is per fall; all other weights are per second.
        period = [1.0 if name == "termination" else control_period for name in self.names]
        self._period = torch.tensor(period, device=device)
        rows = [[getattr(tile, name) if name in PAID_BY_TILE else 1.0 for name in self.names] for tile in tiles]
        factors = torch.tensor(rows)
        self._factors = factors.to(device)[kind] if bool((factors != 1.0).any()) else None

    def __call__(self, inputs: StepInputs, progress: torch.Tensor) -> torch.Tensor:
        """Weighted rewards of every term, (N, terms), at a fraction of the run (scalar tensor)."""
        values = torch.stack([term(inputs) for term in self._terms], dim=1)
        weights = self._weights.at(progress) * self._period
        return values * (weights if self._factors is None else weights * self._factors)
