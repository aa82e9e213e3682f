"""The metrics of a motion at one instant, and their table, which plug-ins extend.

Every metric is 1 for a perfect motion and falls with the error; nothing is clamped. Paper table ``Metrics for the RoboGauge
Framework`` and its appendix ``Stability Metric``; gauge protocol §6.2 and §6.5.

A plug-in is an entry point of the group ``gaitgauge.metrics``. Its name is that of the metric, its value refers to a ``Metric``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial

import torch

from ..backends.base import PhysicsState
from ..files.parsing import did_you_mean, shown
from ..files.plugins import guarded, load_plugin, origin, plugins
from ..robots.base import Robot
from ..robots.rotation import projected_gravity, rotate_inverse
from .episodes import MOTION
from .instants import Instants, MetricConstants, MetricError
from .metric_rules import Metrics

GROUP = "gaitgauge.metrics"


# ---- functions ----------------------------------------------------------------------------------------------------------


def linear_velocity(
    quaternion: torch.Tensor, velocity_w: torch.Tensor, command: torch.Tensor, scale: torch.Tensor, kind: str
) -> torch.Tensor:
    """Return 1 - ‖v - v*‖ / scale, with v in the body frame (Lin. Velocity Error), (N,).

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
    """Return 1 - ‖ω - ω*‖ / scale (Ang. Velocity Error), (N,).

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
    """Return 1 - RMS over joints of the overshoot outside [low, high] as a share of the full range (Dof Limits).

    ``position`` (N, W) [rad]; ``low``, ``high``, ``full`` (W,) [rad]; returns (N,).
    """
    over = (torch.relu(low - position) + torch.relu(position - high)) / full
    return 1.0 - torch.sqrt((over**2).mean(1))


def joint_power(torque: torch.Tensor, velocity: torch.Tensor, scale: float) -> torch.Tensor:
    """Return 1 - RMS over joints of |τ q̇| / scale (Dof Power), (N,). ``torque`` [N·m], ``velocity`` [rad/s], (N, J); ``scale`` [W]."""
    return 1.0 - torch.sqrt(((torque * velocity) ** 2).mean(1)) / scale


def orientation(quaternion: torch.Tensor) -> torch.Tensor:
    """Return 1 - |lateral component of gravity's direction in the body frame| (Orientation Stability), roll alone: (N, 4) to (N,)."""
    return 1.0 - projected_gravity(quaternion)[:, 1].abs()


def upright(quaternion: torch.Tensor) -> torch.Tensor:
    """Return 1 - sin of the base's tilt, roll and pitch together: (N, 4) to (N,)."""
    return 1.0 - torch.linalg.vector_norm(projected_gravity(quaternion)[:, :2], dim=1)


def torque_smoothness(torque: torch.Tensor, before: torch.Tensor, known: torch.Tensor, scale: float) -> torch.Tensor:
    """Return 1 - RMS over joints of τ - τ_before, over scale (Torque Smoothness); 1 where no torque before is known.

    ``torque``, ``before`` (N, J) [N·m], ``known`` (N,) bool, ``scale`` [N·m]; returns (N,).
    """
    change = torch.sqrt(((torque - before) ** 2).mean(1)) / scale
    return torch.where(known, 1.0 - change, torch.ones_like(change))


