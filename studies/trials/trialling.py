"""Policies through scenarios: ``trials.json``, ``trials.csv`` and ``trial.html``."""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import compress
from pathlib import Path
from statistics import median
from typing import Any

import torch

from ...backends.base import BackendError, PhysicsState
from ...backends.registry import choose_device, find_backend
from ...files.choices import cpu_threads
from ...files.provenance import provenance
from ...files.writing import csv_text, json_text, write_files
from ...gauge.chance.intervals import wilson_interval
from ...gauge.play.remaining import Stage
from ...gauge.suite import SuiteError
from ...policy.base import Policy, PolicyError
from ...policy.contract import ContractError, PolicyContract
from ...robots import RobotError
from ...robots.anatomy.roles import anatomy
from ..policies import describe, load_policies
from ..turns import Turns
from ..turns import Watch as WatchTurns
from .page import render_page
from .request import ALL, TrialRequest
from .running import Trial, Watch, run_scenario
from .scenario import Scenario, ScenarioError, load_scenario, scenario_names

_LOOP = 3.0
"""Robots whose steps take as long as the rest of the loop."""
MEASURES = ("reached", "progress", "mean_speed", "peak_speed", "speed_time", "tracking_error")
"""Numbers of a trial that are shown as medians."""


def run_trials(
    request: TrialRequest, folder: Path, *, command: Sequence[str] = (), watch: WatchTurns = lambda _: None
) -> dict[str, Any]:
    """Send every policy through every scenario. What cannot be done is said under ``refused``; the rest is done.

    Returns the content of ``trials.json`` (docs/guides/trials.md).

    Raises:
        BackendError, RobotError, ScenarioError: nothing of it can be done; or no such engine, device or robot.
    """
    began = time.perf_counter()
    device = choose_device(request.backend, request.device)
    find_backend(request.backend, device)
    policies, refused = load_policies(
        request.policies, request.robot, trust=request.trust, contract_file=request.contract
    )
    scenarios: dict[str, Scenario] = {}
    named: set[str] = set()
    names = [n for name in request.scenarios or (ALL,) for n in (scenario_names() if name == ALL else [name])]
    for name in dict.fromkeys(names):
        try:
            scenario = load_scenario(name)
            if scenario.name in scenarios:
                called = f"'{name}' is called '{scenario.name}' as another one of these scenarios"
                raise ScenarioError(f"{called}; rename it")
            scenarios[scenario.name] = scenario
            named |= {scenario.name} if name in request.scenarios else set()
        except ScenarioError as error:
            refused.append({"what": name, "reason": str(error)})
    where: dict[str, Any] = {"backend": request.backend, "device": device, "threads": cpu_threads(request.threads)}
    legs = {label: len(anatomy(each.robot).legs) for label, each in policies.items()}
    fits = {name: [p for p in policies if name in named or s.legs in (None, legs[p])] for name, s in scenarios.items()}
    entries = [_about(scenario) for name, scenario in scenarios.items() if fits[name]]
    turns = [(scenarios[entry["name"]], entry, label) for entry in entries for label in fits[entry["name"]]]
    repeats = [request.repeats or scenario.repeats for scenario, *_ in turns]
    told = Turns(
        watch,
        [
            Stage(s.name, s.usual_rest(0.0, s.start.x) * (_LOOP + n), s.name)
            for (s, *_), n in zip(turns, repeats, strict=True)
        ],
    )
    for scenario, entry, label in turns:
        told.begin(f"{label} in {scenario.name}")
        seeds = range(request.seed, request.seed + (request.repeats or scenario.repeats))
        policy, robot = policies[label].policy, policies[label].robot
        try:
            trials = run_scenario(policy, robot, scenario, seeds, watch=_steps(told, policy, scenario), **where)
        except (BackendError, ContractError, PolicyError, RobotError, SuiteError) as error:
            refused.append({"what": f"{label} in {scenario.name}", "reason": str(error)})
        else:
            entry["results"].append(summary(label, policy.contract, scenario, trials))
    if not any(entry["results"] for entry in entries):
        raise ScenarioError("; ".join(r["reason"] for r in refused) or "there is nothing to try; name a scenario")
    results = {
        "schema": 1,
        "policies": [describe(label, loaded) for label, loaded in policies.items()],
        "scenarios": entries,
        "refused": refused,
        "backend": request.backend,
        "provenance": provenance(
            command=command,
            device=device,
            threads=cpu_threads(request.threads),
            seconds=round(time.perf_counter() - began, 2),
        ),
    }
    texts = {"trials.csv": as_csv(results), "trial.html": render_page(results), "trials.json": json_text(results)}
    write_files(folder, texts, ScenarioError)
    return results


