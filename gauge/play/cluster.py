"""Workers on a Ray cluster: a transport whose workers are actors, one for each CPU.

Everything that decides about results travels to the nodes as data: suite, policy and robot. A node needs gaitgauge itself, in
the same versions and with the same source as here, or it is refused. A worker whose node or process dies is replaced wherever
the cluster has a CPU, now or later; until then the others play what it had. Ray is imported where it is used.

An actor does nothing between two calls. A call brings it messages and lets it play until there is something to tell, for
``PROGRESS_INTERVAL`` at most; then comes the next one, unless it has nothing to play.
"""

from __future__ import annotations

import importlib
import logging
import os
import pickle
import re
import socket
import time
from dataclasses import dataclass, field
from typing import Any

from ...files.parsing import one_line, shown
from ...policy.native import first_line
from ...robots.identity import packed
from .cluster_node import Arrived, Message, fingerprint
from .workers import Drop, Failed, Finished, Job, Lost, Play, Progress, Stop

_ADDRESS = re.compile(r"auto|(ray://)?(?P<host>[\w.-]{1,253}|\[[\da-fA-F:]{1,45}\]):(?P<port>\d{1,5})", re.ASCII)
_CONNECTING = 5.0
"""Longest wait for the cluster's port to answer [s]."""
_ARRIVING = 60.0
"""Longest wait for all workers before those that are there begin [s]."""
_LISTENING = 2.0
"""Time between two looks at the nodes [s]."""
_HEADLESS = 30.0
"""Longest time for which the head node may be out of reach [s]; after 60 s Ray ends this process without a word."""
_MOST_LOSSES = 3
"""Replacements in a row of a worker that never finished an episode; after them the fault is not that of the nodes."""
_MOST_STARTS = 60
"""Deaths in a row of a worker before its first answer: Ray starts workers on a dead node until Ray notices."""
_PAUSE = 2.0
"""Time from such a death to the next start [s]."""
_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])
"""First bytes of a gRPC client: the preface of HTTP/2 and empty settings. A server answers with its own settings."""
_KEPT = "what had finished is kept: go on with --resume"


class ClusterError(RuntimeError):
    """A cluster cannot be used, or not any more; the message says why and what to do."""


def check_address(address: str) -> None:
    """Raise ``ClusterError`` for a text that is no address of a Ray cluster, and on a machine without Ray."""
    _ray()
    if _ADDRESS.fullmatch(address) is None:
        raise ClusterError(
            f"{shown(address)} is no address of a Ray cluster; give auto for the one of this machine, HOST:PORT (--cluster "
            "10.0.0.1:6379) or ray://HOST:PORT"
        )


class Cluster:
    """A connection to a running Ray cluster."""

    def __init__(self, address: str) -> None:
        """Connect; raise ``ClusterError`` where Ray is not installed, nothing answers at the address, or no CPU is free."""
        check_address(address)
        self._ray = _ray()
        try:
            if address != "auto":
                _knock(address, greet=True)  # Ray itself would try for a minute or more
            self._ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
            self._head = address if "://" in address else self._ray.get_runtime_context().gcs_address
        except Exception as error:  # Ray raises errors of many classes, some of them its own
            raise ClusterError(
                f"no Ray cluster can be used at {address} ({one_line(first_line(error), 160)}); start one with 'ray "
                "start --head', run this on one of its nodes or give its ray:// address (--cluster)"
            ) from error
        self.cpus = self._free_cpus()
        """CPUs that were free, at least 1."""
        if self.cpus < 1:
            there = self._ray.cluster_resources().get("CPU", 0.0)
            self.close()
            raise ClusterError(
                f"the Ray cluster at {address} has no free CPU (of {there:g}); add nodes with 'ray start --address', or wait "
                "until others have finished"
            )

    def _free_cpus(self) -> int:
        """Return CPUs that are free; those of a run that has just ended may take some seconds to be."""
        until = time.monotonic() + _CONNECTING
        while (free := int(self._ray.available_resources().get("CPU", 0.0))) < 1 and time.monotonic() < until:
            time.sleep(0.5)
        return free

    def workers(self, job: Job, count: int) -> ClusterWorkers:
        """Start so many workers."""
        return ClusterWorkers(self._ray, self._head, job, count)

    def close(self) -> None:
        """Disconnect; what still runs there for this program ends."""
        self._ray.shutdown()