def zmp_margin(moment: torch.Tensor, force: torch.Tensor, span: float) -> torch.Tensor:
    """Return max(0, 1 - d / span) with d = ‖(x, y)‖, the zero moment point's distance from the centre of the contacts (appendix).

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


def friction_margin(
    normal: torch.Tensor, tangential: torch.Tensor, friction: torch.Tensor, least: float = 0.0
) -> torch.Tensor:
    """Return the normal-force-weighted slack to the friction cone over the feet's contacts (appendix, Coulomb Friction Margin).

    With weights f_n/Σf_n the weighted mean of 1 - f_t/(μ f_n) is 1 - Σf_t / (μ Σf_n).

    Args:
        normal: sum of the normal forces of each foot's contacts, along each contact's own normal [N], (N, F).
        tangential: sum of the magnitudes of their tangential forces [N], (N, F).
        friction: friction coefficient, (N,).
        least: normal force up to which a foot does not count, and limit μ f_n up to which its slack is zero [N].

    Returns:
        (N,); meaningless without contact.
    """
    limit, counted = friction[:, None] * normal, normal * (normal > least)
    slack = torch.clamp(1.0 - tangential / (limit + 1e-12), min=0.0) * (limit > least)
    return (counted * slack).sum(1) / (counted.sum(1) + 1e-12)


def motion_done(velocity: torch.Tensor, command: torch.Tensor, limits: torch.Tensor) -> torch.Tensor:
    """Return the part of a velocity along the command, as a share of the command; NaN where nothing is commanded, (N,).

    All three are taken as shares of the limits, so that metres and radians add up: v · v* / ‖v*‖².

    Args:
        velocity: forward, lateral [m/s] and yaw rate [rad/s] in the body frame, (N, 3).
        command: commanded values of the same, (N, 3).
        limits: command limits, (N, 3).
    """
    done, asked = velocity / limits, command / limits
    size = (asked**2).sum(1)
    return torch.where(size > 1e-9, (done * asked).sum(1) / size, torch.full_like(size, math.nan))


def quality(values: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Return the weighted geometric mean of the metrics of a sample, each clamped to [1e-9, 1] (gauge protocol §6.3).

    Metrics that are not defined (NaN) drop out of the product and of the sum of weights. ``values`` (N, M), ``weights``
    (M,); returns (N,).
    """
    defined = ~torch.isnan(values)
    logs = torch.log(torch.clamp(torch.where(defined, values, torch.ones_like(values)), 1e-9, 1.0))
    return torch.exp((logs * weights).sum(1) / (defined * weights).sum(1))


def fill_flight(values: torch.Tensor, keep: torch.Tensor) -> torch.Tensor:
    """Return the metrics of a segment without gaps: the mean over the instants that count stands where a metric is not defined.

    Flight then neither raises nor lowers the contact metrics of a motion. The mean is zero where no instant defines the metric.

    Args:
        values: (T, M), NaN where a metric is not defined; clamped to [0, 1] before they are averaged.
        keep: instants that count, (T,) bool.
    """
    defined = ~torch.isnan(values)
    told = torch.where(defined & keep[:, None], torch.clamp(values, 0.0, 1.0), torch.zeros_like(values))
    mean = told.sum(0) / torch.clamp((defined & keep[:, None]).sum(0), min=1)
    return torch.where(defined, values, mean)


# ---- the table ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Metric:
    """One entry of the table."""

    function: Callable[[Instants], torch.Tensor]
    """Values of N instants, (N,): 1 for a perfect motion, smaller for a worse one, NaN where the metric is not defined."""
    state: tuple[str, ...]
    """Fields of ``PhysicsState`` that the function reads."""
    label: str
    """Name in a report."""
    short_label: str = ""
    """Name at the head of a column; the same as ``label`` if empty."""
    group: str = ""
    """Group in ``gaitgauge validate``: ``tracking``, ``safety``, ``quality`` or another; none if empty. In a score, the suite groups."""
    prepare: Callable[[MetricConstants], object] | None = None
    """Called before anything is played: works out constants from the robot's files, which may be gone later, and raises
    ``MetricError`` if the metric cannot be measured on the robot."""


def _linear_velocity(at: Instants) -> torch.Tensor:
    scale, kind = torch.hypot(at.limits[:, 0], at.limits[:, 1]), at.constants.rules.linear_velocity
    return linear_velocity(at.state.base_quaternion_w, at.state.base_linear_velocity_w, at.command, scale, kind)


def _angular_velocity(at: Instants) -> torch.Tensor:
    scale, kind = at.limits[:, 2], at.constants.rules.angular_velocity
    return angular_velocity(at.state.base_quaternion_w, at.state.base_angular_velocity_b, at.command, scale, kind)


def _motion_done(at: Instants) -> torch.Tensor:
    state = at.state
    linear = rotate_inverse(state.base_quaternion_w, state.base_linear_velocity_w)[:, :2]
    return motion_done(torch.cat((linear, state.base_angular_velocity_b[:, 2:]), dim=1), at.command, at.limits)


def _joint_limits(at: Instants) -> torch.Tensor:
    joints, *limits = at.constants.limits
    return joint_limits(at.state.joint_position[:, joints], *limits)


