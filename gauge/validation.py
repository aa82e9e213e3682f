"""How well an engine predicts reality: errors between metrics measured on a robot and predicted by simulation.

Paper, section on sim-to-real validation: four motions (forward on flat ground, forward on stairs, sideways, turning), six
metrics, three groups.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

COMMANDS: Mapping[str, tuple[str, ...]] = {
    "longitudinal": ("linear", "stairs"),
    "lateral": ("lateral",),
    "angular": ("angular",),
}
"""Motions behind each command: those of one command are averaged first, so that commands and not motions weigh the same."""

GROUPS: Mapping[str, tuple[str, ...]] = {
    "tracking": ("lin_vel_err", "ang_vel_err"),
    "safety": ("dof_power", "dof_limits"),
    "quality": ("orientation_stability", "torque_smoothness"),
}
"""The metrics that a motion capture of a real robot gives, in the paper's groups."""

Table = Mapping[str, Mapping[str, float]]


class ValidationError(ValueError):
    """Measured and predicted values do not fit each other."""


@dataclass(frozen=True, kw_only=True)
class PredictionErrors:
    """Absolute errors of a prediction. Rows are the commands, then ``average``."""

    metrics: Table
    """Row, then metric."""
    groups: Table
    """Row, then group: the mean over the group's metrics."""


def aggregate_errors(real: Table, predicted: Table) -> PredictionErrors:
    """Absolute errors by command and on average, by metric and by group.

    Args:
        real: metric values measured on the robot: motion (``linear``, ``stairs``, ``lateral``, ``angular``), then metric.
        predicted: the same from simulation.

    Raises:
        ValidationError: a motion or a metric is missing on either side.
    """
    metrics = [m for names in GROUPS.values() for m in names]
    for source, table in (("measured", real), ("predicted", predicted)):
        for motion in (m for motions in COMMANDS.values() for m in motions):
            missing = [m for m in metrics if m not in table.get(motion, {})]
            if missing:
                raise ValidationError(
                    f"the {source} values lack {missing[0]} of motion '{motion}'; give all six metrics"
                )

    def error(motion: str, metric: str) -> float:
        return abs(predicted[motion][metric] - real[motion][metric])

    rows = {c: {m: _mean([error(motion, m) for motion in motions]) for m in metrics} for c, motions in COMMANDS.items()}
    rows["average"] = {m: _mean([rows[c][m] for c in COMMANDS]) for m in metrics}
    groups = {
        row: {g: _mean([errors[m] for m in names]) for g, names in GROUPS.items()} for row, errors in rows.items()
    }
    return PredictionErrors(metrics=rows, groups=groups)


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)
