"""A consistency study from request to ``consistency.json``: every layer, every policy, every engine."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from ...backends.base import BackendError
from ...backends.registry import find_backend
from ...files.choices import cpu_threads
from ...files.provenance import provenance
from ...files.writing import json_text, write_atomically
from ...gauge.evaluate import Request, common_identity, prepare
from ...gauge.plan import Records
from ...gauge.play.progress import Status
from ...gauge.play.sampling import GRAVITY
from ...gauge.results import health
from ...gauge.store import RunFolder, StoreError, check_folder
from ...gauge.suite import Suite, SuiteError, load_suite
from ...policy.loading import own_contract
from ...policy.native import FilePolicy
from ...robots import Robot
from ...robots.body_plan import total_mass
from ...robots.loading import robot_digest
from ...terrains.registry import gauge_terrain_names
from .attribution import FLOOR_DRAWS, Factor, choose_factors, effect_of_switch, rounded
from .budget import Budget
from .closed_loop import Cell, Design, compare, floor_only, gap_only, make_cells, play_variant
from .models import compare_models
from .open_loop import Trajectory, compare_trajectories, record_targets, replay
from .request import ConsistencyError, StudyCost, StudyRequest, StudyStatus
from .variants import Variant, parse_variant, place

SCHEMA = 3
LEVEL = 3
"""Level of terrains that have levels, where none is asked for."""

Watch = Callable[[StudyStatus], None]


@dataclass(kw_only=True)
class PreparedStudy:
    """A request that can be carried out."""

    request: StudyRequest
    suite: Suite
    robot: Robot
    policies: list[tuple[str, FilePolicy]]
    reference: Variant
    others: list[Variant]
    cells: list[Cell]
    seeds: tuple[int, ...]
    factors: tuple[Factor, ...]
    skipped: list[dict[str, str]] = field(default_factory=list)
    """Engines that are left out and why."""

    @property
    def design(self) -> Design:
        """Return what is compared."""
        return Design(suite=self.suite, cells=tuple(self.cells), seeds=self.seeds, margin=self.request.margin)

    @property
    def engines(self) -> list[Variant]:
        """The reference and the others."""
        return [self.reference, *self.others]

    def home(self, number: int) -> Path:
        """Return the folder of the policy of that number within the study's."""
        return Path(f"{number + 1}-{Path(self.policies[number][0]).name}") if len(self.policies) > 1 else Path()

    def identity(self, policy: FilePolicy, variant: Variant) -> dict[str, Any]:
        """Return what decides about the records of a policy in a variant."""
        return common_identity(self.suite, policy.digest, self.robot, variant.device, self.seeds) | {
            "pipeline": "consistency",
            "variant": variant.label,
            "robot": self.request.robot or self.robot.name,
            "cells": [f"{c.terrain}-L{c.level}-f{c.friction:g}" for c in self.cells],
        }

    @property
    def runs(self) -> list[tuple[str, dict[str, Any]]]:
        """Return the folder of every engine's run within the study's, and its identity."""
        return [
            (str(self.home(number) / variant.folder), self.identity(policy, variant))
            for number, (_, policy) in enumerate(self.policies)
            for variant in self.engines
        ]

    @property
    def draws(self) -> list[Variant]:
        """Return the reference, perturbed, for the floor."""
        return [rounded(self.reference, draw) for draw in range(1, FLOOR_DRAWS + 1)]

    @property
    def switches(self) -> list[tuple[Factor, Variant]]:
        """Return which factor is switched in which engine: the reference's, and buffer sizes in the engines that have them."""
        return self.switches_of(self.factors)

    def switches_of(self, factors: Sequence[Factor]) -> list[tuple[Factor, Variant]]:
        """Return the same for some factors."""
        found = []
        for factor in factors:
            engines = self.others if factor.fixed_buffers_only else [self.reference]
            found += [(factor, v) for v in engines if factor.applies(v, self.suite.physics)]
        return found

    def variants(self, factors: Sequence[Factor]) -> list[Variant]:
        """Return all that is played of a policy, in order."""
        switched = (factor.switch(v) for factor, v in self.switches_of(factors))
        return list({v.label: v for v in (*self.engines, *self.draws, *switched)}.values())

    def drop(self, variant: Variant, reason: str) -> None:
        """Leave out an engine that turned out unable.

        Raises:
            ConsistencyError: it is the reference, or nothing is left to compare it with.
        """
        if variant.label == self.reference.label:
            raise ConsistencyError(f"the reference '{variant.label}' cannot run: {reason}")
        self.others = [v for v in self.others if v.label != variant.label]
        self.skipped.append({"backend": variant.label, "reason": reason})
        self.require_two()

    def require_two(self) -> None:
        """Raise unless there are two engines to compare."""
        if not self.others:
            reasons = "; ".join(f"{s['backend']}: {s['reason']}" for s in self.skipped)
            raise ConsistencyError(
                f"only '{self.reference.label}' is left to compare, and two engines are needed ({reasons})"
            )


