"""The part of ``cluster`` that runs on a node: it compares the versions of programs, builds the worlds, and plays."""

from __future__ import annotations

import gc
import pickle
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from ...files.parsing import one_line
from ...files.provenance import plugins, processor, source_digest, versions
from ...robots.identity import unpacked
from ...robots.loading import LARGEST_MODEL
from .workers import PROGRESS_INTERVAL, Drop, Failed, Finished, Play, Progress, Stop, Worker, portable

Message = Finished | Progress | Failed


@dataclass(frozen=True)
class Arrived:
    """A worker's first message."""

    processor: str
    """Its node's CPU."""


def fingerprint() -> dict[str, str]:
    """Return the versions that must be the same on all nodes."""
    return {**versions(), **plugins(), "source of gaitgauge": source_digest()}


class NodeWorker:
    """A worker in an actor's process."""

    def __init__(self, node: str, wanted: dict[str, str], shipment: bytes) -> None:
        """Keep what is needed to begin; ``node``: its name for messages, ``wanted``: ``fingerprint`` of the machine that asks."""
        self._node, self._wanted, self._shipment = node, wanted, shipment
        self._worker: Worker | None = None

    def exchange(self, messages: Sequence[Play | Drop | Stop]) -> bytes | str:
        """Take messages, play until there is something to tell, and tell it (pickled), or why this node is refused."""
        told: list[Any] = []
        try:
            if self._worker is None:
                if reason := self._difference():
                    return reason
                self._worker = self._begin()
                told.append(Arrived(processor()))
            told += self._play(self._worker, messages)
        except Exception as error:  # noqa: BLE001  (the caller has to hear of any error)
            told.append(Failed(portable(error)))
        return pickle.dumps(told)

    def _difference(self) -> str | None:
        """Return one sentence on a version that differs from the wanted one, None if none does."""
        mine = fingerprint()
        for name in sorted(mine.keys() | self._wanted.keys()):
            here, there = (found.get(name, "not there")[:40] for found in (mine, self._wanted))
            if here != there:
                return (
                    f"node {self._node} of the Ray cluster has another {one_line(name, 80)} ({one_line(here)}) than this machine "
                    f"({one_line(there)}), so that results would mix; install the same on all nodes"
                )
        return None

    def _begin(self) -> Worker:
        torch.set_num_threads(1)
        job, robot = pickle.loads(self._shipment)
        # the engine has read all files once the worker is made
        with tempfile.TemporaryDirectory(prefix="gaitgauge-robot-") as folder:
            worker = Worker(replace(job, robot=unpacked(robot, Path(folder), largest=LARGEST_MODEL)))
        gc.freeze()
        return worker

    def _play(self, worker: Worker, messages: Sequence[Play | Drop | Stop]) -> list[Message]:
        """Play until a record is there, or new room, or the time for a report; returns the messages."""
        for message in messages:
            worker.take(message)
        rollout, until = worker.rollout, time.monotonic() + PROGRESS_INTERVAL
        room = max(rollout.room, 0)
        records: list[Message] = []
        while not (records or worker.stopped or rollout.idle or rollout.room > room or time.monotonic() >= until):
            records += [Finished(record) for record in rollout.advance()]
        return [*records, worker.progress()]
