"""Check a request of a study and load what it names: policies, engines, cells and factors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from ...backends.base import BackendError
from ...backends.registry import find_backend
from ...gauge.evaluate import Request, common_identity, prepare
from ...gauge.suite import Suite, SuiteError, load_suite
from ...policy.loading import own_contract
from ...policy.native import FilePolicy
from ...robots import Robot
from ...robots.loading import robot_digest
from ...terrains.registry import gauge_terrain_names
from .attribution import FLOOR_DRAWS, Factor, choose_factors, rounded
from .closed_loop import Cell, Design, make_cells
from .request import ConsistencyError, StudyRequest
from .variants import Variant, parse_variant, parse_variants, place_all

LEVEL = 3
"""Level of terrains that have levels, where none is asked for."""


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
    variants = parse_variants(request.backends or default_engines())
    wanted = parse_variant(request.reference).label if request.reference else next(iter(variants), None)
    if wanted is None or len(variants) + (wanted not in variants) < 2:
        raise ConsistencyError("a comparison needs two engines; give for example --backends mujoco,mujoco-warp")
    if wanted not in variants:
        variants = {wanted: parse_variant(wanted), **variants}
    unknown = ("unknown backend", "unknown Newton solver")
    placed, reasons = place_all(
        variants, suite.physics, request.device, needed=lambda label, why: label == wanted or why.startswith(unknown)
    )
    skipped = [{"backend": label, "reason": reason} for label, reason in reasons.items()]
    return placed.pop(wanted), list(placed.values()), skipped


def default_engines() -> tuple[str, str]:
    """Return MuJoCo and one more that starts at once here: MuJoCo Warp on a GPU, else Drake, else MuJoCo without friction in turns."""
    if torch.cuda.is_available():
        return "mujoco", "mujoco-warp"
    try:
        find_backend("drake", "cpu")
    except BackendError:
        return "mujoco", "mujoco@foot_condim=3"
    return "mujoco", "drake"
