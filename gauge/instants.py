"""The input of a metric: instants of one robot's motion, and the values that are the same for all of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from ..backends.base import PhysicsState
from ..files.parsing import shown
from ..robots.anatomy.body_plan import LEG_PARTS, body_plan, joint_ranges, stance_span
from ..robots.base import Robot
from .metric_rules import GO2_LEG, GO2_MASS, Metrics, RobotScales
from .support import Soles


class MetricError(ValueError):
    """A metric that does not exist, cannot be loaded, or cannot be measured on a robot; the message is one sentence."""


@dataclass(frozen=True, kw_only=True)
class MetricConstants:
    """The values that are the same for all instants of a robot in a suite."""

    rules: Metrics
    robot: Robot
    weight: float
    """Weight of the robot [N]."""
    device: torch.device
    dtype: torch.dtype

    @cached_property
    def limits(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return indices, lower and upper soft limits, and full ranges [rad] of the watched joints, (W,) each.

        ``soft_limit_joints`` names these joints by parts of legs (``LEG_PARTS``), or by parts of their names.

        Raises:
            MetricError: no such joint has limits.
        """
        rules, robot, plan, bounds = self.rules, self.robot, body_plan(self.robot), joint_ranges(self.robot)
        watched = [
            j
            for j, name in enumerate(robot.joint_names)
            if any(plan.part(j) == part if part in LEG_PARTS else part in name for part in rules.soft_limit_joints)
            or (("leg" in rules.soft_limit_joints and plan.part(j)) and np.isfinite(bounds[j]).all())
        ]
        if not watched:
            raise MetricError(
                f"the metric 'dof_limits' watches {', '.join(rules.soft_limit_joints)}, of which robot '{robot.name}' has no "
                "joint with limits; give its joints a range in the model"
            )
        ranges = torch.tensor(bounds[watched], device=self.device, dtype=self.dtype)
        middle, full = ranges.mean(1), ranges[:, 1] - ranges[:, 0]
        soft = 0.5 * rules.soft_limit * full
        return torch.tensor(watched, device=self.device), middle - soft, middle + soft, full

    @cached_property
    def scales(self) -> RobotScales:
        """Return the factors on scales that are stated for the Go2."""
        if self.rules.measure == "fixed":
            return RobotScales()
        plan = body_plan(self.robot)
        heavier, longer = plan.mass / GO2_MASS, plan.leg_length / GO2_LEG
        return RobotScales(force=heavier, torque=heavier * longer, power=heavier * math.sqrt(longer))

    @cached_property
    def motors(self) -> torch.Tensor | slice:
        """Return the joints over which power and torque are averaged, as an index."""
        if self.rules.motors == "all":
            return slice(None)
        legs = sorted({joint for leg in body_plan(self.robot).legs for joint in leg})
        return torch.tensor(legs, device=self.device)

    @cached_property
    def soles(self) -> Soles:
        """Return the soles of the feet."""
        return Soles(self.robot, self.device, self.dtype)

    @cached_property
    def span(self) -> float:
        """Return the diagonal stance span [m]."""
        return stance_span(self.robot) if self.rules.zmp_span is None else self.rules.zmp_span


class SampledState:
    """The columns of ``PhysicsState`` that the metrics of a suite need, of N samples, in the same shapes, frames and units."""

    def __init__(self, columns: Mapping[str, torch.Tensor]) -> None:
        self._columns = columns

    def __getattr__(self, name: str) -> torch.Tensor:
        try:
            return self.__dict__["_columns"][name]
        except KeyError:
            raise MetricError(f"a metric reads {shown(name)} of the state; name it in the metric's 'state'") from None


@dataclass(frozen=True, kw_only=True)
class Instants:
    """N instants of one robot's motion: the input of a metric."""

    state: SampledState | PhysicsState
    command: torch.Tensor
    """Commanded velocities, forward, lateral [m/s] and yaw [rad/s], (N, 3)."""
    limits: torch.Tensor
    """Limits of the commands, (N, 3)."""
    friction: torch.Tensor
    """Friction coefficient, (N,)."""
    torque_before: torch.Tensor
    """Joint torque at the instant before [N·m], (N, J)."""
    torque_known: torch.Tensor
    """Instants with a torque before, (N,) bool."""
    constants: MetricConstants

    def with_contact(self, force: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        """Return values, (N,); where ``force`` [N], (N,), is too small a share of the weight (``contact_share``), NaN or, in a
        suite with ``flight = "perfect"``, 1.
        """
        rules = self.constants.rules
        carried = force > rules.contact_share * self.constants.weight
        return torch.where(carried, values, torch.full_like(values, 1.0 if rules.flight == "perfect" else math.nan))
