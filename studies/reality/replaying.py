"""Logs played again by parameter sets and engines, side by side: ``replay.json`` and ``replay.html``."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...backends.registry import choose_device, find_backend
from ...files.choices import cpu_threads
from ...files.provenance import provenance
from ...files.writing import json_text, write_files
from ...gauge.play.remaining import Stage
from ...robots import JointParameters
from ...robots.sets import find_set, joint_groups
from ..turns import Turns, Watch
from .log import Log, LogError, carried_share, free_legs_torque
from .page import render_page, traces
from .readers import read_log, read_map
from .request import LogOptions, ReplayRequest
from .residuals import differences, noise, repeatability, summarize
from .rig import FixedRig, Motion, acting_parameters, at_rows, beginning, held_targets, num_steps, play

_SMOOTHED = 0.1
"""Length of the windows in which series are smoothed before torques are held against gains [s]."""
_MOVES = 0.02
"""Least standard deviation of a target at which its joint's torques are held against its gains [rad]."""
LONGEST_DELAY = 0.03
"""Largest delay that is fitted [s]."""
_CARRIED = 0.4
"""Largest share of a robot's weight that friction and offsets of a hung robot's joints can look like."""


def read_logs(paths: Sequence[Path], options: LogOptions) -> list[Log]:
    """Read logs, all of one robot, cut as asked.

    Raises:
        LogError: a log that cannot be used, or logs of several robots.
        RobotError: no such robot.
    """
    if not paths:
        raise LogError("no log was given; name one or more files")
    mapping = None if options.mapping is None else read_map(options.mapping)
    logs = [read_log(path, robot=options.robot, mapping=mapping, held=options.held) for path in paths]
    if len({log.robot.name for log in logs}) > 1:
        names = " and ".join(sorted({log.robot.name for log in logs}))
        raise LogError(f"the logs are of several robots, {names}; replay them one robot at a time")
    if options.begin or options.end is not None:
        logs = [log.cut(options.begin, np.inf if options.end is None else options.end) for log in logs]
    return logs


def hung_or_standing(log: Log) -> Log:
    """Return the log with ``held`` decided: as it says, hung where it says nothing.

    Raises:
        LogError: the robot walked, or a log that says hung shows legs that carry a robot.
    """
    if log.held == "walking":
        raise LogError(f"log '{log.name}' is of a walking robot; a replay needs one that hung or stood (--held)")
    log = replace(log, held=log.held or "hung")
    if log.held == "hung":
        _check_hung(log)
    return log


def _check_hung(log: Log) -> None:
    """Refuse a log of a robot on its feet: its motors give torques that free legs do not need, or its trunk moves."""
    if log.angular_velocity is not None and (turning := float(np.sqrt((log.angular_velocity**2).sum(1).mean()))) > 0.5:
        raise LogError(
            f"log '{log.name}' is replayed as hung, but its trunk turns at {turning:.1f} rad/s; it looks like a walking robot's"
        )
    pose, error = np.median(log.position, axis=0), log.target - log.position
    speed = log.velocity if log.velocity is not None else np.gradient(log.position, log.time, axis=0)
    free = free_legs_torque(log.robot, pose[None])[0]
    carried = carried_share(log.robot, pose, (log.stiffness * error - log.damping * speed).mean(axis=0) - free)
    if carried > _CARRIED:
        raise LogError(
            f"log '{log.name}' is replayed as hung, but its legs carry {carried:.0%} of the robot's weight; it looks like a robot "
            "on its feet (--held standing where it stood), or the gains in the log are not those that were sent"
        )
    beyond = np.abs(np.median(log.stiffness * error, axis=0) - free)
    group, joints = max(joint_groups(log.robot).items(), key=lambda item: float(beyond[item[1]].mean()))
    limit = 0.15 * np.asarray(log.robot.parameters[log.robot.default_parameters].torque_limit)[joints].mean()
    if (most := float(beyond[joints].mean())) > limit:
        raise LogError(
            f"log '{log.name}' is replayed as hung, but its {group} motors hold {most:.1f} N·m more than free legs need; it looks "
            "like a robot on its feet (--held standing), or the gains in the log are not those that were sent"
        )


def replay(
    request: ReplayRequest, folder: Path, *, command: Sequence[str] = (), watch: Watch = lambda _: None
) -> dict[str, Any]:
    """Replay logs with each parameter set in each engine; return the content of ``replay.json`` (docs/guides/real-robot.md).

    Raises:
        LogError: a log that cannot be used.
        BackendError, RobotError: no such engine, device, robot or parameter set.
    """
    began = time.perf_counter()
    logs = [hung_or_standing(log) for log in read_logs(request.logs, request)]
    robot = logs[0].robot
    sets = dict(find_set(robot, name) for name in request.parameters or (None,))
    engines = {name: choose_device(name, request.device) for name in request.backends or ("mujoco",)}
    for name, device in engines.items():
        find_backend(name, device)
    variants = [(f"{s} in {e}" if len(engines) > 1 else s, s, e) for e in engines for s in sets]
    entries, pictures = [], []
    turns = Turns(watch, [Stage(label, float(len(log.time)), engine) for log in logs for label, _, engine in variants])
    for log in logs:
        check_torque(log)
        motions: dict[str, Motion] = {}
        reference = None
        rows = []
        for label, name, engine in variants:
            turns.begin(f"{log.name}: {label}")
            parameters, fitted = sets[name], None
            if request.fit_delay and parameters.delay is not None:
                fitted = fit_delay(log, parameters, threads=cpu_threads(request.threads))
            delay = parameters.delay or 0.0 if fitted is None else fitted
            motions[label] = play(log, parameters, engine=engine, device=engines[engine], delay=delay)
            figures, squares = summarize(log, motions[label], reference)
            reference = reference or squares
            rows.append(
                {
                    "label": label,
                    "parameters": name,
                    "engine": engine,
                    "delay": delay,
                    "delay_fitted": fitted is not None,
                    **figures,
                }
            )
        entries.append(_about(log, logs, rows))
        pictures.append(traces(log, motions, {label: differences(log, motion) for label, motion in motions.items()}))
    results = {
        "schema": 1,
        "robot": robot.name,
        "logs": entries,
        "refused": [],
        "provenance": provenance(
            command=command, threads=cpu_threads(request.threads), seconds=round(time.perf_counter() - began, 2)
        ),
    }
    write_files(folder, {"replay.json": json_text(results), "replay.html": render_page(results, pictures)}, LogError)
    return results


