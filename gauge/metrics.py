"""What is measured of a motion at one instant. Every metric is 1 for a perfect motion and falls with the error; nothing is clamped.

Paper table ``Metrics for the RoboGauge Framework`` and its appendix ``Stability Metric``; gauge protocol §6.2 and §6.5.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ..backends.base import PhysicsState
from ..robots.base import Robot
from ..robots.body_plan import LEG_PARTS, body_plan, joint_ranges, stance_span
from ..robots.rotation import projected_gravity, rotate_inverse
from .suite import Metrics, SuiteError


def linear_velocity(
    quaternion: torch.Tensor, velocity_w: torch.Tensor, command: torch.Tensor, scale: torch.Tensor, kind: str
) -> torch.Tensor:
    """1 - ‖v - v*‖ / scale, with v in the body frame (Lin. Velocity Error), (N,).

    Args:
        quaternion: base orientation wxyz, (N, 4).
        velocity_w: base velocity, world frame [m/s], (N, 3).
        command: forward, lateral [m/s] and yaw [rad/s], (N, 3).
        scale: error that scores zero [m/s], (N,).
        kind: ``body``: all three components, the vertical one against zero; ``commanded``: the first two.
    """
    error = rotate_inverse(quaternion, velocity_w)
    error = torch.cat((error[:, :2] - command[:, :2], error[:, 2:]), dim=1)
    if kind == "commanded":
        error = error[:, :2]
    return 1.0 - torch.linalg.vector_norm(error, dim=1) / scale


def angular_velocity(
    quaternion: torch.Tensor, velocity_b: torch.Tensor, command: torch.Tensor, scale: torch.Tensor, kind: str
) -> torch.Tensor:
    """1 - ‖ω - ω*‖ / scale (Ang. Velocity Error), (N,).

    Args:
        quaternion: base orientation wxyz, (N, 4).
        velocity_b: angular velocity in the body frame [rad/s], (N, 3).
        command: as for ``linear_velocity``.
        scale: error that scores zero [rad/s], (N,).
        kind: ``body``: all three components, roll and pitch rate against zero; ``commanded``: the yaw rate alone;
            ``twice-rotated``: all three of the body rates turned into the body frame once more, the reference's slip.
    """
    rate = rotate_inverse(quaternion, velocity_b) if kind == "twice-rotated" else velocity_b
    yaw = rate[:, 2] - command[:, 2]
    if kind == "commanded":
        return 1.0 - yaw.abs() / scale
    return 1.0 - torch.sqrt(rate[:, 0] ** 2 + rate[:, 1] ** 2 + yaw**2) / scale


def joint_limits(position: torch.Tensor, low: torch.Tensor, high: torch.Tensor, full: torch.Tensor) -> torch.Tensor:
    """1 - RMS over joints of the overshoot outside [low, high] as a share of the full range (Dof Limits).

    ``position`` (N, W) [rad]; ``low``, ``high``, ``full`` (W,) [rad]; returns (N,).
    """
    over = (torch.relu(low - position) + torch.relu(position - high)) / full
    return 1.0 - torch.sqrt((over**2).mean(1))


def joint_power(torque: torch.Tensor, velocity: torch.Tensor, scale: float) -> torch.Tensor:
    """1 - RMS over joints of |τ q̇| / scale (Dof Power). ``torque`` [N·m], ``velocity`` [rad/s], (N, J); ``scale`` [W]; (N,)."""
    return 1.0 - torch.sqrt(((torque * velocity) ** 2).mean(1)) / scale


def orientation(quaternion: torch.Tensor) -> torch.Tensor:
    """1 - |lateral component of the gravity direction in the body frame| (Orientation Stability): roll alone. (N, 4) to (N,)."""
    return 1.0 - projected_gravity(quaternion)[:, 1].abs()


def torque_smoothness(torque: torch.Tensor, before: torch.Tensor, known: torch.Tensor, scale: float) -> torch.Tensor:
    """1 - RMS over joints of τ - τ_before, over scale (Torque Smoothness); 1 where no torque before is known.

    ``torque``, ``before`` (N, J) [N·m], ``known`` (N,) bool, ``scale`` [N·m]; returns (N,).
    """
    change = torch.sqrt(((torque - before) ** 2).mean(1)) / scale
    return torch.where(known, 1.0 - change, torch.ones_like(change))


def zmp_margin(moment: torch.Tensor, force: torch.Tensor, span: float) -> torch.Tensor:
    """max(0, 1 - ‖(x, y)‖ / span), the zero moment point's distance from the centre of the active contacts (appendix, ZMP Margin).

    By Newton and Euler the inertial and gravitational wrench of all bodies is the opposite of the contact wrench, so the
    paper's x = -M_y/F_z, y = M_x/F_z follow from the contacts alone.

    Args:
        moment: moment of the ground contacts about their centre, world axes [N·m], (N, 3).
        force: net force of the ground contacts, world frame [N], (N, 3).
        span: diagonal stance span [m].

    Returns:
        (N,); meaningless where the vertical force vanishes.
    """
    return torch.clamp(1.0 - torch.hypot(moment[:, 0], moment[:, 1]) / (force[:, 2].abs() * span + 1e-12), min=0.0)


def friction_margin(normal: torch.Tensor, tangential: torch.Tensor, friction: torch.Tensor) -> torch.Tensor:
    """Normal-force-weighted slack to the friction cone over the feet's contacts (appendix, Coulomb Friction Margin).

    With weights f_n/Σf_n the weighted mean of 1 - f_t/(μ f_n) is 1 - Σf_t / (μ Σf_n).

    Args:
        normal: sum of the normal forces of each foot's contacts, along each contact's own normal [N], (N, F).
        tangential: sum of the magnitudes of their tangential forces [N], (N, F).
        friction: friction coefficient, (N,).

    Returns:
        (N,); meaningless without contact.
    """
    slack = 1.0 - tangential / (friction[:, None] * normal + 1e-12)
    return (normal * torch.clamp(slack, min=0.0)).sum(1) / (normal.sum(1) + 1e-12)


def quality(values: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Weighted geometric mean of the metrics of a sample, each clamped to [1e-9, 1] (gauge protocol §6.3).

    Metrics that are not defined (NaN) drop out of the product and of the sum of weights. ``values`` (N, M), ``weights``
    (M,); returns (N,).
    """
    defined = ~torch.isnan(values)
    logs = torch.log(torch.clamp(torch.where(defined, values, torch.ones_like(values)), 1e-9, 1.0))
    return torch.exp((logs * weights).sum(1) / (defined * weights).sum(1))


