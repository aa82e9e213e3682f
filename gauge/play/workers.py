"""Workers play episodes that are pushed to them and send records back; a transport is the way to them.

To a worker go ``Play``, ``Drop`` and ``Stop``; from it come ``Finished`` with a record, ``Progress`` and ``Failed`` with an
error. A worker answers to nothing: it plays what it has, and says in its progress how much more it could begin at once.
``InProcess`` is one worker in this process, for a GPU or a single thread; ``LocalProcesses`` are several, with one pipe each;
``cluster.ClusterWorkers`` are actors on other machines, which may be lost and come back.

The control loop of a rollout is one Python thread that waits for its engine and lets the engine wait for it: two processes of
one thread each keep two cores busy where one with two threads does not.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import pickle
import signal
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Protocol

import torch

from ...backends.base import PhysicsBackend, Scene
from ...backends.registry import engine_class
from ...files.cell import CONTEXT
from ...policy.base import Policy
from ...policy.foreign.fenced_policy import FencedPolicy
from ...policy.loading import restore_policy
from ...policy.native import FilePolicy
from ...robots import Robot
from ..episodes import Episode, Record
from ..ground_rules import build_terrain
from ..motors import joint_parameters
from ..suite import Suite
from .remaining import Work
from .rollout import Rollout
from .segments import AtWork

_FRESH = multiprocessing.get_context("spawn")
PROGRESS_INTERVAL = 0.2
"""Time between a worker's reports on how far it is [s]."""


# ---- messages ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Play:
    """Play episodes."""

    episodes: Sequence[Episode]


@dataclass(frozen=True)
class Drop:
    """Cancel episodes. A record that was on its way may still arrive."""

    episodes: Collection[Episode]


@dataclass(frozen=True)
class Stop:
    """Leave everything, report once more and end."""


@dataclass(frozen=True)
class Finished:
    """An episode has ended."""

    record: Record


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Progress of a worker."""

    played: int = 0
    """``Play`` messages that it has taken."""
    room: int = 0
    """Number of segments that it could begin at once beside those that it has."""
    active: dict[Episode, AtWork] = field(default_factory=dict)
    """Episodes at work, and how far each is."""
    busy_seconds: float = 0.0
    """Time in the control loop so far, its first call left out [s]."""
    work: Work = field(default_factory=Work)
    """Control steps so far."""
    physics_steps: int = 0
    """Physics steps so far, added up over worlds."""
    engine_seconds: float | None = None
    """Time spent inside the engine's stepping so far [s]; None where the engine does not measure it."""
    stopped: bool = False
    """True in the worker's last message."""


@dataclass(frozen=True)
class Failed:
    """Something went wrong; the worker has ended."""

    error: Exception


@dataclass(frozen=True)
class Lost:
    """The worker is gone with all that it had and was sent. If another one takes its place, that one's progress says so."""


class WorkerError(RuntimeError):
    """A worker is gone before it was told to stop; the message says how, and what to do. No fault of an engine."""


class Transport(Protocol):
    """Workers, and the way to them. They are numbered from 0 and have started once the transport is made."""

    count: int
    """Number of workers."""
    worlds: int
    """Worlds of each worker."""

    def send(self, worker: int, message: Play | Drop | Stop) -> None:
        """Send a message to a worker."""

    def receive(self) -> Sequence[tuple[int, Finished | Progress | Failed | Lost]]:
        """Wait for messages; returns those that are there, each with the worker's number, a worker's own in their order.

        Raises:
            WorkerError, ClusterError: a worker is gone, or all of them where they may come and go.
        """

    def close(self) -> None:
        """End whatever still runs."""


