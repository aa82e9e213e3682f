"""Where the time of a training iteration goes: the device's kernels by the part of the loop that launched them.

    python benchmarks/training_profile.py --task go2-moe-cts --num-envs 16384 --out profile.json
    python benchmarks/training_profile.py --task go2-flat --num-envs 16 --device cpu --backend mujoco --skip 1

Trains for ``--skip`` iterations (compiling and CUDA graphs are behind them), then lets ``torch.profiler`` watch the next ones,
and prints for each part: milliseconds of an iteration in which a kernel of it ran, milliseconds in which the device waited for
one of it, how many kernels, how often the host waited for the device, and its dearest kernels. The profiler itself slows the
host down, so that more is waited for than without it, and it misses most kernels inside of a graph's loops, which count as waiting;
``several_gpus.py`` measures the whole. On a CPU, where there are no kernels, the parts' own times are printed.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
import time
from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import environment_throughput
import torch
import warp_profile
from gaitgauge.training.environment.stretches import first_alone
from gaitgauge.training.run.launch import train
from gaitgauge.training.run.plan import prepare
from gaitgauge.training.run.request import TrainRequest
from gaitgauge.training.run.runner import TrainingRunner
from gaitgauge.training.run.stopping import Progress
from gaitgauge.training.tasks import find_task
from torch.profiler import ProfilerActivity, profile, record_function

PARTS = (
    ("acting", "alg.act"),
    ("noting outcomes", "alg.store_outcome"),
    ("guard against NaN", "_guard"),
    ("episode log", "logger.add_step"),
    *((title, ".".join(filter(None, ("env", path, name)))) for title, path, name in environment_throughput.PARTS),
    ("returns", "alg.compute_returns"),
    ("policy learning", "alg._policy_step"),
    ("student's targets", "alg.losses.prepare_student"),
    ("student learning", "alg._student_step"),
)
"""Parts of an iteration: title, and where the function is, seen from the runner."""
ELSE = "everything else"


@dataclass
class Share:
    """What one part took of the profiled iterations."""

    microseconds: float = 0.0
    idle: float = 0.0
    """Microseconds before its kernels in which nothing ran."""
    kernels: int = 0
    waits: int = 0
    """How often the host waited for the device."""
    names: Counter[str] = field(default_factory=Counter)
    """Microseconds by kernel."""


def annotate(runner: TrainingRunner) -> None:
    """Make each part tell the profiler its title."""

    def told(title: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            with record_function(title):
                return function(*args, **kwargs)

        return call

    for title, path in PARTS:
        *owners, name = path.split(".")
        owner: Any = runner
        for step in owners:
            owner = getattr(owner, step)
        setattr(owner, name, told(title, getattr(owner, name)))


def shares(trace: list[dict[str, Any]]) -> dict[str, Share]:
    """Shares by part from a trace in Chrome's format.

    A kernel belongs to the part in whose annotation the host launched it; kernels of a graph to the launch of the graph.
    """
    titles = {title for title, _ in PARTS}
    spans = sorted(
        (event["ts"], event["ts"] + event["dur"], event["name"])
        for event in trace
        if event.get("cat") == "user_annotation" and event["name"] in titles
    )
    begins = [begin for begin, _, _ in spans]

    def part_at(moment: float) -> str:
        number = bisect_right(begins, moment) - 1
        return spans[number][2] if number >= 0 and moment <= spans[number][1] else ELSE

    calls = [event for event in trace if event.get("cat") in ("cuda_runtime", "cuda_driver")]
    launched = {e["args"]["correlation"]: e["ts"] for e in calls if "correlation" in e.get("args", {})}
    kernels = [event for event in trace if event.get("cat") in ("kernel", "gpu_memcpy", "gpu_memset")]
    found: dict[str, Share] = defaultdict(Share)
    if not kernels:
        for begin, end, title in spans:
            found[title].microseconds += end - begin
            found[title].kernels += 1
        return found
    for event in calls:
        found[part_at(event["ts"])].waits += "Synchronize" in event["name"]
    reached = None
    for event in sorted(kernels, key=lambda e: float(e["ts"])):
        share = found[part_at(launched.get(event["args"].get("correlation"), -1.0))]
        share.microseconds += event["dur"]
        share.kernels += 1
        share.names[short_name(event["name"])] += event["dur"]
        if reached is not None:
            share.idle += max(event["ts"] - reached, 0.0)
        reached = max(reached or 0.0, event["ts"] + event["dur"])
    return found


def short_name(name: str) -> str:
    """A kernel's name without template arguments, and without what Warp adds to tell variants apart."""
    name = warp_profile.short_name(name)
    if functor := re.search(r"elementwise_kernel.*?native::(?:\(anonymous namespace\)::)?(\w+)", name):
        return f"elementwise {functor.group(1)}"
    if product := re.search(r"cutlass_\w+", name):
        return product.group()
    return re.sub(r"^void |<.*$|\(.*$", "", name)[:90]