def prepare_study(request: StudyRequest) -> PreparedStudy:
    """Check a request and load what it names; engines that cannot run here are left out.

    Raises:
        ConsistencyError: fewer than two engines, or something else that makes no study.
        SuiteError, RobotError, TerrainError, PolicyError, ContractError, BackendError: one sentence on what is wrong.
    """
    if not request.policies:
        raise ConsistencyError("name at least one policy")
    suite = load_suite(request.suite)
    reference, others, skipped = _engines(request, suite)
    if not 2 <= request.seeds <= 1000:
        raise ConsistencyError(
            f"{request.seeds} seeds are not possible; give 2 to 1000, since an interval needs a spread (--seeds)"
        )
    frictions = request.frictions or (suite.matrix.nominal_friction,)
    levels = tuple(dict.fromkeys(request.levels or (LEVEL,)))
    for level in levels:
        if not 1 <= level <= suite.scoring.levels:
            raise SuiteError(f"level {level} does not exist; choose 1 to {suite.scoring.levels} (--level)")
    order = gauge_terrain_names()
    asked = dict.fromkeys(request.terrains or suite.matrix.terrains)
    terrains = sorted(asked, key=lambda t: order.index(t) if t in order else len(order))
    policies = []
    robot = None
    for name in request.policies:
        prepared_policy = prepare(
            Request(
                policy=name,
                suite=request.suite,
                pipeline="multi",
                backend=reference.backend,
                device=reference.device,
                robot=request.robot,
                terrains=tuple(terrains),
                level=levels[0] if request.levels or any(t != "flat" for t in terrains) else None,
                frictions=frictions,
                trust=request.trust,
                contract=own_contract(name, request.contract),
            )
        )
        if robot is not None and robot_digest(robot) != robot_digest(prepared_policy.robot):
            raise ConsistencyError(
                f"policy '{name}' is for robot '{prepared_policy.robot.name}', the others for '{robot.name}'; one study is of "
                "one robot"
            )
        robot = prepared_policy.robot
        policies.append((name, prepared_policy.policy))
    assert robot is not None
    prepared = PreparedStudy(
        request=request,
        suite=suite,
        robot=robot,
        policies=policies,
        reference=reference,
        others=others,
        cells=make_cells(terrains, levels, tuple(dict.fromkeys(frictions))),
        seeds=tuple(range(request.seeds)),
        factors=choose_factors(request.factors) if request.attribution or request.factors else (),
        skipped=skipped,
    )
    prepared.require_two()
    return prepared


def _engines(request: StudyRequest, suite: Suite) -> tuple[Variant, list[Variant], list[dict[str, str]]]:
    """The reference, the others, and those that cannot run on this machine."""
    variants = {v.label: v for v in (parse_variant(text) for text in request.backends or default_engines())}
    wanted = parse_variant(request.reference).label if request.reference else next(iter(variants), None)
    if wanted is None or len(variants) + (wanted not in variants) < 2:
        raise ConsistencyError("a comparison needs two engines; give for example --backends mujoco,mujoco-warp")
    if wanted not in variants:
        variants = {wanted: parse_variant(wanted), **variants}
    placed: dict[str, Variant] = {}
    skipped = []
    for label, variant in variants.items():
        variant.physics(suite.physics)  # an impossible option is the user's mistake and not the machine's
        try:
            placed[label] = place(variant, request.device)
        except BackendError as error:
            if label == wanted or str(error).startswith(("unknown backend", "unknown Newton solver")):
                raise
            skipped.append({"backend": label, "reason": str(error)})
    return placed[wanted], [v for label, v in placed.items() if label != wanted], skipped


def default_engines() -> tuple[str, str]:
    """Return MuJoCo and one more that starts at once here: MuJoCo Warp on a GPU, else Drake, else MuJoCo without friction in turns."""
    if torch.cuda.is_available():
        return "mujoco", "mujoco-warp"
    try:
        find_backend("drake", "cpu")
    except BackendError:
        return "mujoco", "mujoco@foot_condim=3"
    return "mujoco", "drake"


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
        request: what to compare, as it is or prepared already.
        folder: where ``consistency.json`` and a folder for each engine go (with several policies, one for each of them above).
        watch: called a few times a second.
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
