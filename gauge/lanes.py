"""Playing a plan in several processes on one machine, each with worlds of its own: a lane is one such process.

The control loop of a runner is one Python thread that waits for its engine and lets the engine wait for it. Two lanes of one
thread each keep two cores busy where one lane of two threads does not. A lane asks for episodes and hands back records; what
happens in an episode does not depend on the lane that plays it. Plan, store and results stay in the parent process.
"""

from __future__ import annotations

import gc
import multiprocessing
import pickle
import signal
import sys
import time
from collections.abc import Callable, Collection, Sequence
from ctypes import c_longlong
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

import torch

from ..backends import Scene, make_backend
from ..backends.base import BackendError
from ..policy.base import Policy
from ..policy.loading import load_policy
from ..robots import Robot
from ..terrains.registry import make_terrain
from .episodes import Episode, Record
from .pipelines import Plan
from .runner import EpisodeRunner
from .suite import Suite

_REPORT_INTERVAL = 0.2
"""Time between a lane's reports on how far it is [s]."""
_TOGETHER = 8
"""Level tests that are left to one lane: policies are run on eight rows or more, and so few worlds are mostly the loop's cost."""
_AHEAD = 16
"""Episodes beside which a lane begins none ahead of time: more of them slow those that are sure to be needed."""
# a forked lane has all modules at once, which saves importing torch; elsewhere system libraries do not bear being forked
if sys.platform == "linux":
    _CONTEXT = multiprocessing.get_context("fork")
else:
    _CONTEXT = multiprocessing.get_context("spawn")


@dataclass(frozen=True, kw_only=True)
class LaneJob:
    """What a lane plays with."""

    policy: str
    """Policy file."""
    trust: bool = False
    """Whether a program inside it is run."""
    suite: Suite
    robot: Robot
    backend: str
    device: str
    terrains: tuple[tuple[str, int], ...]
    """Names and levels of all terrains that episodes may ask for."""
    slots: int
    """Worlds."""
    threads: int
    """CPU threads of the engine."""


@dataclass(frozen=True, kw_only=True)
class Effort:
    """What playing took."""

    physics_steps: int
    engine_seconds: float | None
    """Time spent inside the engine's stepping, added up over lanes [s]; None where the engine does not measure it."""


class LaneProgress:
    """How far all lanes are, as they reported last (see ``runner.Progress``)."""

    def __init__(self, lanes: int) -> None:
        self._steps = [(0, 0)] * lanes
        self._active: list[dict[Episode, int]] = [{} for _ in range(lanes)]

    @property
    def control_steps(self) -> int:
        """Control steps so far, added up over lanes."""
        return sum(control for control, _ in self._steps)

    @property
    def physics_steps(self) -> int:
        """Physics steps so far, added up over worlds."""
        return sum(physics for _, physics in self._steps)

    def active(self) -> dict[Episode, int]:
        """Episodes at work, and the control steps that each has behind it."""
        return {episode: age for active in self._active for episode, age in active.items()}

    def update(self, lane: int, control_steps: int, physics_steps: int, active: dict[Episode, int]) -> None:
        """Take a lane's report."""
        self._steps[lane], self._active[lane] = (control_steps, physics_steps), active


def build_runner(job: LaneJob, policy: Policy) -> EpisodeRunner:
    """Worlds with all terrains in one layout, and the runner that plays in them.

    Raises:
        TerrainError, BackendError: a terrain or the engine cannot be made.
    """
    scene = Scene(
        robot=job.robot,
        parameters=job.robot.parameters[job.suite.parameters],
        terrains=tuple(make_terrain(name, level) for name, level in job.terrains),
        terrain_index=(0,) * job.slots,
        physics=job.suite.physics,
    )
    backend = make_backend(job.backend, scene, device=job.device, threads=job.threads)
    index = {key: i for i, key in enumerate(job.terrains)}
    return EpisodeRunner(job.suite, policy, backend, lambda e: index[e.terrain, e.level])


def play(job: LaneJob, policy: Policy, plan: Plan, watch: Callable[[Any], None] | None) -> Effort:
    """Play a plan to its end in this process; ``watch`` is called after every control step."""
    runner = build_runner(job, policy)
    try:
        runner.run(plan, watch)
        return Effort(physics_steps=runner.physics_steps, engine_seconds=runner.backend.engine_seconds)
    finally:
        runner.backend.close()


# ---- parent ----------------------------------------------------------------------------------------------------------


def play_in_lanes(job: LaneJob, plan: Plan, lanes: int, watch: Callable[[Any], None] | None) -> Effort:
    """Play a plan to its end in ``lanes`` processes; ``watch`` is called whenever one reports.

    Raises:
        PolicyError, BackendError …: what went wrong in a lane, or that a lane's process ended.
    """
    crew = _Crew(job, lanes)
    try:
        return crew.play(plan, watch)
    finally:
        crew.dismiss()


