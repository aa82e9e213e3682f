"""One policy under several parameter sets of its robot, the nominal one first: the same episodes, paired differences."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ...files.parsing import bare_name
from ...gauge.evaluate import Request, Status, evaluate, identity, prepare
from ...gauge.report.page import write_report
from ..compare.comparison import compare
from ..compare.contestants import deciding_request
from ..compare.report import write_comparison
from ..naming import free_run_folder, run_folders
from ..turns import EvaluationTurns
from .log import LogError


def score_sets(
    request: Request,
    sets: Sequence[str],
    *,
    folder: Path,
    overwrite: bool = True,
    runs: Path,
    command: Sequence[str] = (),
    watch: Callable[[Status], None] | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> tuple[dict[str, Any], dict[str, Path]]:
    """Evaluate a policy under each parameter set and compare; return the comparison as plain data, and its files.

    Args:
        request: how it is evaluated; its ``parameters`` are replaced by each set.
        sets: names or files, as for ``find_set``; the first is the one that the others are compared with.

    Raises:
        LogError: fewer than two sets, or two of one name.
        Those of ``evaluate``: one sentence.
    """
    labels = [bare_name(Path(name).name) for name in sets]
    if len(sets) < 2 or len(set(labels)) < len(labels):
        given = ", ".join(sets) or "none"
        raise LogError(
            f"a policy is compared under two or more different parameter sets, and {given} was given; name them behind the policy"
        )
    request = deciding_request(request, say)
    prepared = [prepare(replace(request, parameters=name)) for name in sets]
    results, turns = [], EvaluationTurns(watch, len(sets))
    for name, one in zip(sets, prepared, strict=True):
        usual = run_folders([request.policy], runs, suite=request.suite, pipeline=request.pipeline, parameters=name)[0]
        target = free_run_folder(usual, ("", identity(one)))
        results.append(evaluate(one, target, resume=True, command=command, watch=turns.begin()))
        write_report(target)
    robot = results[0].provenance.digests["robot"]  # one machine, whatever set stands for it
    alike = [
        replace(r, provenance=replace(r.provenance, digests={**r.provenance.digests, "robot": robot})) for r in results
    ]
    comparison = compare(alike, labels)
    return comparison.plain(), write_comparison(folder, comparison, overwrite=overwrite)