def _about(log: Log, logs: Sequence[Log], rows: list[dict[str, Any]]) -> dict[str, Any]:
    groups = joint_groups(log.robot)
    again = next((other for other in logs if other is not log and repeatability(log, other, [0]) is not None), None)
    floor = {g: noise(log, j) if again is None else repeatability(log, again, j) for g, j in groups.items()}
    return {
        "name": log.name,
        "held": log.held,
        "seconds": float(log.time[-1]),
        "defects": log.defects(),
        "notes": list(log.notes),
        "stiffness": log.stiffness.tolist(),
        "damping": log.damping.tolist(),
        "floor": {"of": "noise" if again is None else f"repetition in {again.name}", "groups": floor},
        "variants": rows,
    }


def check_torque(log: Log) -> None:
    """Refuse a log if its recorded torques follow other gains than the gains that it states.

    Raises:
        LogError: all torques are 0, or the median over the moving joints of the acting share of kp is below 0.5 or above 1.6.
    """
    if log.torque is None:
        return
    if not log.torque.any():
        raise LogError(f"log '{log.name}' has torques of 0 in every row; leave them out, or record the motors' own")
    moving = np.flatnonzero(log.target.std(axis=0) > _MOVES)
    if not len(moving):
        return
    from scipy.signal import savgol_filter

    window = max(2 * round(_SMOOTHED / log.period / 2) + 1, 5)
    target, position, torque = (savgol_filter(one, window, 3, axis=0) for one in (log.target, log.position, log.torque))
    # of positions: the noise of recorded speeds, times a high kd, would make kp look small
    speed = savgol_filter(log.position, window, 3, deriv=1, delta=log.period, axis=0)
    slopes = []
    for lag in range(8):
        rows = slice(lag, None), slice(None, len(log.time) - lag)
        error = target[rows[1]] - position[rows[0]]
        found = []
        for j in moving:
            columns = np.stack([error[:, j], -speed[rows[0]][:, j], np.ones(len(error))], axis=1)
            solution, residual, *_ = np.linalg.lstsq(columns, torque[rows[0]][:, j], rcond=None)
            found.append((float(residual[0]) if len(residual) else np.inf, solution[0]))
        slopes.append((sum(r for r, _ in found), [float(s) for _, s in found]))
    followed = np.array(min(slopes)[1])
    if not 0.5 <= float(np.median(followed / log.stiffness[moving].clip(1e-9))) <= 1.6:
        raise LogError(
            f"log '{log.name}' says that kp was {np.median(log.stiffness):g} N·m/rad, but its torques follow {np.median(followed):.3g}; "
            "correct the gains (stiffness and damping in --map)"
        )


def fit_delay(log: Log, parameters: JointParameters, *, threads: int = 2) -> float:
    """Return the delay with which a hung robot's positions are nearest to the log [s]: the mean over joints of the logarithm of
    their RMS error is least.

    Raises:
        LogError: the log is of a standing robot.
    """
    if log.held == "standing":
        raise LogError(f"log '{log.name}' is of a standing robot; a delay is fitted on a robot that hangs")
    rig = FixedRig(log.robot, parameters, threads=threads)
    try:
        return _fit_delay(rig, log, parameters)
    finally:
        rig.close()


def _fit_delay(rig: FixedRig, log: Log, parameters: JointParameters) -> float:
    from scipy.optimize import minimize_scalar

    acting, start, steps = acting_parameters(log, parameters), beginning(log), num_steps(log)
    offset = np.asarray(parameters.target_offset or 0.0)
    counted = log.fresh & (log.time >= 0.1)

    def costs(delays: Sequence[float]) -> list[float]:
        targets = np.stack([held_targets(log, delay, steps) for delay in delays]) + offset
        series = rig.run([acting] * len(delays), targets, [start] * len(delays))
        error = at_rows(log, series[0])[:, counted] - log.position[counted]
        return list(np.log((error**2).mean(axis=1)).mean(axis=1))

    coarse = np.arange(0.0, LONGEST_DELAY, 0.003)
    best = float(coarse[int(np.argmin(costs(coarse.tolist())))])
    bounds = max(best - 0.003, 0.0), best + 0.003
    found = minimize_scalar(lambda d: costs([float(d)])[0], bounds=bounds, method="bounded", options={"xatol": 5e-5})
    return float(found.x)


def label_of(entry: Mapping[str, Any]) -> str:
    """Return a replay's label with its delay, for tables."""
    return f"{entry['label']}, delay {1e3 * entry['delay']:.1f} ms" if entry["delay"] else str(entry["label"])
