"""A jury from request to ``jury.json``: every policy plays the same episodes in every engine."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch

from ...backends.base import BackendError
from ...backends.registry import engine_class
from ...files.choices import cpu_threads
from ...files.parsing import did_you_mean, one_line, shown
from ...files.provenance import provenance
from ...files.writing import json_text, write_atomically
from ...gauge.described import training_physics
from ...gauge.evaluate import common_identity
from ...gauge.fit import check_fit
from ...gauge.plan import Records
from ...gauge.play.progress import Status
from ...gauge.play.remaining import Cost
from ...gauge.play.workers import WorkerError
from ...gauge.store import RunFolder, StoreError, check_folder
from ...gauge.suite import Suite, load_suite
from ...robots import Robot
from ...robots.loading import robot_digest
from ..consistency.closed_loop import Cell, play_variant
from ..consistency.variants import Variant, parse_variants, place_all
from ..engine_pace import EnginePace, measure_all, measure_cost
from ..naming import folder_name
from ..policies import Loaded, describe, load_policies
from .request import BIPED_PARTS, ENGINES, PARTS, JuryCost, JuryError, JuryRequest, JuryStatus
from .verdict import Bench, sentences, verdict

SCHEMA = 1

Watch = Callable[[JuryStatus], None]


@dataclass(kw_only=True)
class PreparedJury:
    """A request that can be carried out."""

    request: JuryRequest
    suite: Suite
    robot: Robot
    policies: dict[str, Loaded]
    engines: list[Variant]
    bench: Bench
    skipped: list[dict[str, str]] = field(default_factory=list)
    """Engines that do not judge, and why."""

    @property
    def families(self) -> dict[str, str]:
        """Return the family of each engine."""
        return {v.label: engine_class(v.backend).family or v.backend for v in self.engines}

    @property
    def world_steps(self) -> int:
        """Return the physics steps of one world that all episodes of an engine take at most."""
        suite, phases = self.suite, [row for goal in self.suite.goals for row in goal.sub_commands]
        seconds = sum(phase.seconds for row in phases for phase in row) + len(phases) * suite.settling.longest
        return len(self.bench.episodes()) * round(seconds / suite.physics.timestep)

    def home(self, label: str) -> Path:
        """Return the folder of a policy within the jury's."""
        return Path(folder_name(label)) if len(self.policies) > 1 else Path()

    def identity(self, label: str, variant: Variant) -> dict[str, Any]:
        """Return what decides about the records of a policy in an engine."""
        return common_identity(
            self.suite, self.policies[label].policy.digest, self.robot, variant.device, self.bench.seeds
        ) | {
            "pipeline": "jury",
            "engine": variant.label,
            "cells": [f"{c.terrain}-L{c.level}-f{c.friction:g}" for c in self.bench.cells],
        }

    @property
    def runs(self) -> list[tuple[str, dict[str, Any]]]:
        """Return the folder of every run within the jury's, and its identity."""
        return [(str(self.home(p) / v.folder), self.identity(p, v)) for p in self.policies for v in self.engines]