# ---- what workers play with --------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Job:
    """The suite, policy, robot and engine of workers. It is prepared once: forked processes have it as it is."""

    suite: Suite
    policy: Policy
    robot: Robot
    places: tuple[tuple[str, int], ...]
    """Names and levels of all terrains that episodes may ask for."""
    worlds: int
    """Worlds of a worker."""
    build: Callable[..., PhysicsBackend]
    """Makes the worlds; called with the scene and ``threads=``."""
    threads: int = 1
    """CPU threads of the engine."""

    @cached_property
    def scene(self) -> Scene:
        """Return the worlds, with all terrains in one layout; raise ``TerrainError`` where a terrain cannot be made."""
        return Scene(
            robot=self.robot,
            parameters=joint_parameters(self.suite, self.robot, self.policy.contract),
            terrains=tuple(build_terrain(self.suite.ground, self.robot, *place) for place in self.places),
            terrain_index=(0,) * self.worlds,
            physics=self.suite.physics,
        )

    def rollout(self) -> Rollout:
        """Build the worlds and return the rollout in them; raise ``BackendError`` where the engine cannot do what the scene asks for."""
        index = {place: i for i, place in enumerate(self.places)}
        backend = self.build(self.scene, threads=self.threads)
        return Rollout(self.suite, self.policy, backend, lambda e: index[e.terrain, e.level])

    def in_another_process(self) -> Job:
        """Return the job in a worker's process: a policy that is at work in a process of its own gets another one there."""
        policy = self.policy
        if not isinstance(policy, FencedPolicy):
            return self
        return replace(self, policy=restore_policy(policy.stored, policy.contract, policy.path, self.robot))

    def __getstate__(self) -> dict[str, Any]:
        """Send the policy to a process that was not forked as the content of its file."""
        policy = self.policy
        assert isinstance(policy, FilePolicy)
        return {**vars(self), "policy": (policy.stored, policy.contract, policy.path)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make the policy again."""
        stored, contract, path = state["policy"]
        vars(self).update(state | {"policy": restore_policy(stored, contract, path, state["robot"])})


class Worker:
    """Plays what it is sent; a transport carries its messages."""

    def __init__(self, job: Job) -> None:
        self.rollout = job.rollout()
        self._played = 0
        self.stopped = False

    def take(self, message: Play | Drop | Stop) -> None:
        """Do as a message says."""
        if isinstance(message, Play):
            self._played += 1
            self.rollout.play(message.episodes)
        elif isinstance(message, Drop):
            self.rollout.drop(message.episodes)
        else:
            self.stopped = True

    def progress(self) -> Progress:
        """Return the worker's progress."""
        rollout = self.rollout
        return Progress(
            played=self._played,
            room=rollout.room,
            active=rollout.at_work(),
            busy_seconds=rollout.busy_seconds,
            work=Work(loops=rollout.control_steps, world_steps=rollout.world_steps),
            physics_steps=rollout.physics_steps,
            engine_seconds=rollout.backend.engine_seconds,
            stopped=self.stopped,
        )


def start_workers(job: Job, count: int, *, forked: bool = True) -> Transport:
    """Workers on this machine: processes, or this process itself where there is one of them.

    Args:
        forked: False for processes that start afresh, because the engine is not ``forkable``.
    """
    return InProcess(job) if count == 1 else LocalProcesses(job, count, CONTEXT if forked else _FRESH)


def local_workers(backend: str, device: str, *, threads: int, most: int) -> int:
    """Return the number of workers on this machine, ``most`` at most: one on a GPU, or for an engine without ``parallel_processes``.

    Raises:
        BackendError: no such engine.
    """
    several = torch.device(device).type == "cpu" and os.name == "posix" and engine_class(backend).parallel_processes
    return max(min(threads, most), 1) if several else 1


class InProcess:
    """One worker in this process; it plays while ``receive`` waits."""

    count = 1

    def __init__(self, job: Job) -> None:
        self.worlds = job.worlds
        self._worker = Worker(job)

    def send(self, worker: int, message: Play | Drop | Stop) -> None:
        """See ``Transport.send``."""
        self._worker.take(message)

    def receive(self) -> list[tuple[int, Finished | Progress | Failed]]:
        """See ``Transport.receive``; errors of the policy or the engine are raised."""
        records = [] if self._worker.stopped else self._worker.rollout.advance()
        return [*((0, Finished(record)) for record in records), (0, self._worker.progress())]

    def close(self) -> None:
        """See ``Transport.close``."""
        self._worker.rollout.backend.close()


class LocalProcesses:
    """Several workers on this machine, one process and one pipe each."""

    def __init__(self, job: Job, count: int, context: Any = CONTEXT) -> None:
        self.count, self.worlds = count, job.worlds
        _ = job.scene  # made here, once
        self._processes: list[BaseProcess] = []
        self._pipes: list[Connection] = []
        self._open: dict[Connection, int] = {}  # workers that have not stopped
        try:
            for number in range(count):
                ours, theirs = context.Pipe()  # a forked worker has all modules and the policy at once
                self._pipes.append(ours)
                self._open[ours] = number
                with theirs:
                    inherited = tuple(self._pipes) if context.get_start_method() == "fork" else ()
                    arguments = (job, theirs, inherited)
                    process = context.Process(target=_run_worker, args=arguments, name=f"worker-{number}")
                    process.start()
                self._processes.append(process)
        except BaseException:
            self.close()
            raise

    def send(self, worker: int, message: Play | Drop | Stop) -> None:
        """See ``Transport.send``. A message to a process that has ended is lost; ``receive`` says why the process ended."""
        with suppress(OSError):
            self._pipes[worker].send(message)

    def receive(self) -> list[tuple[int, Finished | Progress | Failed]]:
        """See ``Transport.receive``."""
        messages: list[tuple[int, Finished | Progress | Failed]] = []
        for pipe in wait(list(self._open)):
            assert isinstance(pipe, Connection)
            worker = self._open[pipe]
            try:
                messages.append((worker, pipe.recv()))
            except (EOFError, OSError) as error:
                raise self._gone(worker) from error
            last = messages[-1][1]
            if isinstance(last, Progress) and last.stopped:
                del self._open[pipe]
        return messages

    def _gone(self, worker: int) -> WorkerError:
        self._processes[worker].join()
        code = self._processes[worker].exitcode or 0
        how = f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
        return WorkerError(
            f"a process that plays episodes {how}; what had finished is kept: go on with --resume, with fewer "
            "--threads if memory ran out"
        )

    def close(self) -> None:
        """See ``Transport.close``."""
        for process in self._processes:
            process.kill()
        for process in self._processes:
            process.join()
        for pipe in self._pipes:
            pipe.close()


def _run_worker(job: Job, pipe: Connection, inherited: Sequence[Connection]) -> None:
    """Play in a worker process until the end of the run.

    Args:
        pipe: to its parent.
        inherited: the parent's ends of all pipes; while any process holds one, its worker would not notice that the parent is
            gone.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes of a terminal; the parent ends them
    for end in inherited:
        end.close()
    try:
        try:
            torch.set_num_threads(1)
            gc.freeze()  # what a worker has from its parent is not looked through for garbage again
            _serve(Worker(job.in_another_process()), pipe)
        except (EOFError, ConnectionError):
            return  # the parent is gone
        except Exception as error:  # noqa: BLE001  (whatever it is, the parent has to hear of it)
            pipe.send(Failed(portable(error)))
    except (EOFError, ConnectionError):
        return


def _serve(worker: Worker, pipe: Connection) -> None:
    """Play until told to stop. Send progress now and then, and at once when there is more room than was reported."""
    rollout, next_report, told = worker.rollout, 0.0, 0
    while True:
        now = time.monotonic()
        if now >= next_report or rollout.room > max(told, 0):
            progress = worker.progress()
            next_report, told = now + PROGRESS_INTERVAL, progress.room
            pipe.send(progress)
        while rollout.idle or pipe.poll():
            message = pipe.recv()
            worker.take(message)
            if worker.stopped:
                pipe.send(worker.progress())
                return
            told = 0 if isinstance(message, Play) else told
        for record in rollout.advance():
            pipe.send(Finished(record))


def portable(error: Exception) -> Exception:
    """Return the error itself if it survives the way to the parent, else one with the same words."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # noqa: BLE001  (some errors cannot be taken apart and put together again)
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
