"""How well simulators predict reality: errors between metrics measured on a robot and predicted, and agreement of ranks.

Paper, section on sim-to-real validation: four motions (forward on flat ground, forward on stairs, sideways, turning), six
metrics, three groups. Any other motions, metrics and policies are taken alike.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...files.parsing import did_you_mean, one_line, read_text, shown
from ...gauge.metrics import metric_groups

COMMANDS: Mapping[str, tuple[str, ...]] = {
    "longitudinal": ("linear", "stairs"),
    "lateral": ("lateral",),
    "angular": ("angular",),
}
"""The paper's motions behind each command: those of one command are averaged first, so that commands weigh the same."""

EXAMPLES = Path(__file__).parent / "examples"
AVERAGE = "average"
MOST: Mapping[str, int] = {"rows": 100_000, "columns": 100, "policies": 1000, "motions": 100}
"""Of a table; what is compared grows with the square of the policies."""
LARGEST = 1e12
"""Magnitude of a value."""
_LONE = "the policy"
"""Name of the policy in tables without a column for it."""

Table = Mapping[str, Mapping[str, float]]
"""Values by motion, then by metric."""


class ValidationError(ValueError):
    """Measured and predicted values do not fit each other, or cannot be read."""


@dataclass(frozen=True, kw_only=True)
class Measurements:
    """Measurements on a robot, or predictions of one simulator."""

    name: str
    values: Mapping[str, Table]
    """Means over trials, by policy, motion and metric."""
    commands: Mapping[str, str] = field(default_factory=dict)
    """Command by motion, where the table has a column for it."""
    trials: int = 1
    """Largest number of rows of one policy and motion."""


@dataclass(frozen=True, kw_only=True)
class PredictionErrors:
    """Errors of a prediction. Rows are the commands, then ``average``."""

    metrics: Table
    """Absolute errors: row, then metric."""
    groups: Table
    """Row, then group: the mean over the group's metrics."""
    bias: Mapping[str, float] = field(default_factory=dict)
    """Signed errors, predicted minus measured, by metric, averaged as the row ``average`` is."""


@dataclass(frozen=True, kw_only=True)
class RankAgreement:
    """Agreement of a simulator with reality on the order of policies."""

    tau: float | None
    """Kendall's τ-b, 1 for the same order, -1 for the reverse; None where all values are the same on one side."""
    violation: float
    """Mean maximum rank violation: by how much, of the measured value, the worst wrongly ordered other policy differs, averaged over
    policies; 0 where no pair is in the wrong order."""


def read_measurements(path: Path) -> Measurements:
    """Read a CSV table: columns ``motion`` and metrics, and where there are several ``policy``; a row is a trial.

    Rows of one policy and motion are averaged. A column ``command`` says which motions belong together; without it ``linear`` and
    ``stairs`` do, as in the paper.

    Raises:
        ValidationError: one sentence on what is wrong, and where.
    """
    text = read_text(path, "table", ValidationError)
    reader = csv.DictReader(text.splitlines(), strict=True)
    try:
        rows = [(reader.line_num, row) for row in reader]
    except csv.Error as error:
        raise ValidationError(f"{one_line(path)} is not valid CSV: {error}") from error
    names = [n for n in reader.fieldnames or () if n not in ("policy", "motion", "command")]
    if "motion" not in (reader.fieldnames or ()) or not names or not rows:
        raise ValidationError(
            f"{one_line(path)} needs a column 'motion', a column for each metric, and a row for each trial"
        )
    for what, count in (("rows", len(rows)), ("columns", len(names))):
        if count > MOST[what]:
            raise ValidationError(f"{one_line(path)} has {count:,} {what}; at most {MOST[what]:,} are compared")
    if len(set(reader.fieldnames or ())) < len(reader.fieldnames or ()):
        raise ValidationError(f"{one_line(path)} has two columns of one name")
    sums: dict[str, dict[str, list[list[float]]]] = {}
    commands: dict[str, str] = {}
    for number, row in rows:
        policy, motion = row.get("policy") or _LONE, row["motion"]
        if None in row or not motion:
            raise ValidationError(f"line {number} of {one_line(path)} does not have the columns of the first line")
        values = [_number(row[name], f"{one_line(name, 80)} in line {number} of {one_line(path)}") for name in names]
        sums.setdefault(policy, {}).setdefault(motion, []).append(values)
        if "command" in row and commands.setdefault(motion, row["command"]) != row["command"]:
            raise ValidationError(f"line {number} of {one_line(path)} gives motion {shown(motion)} another command")
        if AVERAGE in (motion, row.get("command")):
            raise ValidationError(
                f"line {number} of {one_line(path)} has a motion or command '{AVERAGE}', as the average of all is "
                "called; give it another name"
            )
    for what, found in (("policies", sums), ("motions", {motion for of in sums.values() for motion in of})):
        if len(found) > MOST[what]:
            raise ValidationError(f"{one_line(path)} has {len(found):,} {what}; at most {MOST[what]:,} are compared")
    return Measurements(
        name=path.stem,
        values={
            policy: {
                motion: dict(zip(names, map(_mean, zip(*trials, strict=True)), strict=True))
                for motion, trials in of.items()
            }
            for policy, of in sums.items()
        },
        commands=commands,
        trials=max(len(trials) for of in sums.values() for trials in of.values()),
    )


