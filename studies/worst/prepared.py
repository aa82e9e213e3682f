"""A search that can be carried out: its policy, its engines and its ranges, and the folder that is free for it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from ...files.parsing import shown
from ...gauge.suite import load_suite
from ...robots import Robot
from ...robots.loading import robot_digest
from ..consistency.variants import Variant, parse_variant, parse_variants, place, place_all
from ..naming import free_folder
from ..policies import Loaded, load_policies
from .folder import check_folder
from .ranges import Measures, Ranges, measures_of
from .request import OTHERS, WorstError, WorstRequest


@dataclass(kw_only=True)
class PreparedSearch:
    """A request that can be carried out."""

    request: WorstRequest
    label: str
    loaded: Loaded
    engine: Variant
    others: list[Variant]
    measures: Measures
    ranges: Ranges = field(default_factory=Ranges)
    skipped: list[dict[str, str]] = field(default_factory=list)
    """Engines that do not play failures again, and why."""

    @property
    def robot(self) -> Robot:
        """Return the robot."""
        return self.loaded.robot


def prepare_search(request: WorstRequest) -> PreparedSearch:
    """Check a request and load what it names.

    Raises:
        WorstError: the policy cannot be had, or two engines are the same.
        ConsistencyError, SuiteError, RobotError, ContractError, BackendError: one sentence on what is wrong.
    """
    suite = load_suite(request.suite)
    device = request.device or (None if torch.cuda.is_available() else "cpu")
    engine = place(parse_variant(request.backend), device)
    engine.physics(suite.physics)
    asked = parse_variants(OTHERS if request.others is None else request.others)
    if asked.pop(engine.label, None) and request.others is not None:
        raise WorstError(f"--others names {shown(engine.label)}, the engine that is searched; name another one")
    others, reasons = place_all(asked, suite.physics, device, needed=lambda *_: request.others is not None)
    loaded, refused = load_policies(
        [request.policy], request.robot, trust=request.trust, contract_file=request.contract
    )
    if refused:
        raise WorstError(refused[0]["reason"])
    ((label, found),) = loaded.items()
    limits = found.policy.contract.command_limits
    measures = measures_of(found.robot, limits, request.suite, request.seed, suite.parameters)
    return PreparedSearch(
        request=request,
        label=label,
        loaded=found,
        engine=engine,
        others=list(others.values()),
        measures=measures,
        skipped=[{"engine": label, "reason": reason} for label, reason in reasons.items()],
    )


def identity(prepared: PreparedSearch) -> dict[str, Any]:
    """Return all that decides about a search but for its length."""
    return {
        "policy": prepared.loaded.policy.file_sha256,
        "contract": prepared.loaded.policy.contract.hash,
        "robot": robot_digest(prepared.robot),
        "suite": load_suite(prepared.request.suite).digest,
        "engine": prepared.engine.label,
        "device": prepared.engine.device,
        "seed": prepared.request.seed,
        "batch": prepared.request.batch,
        "ranges": asdict(prepared.ranges),
    }


def free_search_folder(folder: Path, prepared: PreparedSearch) -> Path:
    """Return a folder, or the first of ``<folder>-2`` …, in which no other search is."""

    def is_free(candidate: Path) -> bool:
        try:
            check_folder(candidate, json.loads(json.dumps(identity(prepared))), resume=True)
        except WorstError:
            return False
        return True

    return free_folder(folder, is_free)