def main() -> None:
    """Train a little, profile, print, save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="go2-moe-cts")
    parser.add_argument("--backend", default="mujoco-warp")
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--num-envs", type=int, default=16384)
    parser.add_argument("--skip", type=int, default=12, help="iterations before the profile")
    parser.add_argument("--iterations", type=int, default=2, help="iterations that are profiled")
    parser.add_argument(
        "--fuse", action=argparse.BooleanOptionalAction, help="compile the environment's torch parts; default: on a GPU"
    )
    parser.add_argument("--most", type=int, default=8, help="kernels listed for each part")
    parser.add_argument("--init-from", help="checkpoint or policy to begin with, so that the robots walk")
    parser.add_argument("--out", type=Path)
    parser.add_argument("settings", nargs="*", metavar="key=value", help="settings of the task")
    options = parser.parse_intermixed_args()

    original = TrainingRunner.learn

    def learn(self: TrainingRunner, *args: Any, **kwargs: Any) -> Any:
        annotate(self)
        return original(self, *args, **kwargs)

    TrainingRunner.learn = learn  # type: ignore[method-assign]
    on_gpu = options.device.startswith("cuda")
    watched = profile(activities=[ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if on_gpu else [])])
    moments: list[float] = []

    def progress(now: Progress) -> None:
        if on_gpu:
            torch.cuda.synchronize()
        moments.append(time.perf_counter())
        if now.iteration == options.skip:
            watched.start()
        if now.iteration == options.skip + options.iterations:
            watched.stop()

    with tempfile.TemporaryDirectory() as folder:
        request = TrainRequest(
            task=options.task,
            backend=options.backend,
            device=options.device,
            num_envs=options.num_envs,
            iterations=options.skip + options.iterations,
            overrides=(
                "training.run.keep_episodes=false",
                *first_alone(find_task(options.task).environment),
                *options.settings,
            ),
            init_from=options.init_from,
            log_root=Path(folder),
            fuse=options.fuse,
            score=False,
        )
        train(prepare(request), began=time.monotonic(), progress=progress)
        trace = Path(folder) / "trace.json"
        watched.export_chrome_trace(str(trace))
        found = shares(json.loads(trace.read_text())["traceEvents"])

    each = 1e3 * options.iterations
    plain = [b - a for a, b in pairwise(moments)][options.skip // 2 - 1 : options.skip - 1]
    print(
        f"{options.task}, {options.num_envs} worlds, {options.device}, fuse={options.fuse} {' '.join(options.settings)}"
    )
    if plain:
        print(f"an iteration without the profiler: {1e3 * sorted(plain)[len(plain) // 2]:.1f} ms")
    print(f"{'part':<32}{'busy ms':>9}{'idle ms':>9}{'kernels':>9}{'waits':>7}")
    parts = sorted(found.items(), key=lambda item: -item[1].microseconds - item[1].idle)
    everything = Share(
        **{name: sum(getattr(s, name) for s in found.values()) for name in ("microseconds", "idle", "kernels", "waits")}
    )
    for title, share in [*parts, ("all", everything)]:
        print(
            f"{title:<32}{share.microseconds / each:>9.2f}{share.idle / each:>9.2f}"
            f"{share.kernels / options.iterations:>9.0f}{share.waits / options.iterations:>7.0f}"
        )
    for title, share in parts:
        if share.names:
            print(f"\n{title}")
        for name, spent in share.names.most_common(options.most):
            print(f"{spent / each:>9.3f}  {name}")
    if options.out:
        rows = {
            title: {
                "busy_milliseconds": share.microseconds / each,
                "idle_milliseconds": share.idle / each,
                "kernels": share.kernels / options.iterations,
                "waits": share.waits / options.iterations,
                "names": {name: spent / each for name, spent in share.names.most_common(40)},
            }
            for title, share in parts
        }
        options.out.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
