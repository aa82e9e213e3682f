"""From records to a verdict: scores by engine, consensus of families, spread, speeds by command, advantage at home. Pure functions.

The unit of chance is a segment (one sub-command of one episode), because each draws its own noise. Engines play the same segments,
so that differences are paired.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...gauge.episodes import MOTION, QUALITY, Episode, Record
from ...gauge.goals import count_sub_commands
from ...gauge.plan import Records
from ...gauge.suite import Suite
from ..consistency.closed_loop import Cell, episodes_of
from ..consistency.statistics import Estimate, paired_mean

Array = NDArray[np.float64]
SETTLED = 0.25
"""Share of a sub-command after which its speed is measured: the robot has caught up with the command."""
OFF = 0.10
"""Deviation from a commanded speed that is marked."""
HOME = 0.02
"""Advantage of an engine over the others that matters."""


@dataclass(frozen=True, kw_only=True)
class Segments:
    """Segments of one engine: rows are sub-commands of cells, columns are seeds."""

    quality: Array
    """Mean quality, (R, S)."""
    share: Array
    """Mean share of the commanded speed once settled, (R, S); NaN after a fall."""
    fell: NDArray[np.bool_]
    """(R, S)."""


@dataclass(frozen=True, kw_only=True)
class Bench:
    """The rows of all engines."""

    suite: Suite
    cells: tuple[Cell, ...]
    seeds: tuple[int, ...]

    @property
    def rows(self) -> list[tuple[Cell, str, int]]:
        """Cell, goal and number of the sub-command of each row."""
        return [
            (cell, goal.name, part)
            for cell in self.cells
            for goal in self.suite.goals
            for part in range(count_sub_commands(self.suite, goal.name))
        ]

    def episodes(self) -> list[Episode]:
        """Return all episodes."""
        return [e for cell in self.cells for e in episodes_of(cell, self.suite, self.seeds)]

    def segments(self, records: Records) -> Segments:
        """Return the segments of one engine's records."""
        parts = []
        for cell, goal, part in self.rows:
            episodes = episodes_of(cell, self.suite, self.seeds)
            parts.append([_segment(records[e], e.goals.index(goal), part) for e in episodes])
        quality, share, fell = np.moveaxis(np.array(parts, dtype=np.float64), 2, 0)
        return Segments(quality=quality, share=share, fell=fell > 0.0)

    def estimate(self, values: Array, name: str) -> Estimate:
        """Return the mean of values, (R, S), over terrains with its 95 % interval."""
        terrains = [cell.terrain for cell, _, _ in self.rows]
        return paired_mean(values, terrains, shared=False, resamples=self.suite.scoring.bootstrap, name=name)


def _segment(record: Record, goal: int, part: int) -> tuple[float, float, bool]:
    """Return quality, share of the commanded speed, and whether the robot fell."""
    mine = record.samples[(record.goal_index == goal) & (record.part_index == part)].astype(np.float64)
    fell = (goal, part) in (record.fallen or ()) or record.diverged
    if len(mine) == 0:
        return 0.0, np.nan, fell
    shares = mine[int(SETTLED * len(mine)) :, record.columns.index(MOTION)]
    share = np.nan if fell or np.isnan(shares).all() else float(np.nanmean(shares))
    return float(np.clip(mine[:, record.columns.index(QUALITY)], 0.0, 1.0).mean()), share, fell


def verdict(
    bench: Bench, found: Mapping[str, Records], families: Mapping[str, str], home: Sequence[str], name: str
) -> dict[str, Any]:
    """Return what the engines say of one policy, as plain data.

    Args:
        families: family of each engine.
        home: families in which the policy was trained or tuned; empty where its file does not say.
        name: of the policy; seeds the intervals' generators.
    """
    segments = {label: bench.segments(records) for label, records in found.items()}
    groups = {
        f: [s for label, s in segments.items() if families[label] == f]
        for f in dict.fromkeys(families[x] for x in found)
    }
    family_quality = {f: np.mean([s.quality for s in group], axis=0) for f, group in groups.items()}
    scores = {label: bench.estimate(s.quality, f"{name}/{label}") for label, s in segments.items()}
    values = {label: estimate.value for label, estimate in scores.items()}
    lowest, highest = min(values, key=values.__getitem__), max(values, key=values.__getitem__)
    consensus = bench.estimate(np.mean(list(family_quality.values()), axis=0), f"{name}/consensus")
    return {
        "engines": {
            label: {
                "family": families[label],
                "score": scores[label].plain(),
                "falls": int(segments[label].fell.sum()),
                "segments": int(segments[label].fell.size),
                "physics_steps": sum(r.physics_steps for r in found[label].values()),
                "diverged": sum(r.diverged for r in found[label].values()),
                "overflowed": sum(r.overflowed for r in found[label].values()),
                "metrics": _metric_means(bench, found[label]),
            }
            for label in found
        },
        "consensus": consensus.plain(),
        "lowest": lowest,
        "highest": highest,
        "ratio": values[lowest] / values[highest] if values[highest] > 0.0 else None,
        "speeds": _speeds(bench, segments),
        "home": list(home),
        "advantages": _advantages(bench, segments, families, home, name),
    }


