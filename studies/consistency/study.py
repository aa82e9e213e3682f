"""A consistency study from request to ``consistency.json``: every layer, every policy, every engine."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from ...backends.base import BackendError
from ...files.choices import cpu_threads
from ...files.provenance import provenance
from ...files.writing import json_text, write_atomically
from ...gauge.plan import Records
from ...gauge.play.progress import Status
from ...gauge.play.sampling import GRAVITY
from ...gauge.results import health
from ...gauge.store import RunFolder, StoreError, check_folder
from ...policy.native import FilePolicy
from ...robots.anatomy.body_plan import total_mass
from .attribution import FLOOR_DRAWS, Factor, effect_of_switch, rounded
from .budget import Budget
from .closed_loop import compare, floor_only, gap_only, play_variant
from .models import compare_models
from .open_loop import Trajectory, compare_trajectories, record_targets, replay
from .prepared import PreparedStudy, prepare_study
from .request import StudyCost, StudyRequest, StudyStatus
from .variants import Variant

SCHEMA = 3

Watch = Callable[[StudyStatus], None]


def study(
    request: StudyRequest | PreparedStudy,
    folder: Path,
    *,
    resume: bool = False,
    command: Sequence[str] = (),
    watch: Watch = lambda _: None,
    told: Callable[[StudyCost], None] = lambda _: None,
) -> dict[str, Any]:
    """Carry out a study; every finished episode is on disk at once.

    Returns the content of ``consistency.json`` (docs/guides/consistency.md).

    Args:
        folder: where ``consistency.json`` and a folder for each engine go (with several policies, one for each of them above).
        told: called before anything is played with what the study takes, and what more of it would.

    Raises:
        ConsistencyError, SuiteError, RobotError, PolicyError, ContractError, BackendError, WorkerError, StoreError: one sentence.
    """
    began = time.perf_counter()
    prepared = request if isinstance(request, PreparedStudy) else prepare_study(request)
    request = prepared.request
    prepared = replace(prepared, others=list(prepared.others), skipped=list(prepared.skipped))  # engines may drop out
    torch.set_num_threads(1)  # several would change the last bits of the policy's output
    for name, identity in prepared.runs:  # refused before engines are measured
        check_folder(folder / name, identity, resume=resume)
    budget = Budget(prepared, watch)
    told(budget.cost)
    blocks = []
    for number, (name, policy) in enumerate(prepared.policies):
        home = folder / prepared.home(number)
        blocks.append(_Policy(prepared, name, policy, home, number, budget, resume=resume, watch=watch).run())
    results: dict[str, Any] = {
        "schema": SCHEMA,
        "suite": {"name": prepared.suite.name, "version": prepared.suite.version, "title": prepared.suite.title},
        "robot": prepared.robot.name,
        "reference": prepared.reference.label,
        "compared": [v.label for v in prepared.others],
        "devices": {v.label: v.device for v in prepared.engines},
        "skipped": prepared.skipped,
        "cells": [asdict(cell) for cell in prepared.cells],
        "seeds": list(prepared.seeds),
        "shared_draws": prepared.design.shared_draws,
        "resamples": prepared.suite.scoring.bootstrap,
        "margin": request.margin,
        "draws": FLOOR_DRAWS,
        "policies": blocks,
        "provenance": provenance(
            command=command, threads=cpu_threads(request.threads), seconds=round(time.perf_counter() - began, 2)
        ),
    }
    write_atomically(folder / "consistency.json", json_text(results), StoreError)
    return results


class _Policy:
    """The study of one policy."""

    def __init__(
        self,
        prepared: PreparedStudy,
        name: str,
        policy: FilePolicy,
        folder: Path,
        number: int,
        budget: Budget,
        *,
        resume: bool,
        watch: Watch,
    ) -> None:
        self._prepared, self._name, self._policy, self._folder = prepared, name, policy, folder
        self._resume, self._watch = resume, watch
        self._records: dict[str, Records] = {}
        self._unable: dict[str, str] = {}
        self._budget, self._number = budget, number

    def run(self) -> dict[str, Any]:
        """All layers; the closed loop comes first, since it finds out which engines can play these terrains."""
        prepared = self._prepared
        switches, draws = prepared.switches, prepared.draws
        for variant in prepared.engines:
            try:
                self._play(variant)
            except BackendError as error:
                self._unable[variant.label] = str(error)
                prepared.drop(variant, str(error))
        floor = [self._play(draw) for draw in draws]
        models, open_loop = self._open_loop()
        attribution = [self._attribute(factor, variant) for factor, variant in switches]
        reference, design = prepared.reference.label, prepared.design
        pairs = {
            v.label: compare(
                design,
                self._records[reference],
                self._records[v.label],
                floor=floor,
                name=f"{self._name}/{reference}/{v.label}",  # as in the gaps: one difference, one interval
            )
            for v in prepared.others
        }
        gaps = [
            {"pair": [a.label, b.label]}
            | gap_only(design, self._records[a.label], self._records[b.label], f"{self._name}/{a.label}/{b.label}")
            for a, b in itertools.combinations(prepared.engines, 2)
        ]
        return {
            "policy": self._name,
            "contract_hash": self._policy.contract.hash,
            "file_sha256": self._policy.file_sha256,
            "models": models,
            "open_loop": open_loop,
            "gaps": gaps,
            "floor": floor_only(design, self._records[reference], floor, f"{self._name}/floor"),
            "pairs": pairs,
            "attribution": attribution,
            "health": {label: health(records.values()).to_data() for label, records in self._records.items()},
        }

    def _play(self, variant: Variant) -> Records:
        """Records of all episodes in a variant; nothing is played twice."""
        prepared = self._prepared
        if variant.label in self._records:
            return self._records[variant.label]
        episodes = prepared.design.episodes()
        part, parts, meter = self._budget.begin(self._number, variant)
        status = partial(StudyStatus, self._name, variant.label, part, parts, episodes=len(episodes))

        def watch(found: Status) -> None:
            share, left = self._budget.look(found)
            self._watch(status(done=found.done, share=share, seconds_left=left))

        with RunFolder(
            self._folder / variant.folder, prepared.identity(self._policy, variant), resume=self._resume
        ) as store:
            played = len(store.records)
            play_variant(
                variant,
                episodes,
                suite=prepared.suite,
                robot=prepared.robot,
                policy=self._policy,
                records=store.records,
                keep=store.put,
                threads=cpu_threads(prepared.request.threads),
                watch=watch,
                meter=meter,
            )
        self._budget.end(counts=played == 0)
        self._records[variant.label] = store.records
        return store.records

    def _attribute(self, factor: Factor, variant: Variant) -> dict[str, Any]:
        """Switch a factor, play, and say what came of it."""
        prepared = self._prepared
        switched = factor.switch(variant)
        entry: dict[str, Any] = {"factor": factor.name, "title": factor.title, "engine": variant.label}
        unable = self._unable.get(variant.label) or self._unable.get(switched.label)
        entry |= {"variant": switched.label, "not_run": unable}
        if unable:
            return entry
        try:
            records = self._play(switched)
        except BackendError as error:
            return entry | {"not_run": str(error)}
        near = prepared.others if variant.label == prepared.reference.label else [prepared.reference]
        others = {v.label: self._records[v.label] for v in near}
        name = f"{self._name}/{switched.label}"
        return entry | effect_of_switch(prepared.design, self._records[variant.label], records, others, name=name)

    def _open_loop(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """The first two layers."""
        prepared = self._prepared
        settings: dict[str, Any] = {
            "suite": prepared.suite,
            "robot": prepared.robot,
            "friction": prepared.cells[0].friction,
            "threads": cpu_threads(prepared.request.threads),
        }
        targets = record_targets(prepared.reference, policy=self._policy, **settings)
        runs: dict[str, Trajectory] = {}
        descriptions: dict[str, Mapping[str, list[float]] | None] = {}
        floor = rounded(prepared.reference)
        contract = self._policy.contract
        for each in [*prepared.engines, floor]:
            runs[each.label], descriptions[each.label] = replay(each, targets, contract=contract, **settings)
        del descriptions[floor.label]
        weight = GRAVITY * total_mass(prepared.robot)
        base = prepared.reference.label
        differences = {
            label: compare_trajectories(runs[base], run, period=prepared.suite.physics.control_period, weight=weight)
            for label, run in runs.items()
            if label != base
        }
        return compare_models(prepared.robot, descriptions, base), {"floor": floor.label, "differences": differences}
