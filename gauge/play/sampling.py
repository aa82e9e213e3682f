"""Keeps the state of each sample while a segment runs; the metrics are computed at the end of the segment."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields

import numpy as np
import torch
from numpy.typing import NDArray

from ...backends.base import PhysicsState
from ...robots.base import Robot
from ..instants import Instants, SampledState
from ..metrics import MetricEvaluator
from ..suite import Suite
from .self_contact import SelfContact

GRAVITY = 9.81
"""[m/s²]; turns the robot's mass into its weight."""

Samples = tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]
"""Metrics and quality of T samples, (T, columns), NaN where a metric is not defined; which of them count, and in which parts of the
robot touch each other, (T,)."""


class SampleTable:
    """Samples of K worlds. A world's rows depend on its own segment alone, and so do the metrics worked out from them."""

    def __init__(self, suite: Suite, robot: Robot, weight: float, like: PhysicsState, *, one_by_one: bool) -> None:
        """Prepare the table; ``reserve`` gives it rows.

        Args:
            weight: its weight [N].
            like: any state of the K worlds.
            one_by_one: evaluate metrics segment by segment. In a CPU's vector units the last bit may depend on the rest of a
                batch, while a GPU evaluates all segments at once.
        """
        worlds, device, dtype = len(like.joint_position), like.joint_position.device, like.joint_position.dtype
        self._metrics = MetricEvaluator(suite.metrics, robot, weight, device, dtype)
        self.names = self._metrics.names
        self.push_scale = self._metrics.constants.scales.force
        self._self_contact = SelfContact(robot)
        self._between_samples = suite.metrics.smoothness == "samples"
        joints = robot.num_joints
        needed = {*self._metrics.columns, "joint_position"}  # joint positions show which parts touch each other
        self._shapes = {f.name: getattr(like, f.name).shape[1:] for f in fields(PhysicsState) if f.name in needed}
        widths = [math.prod(shape) for shape in self._shapes.values()]
        # then the command, the torque before, whether that is known, and whether the sample counts
        self._split = [*widths, 3, joints, 1, 1]
        self._worlds, self._device, self._dtype, self._one_by_one = worlds, device, dtype, one_by_one
        self.rows = torch.zeros(0, 0, device=device, dtype=dtype)
        """All rows, one world's after the other's; other memory after ``reserve``."""
        self._begin = torch.zeros(worlds, dtype=torch.int64, device=device)
        self.capacity = 0
        """Rows of each world."""
        self.count = torch.zeros(worlds, dtype=torch.int64, device=device)
        """Rows that each world has filled, (K,)."""
        self._torque = torch.zeros(worlds, joints, device=device, dtype=dtype)
        self._torque_known = torch.zeros(worlds, dtype=torch.bool, device=device)

    def reserve(self, rows: int) -> None:
        """Have room for segments of so many samples."""
        if rows <= self.capacity:
            return
        # one row more, for worlds that have no sample to write
        table = torch.zeros(self._worlds, rows + 1, sum(self._split), device=self._device, dtype=self._dtype)
        if self.capacity:
            table[:, : self.capacity] = self.rows.view(self._worlds, self.capacity + 1, -1)[:, :-1]
        self.rows, self.capacity = table.flatten(0, 1), rows
        self._begin = torch.arange(self._worlds, device=self._device) * (rows + 1)

    def clear(self, mask: torch.Tensor) -> None:
        """Forget the samples of some worlds, (K,) bool."""
        self.count.masked_fill_(mask, 0)

    def forget_torque(self, mask: torch.Tensor) -> None:
        """Forget the last torque of robots that were reset, (K,) bool."""
        self._torque_known &= ~mask

    def write(self, sample: PhysicsState, due: torch.Tensor, keep: torch.Tensor, command: torch.Tensor) -> None:
        """Write a row for every world that takes a sample.

        Args:
            sample: the state at which it is taken; the other worlds' rows do not matter.
            due: (K,) bool; none may be before ``reserve``.
            keep: samples that count, (K,) bool.
            command: commanded velocities, (K, 3).
        """
        if not self.capacity:
            return
        values = [getattr(sample, name).reshape(self._worlds, -1) for name in self._shapes]
        flags = torch.stack((self._torque_known, keep), dim=1)
        row = torch.cat((*values, command, self._torque, flags), dim=1)
        at = torch.clamp(self.count, max=self.capacity - 1).masked_fill_(~due, self.capacity)
        self.rows.index_copy_(0, self._begin + at, row)
        self.count += due
        if self._between_samples:
            self._torque.copy_(torch.where(due[:, None], sample.joint_torque, self._torque))
            self._torque_known |= due

    def end_step(self, state: PhysicsState, active: torch.Tensor) -> None:
        """Keep the torque at the end of a control step for the next comparison, where the suite says so."""
        if not self._between_samples:
            self._torque.copy_(state.joint_torque)
            self._torque_known |= active

    def read(
        self, worlds: Sequence[int], counts: Sequence[int], limits: torch.Tensor, friction: torch.Tensor
    ) -> list[Samples]:
        """Return the metrics of the first samples of some worlds.

        Args:
            counts: number of samples T of each, at least 1.
            limits: command limits of all worlds' segments, (K, 3).
            friction: their friction coefficients, (K,).
        """
        owner = np.repeat(worlds, counts)
        first = np.repeat(np.asarray(worlds) * (self.capacity + 1) - np.cumsum(counts) + counts, counts)
        at, world = torch.tensor(np.stack((first + np.arange(len(owner)), owner)), device=self._device)
        batches = [[count] for count in counts] if self._one_by_one else [list(counts)]
        mine = self.rows[at]
        rows = [x.split([sum(batch) for batch in batches]) for x in (mine, limits[world], friction[world])]
        values = torch.cat([self._evaluate(*batch) for batch in zip(*rows, batches, strict=True)])
        poses = mine.split(self._split, dim=1)[list(self._shapes).index("joint_position")].cpu().numpy()
        ends = np.cumsum(counts)[:-1]
        touching = np.split(self._self_contact.touching(poses), ends)
        pieces = zip(np.split(values.cpu().numpy(), ends), touching, strict=True)
        return [(piece[:, :-1], piece[:, -1] > 0, touched) for piece, touched in pieces]

    def _evaluate(
        self, rows: torch.Tensor, limits: torch.Tensor, friction: torch.Tensor, counts: Sequence[int]
    ) -> torch.Tensor:
        """Return the metrics and quality of rows of the table, and 1 for those that count, (N, columns + 1) float32.

        The rows are those of some segments, one after the other, with so many samples each.
        """
        *values, command, before, known, keep = rows.split(self._split, dim=1)
        columns = zip(self._shapes.items(), values, strict=True)
        instants = Instants(
            state=SampledState({name: value.reshape(-1, *shape) for (name, shape), value in columns}),
            command=command,
            limits=limits,
            friction=friction,
            torque_before=before,
            torque_known=known[:, 0] > 0,
            constants=self._metrics.constants,
        )
        metrics = self._metrics.evaluate(instants)
        return torch.cat((self._metrics.with_quality(metrics, keep[:, 0] > 0, counts), keep), dim=1).to(torch.float32)