def prepare_jury(request: JuryRequest) -> PreparedJury:
    """Check a request and load what it names; engines of the default that are not installed are left out.

    Raises:
        JuryError, ConsistencyError: there is no such part, no engine, or policies of different robots.
        SuiteError, RobotError, PolicyError, ContractError, BackendError: one sentence on what is wrong.
    """
    if request.part not in PARTS:
        hint = did_you_mean(request.part, PARTS) or ";"
        raise JuryError(f"there is no part {shown(request.part)}{hint} choose from {', '.join(PARTS)} (--part)")
    policies, refused = load_policies(
        request.policies, request.robot, trust=request.trust, contract_file=request.contract
    )
    if refused:
        raise JuryError(f"'{one_line(refused[0]['what'])}' cannot be judged: {refused[0]['reason']}")
    first, *others = policies
    robot = policies[first].robot
    for label in others:
        if robot_digest(policies[label].robot) != robot_digest(robot):
            raise JuryError(
                f"policy '{first}' is for robot '{robot.name}', '{label}' for '{policies[label].robot.name}'; one jury judges "
                "policies of one robot"
            )
    part = (BIPED_PARTS if len(robot.foot_names) == 2 else PARTS)[request.part]
    suite = load_suite(part.suite)
    engines, skipped = _engines(request, suite)
    for loaded in policies.values():
        check_fit(suite, robot, loaded.policy.contract)
    cells = [Cell(terrain=t, level=level, friction=f) for t, level in part.grounds for f in part.frictions]
    return PreparedJury(
        request=request,
        suite=suite,
        robot=robot,
        policies=policies,
        engines=engines,
        bench=Bench(suite=suite, cells=tuple(cells), seeds=tuple(range(part.seeds))),
        skipped=skipped,
    )


def _engines(request: JuryRequest, suite: Suite) -> tuple[list[Variant], list[dict[str, str]]]:
    """Return the engines that judge, and those of the default that cannot run on this machine."""
    device = request.device or (None if torch.cuda.is_available() else "cpu")  # a jury is small enough for the CPU
    variants = parse_variants(request.engines or ENGINES)
    found, reasons = place_all(variants, suite.physics, device, needed=lambda *_: bool(request.engines))
    if not found:
        raise JuryError(f"no engine can judge here: {'; '.join(reasons.values())}")
    return list(found.values()), [{"engine": label, "reason": reason} for label, reason in reasons.items()]


def jury(
    request: JuryRequest | PreparedJury,
    folder: Path,
    *,
    resume: bool = False,
    command: Sequence[str] = (),
    watch: Watch = lambda _: None,
    told: Callable[[JuryCost], None] = lambda _: None,
) -> dict[str, Any]:
    """Judge policies; every finished episode is on disk at once. An engine that fails is named, and the others judge on.

    ``told`` hears what it takes before anything is played. Returns the content of ``jury.json`` (docs/guides/jury.md).

    Raises:
        JuryError: not one engine played to the end.
        ConsistencyError, SuiteError, RobotError, PolicyError, ContractError, BackendError, StoreError: one sentence.
    """
    began = time.perf_counter()
    prepared = request if isinstance(request, PreparedJury) else prepare_jury(request)
    for name, identity in prepared.runs:  # before the engines' speeds are measured, which takes long
        check_folder(folder / name, identity, resume=resume)
    torch.set_num_threads(1)  # several would change the last bits of the policy's output
    session = _Session(prepared, folder, resume=resume, watch=watch, told=told)
    blocks = [session.judge(label, loaded) for label, loaded in prepared.policies.items()]
    results: dict[str, Any] = {
        "schema": SCHEMA,
        "part": prepared.request.part,
        "suite": {"name": prepared.suite.name, "version": prepared.suite.version, "title": prepared.suite.title},
        "robot": prepared.robot.name,
        "engines": [
            {
                "label": v.label,
                "family": prepared.families[v.label],
                "device": v.device,
                "solver": dict(engine_class(v.backend).solver_settings(v.physics(prepared.suite.physics))),
            }
            for v in prepared.engines
        ],
        "skipped": prepared.skipped,
        "cells": [asdict(cell) for cell in prepared.bench.cells],
        "seeds": list(prepared.bench.seeds),
        "policies": blocks,
        "provenance": provenance(
            command=command,
            threads=cpu_threads(prepared.request.threads),
            seconds=round(time.perf_counter() - began, 2),
        ),
    }
    write_atomically(folder / "jury.json", json_text(results), StoreError)
    return results


