"""Judge, train and read policies from Python.

Each function does what the command of the same name does, with the same defaults, and raises the same one-sentence
errors. Heavy packages are imported inside the functions.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .gauge.request import EvaluationOptions, Request

if TYPE_CHECKING:
    from .gauge.result import Result
    from .policy.base import Policy
    from .studies.compare.comparison import Comparison
    from .training.run.stopping import TrainingOutcome


class ResultsError(ValueError):
    """Refuse a folder or file that holds no results; the message says what is wrong."""


class ArgumentError(TypeError):
    """Refuse an argument of the wrong type; the message names it."""


def _need(kind: str, **given: Any) -> None:
    """Check types by the words of ``_KINDS``.

    Raises:
        ArgumentError: one does not fit.
    """
    from .files.parsing import shown

    for name, value in given.items():
        several = kind.startswith("several ")
        if several and (isinstance(value, str | bytes) or not isinstance(value, Iterable)):
            raise ArgumentError(f"{name} is {shown(value)}; give a list, such as {name}=[{shown(value)}]")
        for one in value if several else (value,):
            if not isinstance(one, _KINDS[kind]):
                raise ArgumentError(f"{name} is {shown(value)}; it must be {kind}")


_KINDS: Mapping[str, tuple[type, ...]] = {
    "a path": (str, os.PathLike),
    "a path or None": (str, os.PathLike, type(None)),
    "a text": (str,),
    "a text or None": (str, type(None)),
    "several texts": (str,),
    "a path, or a request": (str, os.PathLike, EvaluationOptions),
}


def _request(**options: Any) -> Request:
    """Return a request with these options: paths as texts, sequences as tuples, NumPy's numbers as Python's.

    Raises:
        ArgumentError: there is no such option, or a value is of another type or out of range.
    """
    from .files.choices import choices
    from .files.parsing import check_fields

    known = choices(Request)
    if unknown := sorted(set(options) - set(known)):
        raise ArgumentError(f"there is no option {unknown[0]}; choose from {', '.join(known)}")
    request = Request(**{name: _plain(value) for name, value in options.items()})
    check_fields(request, "evaluate", ArgumentError)
    return request


def _plain(value: Any) -> Any:
    """Return a value as a request has it: a path as text, a sequence as a tuple, a NumPy number as Python's."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Integral) and not isinstance(value, bool):
        return int(value)
    if isinstance(value, Real) and not isinstance(value, bool | Integral):
        return float(value)
    if isinstance(value, Iterable) and not isinstance(value, str | bytes):
        return tuple(map(_plain, value))
    return value


def load_results(path: str | Path) -> Result:
    """Read the results of an evaluation.

    Args:
        path: a results folder, or its ``results.json``.

    Raises:
        ResultsError: there are none, or the file is damaged.
    """
    from .gauge.result import read_result

    _need("a path", path=path)
    return read_result(Path(path), ResultsError, words=" was edited or is damaged")


def load_policy(
    policy: str | Path, *, robot: str | None = None, trust: bool = False, contract: str | Path | None = None
) -> Policy:
    """Load a policy: own format, TorchScript, ONNX or an rsl_rl checkpoint.

    Args:
        policy: a file, or ``latest``, ``best`` or ``pretrained``.
        robot: name of the robot, or the path of its ``robot.toml``; a foreign file gets its contract from it, from the Go2 if
            this is None.
        trust: run the program that a file of the project's own format carries inside.
        contract: description of a file without a contract of its own, such as a ``contract.toml``.

    Raises:
        PolicyError, ContractError, RobotError: one sentence on what is wrong.
    """
    _need("a path", policy=policy)
    _need("a text or None", robot=robot)
    from .policy.loading import load_policy as load
    from .robots import load_robot

    return load(str(policy), None if robot is None else load_robot(robot), trust=trust, contract_file=contract)


def evaluate(
    policy: str | Path | Request,
    *,
    out: str | Path | None = None,
    resume: bool = False,
    watch: Callable[[Any], None] | None = None,
    **options: Any,
) -> Result:
    """Judge a policy, as ``gaitgauge evaluate`` does, and write results, episodes and the report.

    Args:
        policy: a file, or ``latest``, ``best`` or ``pretrained``; or a whole request in place of all options.
        out: output folder; None for ``results/<policy>-<suite>-<pipeline>``.
        resume: go on with the run in the folder.
        watch: called a few times a second with a ``Status``.
        options: fields of ``gaitgauge.gauge.request.Request``: ``suite``, ``terrains``, ``frictions``, ``threads`` …

    Raises:
        ArgumentError, SuiteError, RobotError, TerrainError, PolicyError, ContractError, BackendError, StoreError: one sentence.
    """
    from .gauge.evaluate import evaluate as run
    from .gauge.evaluate import identity, prepare
    from .gauge.report.page import write_report
    from .studies.naming import free_run_folder, run_folders

    _need("a path or None", out=out)
    _need("a path, or a request", policy=policy)
    request = policy if isinstance(policy, Request) else _request(policy=policy, **options)
    usual = run_folders([request.policy], Path("results"), suite=request.suite, pipeline=request.pipeline)[0]
    prepared = prepare(request)
    folder = free_run_folder(usual, ("", identity(prepared))) if out is None else Path(out)
    result = run(prepared, folder, resume=resume, watch=watch)
    write_report(folder)
    return result


def compare(*results: Result | str | Path) -> Comparison:
    """Compare policies as ``gaitgauge compare`` does, without the evaluating.

    Args:
        results: two or more of: objects that ``evaluate`` returned, results folders, copies of ``results.json``.

    Raises:
        ComparisonError: results that cannot be read, or were not made alike.
    """
    from .files.parsing import shown
    from .gauge.result import Result
    from .gauge.result_figures import check_figures
    from .studies.compare.comparison import ComparisonError, load_result
    from .studies.compare.comparison import compare as run

    found = []
    for result in results:
        if isinstance(result, Result):
            check_figures(result, f"the results of '{result.policy.path}'", ComparisonError)
        elif not isinstance(result, str | os.PathLike):
            raise ArgumentError(f"result is {shown(result)}; it must be a path, or what evaluate returned")
        found.append(result if isinstance(result, Result) else load_result(Path(result)))
    return run(found)


def train(task: str, *settings: str, seconds: float | None = None, **options: Any) -> tuple[TrainingOutcome, Path]:
    """Train a policy, as ``gaitgauge train`` does.

    Args:
        task: name of the task.
        settings: ``key=value`` settings of the task, such as ``environment.push.linear=0.6``.
        seconds: wall-clock limit [s].
        options: fields of ``gaitgauge.training.run.request.TrainRequest``.

    Returns:
        The outcome, and the run directory.

    Raises:
        ArgumentError, TaskError, ConfigurationError, BackendError, SuiteError, CheckpointError: one sentence on what is wrong.
    """
    from .training.run.launch import train as run
    from .training.run.plan import prepare
    from .training.run.request import TrainRequest
    from .training.run.without_gpu import check_gpu

    _need("a text", task=task)
    _need("several texts", settings=settings)
    known = [f.name for f in fields(TrainRequest) if f.name not in ("task", "overrides", "seconds")]
    if unknown := sorted(set(options) - set(known)):
        raise ArgumentError(f"there is no option {unknown[0]}; choose from {', '.join(known)}")
    request = TrainRequest(task=task, overrides=settings, seconds=seconds, **options)
    check_gpu(request)
    plan = prepare(request)
    return run(plan, began=time.monotonic())
