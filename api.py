"""The project as a library: judge, train and read policies from Python.

Each function does what the command of the same name does, with the same defaults, and raises the same one-sentence
errors. Heavy packages are imported inside the functions.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .gauge.result import Result
    from .policy.base import Policy
    from .studies.compare.comparison import Comparison
    from .training.run.stopping import TrainingOutcome


class ResultsError(ValueError):
    """A folder or file that holds no results; the message says what is wrong."""


class ArgumentError(TypeError):
    """An argument of another type than it must have; the message names it."""


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
    "a whole number or None": (Integral, type(None)),
    "several texts": (str,),
    "several numbers": (Real,),
}


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


def load_policy(policy: str | Path, *, robot: str | None = None, trust: bool = False) -> Policy:
    """Load a policy: own format, TorchScript, ONNX or an rsl_rl checkpoint.

    Args:
        policy: a file, or ``latest``, ``best`` or ``pretrained``.
        robot: name of the robot, or the path of its ``robot.toml``; a foreign file gets its contract from it, from the Go2 if
            this is None.
        trust: run the program that a file of the project's own format carries inside.

    Raises:
        PolicyError, ContractError, RobotError: one sentence on what is wrong.
    """
    _need("a path", policy=policy)
    _need("a text or None", robot=robot)
    from .policy.loading import load_policy as load
    from .robots import load_robot

    return load(str(policy), None if robot is None else load_robot(robot), trust=trust)


def evaluate(
    policy: str | Path,
    *,
    suite: str | Path = "gaitgauge-1",
    pipeline: str = "stress",
    backend: str = "mujoco",
    device: str | None = None,
    robot: str | None = None,
    terrains: Sequence[str] = (),
    level: int | None = None,
    frictions: Sequence[float] = (),
    payloads: Sequence[float] = (),
    seeds: Sequence[int] = (),
    threads: int | None = None,
    out: str | Path | None = None,
    resume: bool = False,
    trust: bool = False,
    watch: Callable[[Any], None] | None = None,
) -> Result:
    """Judge a policy, as ``gaitgauge evaluate`` does; writes results, episodes and the report.

    Args:
        policy: a file, or ``latest``, ``best`` or ``pretrained``.
        suite: a suite's name, or the path of its file.
        pipeline: ``base``, ``multi``, ``level`` or ``stress``.
        backend: the physics engine.
        device: ``cpu`` or ``cuda``; None for what the engine is made for.
        robot: name of the robot, or the path of its ``robot.toml``; None for the one that the policy is for.
        terrains: names; empty for the suite's own.
        level: to play at; None to search for the highest.
        frictions: coefficients; empty for the suite's own.
        payloads: masses on the base [kg]; empty for the suite's own.
        seeds: of the quality episodes; empty for the suite's own.
        threads: CPU threads, None for all cores; they change the time, never the results.
        out: output folder; None for ``results/<policy>-<suite>-<pipeline>``.
        resume: go on with what the folder holds.
        trust: run the program that a policy file of the project's own format carries inside.
        watch: called a few times a second with a ``Status``.

    Raises:
        ArgumentError, SuiteError, RobotError, TerrainError, PolicyError, ContractError, BackendError, StoreError: one sentence.
    """
    from .backends.registry import choose_device
    from .files import MOST_THREADS
    from .files.parsing import shown
    from .gauge.evaluate import Request
    from .gauge.evaluate import evaluate as run
    from .gauge.report.page import write_report
    from .studies.naming import run_folders

    _need("a path", policy=policy, suite=suite)
    _need("a path or None", out=out)
    _need("a text", pipeline=pipeline, backend=backend)
    _need("a text or None", device=device, robot=robot)
    _need("several texts", terrains=terrains)
    _need("several numbers", frictions=frictions, payloads=payloads, seeds=seeds)
    _need("a whole number or None", level=level, threads=threads)
    if threads is not None and not 1 <= threads <= MOST_THREADS:
        raise ArgumentError(f"threads is {shown(threads)}; it must be 1 to {MOST_THREADS}")
    usual = run_folders([str(policy)], Path("results"), suite=str(suite), pipeline=pipeline)[0]
    folder = usual if out is None else Path(out)
    request = Request(
        policy=str(policy),
        suite=str(suite),
        pipeline=pipeline,
        backend=backend,
        device=choose_device(backend, device),
        robot=robot,
        terrains=tuple(terrains),
        level=None if level is None else int(level),  # numpy's numbers, too, have to be written into results
        frictions=tuple(map(float, frictions)),
        payloads=tuple(map(float, payloads)),
        seeds=tuple(int(s) if isinstance(s, Integral) else s for s in seeds),
        threads=os.cpu_count() or 1 if threads is None else int(threads),
        trust=trust,
    )
    result = run(request, folder, resume=resume, watch=watch)
    write_report(folder)
    return result


def compare(*results: Result | str | Path) -> Comparison:
    """Compare policies as ``gaitgauge compare`` does, without the evaluating.

    Args:
        results: two or more of: what ``evaluate`` returned, results folders, copies of ``results.json``.

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
        options: fields of ``gaitgauge.training.run.launch.TrainRequest``.

    Returns:
        How it ended, and the run directory.

    Raises:
        ArgumentError, TaskError, ConfigurationError, BackendError, SuiteError, CheckpointError: one sentence on what is wrong.
    """
    from .training.run.launch import TrainRequest, prepare
    from .training.run.launch import train as run

    _need("a text", task=task)
    _need("several texts", settings=settings)
    known = [f.name for f in fields(TrainRequest) if f.name not in ("task", "overrides", "seconds")]
    if unknown := sorted(set(options) - set(known)):
        raise ArgumentError(f"there is no option {unknown[0]}; choose from {', '.join(known)}")
    plan = prepare(TrainRequest(task=task, overrides=settings, seconds=seconds, **options))
    return run(plan, began=time.monotonic())