def fill_flight(values: torch.Tensor, keep: torch.Tensor) -> torch.Tensor:
    """The metrics of a segment without gaps: where one is not defined stands its mean over the instants that count.

    So flight neither raises nor lowers what contacts say of a motion. Zero where no instant defines the metric.

    Args:
        values: (T, M), NaN where a metric is not defined; clamped to [0, 1] before they are averaged.
        keep: whether the instant counts, (T,) bool.
    """
    defined = ~torch.isnan(values)
    told = torch.where(defined & keep[:, None], torch.clamp(values, 0.0, 1.0), torch.zeros_like(values))
    mean = told.sum(0) / torch.clamp((defined & keep[:, None]).sum(0), min=1)
    return torch.where(defined, values, mean)


@dataclass(frozen=True, kw_only=True)
class SampledState:
    """The part of ``PhysicsState`` that metrics look at, of T samples, in the same frames and units."""

    base_quaternion_w: torch.Tensor
    base_linear_velocity_w: torch.Tensor
    base_angular_velocity_b: torch.Tensor
    joint_position: torch.Tensor
    joint_velocity: torch.Tensor
    joint_torque: torch.Tensor
    ground_moment_w: torch.Tensor
    ground_force_w: torch.Tensor
    foot_normal_force: torch.Tensor
    foot_tangential_force: torch.Tensor


def _joints_of(robot: Robot, parts: tuple[str, ...]) -> list[int]:
    """Joints that a suite names by parts of legs (``LEG_PARTS``), or by parts of their names."""
    plan = body_plan(robot)
    return [
        j
        for j, name in enumerate(robot.joint_names)
        if any(plan.part(j) == part if part in LEG_PARTS else part in name for part in parts)
    ]