def _zmp_margin(at: Instants) -> torch.Tensor:
    force = at.state.ground_force_w
    return at.with_contact(force[:, 2], zmp_margin(at.state.ground_moment_w, force, at.constants.span))


def _support_margin(at: Instants) -> torch.Tensor:
    """Return the depth of the ground's pressure in the support polygon over half a sole's width, at most 1."""
    state, constants = at.state, at.constants
    force, moment = state.ground_force_w, state.ground_moment_w
    lift = force[:, 2:].clamp(min=1e-6)
    pressure = state.contact_center_w[:, :2] + torch.stack((-moment[:, 1], moment[:, 0]), dim=1) / lift
    carries = state.foot_normal_force > constants.rules.contact_share * constants.weight
    corners = constants.soles.corners(state.base_position_w, state.base_quaternion_w, state.joint_position)
    share = constants.soles.depth(pressure, corners, carries) / constants.soles.half_width
    return at.with_contact(force[:, 2] * carries.any(dim=1), share.clamp(min=0.0, max=1.0))


def _friction_margin(at: Instants) -> torch.Tensor:
    normal, least = at.state.foot_normal_force, at.constants.rules.foot_force
    margin = friction_margin(normal, at.state.foot_tangential_force, at.friction, least)
    return at.with_contact((normal * (normal > least)).sum(1), margin)


METRICS: Mapping[str, Metric] = {
    "lin_vel_err": Metric(
        function=_linear_velocity,
        state=("base_quaternion_w", "base_linear_velocity_w"),
        label="linear velocity tracking",
        short_label="linear velocity",
        group="tracking",
    ),
    "ang_vel_err": Metric(
        function=_angular_velocity,
        state=("base_quaternion_w", "base_angular_velocity_b"),
        label="angular velocity tracking",
        short_label="angular velocity",
        group="tracking",
    ),
    "dof_limits": Metric(
        function=_joint_limits,
        state=("joint_position",),
        label="joint limits",
        group="safety",
        prepare=lambda constants: constants.limits,
    ),
    "dof_power": Metric(
        function=lambda at: joint_power(
            at.state.joint_torque[:, at.constants.motors],
            at.state.joint_velocity[:, at.constants.motors],
            at.constants.rules.power_scale * at.constants.scales.power,
        ),
        state=("joint_torque", "joint_velocity"),
        label="joint power",
        group="safety",
    ),
    "orientation_stability": Metric(
        function=lambda at: orientation(at.state.base_quaternion_w),
        state=("base_quaternion_w",),
        label="orientation stability",
        short_label="orien\u00adtation",
        group="quality",
    ),
    "upright": Metric(
        function=lambda at: upright(at.state.base_quaternion_w),
        state=("base_quaternion_w",),
        label="uprightness",
        group="quality",
    ),
    "torque_smoothness": Metric(
        function=lambda at: torque_smoothness(
            at.state.joint_torque[:, at.constants.motors],
            at.torque_before[:, at.constants.motors],
            at.torque_known,
            at.constants.rules.torque_scale * at.constants.scales.torque,
        ),
        state=("joint_torque",),
        label="torque smoothness",
        short_label="smooth\u00adness",
        group="quality",
    ),
    "zmp_margin": Metric(
        function=_zmp_margin,
        state=("ground_moment_w", "ground_force_w"),
        label="ZMP margin",
        group="quality",
        prepare=lambda constants: constants.span,
    ),
    "support_margin": Metric(
        function=_support_margin,
        state=(
            *("base_position_w", "base_quaternion_w", "joint_position", "foot_normal_force"),
            *("ground_moment_w", "ground_force_w", "contact_center_w"),
        ),
        label="support margin",
        group="quality",
        prepare=lambda constants: constants.soles,
    ),
    "friction_margin": Metric(
        function=_friction_margin,
        state=("foot_normal_force", "foot_tangential_force"),
        label="friction margin",
        group="quality",
    ),
    MOTION: Metric(
        function=_motion_done,
        state=("base_quaternion_w", "base_linear_velocity_w", "base_angular_velocity_b"),
        label="motion done",
    ),
}
"""The metrics of the project."""