def _number(text: str | None, where: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not abs(value) <= LARGEST:
        raise ValidationError(f"{where} is {shown(text)}; a number is needed, from -{LARGEST:g} to {LARGEST:g}")
    return value


def aggregate_errors(real: Table, predicted: Table, commands: Mapping[str, str] | None = None) -> PredictionErrors:
    """Absolute errors by command and on average, by metric and by group.

    Args:
        real: metric values measured on the robot: motion, then metric.
        predicted: the same from simulation; metrics that were not measured are left out.
        commands: command by motion; None for the paper's.

    Raises:
        ValidationError: a motion or a metric is missing on either side.
    """
    metrics = list(dict.fromkeys(m for row in real.values() for m in row))
    for motion in dict.fromkeys((*real, *predicted)):
        for source, table in (("measured", real), ("predicted", predicted)):
            missing = [m for m in metrics if m not in table.get(motion, {})]
            if missing:
                hint = did_you_mean(motion, table) if motion not in table else ""
                raise ValidationError(
                    f"the {source} values lack {one_line(missing[0], 80)} of motion {shown(motion)}{hint or ';'} "
                    "both sides need the same motions"
                )
    rows = {
        command: {m: _mean([abs(predicted[o][m] - real[o][m]) for o in motions]) for m in metrics}
        for command, motions in _by_command(list(real), commands).items()
    }
    rows[AVERAGE] = {m: _mean([row[m] for row in rows.values()]) for m in metrics}
    bias = {
        m: _mean(
            [
                _mean([predicted[o][m] - real[o][m] for o in motions])
                for motions in _by_command(list(real), commands).values()
            ]
        )
        for m in metrics
    }
    groups = metric_groups(metrics)
    return PredictionErrors(
        metrics=rows,
        groups={r: {g: _mean([row[m] for m in names]) for g, names in groups.items()} for r, row in rows.items()},
        bias=bias,
    )


def _by_command(motions: Sequence[str], commands: Mapping[str, str] | None) -> dict[str, list[str]]:
    """Motions of each command. A motion that belongs to none is a command of its own."""
    known = commands or {motion: command for command, of in COMMANDS.items() for motion in of}
    found: dict[str, list[str]] = {}
    for motion in motions:
        found.setdefault(known.get(motion) or motion, []).append(motion)
    return found


def rank_agreement(real: Sequence[float], predicted: Sequence[float]) -> RankAgreement:
    """Agreement of two orders of policies.

    Args:
        real: value of each policy on the robot, (N,).
        predicted: the same in simulation; its scale does not matter.

    Raises:
        ValidationError: fewer than two policies.
    """
    from scipy.stats import kendalltau

    if len(real) < 2 or len(real) != len(predicted):
        raise ValidationError(
            f"ranks need at least two policies with both values, not {min(len(real), len(predicted))}"
        )
    tau = float(kendalltau(real, predicted).statistic)
    measured, told = np.array(real), np.array(predicted)
    wrong = (told[:, None] < told) != (measured[:, None] < measured)
    worst = np.where(wrong, np.abs(measured[:, None] - measured), 0.0).max(axis=1)
    return RankAgreement(tau=None if math.isnan(tau) else tau, violation=float(worst.mean()))


def validate(real: Measurements, simulators: Sequence[Measurements], *, ranks_only: bool = False) -> dict[str, Any]:
    """Errors and ranks of any number of simulators.

    Args:
        simulators: what each predicted, for the same policies and motions.
        ranks_only: both sides are on different scales (a score, and the share of trials survived): errors mean nothing.

    Returns:
        Plain data: by simulator ``errors`` (as ``PredictionErrors``, averaged over policies; absent with ``ranks_only``) and
        ``ranks`` (with two policies or more): by motion and metric, and ``average`` over them.

    Raises:
        ValidationError: one sentence.
    """
    if ranks_only and len(real.values) < 2:
        raise ValidationError(f"ranks need at least two policies; '{one_line(real.name)}' has one")
    found: dict[str, Any] = {}
    for simulator in simulators:
        for policy in dict.fromkeys((*real.values, *simulator.values)):
            for side in (real, simulator):
                if policy not in side.values:
                    raise ValidationError(
                        f"'{one_line(side.name)}' has no rows of policy {shown(policy)}{did_you_mean(policy, side.values) or ';'} "
                        "both sides need the same policies"
                    )
        for of in real.values.values():
            if odd := set(of) ^ set(next(iter(real.values.values()))):
                raise ValidationError(
                    f"'{one_line(real.name)}' has motion {shown(min(odd))} for some policies alone; "
                    "every policy needs the same motions"
                )
        name = simulator.name
        while name in found:
            name += "'"
        errors = [
            aggregate_errors(of, simulator.values[policy], real.commands or None) for policy, of in real.values.items()
        ]
        entry: dict[str, Any] = {} if ranks_only else {"errors": _averaged([asdict(e) for e in errors])}
        if len(real.values) > 1:
            entry["ranks"] = _ranks(real, simulator)
        found[name] = entry
    return {
        "real": real.name,
        "policies": list(real.values),
        "motions": _by_command(list(next(iter(real.values.values()))), real.commands or None),
        "trials": real.trials,
        "simulators": found,
    }


def _ranks(real: Measurements, simulator: Measurements) -> list[dict[str, Any]]:
    """Agreement for each motion and metric, then on average."""
    rows = []
    first = next(iter(real.values.values()))
    for motion, metrics in first.items():
        for metric in metrics:
            values = [[side.values[p][motion][metric] for p in real.values] for side in (real, simulator)]
            rows.append({"motion": motion, "metric": metric, **asdict(rank_agreement(*values))})
    taus = [r["tau"] for r in rows if r["tau"] is not None]
    average = {"tau": _mean(taus) if taus else None, "violation": _mean([r["violation"] for r in rows])}
    return [*rows, {"motion": AVERAGE, "metric": AVERAGE, **average}]


def _averaged(items: Sequence[Any]) -> Any:
    """Mean of numbers in tables of one shape."""
    if isinstance(items[0], Mapping):
        return {key: _averaged([item[key] for item in items]) for key in items[0]}
    return _mean(items)


def example(name: str) -> list[dict[str, Any]]:
    """The parts of an example that ships with the project, validated: errors of predicted metrics, then ranks of policies.

    Raises:
        ValidationError: no such example.
    """
    folder = EXAMPLES / name
    known = sorted(p.name for p in EXAMPLES.iterdir() if p.is_dir() and not p.name.startswith("_"))
    if name not in known:
        raise ValidationError(f"there is no example {shown(name)}; choose from {', '.join(known)}")
    read = [read_measurements(folder / f"{f}.csv") for f in ("real", "RoboGauge", "IsaacGym", "trials", "scores")]
    return [validate(read[0], read[1:3]), validate(read[3], read[4:], ranks_only=True)]


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)