class _Crew:
    """The processes, and who waits for work."""

    def __init__(self, job: LaneJob, lanes: int) -> None:
        self._processes: list[BaseProcess] = []
        self._connections: list[Connection] = []
        self._idle: set[int] = set()
        self._at_work: list[set[Episode]] = [set() for _ in range(lanes)]
        # how often what there is to take has changed: lanes look at it in every control step, and ask only when it has
        self._changes = _CONTEXT.RawValue("q", 0)
        # what each lane has at work although nobody needs it any more, and how often it had anything of that kind
        self._needless: list[list[Episode]] = [[] for _ in range(lanes)]
        self._calls = [_CONTEXT.RawValue("q", 0) for _ in range(lanes)]
        self._progress = LaneProgress(lanes)
        try:
            for lane in range(lanes):
                ours, theirs = _CONTEXT.Pipe()
                self._connections.append(ours)
                with theirs:
                    parents = tuple(self._connections)
                    process = _CONTEXT.Process(
                        target=run_lane,
                        args=(job, theirs, self._changes, self._calls[lane], parents),
                        name=f"lane-{lane}",
                    )
                    process.start()
                    self._processes.append(process)
        except BaseException:
            self.dismiss()
            raise

    def dismiss(self) -> None:
        """End whatever still runs."""
        for process in self._processes:
            process.kill()
        for process in self._processes:
            process.join()
        for connection in self._connections:
            connection.close()

    def play(self, plan: Plan, watch: Callable[[Any], None] | None) -> Effort:
        """See ``play_in_lanes``."""
        efforts: list[Effort] = []
        at_work = list(self._connections)
        while at_work:
            for connection in wait(at_work):
                lane = self._connections.index(connection)  # type: ignore[arg-type]
                kind, *content = self._receive(lane)
                if kind == "take":
                    most, urgent = content
                    episodes = self._share(plan, lane, most, urgent)
                    self._give(lane, episodes, waiting=any(plan.waiting) or bool(plan.likely()))
                elif kind == "finished":
                    record = content[0]
                    self._at_work[lane].discard(record.episode)
                    plan.finished(record)
                    self._changes.value += 1
                elif kind == "needless":
                    self._connections[lane].send(self._needless[lane])
                    self._needless[lane] = []
                elif kind == "idle":
                    self._idle.add(lane)
                elif kind == "progress":
                    self._progress.update(lane, *content)
                    if watch is not None:
                        watch(self._progress)
                elif kind == "failed":
                    raise content[0]
                else:
                    efforts.append(content[0])
                    at_work.remove(self._connections[lane])
            if not efforts:
                self._call_off(plan.needless())
                self._serve(plan)
        seconds = [e.engine_seconds for e in efforts if e.engine_seconds is not None]
        return Effort(
            physics_steps=sum(e.physics_steps for e in efforts), engine_seconds=sum(seconds) if seconds else None
        )

    def _receive(self, lane: int) -> tuple[Any, ...]:
        try:
            message: tuple[Any, ...] = self._connections[lane].recv()
        except (EOFError, OSError) as error:
            self._processes[lane].join()
            code = self._processes[lane].exitcode or 0
            how = f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
            raise BackendError(
                f"a process that plays episodes {how}; what had finished is kept: go on with --resume, with fewer "
                "--threads if memory ran out"
            ) from error
        return message

    def _give(self, lane: int, episodes: list[Episode], *, waiting: bool = False) -> None:
        """Hand episodes to a lane, if there are any, and say whether any more wait."""
        self._at_work[lane].update(episodes)
        self._changes.value += bool(episodes)
        self._connections[lane].send((episodes, waiting))

    def _share(self, plan: Plan, lane: int, most: int, urgent: bool) -> list[Episode]:
        """Episodes for a lane that asks: level tests first, a few together or its part of all that are at work or wait.

        Others wait for level tests, so that a lane with such does not slow them with quality while another has none. What is
        left of a lane's worlds plays ahead of time.
        """
        lanes = len(self._connections)
        waiting, quality = plan.waiting
        tests = [sum(e.stage == "search" for e in episodes) for episodes in self._at_work]
        part = max(-(-(sum(tests) + waiting) // lanes), _TOGETHER) - tests[lane]
        episodes = plan.take(min(most, max(part, 0)), urgent=True)
        if episodes or urgent:
            return episodes
        if all(tests) or not tests[lane]:
            episodes = plan.take_quality(min(most, -(-quality // lanes)))
        if not episodes and len(self._at_work[lane]) < _AHEAD:
            episodes = plan.take_ahead(1)
        return episodes

    def _call_off(self, episodes: Sequence[Episode]) -> None:
        """Tell the lanes that have them at work that nobody needs some episodes any more."""
        for episode in episodes:
            lane = next(lane for lane, at_work in enumerate(self._at_work) if episode in at_work)
            self._at_work[lane].discard(episode)
            self._needless[lane].append(episode)
            self._calls[lane].value += 1

    def _serve(self, plan: Plan) -> None:
        """Give waiting lanes work, or send them home once nothing can follow any more."""
        for lane in sorted(self._idle):
            episodes = self._share(plan, lane, 1, urgent=False) or plan.take(1)
            if not episodes:
                break
            self._give(lane, episodes)
            self._idle.discard(lane)
        if len(self._idle) == len(self._connections):
            for lane in self._idle:
                self._give(lane, [])
            self._idle.clear()


# ---- child -----------------------------------------------------------------------------------------------------------


class _RemoteAgenda:
    """The parent's plan, as a lane sees it (see ``segments.Agenda``)."""

    def __init__(self, connection: Connection, changes: c_longlong, calls: c_longlong) -> None:
        """``changes`` counts how often what there is to take has changed, ``calls`` how often something was called off."""
        self._connection, self._changes, self._calls = connection, changes, calls
        self._heard = 0  # of the calls
        self._given: list[Episode] = []
        self._nothing_at = -1  # the count at which there was nothing to take
        self._next_report = 0.0

    def take(self, most: int, *, urgent: bool = False) -> Sequence[Episode]:
        """Episodes that can start now."""
        if self._given and most > 0 and not urgent:
            return [self._given.pop(0)]
        changes = self._changes.value
        if changes == self._nothing_at:
            return []
        self._connection.send(("take", most, urgent))
        episodes, waiting = self._receive()
        if not episodes and not (urgent and waiting):
            self._nothing_at = changes
        return episodes

    def finished(self, record: Record) -> Collection[Episode]:
        """Hand back a record; more episodes may follow from it."""
        self._connection.send(("finished", record))
        self._nothing_at = -1
        return ()  # lanes search step by step, where all that is played is needed

    def needless(self) -> Collection[Episode]:
        """Episodes at work that nobody needs any more."""
        calls = self._calls.value
        if calls == self._heard:
            return ()
        self._heard = calls
        self._connection.send(("needless",))
        episodes: list[Episode] = self._connection.recv()
        self._given = [e for e in self._given if e not in episodes]
        return episodes

    def wait(self) -> bool:
        """Wait until there is something to play; False once nothing will come."""
        self._connection.send(("idle",))
        self._given, _ = self._receive()
        self._nothing_at = -1
        return bool(self._given)

    def _receive(self) -> tuple[list[Episode], bool]:
        """Episodes, and whether any more wait."""
        answer: tuple[list[Episode], bool] = self._connection.recv()
        return answer

    def report(self, progress: Any) -> None:
        """Tell now and then how far the runner is."""
        now = time.monotonic()
        if now >= self._next_report:
            self._next_report = now + _REPORT_INTERVAL
            self._connection.send(("progress", progress.control_steps, progress.physics_steps, progress.active()))


def run_lane(
    job: LaneJob, connection: Connection, changes: c_longlong, calls: c_longlong, inherited: Sequence[Connection]
) -> None:
    """A lane's whole life.

    Args:
        job: what it plays with.
        connection: to its parent.
        changes, calls: see ``_RemoteAgenda``.
        inherited: the parent's ends of all connections; while any process holds one, its lane would not notice that the
            parent is gone.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes of a terminal; the parent ends them
    for end in inherited:
        end.close()
    try:
        try:
            torch.set_num_threads(1)
            gc.freeze()  # what the lane has from its parent is not looked through for garbage again
            runner = build_runner(job, load_policy(job.policy, job.robot, trust=job.trust))
            agenda = _RemoteAgenda(connection, changes, calls)
            while agenda.wait():
                runner.run(agenda, agenda.report, agenda.needless)
            effort = Effort(physics_steps=runner.physics_steps, engine_seconds=runner.backend.engine_seconds)
            connection.send(("done", effort))
        except (EOFError, ConnectionError):
            return  # the parent is gone
        except Exception as error:  # noqa: BLE001  (whatever it is, the parent has to hear of it)
            connection.send(("failed", _portable(error)))
    except (EOFError, ConnectionError):
        return


def _portable(error: Exception) -> Exception:
    """The error itself if it survives the way to the parent, else one with the same words."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # noqa: BLE001  (some errors cannot be taken apart and put together again)
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