@dataclass(kw_only=True)
class _Seat:
    """One worker, seen from here."""

    actor: Any = None
    """None before it is started."""
    begin: float = 0.0
    """Value of ``time.monotonic()`` from which it is started."""
    call: Any = None
    """The call that it is at; None while it has nothing to do."""
    outbox: list[Play | Drop | Stop] = field(default_factory=list)
    """Messages of the next call."""
    there: bool = False
    """True once the worker has answered."""
    losses: int = 0
    """Workers before it in this seat that were lost since one last finished an episode."""
    failures: int = 0
    """Workers before it in this seat that died before their first answer, since one last gave any."""


class ClusterWorkers:
    """Workers on the nodes of a cluster; see ``workers.Transport``."""

    def __init__(self, ray: Any, head: str, job: Job, count: int) -> None:
        """Start workers and wait for them; those that take long are ``Lost`` until they come.

        Raises:
            ClusterError: no node is left.
            RobotError: a file of the robot's model cannot be read.
        """
        self.count, self.worlds = count, job.worlds
        self.processors: set[str] = set()
        """CPUs of the nodes that have played."""
        self._ray, self._head = ray, head
        self._next_look = self._reached = time.monotonic()
        self._make = ray.remote(num_cpus=1, max_restarts=0)(_actor_class())
        self._shipment = ray.put(pickle.dumps((job, packed(job.robot))))
        self._seats = [_Seat() for _ in range(count)]
        self._heard: list[tuple[int, Message | Lost]] = []
        until = time.monotonic() + _ARRIVING
        while not all(s.there for s in self._seats) and (time.monotonic() < until or not self._anyone):
            self._listen()
        self._heard = [(n, Lost()) for n, seat in enumerate(self._seats) if not seat.there] + self._heard

    @property
    def _anyone(self) -> bool:
        return any(seat.there for seat in self._seats)

    def send(self, worker: int, message: Play | Drop | Stop) -> None:
        """See ``Transport.send``; one that is not there is ``Lost``, which ``receive`` has yet to say, and gets nothing."""
        seat = self._seats[worker]
        if not seat.there:
            return
        seat.outbox.append(message)
        if seat.call is None:
            self._call(seat)

    def receive(self) -> list[tuple[int, Message | Lost]]:
        """See ``Transport.receive``.

        Raises:
            ClusterError: no node is left, a worker dies again and again, or a node does not have what this machine has.
        """
        while not self._heard:
            self._listen()
        heard, self._heard = self._heard, []
        return heard

    def close(self) -> None:
        """See ``Transport.close``."""
        for seat in self._seats:
            if seat.actor is not None:
                self._ray.kill(seat.actor)

    # ---- workers come and go --------------------------------------------------------------------------------------

    def _call(self, seat: _Seat) -> None:
        """Bring a worker its messages and let it play on."""
        messages, seat.outbox = seat.outbox, []
        seat.call = seat.actor.exchange.remote(messages)

    def _listen(self) -> None:
        """Take what workers say within ``_LISTENING``; look at the nodes now and then."""
        if time.monotonic() >= self._next_look:
            self._look_at_nodes()
            self._next_look = time.monotonic() + _LISTENING
        for seat in self._seats:
            if seat.actor is None and time.monotonic() >= seat.begin:
                seat.actor = self._make.remote(fingerprint(), self._shipment)  # Ray starts it as soon as a CPU is free
                self._call(seat)
        ray, calls = self._ray, {seat.call: n for n, seat in enumerate(self._seats) if seat.call is not None}
        if not calls:
            idle = [seat for seat in self._seats if seat.there]
            for seat in idle:
                self._call(seat)
            time.sleep(0.0 if idle else _PAUSE / 10)
            return
        done, _ = ray.wait(list(calls), timeout=_LISTENING)
        if done:
            done, _ = ray.wait(list(calls), num_returns=len(calls), timeout=0)
        for call in done:
            self._take(calls[call])

    def _take(self, number: int) -> None:
        """Take the answer to a call that is over."""
        seat = self._seats[number]
        call, seat.call = seat.call, None
        try:
            answer = self._ray.get(call)
        except self._ray.exceptions.RayTaskError:
            raise  # a mistake of this program's
        except self._ray.exceptions.RayError as error:
            self._replace(number, error)
            return
        if isinstance(answer, str):
            raise ClusterError(answer)
        idle = False
        for message in pickle.loads(answer):
            if isinstance(message, Arrived):
                self._welcome(message)
                continue
            self._heard.append((number, message))
            seat.losses = 0 if isinstance(message, Finished) else seat.losses
            idle = isinstance(message, Failed) or (
                isinstance(message, Progress) and (message.stopped or message.room == self.worlds)
            )
        seat.there, seat.failures = True, 0
        if seat.outbox or not idle:
            self._call(seat)

    def _welcome(self, arrived: Arrived) -> None:
        """Say it if nodes may differ in the last bits."""
        before = len(self.processors)
        self.processors.add(arrived.processor)
        if before and len(self.processors) == 2 > before:
            logging.getLogger(__name__).warning(
                "the cluster's nodes have different processors (%s): in the last bits results may not be those of one machine",
                ", ".join(sorted(self.processors)),
            )

    def _replace(self, number: int, error: Exception) -> None:
        """Replace a lost worker."""
        seat, reason = self._seats[number], one_line(first_line(error), 160)
        self._ray.kill(seat.actor)  # it may only have been out of reach
        if seat.there:
            self._heard.append((number, Lost()))
            seat.losses += 1
            logging.getLogger(__name__).warning(
                "a worker on the Ray cluster was lost (%s); what it had is played again", reason
            )
        else:
            seat.failures += 1
        if seat.losses > _MOST_LOSSES or seat.failures > _MOST_STARTS:
            raise ClusterError(
                f"a worker on the Ray cluster died {max(seat.losses, seat.failures)} times in a row ({reason}); {_KEPT}, with "
                "fewer --threads if memory ran out"
            )
        begin = time.monotonic() + (0.0 if seat.there else _PAUSE)
        self._seats[number] = _Seat(begin=begin, losses=seat.losses, failures=seat.failures)

    def _look_at_nodes(self) -> None:
        """See whether anybody is there or can still come; ``ClusterError`` where not."""
        try:
            _knock(self._head)
            self._reached = time.monotonic()
        except OSError as error:
            away = time.monotonic() - self._reached
            if away > _HEADLESS:
                self._seats = []
                raise ClusterError(
                    f"the head node of the Ray cluster ({self._head}) has been out of reach for {away:.0f} s; {_KEPT} once it is "
                    "there again, or without --cluster"
                ) from error
            return
        if not self._anyone and not any(
            node["Alive"] and node["Resources"].get("CPU", 0.0) >= 1.0 for node in self._ray.nodes()
        ):
            raise ClusterError(
                f"no node of the Ray cluster is left; {_KEPT} once it has nodes again, or without --cluster"
            )


