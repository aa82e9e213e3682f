"""Plays plans to their end: says which episode starts next on which worker, and keeps the records.

The records are the state. After each of them its plan is asked again; what a plan requires is pushed to workers as they have
room, level tests first, because others wait for them. One rule says which episodes are played speculatively, before a plan
requires them: as long as fewer than ``Speculation.at_work`` episodes are at work and a worker has room, the most probable one
starts (level tests before quality), if it is probable enough. What no plan may require any more is cancelled; a speculative
episode that has ended is a record like any other, which a plan counts or not. Where a worker is lost, what it had waits again.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, MutableMapping, Sequence
from dataclasses import dataclass, replace

from ..episodes import Episode, Record
from ..plan import Plan, Records
from .remaining import Work
from .segments import AtWork, count_segments
from .workers import Drop, Failed, Finished, Lost, Play, Progress, Stop, Transport

Planner = Callable[[Records], Plan]
"""The plan of one environment, after the records that exist."""
_TOGETHER = 8
"""Level tests that are left to one worker: policies are run on eight rows or more, and so few worlds are mostly the loop's cost."""


@dataclass(frozen=True, kw_only=True)
class Speculation:
    """Chooses episodes that are played before they are required."""

    at_work: int = 0
    """Number of episodes at work, required ones included, up to which others are begun speculatively; 0 for none."""
    test_probability: float = 0.9
    """Least probability, of being required, with which an episode of a level test is begun."""
    quality_probability: float = 0.9
    """The same for a quality episode."""

    def choose(self, plans: Iterable[Plan], taken: Container[Episode]) -> list[Episode]:
        """Return episodes that are probable enough and not ``taken``, in the order in which they are to start."""
        least = {"search": self.test_probability, "eval": self.quality_probability}
        found = [
            (episode.stage != "search", -probability, episode)
            for plan in plans
            for episode, probability in plan.possible.items()
            if probability >= least[episode.stage] and episode not in taken
        ]
        return [episode for *_, episode in sorted(found)]


def play(
    planners: Sequence[Planner],
    records: MutableMapping[Episode, Record],
    keep: Callable[[Record], None],
    workers: Transport,
    *,
    speculation: Speculation,
    watch: Callable[[Dispatcher], None] | None = None,
) -> Dispatcher:
    """Play until no plan requires anything; returns what was played, and what it took.

    Args:
        records: episodes that have ended; those that end are added.
        keep: called with each record once, before anything follows from it.
        workers: the workers that play. They have stopped on return; the caller closes the transport.

    Raises:
        PolicyError, BackendError …: what went wrong in a worker.
        WorkerError: a worker is gone.
    """
    dispatcher = Dispatcher(planners, records, workers, speculation)
    while any(plan.required for plan in dispatcher.plans):
        dispatcher.start_episodes()
        for worker, message in workers.receive():
            if isinstance(message, Failed):
                raise message.error
            if isinstance(message, Finished):
                keep(message.record)
                dispatcher.finish(message.record)
                continue
            if isinstance(message, Lost):
                dispatcher.lose(worker)
                continue
            dispatcher.hear(worker, message)
            if watch is not None:
                watch(dispatcher)
        dispatcher.cancel_episodes()
    dispatcher.stop()
    return dispatcher


