"""Compare what the command line names: evaluate the policies, read the results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ...gauge.coverage import coverage
from ...gauge.evaluate import Prepared, Request, Status, evaluate, identity, prepare
from ...gauge.report.page import write_report
from ...gauge.result import EnvironmentRow, PolicyName, Provenance, Result, SuiteName
from ...gauge.results import chance_rules
from ...gauge.store import check_folder
from ...policy.finding import find_policy
from ...policy.loading import own_contract
from ...robots.loading import robot_digest
from ..naming import distinct_names, run_folders
from .comparison import ComparisonError, check_alike, check_different, compare, load_result
from .report import write_comparison


def is_result(contestant: str) -> bool:
    """Return whether an argument names results rather than a policy: a folder with ``results.json``, or a file that ends in ``.json``."""
    path = Path(contestant)
    return path.suffix == ".json" or (path / "results.json").is_file()


def compare_all(
    contestants: Sequence[str],
    request: Request,
    *,
    folder: Path,
    runs: Path,
    command: Sequence[str] = (),
    watch: Callable[[Status], None] | None = None,
) -> tuple[dict[str, Any], dict[str, Path]]:
    """Evaluate what has not been evaluated yet, compare, and write the comparison; returns it as plain data, and its files.

    Args:
        request: how policies are evaluated; its policy is replaced by each.
        folder: where the comparison goes.
        runs: folder of the evaluations; what it holds is gone on with.
        watch: called a few times a second during an evaluation.

    Raises:
        ComparisonError and those of ``evaluate``: one sentence. What can be known to be wrong is said before anything is played.
    """
    if len(contestants) < 2:
        raise ComparisonError(f"a comparison needs at least two policies or results; only '{contestants[0]}' was given")
    found = {c: load_result(Path(c)) for c in contestants if is_result(c)}
    requests = {
        c: replace(request, policy=c, contract=own_contract(c, request.contract)) for c in contestants if c not in found
    }
    prepared_requests = {c: prepare(wanted) for c, wanted in requests.items()}
    check_different([found.get(c) or find_policy(c).resolve() for c in contestants], contestants)
    check_alike([found.get(c) or _known_before(prepared_requests[c]) for c in contestants], contestants)
    names: Any = {"suite": request.suite, "pipeline": request.pipeline, "parameters": request.parameters}
    folders = run_folders(list(requests), runs, **names)
    for prepared, target in zip(prepared_requests.values(), folders, strict=True):
        check_folder(target, identity(prepared), resume=True)
    labelled = {
        c: f"{c}/{result.policy.path}" for c, result in found.items()
    }  # a card's own name where its policy has none
    for contestant, target in zip(requests, folders, strict=True):
        found[contestant] = evaluate(prepared_requests[contestant], target, resume=True, command=command, watch=watch)
        write_report(target)
    labels = distinct_names([labelled.get(c, found[c].policy.path) for c in contestants])
    comparison = compare([found[c] for c in contestants], labels)
    return comparison.plain(), write_comparison(folder, comparison)


def _known_before(prepared: Prepared) -> Result:
    """Return the parts of a result that ``check_alike`` reads, before anything is played."""
    request, suite = prepared.request, prepared.suite
    return Result(
        suite=SuiteName(name=suite.name, version=suite.version, digest=suite.digest),
        policy=PolicyName(path=prepared.policy.path, file_sha256=prepared.policy.file_sha256),
        backend=request.backend,
        robot=prepared.robot.name,
        pipeline=request.pipeline,
        score=0.0 if prepared.rules.quality else None,
        chance=chance_rules(suite, prepared.seeds),
        coverage=coverage(suite, prepared.environments, prepared.seeds, pipeline=request.pipeline),
        provenance=Provenance(digests={"robot": robot_digest(prepared.robot)}),
        environments=tuple(
            EnvironmentRow(
                terrain=e.terrain, friction=e.friction, payload=e.payload, trials={1: {}} if e.searched else {}
            )
            for e in prepared.environments
        ),
    )