# ---- on a node --------------------------------------------------------------------------------------------------------


def _actor_class() -> type:
    """Return the class of the actors. It travels to the nodes as it stands here, and finds out what they have."""

    class GaitgaugeWorker:
        def __init__(self, wanted: dict[str, str], shipment: bytes) -> None:
            self.wanted, self.shipment = wanted, shipment
            self.worker: Any = None

        def exchange(self, messages: Any) -> Any:
            """Messages of a worker, pickled; or a sentence on why this node is of no use."""
            if self.worker is None:
                import ray

                node = ray.util.get_node_ip_address()
                try:
                    from gaitgauge.gauge.play.cluster_node import NodeWorker
                except ImportError as error:
                    return f"node {node} of the Ray cluster lacks this gaitgauge ({error}); install it on all nodes"
                self.worker = NodeWorker(node, self.wanted, self.shipment)
            return self.worker.exchange(messages)

    return GaitgaugeWorker


# ---- Ray --------------------------------------------------------------------------------------------------------------


def _ray() -> Any:
    """Return Ray's module; ``ClusterError`` where it is not installed."""
    try:
        return importlib.import_module("ray")
    except ImportError as error:
        raise ClusterError(
            "--cluster needs Ray, which is not installed; install it with pip install 'gaitgauge[cluster]'"
        ) from error


def _knock(address: str, *, greet: bool = False) -> None:
    """See whether anybody listens at an address.

    Args:
        address: with its port.
        greet: see whether they speak gRPC, too, as Ray does (unless it is told to use TLS).

    Raises:
        OSError: nobody, the port is none, or something else listens there.
    """
    host, _, port = address.rpartition("://")[2].rpartition(":")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECTING) as connection:
            if not greet or os.environ.get("RAY_USE_TLS", "0").lower() in ("1", "true"):
                return
            connection.sendall(_PREFACE)
            frame = connection.recv(9, socket.MSG_WAITALL)
            if len(frame) < 9 or frame[3] != 4:
                raise OSError("something else than Ray answers there")
    except OverflowError as error:
        raise OSError(str(error)) from error
