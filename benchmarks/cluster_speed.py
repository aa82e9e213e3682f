"""What a Ray cluster brings: one evaluation on this machine and on clusters of nodes with one CPU each, all on this machine.

    python benchmarks/cluster_speed.py [POLICY] [--suite demo] [--terrain flat …] [--nodes 1 2] [--cluster ADDRESS] [--out FILE.json]

Prints for one process, for as many processes as nodes, and for each number of nodes: wall time of the whole evaluation, processor
time of all processes together and of the busiest one, the speed-up against one process by either, and whether results and rows are
equal to the last bit. Nodes are started before the clock; connecting, starting the workers on them, loading and writing are part of
it. Where other work keeps the machine busy wall time says nothing; the processor time of the busiest process is what the
evaluation lasts on cores that have nothing else to do. With ``--cluster`` a cluster that runs already is measured beside them, with
all its free CPUs; processor times are those of this machine.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gaitgauge.files.provenance import processor
from gaitgauge.gauge.evaluate import Request, evaluate

_STORE = 100 * 2**20
"""Memory for objects of a node [bytes]."""


class ProcessorTimes:
    """Processor time that this process and those below it use, by looking at all of them again and again (Linux)."""

    _EVERY = 0.2
    """Time between two looks [s]."""

    def __init__(self) -> None:
        self._first: dict[int, float] = {}
        self._last: dict[int, float] = {}
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> ProcessorTimes:
        self._first = _used()
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._done.set()
        self._thread.join()

    @property
    def seconds(self) -> list[float]:
        """Of each process, the busiest first [s]."""
        return sorted((used - self._first.get(number, 0.0) for number, used in self._last.items()), reverse=True)

    def _watch(self) -> None:
        while not self._done.wait(self._EVERY):
            self._last.update(_used())


def _used() -> dict[int, float]:
    """Processor time of this process and all below it, by number [s]."""
    parents, used = {}, {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text(encoding="utf-8").rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):  # it has ended
            continue
        number = int(path.parent.name)
        parents[number] = int(fields[1])
        used[number] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    mine = {os.getpid()}
    while more := {number for number, parent in parents.items() if parent in mine} - mine:
        mine |= more
    return {number: used[number] for number in mine if number in used}


def measured(options: argparse.Namespace, threads: int | None, cluster: str | None) -> dict[str, Any]:
    """One evaluation: its figures, and what must be the same in all of them."""
    request = Request(
        policy=options.policy, suite=options.suite, terrains=tuple(options.terrain), threads=threads, cluster=cluster
    )
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        with ProcessorTimes() as processor_times:
            result = evaluate(request, Path(folder) / "run")
        seconds = time.perf_counter() - began
        rows = (Path(folder) / "run" / "episodes.csv").read_text(encoding="utf-8")
    found = {name: value for name, value in result.to_data().items() if name != "provenance"}
    return {
        "workers": result.provenance.processes,
        "seconds": seconds,
        "processor_seconds": sum(processor_times.seconds),
        "busiest_seconds": max(processor_times.seconds),
        "score": result.score,
        "outcome": json.dumps(found, sort_keys=True) + rows,
    }


def on_nodes(options: argparse.Namespace, nodes: int) -> dict[str, Any]:
    """One evaluation on a cluster of so many nodes, whose head plays nothing."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(
        initialize_head=True,
        head_node_args={"num_cpus": 0, "object_store_memory": _STORE, "include_dashboard": False},
    )
    try:
        for _ in range(nodes):
            cluster.add_node(num_cpus=1, object_store_memory=_STORE)
        return measured(options, None, cluster.address)
    finally:
        cluster.shutdown()


def main(arguments: Sequence[str] | None = None) -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", nargs="?", default="pretrained")
    parser.add_argument("--suite", default="demo")
    parser.add_argument("--terrain", nargs="*", default=[])
    parser.add_argument("--nodes", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--cluster", help="address of a cluster that runs already")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(arguments)
    runs = [("processes", lambda n=n: measured(options, n, None)) for n in sorted({1, *options.nodes})]
    runs += [("nodes", lambda n=n: on_nodes(options, n)) for n in options.nodes]
    if options.cluster:
        runs.append((options.cluster, lambda: measured(options, None, options.cluster)))
    print(f"load of this machine before: {os.getloadavg()[0]:.1f}, processors: {os.cpu_count()}")
    print("         wall time          processor time")
    print("workers  seconds  speed-up  all    busiest  speed-up  score   results  where", flush=True)
    found: list[dict[str, Any]] = []
    for where, run in runs:
        found.append(run() | {"where": where})
        row, first = found[-1], found[0]
        row["speed_up"] = first["seconds"] / row["seconds"]
        row["processor_speed_up"] = first["busiest_seconds"] / row["busiest_seconds"]
        row["same"] = row["outcome"] == first["outcome"]
        print(
            f"{row['workers']:7d}  {row['seconds']:7.1f}  {row['speed_up']:8.2f}  {row['processor_seconds']:5.1f}  "
            f"{row['busiest_seconds']:7.1f}  {row['processor_speed_up']:8.2f}  "
            f"{row['score']:.4f}  {'equal  ' if row['same'] else 'OTHER  '}  {where}",
            flush=True,
        )
    if options.out:
        table = [{k: v for k, v in row.items() if k != "outcome"} for row in found]
        machine = {"processor": processor(), "cpus": os.cpu_count()}
        options.out.write_text(json.dumps({"machine": machine, "rows": table}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
