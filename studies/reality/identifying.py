"""From logs to an identified robot: ``identify.json``, ``identify.html`` and ``NAME.toml``, judged on logs that it has not seen."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from ...files.choices import cpu_threads
from ...files.parsing import one_line
from ...files.provenance import provenance
from ...files.writing import json_text, write_files
from ...gauge.play.remaining import Stage
from ...robots import JointParameters
from ...robots.loading import PER_JOINT
from ...robots.sets import find_set, joint_groups, set_text
from ...version import __version__
from ..turns import Turns, Watch
from .identification import KINDS, Fit, identify
from .log import Log, LogError
from .page import render_identified
from .replaying import check_torque, fit_delay, hung_or_standing, read_logs
from .request import IdentifyRequest
from .residuals import Squares, differences
from .rig import FixedRig, Motion, acting_parameters, at_rows, beginning, held_targets, num_steps

_HALVES = 0.7
"""Work that each iteration of a fit leaves of what was left: it ends when it no longer changes."""


def identify_robot(
    request: IdentifyRequest, folder: Path, *, command: Sequence[str] = (), watch: Watch = lambda _: None
) -> dict[str, Any]:
    """Identify a robot's constants from logs; return the content of ``identify.json`` (docs/guides/real-robot.md).

    Raises:
        LogError: a log that cannot be used, or a name that no parameter set can have.
        RobotError: no such robot or parameter set.
    """
    began = time.perf_counter()
    if not request.name.isidentifier():
        raise LogError(f"--name is '{one_line(request.name, 40)}'; use letters, digits and _")
    logs = [hung_or_standing(log) for log in read_logs(request.logs, request)]
    for log in logs:
        check_torque(log)
    robot, threads = logs[0].robot, cpu_threads(request.threads)
    base_name, base = find_set(robot, request.base)
    turns = 1 + (len(logs) if request.held_out and len(logs) > 1 else 0)

    told = Turns(watch, [Stage(str(turn), 1.0 if turn == 0 else (len(logs) - 1) / len(logs)) for turn in range(turns)])

    def fit(some: Sequence[Log], what: str) -> Fit:
        told.begin(what)
        steps = itertools.count()
        return identify(
            some,
            base,
            draws=request.draws,
            seed=request.seed,
            threads=threads,
            say=lambda _: told.step(1.0 - _HALVES ** next(steps)),
        )

    found = fit(logs, "all logs")
    entries = [_residuals(log, base, found.parameters, threads, fitted=True) for log in logs]
    for number, log in enumerate(logs if turns > 1 else []):
        others = [other for other in logs if other is not log]
        without = fit(others, f"without {log.name}")
        entries[number]["held_out"] = _residuals(log, base, without.parameters, threads, fitted=True)
    words = _provenance(logs, base_name, found)
    values = {f: getattr(found.parameters, f) for f in (*PER_JOINT, "delay")}
    values = {f: value for f, value in values.items() if value is not None}
    notes = _notes(logs, found)
    text = set_text(robot, request.name, values, words, notes=notes)
    results = {
        "schema": 1,
        "robot": robot.name,
        "name": request.name,
        "base": base_name,
        "parameters": {f.name: getattr(found.parameters, f.name) for f in fields(JointParameters)}
        | {"measured": words},
        "unknowns": [_unknown(found, u) for u in range(len(found.unknowns)) if found.unknowns[u].key != "start"],
        "notes": notes,
        "logs": entries,
        "evaluations": found.evaluations,
        "refused": [],
        "provenance": provenance(command=command, threads=threads, seconds=round(time.perf_counter() - began, 2)),
    }
    write_files(
        folder,
        {
            f"{request.name}.toml": text,
            "identify.json": json_text(results),
            "identify.html": render_identified(results),
        },
        LogError,
    )
    return results


def replay_fixed(log: Log, parameters: JointParameters, delay: float, *, threads: int = 1) -> Motion:
    """Replay a hung robot's log in MuJoCo with its trunk fixed, faster than in an engine."""
    rig = FixedRig(log.robot, parameters, threads=threads)
    try:
        targets = held_targets(log, delay, num_steps(log)) + np.asarray(parameters.target_offset or 0.0)
        series = rig.run([acting_parameters(log, parameters)], targets[None], [beginning(log)])[:, 0]
    finally:
        rig.close()
    return Motion(**{name: at_rows(log, series[i]) for i, name in enumerate(("position", "velocity", "torque"))})


def _residuals(
    log: Log, base: JointParameters, found: JointParameters, threads: int, *, fitted: bool
) -> dict[str, Any]:
    """Return the ratios of a set's residuals to the nominal one's, its delay fitted to this log."""
    delay = fit_delay(log, found, threads=threads) if fitted else found.delay or 0.0
    motions = replay_fixed(log, base, base.delay or 0.0), replay_fixed(log, found, delay)
    return {"name": log.name, "delay": delay, "ratios": _ratios(log, *motions)}


def _ratios(log: Log, nominal: Motion, found: Motion) -> dict[str, dict[str, Any]]:
    """Return the ratio of two replays' RMS differences by group and quantity, the nominal one below."""
    groups = joint_groups(log.robot)
    errors = differences(log, nominal), differences(log, found)
    result: dict[str, dict[str, Any]] = {group: {} for group in groups}
    for quantity in errors[0]:
        if quantity == "velocity":
            continue
        below, above = (Squares(log, e[quantity]) for e in errors)
        for group, joints in groups.items():
            result[group][quantity] = above.rms(joints) / max(below.rms(joints), 1e-12)
    return result


def _unknown(found: Fit, number: int) -> dict[str, Any]:
    unknown = found.unknowns[number]
    return {
        "label": unknown.label,
        "unit": unknown.kind.unit,
        "nominal": unknown.prior,
        "value": float(found.values[number]),
        "interval": [float(v) for v in found.intervals[number]],
        "known": bool(found.known[number]),
    }


def _provenance(logs: Sequence[Log], base: str, found: Fit) -> str:
    gains = ", ".join(f"{log.name} (kp {np.median(log.stiffness):g}, kd {np.median(log.damping):g})" for log in logs)
    delays = ", ".join(f"{1e3 * d:.1f}" for d in found.delays)
    return f"gaitgauge {__version__} identify from {gains}; base set {base}; delays {delays} ms"


def _notes(logs: Sequence[Log], found: Fit) -> list[str]:
    """Say what the logs do not tell."""
    notes = []
    unknown = [u.label for u, known in zip(found.unknowns, found.known, strict=True) if not known and u.key != "start"]
    if unknown:
        notes.append(f"not told by these logs, so at their nominal values: {', '.join(unknown)}")
    if len({tuple(np.round(log.damping, 3)) for log in logs}) == 1:
        notes.append("all logs have one kd, so joint_damping and damping_factor are told apart by their priors alone")
    if all(log.torque is None for log in logs):
        notes.append("no log has torques, so the scale of gains, inertias and friction rests on the model's masses")
    bounds = [
        u.label
        for u, v in zip(found.unknowns, found.values, strict=True)
        if u.key in KINDS and (v - u.kind.low < 1e-3 * u.kind.spread or u.kind.high - v < 1e-3 * u.kind.spread)
    ]
    if bounds:
        notes.append(f"at the end of their range: {', '.join(bounds)}")
    if max(found.delays) - min(found.delays) > 0.001:
        low, high = 1e3 * min(found.delays), 1e3 * max(found.delays)
        notes.append(
            f"the delay differs between logs, {low:.1f} to {high:.1f} ms, which a log with a wrong kd causes too; the set has their mean"
        )
    return notes