class MetricEvaluator:
    """All metrics of a suite for N instants at once."""

    def __init__(self, metrics: Metrics, robot: Robot, weight: float, device: torch.device, dtype: torch.dtype) -> None:
        """Prepare the constants; ``weight`` is that of the robot [N]."""
        self.names = tuple(metrics.weights)
        self.needs_contacts = not {"zmp_margin", "friction_margin"}.isdisjoint(self.names)
        self._metrics = metrics
        self._weight = weight
        self._weights = torch.tensor([metrics.weights[n] for n in self.names], device=device, dtype=dtype)
        bounds = joint_ranges(robot)
        watched = [j for j in _joints_of(robot, metrics.soft_limit_joints) if np.isfinite(bounds[j]).all()]
        if not watched and "dof_limits" in self.names:
            raise SuiteError(
                f"the metric 'dof_limits' watches {', '.join(metrics.soft_limit_joints)}, of which robot '{robot.name}' has no "
                "joint with limits; give its joints a range in the model"
            )
        ranges = torch.tensor(bounds[watched].reshape(-1, 2), device=device, dtype=dtype)
        middle, self._full = ranges.mean(1), ranges[:, 1] - ranges[:, 0]
        self._low, self._high = (
            middle - 0.5 * metrics.soft_limit * self._full,
            middle + 0.5 * metrics.soft_limit * self._full,
        )
        self._watched = torch.tensor(watched, device=device)
        self._span = stance_span(robot) if metrics.zmp_span is None else metrics.zmp_span

    def evaluate(
        self,
        state: SampledState | PhysicsState,
        command: torch.Tensor,
        limits: torch.Tensor,
        friction: torch.Tensor,
        torque_before: torch.Tensor,
        torque_known: torch.Tensor,
    ) -> torch.Tensor:
        """Metrics of one instant, (N, M), NaN where a metric is not defined.

        Args:
            state: N instants; contacts are looked at only if ``needs_contacts``.
            command: commanded velocities, (N, 3).
            limits: command limits, (N, 3): their norm and the yaw limit scale the tracking errors.
            friction: friction coefficient, (N,).
            torque_before: torque to compare with [N·m], (N, J).
            torque_known: whether there is one, (N,) bool.
        """
        m, columns = self._metrics, []
        for name in self.names:
            if name == "lin_vel_err":
                scale = torch.hypot(limits[:, 0], limits[:, 1])
                value = linear_velocity(
                    state.base_quaternion_w, state.base_linear_velocity_w, command, scale, m.linear_velocity
                )
            elif name == "ang_vel_err":
                value = angular_velocity(
                    state.base_quaternion_w, state.base_angular_velocity_b, command, limits[:, 2], m.angular_velocity
                )
            elif name == "dof_limits":
                value = joint_limits(state.joint_position[:, self._watched], self._low, self._high, self._full)
            elif name == "dof_power":
                value = joint_power(state.joint_torque, state.joint_velocity, m.power_scale)
            elif name == "orientation_stability":
                value = orientation(state.base_quaternion_w)
            elif name == "torque_smoothness":
                value = torque_smoothness(state.joint_torque, torque_before, torque_known, m.torque_scale)
            elif name == "zmp_margin":
                value = zmp_margin(state.ground_moment_w, state.ground_force_w, self._span)
                carried = state.ground_force_w[:, 2] > m.contact_share * self._weight
                value = torch.where(carried, value, torch.full_like(value, math.nan))
            else:
                assert name == "friction_margin"  # the last of METRIC_NAMES
                value = friction_margin(state.foot_normal_force, state.foot_tangential_force, friction)
                carried = state.foot_normal_force.sum(1) > m.contact_share * self._weight
                value = torch.where(carried, value, torch.full_like(value, math.nan))
            columns.append(value)
        return torch.stack(columns, dim=1)

    def with_quality(self, values: torch.Tensor, keep: torch.Tensor, counts: Sequence[int]) -> torch.Tensor:
        """The metrics, and the quality of each instant as their last column, (N, M + 1).

        Args:
            values: metrics of the instants of some segments, one after the other, (N, M).
            keep: whether each counts, (N,) bool.
            counts: number of instants of each segment.
        """
        seen = values
        if self.needs_contacts and self._metrics.flight == "filled":
            pieces = zip(values.split(list(counts)), keep.split(list(counts)), strict=True)
            seen = torch.cat([fill_flight(*piece) for piece in pieces])
        return torch.cat((values, quality(seen, self._weights)[:, None]), dim=1)