def _steps(told: Turns, policy: Policy, scenario: Scenario) -> Watch:
    """Return the function that tells how far a scenario is: as far as its last robot that walks."""
    steps, x = itertools.count(1), scenario.start.x

    def step(state: PhysicsState, moving: torch.Tensor) -> None:
        nonlocal x
        spent = next(steps) * policy.contract.control_period
        if bool(moving.any()):
            x = float(state.base_position_w[moving, 0].min())
        told.step(spent / (spent + scenario.usual_rest(spent, x)))

    return step


def _about(scenario: Scenario) -> dict[str, Any]:
    """Return the statements of a result on a scenario."""
    terrain, start = scenario.terrain(), scenario.start
    return {
        "name": scenario.name,
        "title": scenario.title,
        "about": " ".join(scenario.about.split()),
        "digest": scenario.digest,
        "suite": scenario.suite,
        "friction": scenario.friction,
        "seconds": scenario.seconds,
        "success": asdict(scenario.success),
        "reported": [asdict(r) for r in scenario.reported],
        "start": [start.x, start.y],
        "profile": profile(terrain, start.x, start.y, scenario.success.beyond),
        "results": [],
    }


def profile(terrain: Any, x: float, y: float, beyond: float | None) -> list[tuple[float, float]]:
    """Height of the ground along x through the start, as corners of a line [m]; empty where all of it is level."""
    step = 0.02
    count = round((max(beyond or 0.0, x + 2.0) - x + 4.0) / step)
    places = [x - 2.0 + step * i for i in range(count)]
    heights = [float(z) for z in terrain.height(places, [y] * count)]
    if max(heights) - min(heights) < 1e-6:
        return []
    line = [(round(a, 3), round(b, 3)) for a, b in zip(places, heights, strict=True)]
    bends = [abs((b[1] - a[1]) - (c[1] - b[1])) >= 2e-3 for a, b, c in zip(line, line[1:], line[2:], strict=False)]
    return [line[0], *compress(line[1:], bends), line[-1]]


def summary(label: str, contract: PolicyContract, scenario: Scenario, trials: Sequence[Trial]) -> dict[str, Any]:
    """Counts, Wilson's interval and medians of a policy's trials, and each of these."""
    outcomes = [t.outcome for t in trials]
    successes, count = outcomes.count("success"), len(trials)
    asked = [max(abs(p.velocity[i]) for p in scenario.commands) for i in range(3)]
    limits = contract.command_limits
    units = ("m/s forward", "m/s sideways", "rad/s")
    above = [f"{a:g} {unit}" for a, limit, unit in zip(asked, limits, units, strict=True) if a > limit]
    note = (
        f"told up to {', '.join(above)}; made for up to {limits[0]:g} m/s forward, {limits[1]:g} m/s sideways and "
        f"{limits[2]:g} rad/s"
    )
    medians: dict[str, float | None] = {}
    for name in MEASURES:
        values = [v for t in trials if (v := getattr(t, name)) is not None]
        medians[name] = median(values) if values else None
    return {
        "policy": label,
        "trials": count,
        "successes": successes,
        "fell": outcomes.count("fell"),
        "missed": outcomes.count("missed"),
        "diverged": sum(t.diverged for t in trials),
        "share": successes / count,
        "interval": list(wilson_interval(successes / count, count)),
        "medians": medians,
        "note": note if above else "",
        "rows": [asdict(t) for t in trials],
    }


def as_csv(results: Mapping[str, Any]) -> str:
    """One row for each trial."""
    names = ("seed", "outcome", "diverged", "seconds", *MEASURES)
    rows: list[Sequence[object]] = [("scenario", "policy", *names, "pulls")]
    for entry in results["scenarios"]:
        for result in entry["results"]:
            for row in result["rows"]:
                pulls = ("{newtons:.1f} N at {begin:.2f} s for {seconds:.2f} s".format_map(p) for p in row["pulls"])
                values = ["" if row[n] is None else row[n] for n in names]
                rows.append((entry["name"], result["policy"], *values, "; ".join(pulls)))
    return csv_text(rows)