def _metric_means(bench: Bench, records: Records) -> dict[str, float]:
    """Return the mean of each weighted metric over episodes, then over cells; what follows a fall counts as the suite says."""
    weights = bench.suite.metrics.weights
    cells = []
    for cell in bench.cells:
        mine = [records[e] for e in episodes_of(cell, bench.suite, bench.seeds)]
        cells.append([np.mean([_mean(r, name) for r in mine]) for name in weights])
    return {name: float(value) for name, value in zip(weights, np.mean(cells, axis=0), strict=True)}


def _mean(record: Record, name: str) -> float:
    """Return the mean of a metric's samples, each within 0 and 1; samples without a value do not count."""
    values = record.samples[:, record.columns.index(name)].astype(np.float64)
    values = values[~np.isnan(values)]
    return float(np.clip(values, 0.0, 1.0).mean()) if len(values) else 0.0


def _advantages(
    bench: Bench, segments: Mapping[str, Segments], families: Mapping[str, str], home: Sequence[str], name: str
) -> list[dict[str, Any]]:
    """Return for each engine how far its score lies above the mean of the others, paired by segment."""
    entries = []
    for label, own in segments.items() if len(segments) > 1 else ():
        others = np.mean([s.quality for other, s in segments.items() if other != label], axis=0)
        difference, at_home = bench.estimate(own.quality - others, f"{name}/{label}/advantage"), families[label] in home
        above = difference.low > 0.0 and difference.value > HOME
        entries.append({"engine": label, "difference": difference.plain(), "home": at_home, "above": above})
    return entries


def _speeds(bench: Bench, segments: Mapping[str, Segments]) -> list[dict[str, Any]]:
    """Return for each row its command and, by engine, the mean share of the commanded speed that was reached."""
    entries = []
    for at, (cell, goal, part) in enumerate(bench.rows):
        limits = bench.suite.commands.flat if cell.terrain == "flat" else bench.suite.commands.levelled
        velocity = bench.suite.goal(goal).sub_commands[part][0].velocity
        command = [round(share * limit, 9) for share, limit in zip(velocity, limits, strict=True)]
        shares = {label: s.share[at] for label, s in segments.items()}
        walked = {label: None if np.isnan(v).all() else float(np.nanmean(v)) for label, v in shares.items()}
        known = [v for v in walked.values() if v is not None]
        entries.append(
            {
                "terrain": cell.terrain,
                "level": cell.level,
                "friction": cell.friction,
                "command": command,
                "shares": walked,
                "off": [label for label, v in walked.items() if v is None or abs(v - 1.0) > OFF],
                "spread": max(known) - min(known) if known else None,
            }
        )
    return entries


def sentences(block: Mapping[str, Any], label: str) -> list[str]:
    """Return the verdict on a policy in sentences."""
    engines, consensus = block["engines"], block["consensus"]
    low, high = consensus["interval"]
    count = len({e["family"] for e in engines.values()})
    families = f"{count} families" if count > 1 else "one family alone"
    found = [f"{label}: consensus of {families} {consensus['value']:.4f} (95 % interval {low:.4f} to {high:.4f})."]
    worst, best = block["lowest"], block["highest"]
    if worst != best:
        ratio = "" if block["ratio"] is None else f", {100 * block['ratio']:.0f} % of the highest"
        scores = {name: engines[name]["score"]["value"] for name in (worst, best)}
        found.append(f"Lowest score {scores[worst]:.4f} in {worst}{ratio}, {scores[best]:.4f} in {best}.")
    for entry in block["advantages"]:
        if entry["above"] and (entry["home"] or not block["home"]):
            excess = f"{entry['difference']['value']:.4f} above the mean of the other engines"
            found.append(
                f"It has learned its judge: in {entry['engine']}, of the family in which it was trained or tuned, its score is {excess}."
                if entry["home"]
                else f"In {entry['engine']} its score is {excess}; if it was trained or tuned there, it has learned its judge."
            )
    leap = max(block["speeds"], key=lambda e: e["spread"] or 0.0, default=None)
    if leap is not None and (leap["spread"] or 0.0) > OFF:
        shares = {k: v for k, v in leap["shares"].items() if v is not None}
        slow, fast = min(shares, key=shares.__getitem__), max(shares, key=shares.__getitem__)
        found.append(
            f"Engines disagree most at {command_words(leap)}: {shares[slow]:.2f} of the commanded speed in {slow}, "
            f"{shares[fast]:.2f} in {fast}."
        )
    return found


def command_words(entry: Mapping[str, Any]) -> str:
    """Return a command and its ground in words: ``0.5 m/s forward on stairs_fd level 6``."""
    x, y, yaw = entry["command"]
    words = {
        f"{abs(x):g} m/s {'forward' if x > 0 else 'backward'}": x,
        f"{abs(y):g} m/s to the {'left' if y > 0 else 'right'}": y,
        f"{abs(yaw):g} rad/s to the {'left' if yaw > 0 else 'right'}": yaw,
    }
    level = f" level {entry['level']}" if entry["level"] else ""
    return (
        f"{' and '.join(w for w, v in words.items() if v)} on {entry['terrain']}{level}, friction {entry['friction']:g}"
    )
