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
from ...gauge.suite import load_suite
from ...policy.finding import find_policy
from ...policy.loading import own_contract
from ...robots.loading import robot_digest
from ..naming import distinct_names, free_run_folder, run_folders
from ..turns import EvaluationTurns
from .comparison import ComparisonError, check_alike, check_different, compare, load_result
from .report import write_comparison

_SEEDS = 3
"""Seeds where the suite has one: as many as gaitgauge-1 has."""
_TELLS_NOTHING = "which tells no difference from chance"
_ADVICE = "with three seeds or more (--seed 0 --seed 1 --seed 2)"


def is_result(contestant: str) -> bool:
    """Return whether an argument names results, not a policy: a folder with ``results.json``, or a ``.json`` or ``.json.gz`` file."""
    path = Path(contestant)
    return path.name.endswith((".json", ".json.gz")) or (path / "results.json").is_file()


def compare_all(
    contestants: Sequence[str],
    request: Request,
    *,
    folder: Path,
    overwrite: bool = True,
    runs: Path,
    command: Sequence[str] = (),
    watch: Callable[[Status], None] | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> tuple[dict[str, Any], dict[str, Path]]:
    """Evaluate what has not been evaluated yet, compare, and write the comparison; returns it as plain data, and its files.

    Args:
        request: how policies are evaluated; its policy is replaced by each.
        overwrite: write over a comparison of other results there; False for ``<folder>-2`` … in its place.
        runs: folder of the evaluations; what it holds is gone on with.

    Raises:
        ComparisonError and those of ``evaluate``: one sentence. What can be known to be wrong is said before anything is played.
    """
    if len(contestants) < 2:
        raise ComparisonError(f"a comparison needs at least two policies or results; only '{contestants[0]}' was given")
    found = {c: load_result(Path(c)) for c in contestants if is_result(c)}
    added: list[str] = []
    if len(found) < len(contestants):
        lone = [c for c, result in found.items() if len(result.chance.seeds) == 1]
        if lone:
            raise ComparisonError(
                f"the results of '{lone[0]}' have one seed, {_TELLS_NOTHING}; evaluate its policy again {_ADVICE}"
            )
        request = deciding_request(request, added.append)
    requests = {
        c: replace(request, policy=c, contract=own_contract(c, request.contract)) for c in contestants if c not in found
    }
    prepared_requests = {c: prepare(wanted) for c, wanted in requests.items()}
    check_different([found.get(c) or find_policy(c).resolve() for c in contestants], contestants)
    check_alike([found.get(c) or _known_before(prepared_requests[c]) for c in contestants], contestants)
    for sentence in added:  # nothing else is wrong
        say(sentence)
    names: Any = {"suite": request.suite, "pipeline": request.pipeline, "parameters": request.parameters}
    usual = run_folders(list(requests), runs, **names)
    folders = [
        free_run_folder(target, ("", identity(prepared)))
        for prepared, target in zip(prepared_requests.values(), usual, strict=True)
    ]
    labelled = {
        c: f"{c}/{result.policy.path}" for c, result in found.items()
    }  # a card's own name where its policy has none
    turns = EvaluationTurns(watch, len(requests))
    for contestant, target in zip(requests, folders, strict=True):
        prepared = prepared_requests[contestant]
        found[contestant] = evaluate(prepared, target, resume=True, command=command, watch=turns.begin())
        write_report(target)
    labels = distinct_names([labelled.get(c, found[c].policy.path) for c in contestants])
    comparison = compare([found[c] for c in contestants], labels)
    return comparison.plain(), write_comparison(folder, comparison, overwrite=overwrite)


def deciding_request(request: Request, say: Callable[[str], None]) -> Request:
    """Return a request with seeds enough for a comparison: with one seed nothing can be told from chance.

    Args:
        say: called with a sentence where seeds are added to the suite's single one.

    Raises:
        ComparisonError: one seed was asked for, or the pipeline plays one.
        SuiteError: there is no such suite.
    """
    suite = load_suite(request.suite)
    seeds = dict.fromkeys(request.seeds or suite.matrix.seeds)
    if request.pipeline == "base":
        raise ComparisonError(f"pipeline 'base' plays one seed, {_TELLS_NOTHING}; use --pipeline multi")
    if len(seeds) > 1 or request.pipeline == "level":
        return request
    (only,) = seeds
    if request.seeds:
        raise ComparisonError(f"seed {only} is the only one, {_TELLS_NOTHING}; compare {_ADVICE}")
    seeds = dict.fromkeys(range(only, only + _SEEDS))
    named = " and ".join([", ".join(map(str, list(seeds)[:-1])), str(only + _SEEDS - 1)])
    say(f"suite '{suite.name}' has one seed, {_TELLS_NOTHING}: every policy is played with seeds {named}")
    return replace(request, seeds=tuple(seeds))


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