class Dispatcher:
    """Episodes by the worker that has them, and the plans."""

    def __init__(
        self,
        planners: Sequence[Planner],
        records: MutableMapping[Episode, Record],
        workers: Transport,
        speculation: Speculation,
    ) -> None:
        self._planners, self._records, self._workers, self._speculation = planners, records, workers, speculation
        self.plans: list[Plan] = [Plan(level=None, counted=(), required=())] * len(planners)
        self._progress = [Progress() for _ in range(workers.count)]
        self._room = [workers.worlds] * workers.count
        self._sent = [0] * workers.count  # ``Play`` messages
        self._lost: list[Progress] = []  # the last that was heard of workers that are gone
        self._plan_of: dict[Episode, int] = {}
        self._worker_of: dict[Episode, int] = {}
        for number in range(len(planners)):
            self._plan(number)

    def _plan(self, number: int) -> None:
        """Ask a plan again."""
        plan = self.plans[number] = self._planners[number](self._records)
        self._plan_of.update(dict.fromkeys((*plan.required, *plan.possible), number))

    # ---- what workers tell ----------------------------------------------------------------------------------------

    def finish(self, record: Record) -> None:
        """Take the record of an episode, which may have been cancelled meanwhile."""
        self._records[record.episode] = record
        self._worker_of.pop(record.episode, None)
        self._plan(self._plan_of[record.episode])

    def hear(self, worker: int, progress: Progress) -> None:
        """Take a worker's report. The reported room is stale while episodes are on their way to the worker."""
        self._progress[worker] = progress
        if progress.played == self._sent[worker]:
            self._room[worker] = progress.room

    def lose(self, worker: int) -> None:
        """Let the episodes of a lost worker wait again. The worker is back once it reports."""
        self._lost.append(replace(self._progress[worker], active={}))
        self._progress[worker] = Progress(stopped=True)
        self._room[worker] = self._sent[worker] = 0
        self._worker_of = {episode: other for episode, other in self._worker_of.items() if other != worker}

    @property
    def records(self) -> Records:
        """Return the episodes that have ended, counted or not."""
        return self._records

    @property
    def workers(self) -> int:
        """Return the number of workers that are there, at least 1."""
        return max(sum(not progress.stopped for progress in self._progress), 1)

    @property
    def worlds(self) -> int:
        """Return the number of worlds of each worker."""
        return self._workers.worlds

    def active(self) -> dict[Episode, AtWork]:
        """Return the episodes at work, and how far each is."""
        return {episode: found for progress in self._progress for episode, found in progress.active.items()}

    @property
    def busy_seconds(self) -> float:
        """Return the time in the control loop so far, added up over workers [s]."""
        return sum(progress.busy_seconds for progress in (*self._progress, *self._lost))

    @property
    def work(self) -> Work:
        """Return the control steps so far, added up over workers."""
        all_work = [progress.work for progress in (*self._progress, *self._lost)]
        return Work(loops=sum(w.loops for w in all_work), world_steps=sum(w.world_steps for w in all_work))

    @property
    def physics_steps(self) -> int:
        """Return the physics steps so far, added up over worlds."""
        return sum(progress.physics_steps for progress in (*self._progress, *self._lost))

    @property
    def engine_seconds(self) -> float | None:
        """Return the time spent inside the engine's stepping, added up over workers [s]; None where the engine does not measure it."""
        seconds = [p.engine_seconds for p in (*self._progress, *self._lost) if p.engine_seconds is not None]
        return sum(seconds) if seconds else None

    # ---- what workers are told ------------------------------------------------------------------------------------

    def start_episodes(self) -> None:
        """Push episodes to workers that have room."""
        waiting = [e for plan in self.plans for e in plan.required if e not in self._worker_of]
        self._share_tests([e for e in waiting if e.stage == "search"])
        self._share_quality([e for e in waiting if e.stage != "search"])
        budget = self._speculation.at_work - len(self._worker_of)
        if budget > 0 and max(self._room) > 0:
            for episode in self._speculation.choose(self.plans, self._worker_of)[:budget]:
                worker = self._by_room()[0]
                if self._room[worker] <= 0:
                    break
                self._push(worker, [episode])

    def cancel_episodes(self) -> None:
        """Tell workers which of their episodes no plan may require any more."""
        needless: dict[int, list[Episode]] = {}
        for episode, worker in self._worker_of.items():
            plan = self.plans[self._plan_of[episode]]
            if episode not in plan.possible and episode not in plan.required:
                needless.setdefault(worker, []).append(episode)
        for worker, episodes in needless.items():
            self._workers.send(worker, Drop(episodes))
            for episode in episodes:
                del self._worker_of[episode]

    def stop(self) -> None:
        """Stop the workers and hear what they did."""
        at_work = set(self._by_room())
        for worker in at_work:
            self._workers.send(worker, Stop())
        while at_work:
            for worker, message in self._workers.receive():
                if isinstance(message, Failed):
                    raise message.error
                if isinstance(message, Lost):
                    self.lose(worker)
                elif isinstance(message, Progress) and worker in at_work:  # else it has just taken another's place
                    self._progress[worker] = message
                if self._progress[worker].stopped:
                    at_work.discard(worker)

    def _by_room(self) -> list[int]:
        """Workers that are there, those with most room first."""
        there = [worker for worker, progress in enumerate(self._progress) if not progress.stopped]
        return sorted(there, key=lambda worker: -self._room[worker])

    def _share_tests(self, waiting: Sequence[Episode]) -> None:
        """Give each worker its part of all level tests, or a few tests together; they go before all that it has."""
        tests, there = self._tests(), self._by_room()
        part = max(-(-(sum(tests) + len(waiting)) // max(len(there), 1)), _TOGETHER)
        for worker in there:
            most = max(min(part, self._workers.worlds) - tests[worker], 0)
            self._push(worker, waiting[:most])
            waiting = waiting[most:]

    def _share_quality(self, waiting: Sequence[Episode]) -> None:
        """Give quality episodes in turn to workers with room, first to those without level tests, on which other episodes wait."""
        tests = self._tests()
        for episode in waiting:
            there = self._by_room()
            all_have_tests = all(tests[w] for w in there)
            open_to = [w for w in there if self._room[w] > 0 and (all_have_tests or not tests[w])]
            if not open_to:
                return
            self._push(open_to[0], [episode])

    def _tests(self) -> list[int]:
        """Return the number of level tests' episodes that each worker has."""
        counts = [0] * self._workers.count
        for episode, worker in self._worker_of.items():
            counts[worker] += episode.stage == "search"
        return counts

    def _push(self, worker: int, episodes: Sequence[Episode]) -> None:
        """Let a worker play episodes, if there are any."""
        if not episodes:
            return
        self._workers.send(worker, Play(episodes))
        self._sent[worker] += 1
        for episode in episodes:
            self._worker_of[episode] = worker
            self._room[worker] -= count_segments(episode)
