"""Play cases side by side: in this process, or in several where the engine is faster so. Outcomes depend on neither."""

from __future__ import annotations

import gc
import multiprocessing
import signal
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from typing import Any

import torch

from ...backends.base import BackendError
from ...backends.registry import engine_class
from ...files.cell import CONTEXT
from ...gauge.play.workers import local_workers
from ...policy.base import Policy
from ...policy.loading import restore_policy
from ...policy.native import FilePolicy
from ...robots import Robot
from ..consistency.variants import Variant
from ..trials.running import run_each
from ..trials.scenario import Scenario
from .search import Outcome

Play = tuple[Scenario, int]
"""A scenario and the seed with which it is played."""


class Players:
    """Processes that play for one policy; a context manager."""

    def __init__(self, policy: FilePolicy, robot: Robot, threads: int) -> None:
        self._policy, self._robot, self._threads = policy, robot, threads
        self._pools: dict[bool, ProcessPoolExecutor] = {}

    def play(self, plays: Sequence[Play], variant: Variant) -> list[Outcome]:
        """Return what comes of each play.

        Raises:
            BackendError: the engine cannot do what the scenarios ask for, or a process was ended from outside.
            ContractError, PolicyError, RobotError, SuiteError: as ``run_each``.
        """
        count = local_workers(variant.backend, variant.device, threads=self._threads, most=len(plays))
        if count == 1:
            return _play(self._policy, self._robot, variant, self._threads, plays)
        forked = engine_class(variant.backend).forkable()
        if forked not in self._pools:
            job = (self._policy.stored, self._policy.contract, self._policy.path, self._robot)
            context = CONTEXT if forked else multiprocessing.get_context("spawn")
            self._pools[forked] = ProcessPoolExecutor(self._threads, context, _begin, job)
        found: list[Any] = [None] * len(plays)
        parts = [plays[part::count] for part in range(count)]
        try:
            for part, outcomes in enumerate(self._pools[forked].map(partial(_play_here, variant), parts)):
                found[part::count] = outcomes
        except BrokenProcessPool as error:
            raise BackendError(
                "a process that plays cases was ended from outside; what had finished is kept: go on with --resume, with fewer "
                "--threads if memory ran out"
            ) from error
        return found

    def __enter__(self) -> Players:
        return self

    def __exit__(self, kind: object, *details: object) -> None:
        if kind is not None:  # what is being played would have to end first
            for process in multiprocessing.active_children():
                process.terminate()
        for pool in self._pools.values():
            pool.shutdown(cancel_futures=True)


_here: dict[str, Any] = {}
"""Policy and robot of a process that only plays."""


def _begin(stored: Any, contract: Any, path: str, robot: Robot) -> None:
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent process handles Ctrl-C
    gc.freeze()
    _here.update(policy=restore_policy(stored, contract, path, robot), robot=robot)


def _play_here(variant: Variant, plays: Sequence[Play]) -> list[Outcome]:
    return _play(_here["policy"], _here["robot"], variant, 1, plays)


def _play(policy: Policy, robot: Robot, variant: Variant, threads: int, plays: Sequence[Play]) -> list[Outcome]:
    make = partial(variant.worlds, threads=threads)
    trials = run_each(policy, robot, plays, backend=make, device=variant.device)
    limit = plays[0][0].failure.tilt
    return [
        Outcome(
            fell=trial.outcome == "fell",
            diverged=trial.diverged,
            seconds=trial.seconds,
            lean=1.0 if trial.outcome == "fell" else min(max(place[3] for place in trial.path) / limit, 1.0),
        )
        for trial in trials
    ]