class _Session:
    """One jury at work."""

    def __init__(
        self, prepared: PreparedJury, folder: Path, *, resume: bool, watch: Watch, told: Callable[[JuryCost], None]
    ) -> None:
        self._prepared, self._folder, self._resume, self._watch, self._told = prepared, folder, resume, watch, told
        self._episodes = prepared.bench.episodes()
        self._threads = cpu_threads(prepared.request.threads)
        self._unable: dict[str, str] = {}
        self._pace: EnginePace | None = None
        self._turn = 0

    def judge(self, label: str, loaded: Loaded) -> dict[str, Any]:
        """Let every engine play a policy; return its verdict."""
        prepared = self._prepared
        pace = self._pace = self._pace or self._measure(label, loaded)
        home = self._folder / prepared.home(label)
        found: dict[str, Records] = {}
        for variant in prepared.engines:
            self._turn += 1
            if variant.label in self._unable:
                continue
            try:
                found[variant.label] = self._play(label, loaded, variant, home, pace)
            except (BackendError, WorkerError) as error:
                self._unable[variant.label] = str(error)
        if not found:
            raise JuryError(f"no engine could judge '{label}': {'; '.join(self._unable.values())}")
        physics, families = training_physics(loaded.policy.contract), prepared.families
        homes = dict.fromkeys(_family(entry.engine) for entry in (*physics.trained, *physics.tuned))
        block = verdict(prepared.bench, found, families, list(homes), label)
        block |= {
            "policy": describe(label, loaded),
            "training": physics.to_data(),
        }
        block["unable"] = [{"engine": k, "reason": v} for k, v in self._unable.items()]
        return block | {"sentences": sentences(block, label)}

    def _play(self, label: str, loaded: Loaded, variant: Variant, home: Path, pace: EnginePace) -> Records:
        """Return the records of all episodes in an engine."""
        prepared = self._prepared
        identity = prepared.identity(label, variant)
        meter = pace.begin(self._turn - 1)
        with RunFolder(home / variant.folder, identity, resume=self._resume) as store:
            played = len(store.records)
            play_variant(
                variant,
                self._episodes,
                suite=prepared.suite,
                robot=prepared.robot,
                policy=loaded.policy,
                records=store.records,
                keep=store.put,
                threads=self._threads,
                watch=lambda status: self._show(label, variant, pace, status),
                meter=meter,
            )
        pace.end(counts=played == 0)
        return store.records

    def _show(self, label: str, variant: Variant, pace: EnginePace, status: Status | None) -> None:
        """Tell the display how far everything is."""
        if status is not None:
            pace.look(status)
        count = len(self._prepared.engines) * len(self._prepared.policies)
        self._watch(
            JuryStatus(
                policy=label,
                engine=variant.label,
                number=self._turn,
                count=count,
                share=pace.share,
                seconds_left=pace.seconds_left,
            )
        )

    def _measure(self, label: str, loaded: Loaded) -> EnginePace:
        """Measure what every engine costs; one that cannot judge is noted."""
        prepared = self._prepared
        measure = partial(
            measure_cost,
            episodes=self._episodes,
            suite=prepared.suite,
            robot=prepared.robot,
            policy=loaded.policy,
            threads=self._threads,
        )
        engines = prepared.engines
        status = partial(JuryStatus, policy=label, count=len(engines) * len(prepared.policies), share=0.0)

        def one(variant: Variant) -> Cost:
            number = engines.index(variant) + 1
            self._watch(status(engine=variant.label, number=number, seconds_left=None))
            return measure(variant)

        costs = measure_all(engines, one, lambda v, error: self._unable.update({v.label: str(error)}))
        runs = [v for _ in prepared.policies for v in engines]
        pace = EnginePace(runs, costs, self._episodes, suite=prepared.suite, threads=self._threads)
        cost = JuryCost(
            episodes=len(self._episodes),
            world_steps=prepared.world_steps,
            engines=len(engines),
            policies=len(prepared.policies),
            seconds=pace.seconds_left,
        )
        self._told(cost)
        return pace


def _family(name: str) -> str:
    """Return the family of an engine by name; the name itself for an engine that is not installed here."""
    try:
        return engine_class(name).family or name
    except BackendError:
        return name
