"""Estimate the rest of a sweep: trainings share places, one gauging at a time follows them."""

from __future__ import annotations

import heapq
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

_LEFT = re.compile(r"(?:(\d+) h )?(?:(\d+) min ?)?(?:(\d+) s)? ?left\b")
_TAIL = 4000
"""Bytes at the end of a log in which a remaining time is looked for."""
_GAUGING = 0.1
"""Time of a gauging over that of a training, before one was seen."""


@dataclass(frozen=True, kw_only=True)
class Running:
    """A process at work."""

    gauges: bool
    spent: float
    """Time since it began [s]."""
    left: float | None
    """Its own estimate of its rest [s]; None while it has none."""


def seconds_left(
    running: Sequence[Running],
    *,
    to_train: int,
    to_gauge: int,
    places: int,
    trained: Sequence[float],
    gauged: Sequence[float],
) -> float | None:
    """Return the time until everything is trained and gauged [s]; None while nothing tells how long a training takes.

    Args:
        to_train, to_gauge: runs that wait.
        places: trainings side by side.
        trained, gauged: times that processes took [s].
    """
    training = _usual(running, trained, gauges=False)
    gauging = _usual(running, gauged, gauges=True)
    if training is None and (to_train or any(not job.gauges for job in running)):
        return None
    if gauging is None:
        if training is None:
            return None
        gauging = _GAUGING * training
    training = training or 0.0
    ends = [_rest(job, training) for job in running if not job.gauges]
    free = [*ends, *[0.0] * max(places - len(ends), 0)]
    heapq.heapify(free)
    for _ in range(to_train):
        end = heapq.heappop(free) + training
        ends.append(end)
        heapq.heappush(free, end)
    now = max((_rest(job, gauging) for job in running if job.gauges), default=0.0)
    for ready in sorted([*[0.0] * to_gauge, *ends]):
        now = max(now, ready) + gauging
    return now


def _usual(running: Sequence[Running], ended: Sequence[float], *, gauges: bool) -> float | None:
    """Return the usual time of a training or a gauging [s]."""
    times = [*ended, *(job.spent + job.left for job in running if job.gauges is gauges and job.left is not None)]
    return sum(times) / len(times) if times else None


def _rest(job: Running, usual: float) -> float:
    return job.left if job.left is not None else max(usual - job.spent, 0.0)


def told_left(log: Path) -> float | None:
    """Return the remaining time that a process wrote to its log last, less the time since [s]; None where it wrote none."""
    try:
        with log.open("rb") as file:
            file.seek(max(log.stat().st_size - _TAIL, 0))
            text = file.read().decode(errors="replace")
        since = time.time() - log.stat().st_mtime
    except OSError:
        return None
    for hours, minutes, seconds in reversed(_LEFT.findall(text)):
        if hours or minutes or seconds:
            return max(3600.0 * int(hours or 0) + 60.0 * int(minutes or 0) + int(seconds or 0) - since, 0.0)
    return None
