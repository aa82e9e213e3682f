"""A jury from request to ``jury.json``: every policy plays the same episodes in every engine."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from ...backends.base import BackendError, ResetState, Scene
from ...backends.registry import engine_class
from ...files.choices import cpu_threads
from ...files.parsing import did_you_mean, one_line, shown
from ...files.provenance import provenance
from ...files.writing import json_text, write_atomically
from ...gauge.described import training_physics
from ...gauge.evaluate import common_identity
from ...gauge.fit import check_fit
from ...gauge.motors import joint_parameters
from ...gauge.plan import Records
from ...gauge.play.progress import ProgressMeter, Status
from ...gauge.play.workers import WorkerError, local_workers
from ...gauge.store import RunFolder, StoreError
from ...gauge.suite import Suite, load_suite
from ...robots import Robot
from ...robots.loading import robot_digest
from ...terrains.registry import make_terrain
from ..consistency.closed_loop import Cell, play_variant
from ..consistency.variants import Variant, parse_variant, place
from ..naming import folder_name
from ..policies import Loaded, describe, load_policies
from .request import ENGINES, PARTS, JuryError, JuryRequest, JuryStatus
from .verdict import Bench, sentences, verdict

SCHEMA = 1
_TRIED = 20
"""Control steps by which an engine's speed is measured."""
_TRIED_WORLDS = 12

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
    part = PARTS[request.part]
    suite = load_suite(part.suite)
    engines, skipped = _engines(request, suite)
    policies, refused = load_policies(request.policies, request.robot, trust=request.trust)
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
    found: dict[str, Variant] = {}
    skipped = []
    for text in request.engines or ENGINES:
        variant = parse_variant(text)
        variant.physics(suite.physics)
        try:
            found[variant.label] = place(variant, request.device or _device())
        except BackendError as error:
            if request.engines:
                raise
            skipped.append({"engine": variant.label, "reason": str(error)})
    if not found:
        raise JuryError(f"no engine can judge here: {'; '.join(s['reason'] for s in skipped)}")
    return list(found.values()), skipped


def _device() -> str | None:
    """Return the CPU where there is no GPU, since a jury is small enough for it."""
    return None if torch.cuda.is_available() else "cpu"


def jury(
    request: JuryRequest | PreparedJury,
    folder: Path,
    *,
    resume: bool = False,
    command: Sequence[str] = (),
    watch: Watch = lambda _: None,
) -> dict[str, Any]:
    """Judge policies; every finished episode is on disk at once. An engine that fails is named, and the others judge on.

    Returns the content of ``jury.json`` (docs/guides/jury.md).

    Raises:
        JuryError: not one engine played to the end.
        ConsistencyError, SuiteError, RobotError, PolicyError, ContractError, BackendError, StoreError: one sentence.
    """
    began = time.perf_counter()
    prepared = request if isinstance(request, PreparedJury) else prepare_jury(request)
    torch.set_num_threads(1)  # several would change the last bits of the policy's output
    session = _Session(prepared, folder, resume=resume, watch=watch)
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

    def __init__(self, prepared: PreparedJury, folder: Path, *, resume: bool, watch: Watch) -> None:
        self._prepared, self._folder, self._resume, self._watch = prepared, folder, resume, watch
        self._meter = ProgressMeter(prepared.suite, time.perf_counter())
        self._episodes = prepared.bench.episodes()
        self._threads = cpu_threads(prepared.request.threads)
        self._unable: dict[str, str] = {}
        self._expected: dict[str, float] = {}
        self._turn = 0

    def judge(self, label: str, loaded: Loaded) -> dict[str, Any]:
        """Let every engine play a policy; return its verdict."""
        prepared = self._prepared
        if not self._expected:
            self._measure(loaded)
        home = self._folder / prepared.home(label)
        found: dict[str, Records] = {}
        for variant in prepared.engines:
            self._turn += 1
            if variant.label in self._unable:
                continue
            try:
                found[variant.label] = self._play(label, loaded, variant, home)
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

    def _play(self, label: str, loaded: Loaded, variant: Variant, home: Path) -> Records:
        """Return the records of all episodes in an engine."""
        prepared = self._prepared
        identity = prepared.identity(label, variant)
        began = time.perf_counter()
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
                watch=lambda status: self._show(label, variant, status, time.perf_counter() - began),
            )
        if played == 0:  # what it took says more of the next policies than the measured speed did
            self._expected[variant.label] = time.perf_counter() - began
        return store.records

    def _show(self, label: str, variant: Variant, status: Status, seconds: float) -> None:
        """Tell the display how far everything is."""
        engines, expected = [v.label for v in self._prepared.engines], self._expected
        total = sum(expected.values()) * len(self._prepared.policies)
        turn = self._turn - 1
        done = sum(expected.values()) * (turn // len(engines)) + sum(
            expected.get(x, 0.0) for x in engines[: turn % len(engines)]
        )
        own, share = expected[variant.label], 1.0 - status.remaining_work
        if seconds > 0.1 * own and share > 0.05:  # by now this engine's own pace is known
            own = seconds / share
        left = own * status.remaining_work + max(total - done - expected[variant.label], 0.0)
        self._watch(
            JuryStatus(
                policy=label,
                engine=variant.label,
                number=self._turn,
                count=len(engines) * len(self._prepared.policies),
                share=min((done + expected[variant.label] * share) / total, 1.0) if total else 0.0,
                seconds_left=left,
            )
        )

    def _measure(self, loaded: Loaded) -> None:
        """Measure the speed of every engine on flat ground, from which the remaining time is estimated."""
        prepared = self._prepared
        steps = sum(self._meter.usual_steps(e) for e in self._episodes)
        for variant in prepared.engines:
            try:
                seconds = _time_of_a_step(prepared, loaded, variant)
            except BackendError as error:
                self._unable[variant.label] = str(error)
                continue
            workers = local_workers(variant.backend, variant.device, threads=self._threads, most=len(self._episodes))
            self._expected[variant.label] = steps * seconds / workers


def _family(name: str) -> str:
    """Return the family of an engine by name; the name itself for an engine that is not installed here."""
    try:
        return engine_class(name).family or name
    except BackendError:
        return name


def _time_of_a_step(prepared: PreparedJury, loaded: Loaded, variant: Variant) -> float:
    """Return the time that a control step of one world takes [s], with the robot standing on flat ground."""
    scene = Scene(
        robot=prepared.robot,
        parameters=joint_parameters(prepared.suite, prepared.robot, loaded.policy.contract),
        terrains=(make_terrain("flat"),),
        terrain_index=(0,) * _TRIED_WORLDS,
        physics=prepared.suite.physics,
    )
    with closing(variant.worlds(scene, threads=1)) as backend:
        pose, position, upright = (
            torch.tensor(row, device=backend.device, dtype=backend.dtype).expand(_TRIED_WORLDS, -1)
            for row in (
                prepared.robot.default_joint_position,
                (0.0, 0.0, prepared.robot.stand_height),
                (1.0, 0.0, 0.0, 0.0),
            )
        )
        backend.reset(ResetState(base_position=position, base_quaternion=upright, held_target=pose))
        backend.step(pose)
        began = time.perf_counter()
        for _ in range(_TRIED):
            backend.step(pose)
        return (time.perf_counter() - began) / (_TRIED * _TRIED_WORLDS)