def metric_names() -> list[str]:
    """Return the names of all metrics that a suite can weigh, the project's own first."""
    return list(METRICS) + sorted(set(plugins(GROUP)) - set(METRICS))


def find_metric(name: str) -> Metric:
    """Return a metric by its name; raise ``MetricError`` where there is none, or its plug-in fails or gives no ``Metric``."""
    if name in METRICS:
        return METRICS[name]
    plugin = plugins(GROUP).get(name)
    if plugin is None:
        known = metric_names()
        hint = did_you_mean(name, known) or ";"
        raise MetricError(f"metrics.weights has the unknown metric {shown(name)}{hint} choose from {', '.join(known)}")
    metric = load_plugin(plugin, MetricError)
    if not isinstance(metric, Metric):
        raise MetricError(f"{origin(plugin)} gave {shown(type(metric).__name__)}; it must be a Metric")
    columns = [field.name for field in fields(PhysicsState)]
    if missing := [column for column in metric.state if column not in columns]:
        raise MetricError(f"{origin(plugin)} reads the state {shown(missing[0])}; choose from {', '.join(columns)}")
    prepare = metric.prepare and partial(guarded, plugin, MetricError, metric.prepare)
    return replace(metric, function=partial(guarded, plugin, MetricError, metric.function), prepare=prepare)


def metric_label(name: str, *, short: bool = False) -> str:
    """Return a metric's name for readers; a metric that is not installed here, or broken, goes by its own name."""
    try:
        metric = find_metric(name)
    except MetricError:
        return name.replace("_", " ")
    return (short and metric.short_label) or metric.label


def metric_groups(names: Collection[str]) -> dict[str, list[str]]:
    """Return those metrics that have a group, by group; any other names are left out."""
    groups: dict[str, list[str]] = {}
    for name in metric_names():
        if name in names and (group := find_metric(name).group):
            groups.setdefault(group, []).append(name)
    return groups


class MetricEvaluator:
    """All metrics of a suite for N instants at once."""

    def __init__(self, rules: Metrics, robot: Robot, weight: float, device: torch.device, dtype: torch.dtype) -> None:
        """Find the metrics of a robot of ``weight`` [N]; raise ``MetricError`` where one cannot be loaded or measured on the robot."""
        self.names = tuple(rules.weights)
        self.constants = MetricConstants(rules=rules, robot=robot, weight=weight, device=device, dtype=dtype)
        self._metrics = {name: find_metric(name) for name in self.names}
        needed = {column for metric in self._metrics.values() for column in metric.state}
        self.columns = tuple(field.name for field in fields(PhysicsState) if field.name in needed)
        """Fields of ``PhysicsState`` that the metrics read."""
        self._weights = torch.tensor([rules.weights[n] for n in self.names], device=device, dtype=dtype)
        for metric in self._metrics.values():
            if metric.prepare is not None:
                metric.prepare(self.constants)

    def evaluate(self, instants: Instants) -> torch.Tensor:
        """Return metrics of N instants, (N, M), NaN where undefined; raise ``MetricError`` where a plug-in fails or misshapes them."""
        columns = []
        for name, metric in self._metrics.items():
            value, like = metric.function(instants), instants.friction
            if not isinstance(value, torch.Tensor) or value.shape != like.shape:
                found = list(value.shape) if isinstance(value, torch.Tensor) else shown(type(value).__name__)
                raise MetricError(
                    f"metric {shown(name)} gave {found}; it must give a tensor of shape {list(like.shape)}"
                )
            columns.append(value.to(like.dtype))
        return torch.stack(columns, dim=1)

    def with_quality(self, values: torch.Tensor, keep: torch.Tensor, counts: Sequence[int]) -> torch.Tensor:
        """Return the metrics, and the quality of each instant as their last column, (N, M + 1).

        Args:
            values: metrics of the instants of some segments, one after the other, (N, M).
            keep: instants that count, (N,) bool.
            counts: number of instants of each segment.
        """
        seen = values
        if self.constants.rules.flight == "filled":
            pieces = zip(values.split(list(counts)), keep.split(list(counts)), strict=True)
            seen = torch.cat([fill_flight(*piece) for piece in pieces])
        return torch.cat((values, quality(seen, self._weights)[:, None]), dim=1)
