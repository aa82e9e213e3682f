"""Speed of the training environment without learning: random actions, all terrains, and where the time goes.

    python benchmarks/environment_throughput.py --num-envs 8192 --capture --out environment.json

Prints the speed of the whole step and a table of its parts. The parts are timed in a second pass that waits for the
device after each of them, so their sum is a little longer than a step.

    python benchmarks/environment_throughput.py --count --num-envs 16 --device cpu

counts the torch kernels of a step instead, on any machine: beside the physics their number decides about the speed, since each
of them is small.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from gaitgauge.training.environment.environment import TrainingEnvironment
from gaitgauge.training.tasks import find_task
from torch.utils._python_dispatch import TorchDispatchMode

PARTS = (
    ("random numbers", "parts.uniform", "draw"),
    ("targets", "parts", "targets"),
    ("latency", "parts", "delay"),
    ("physics", "backend", "step"),
    ("reading the state", "", "_read"),
    ("judging and resetting (torch)", "", "_after_physics"),
    ("log", "", "_log"),
    ("motor parameters", "backend", "randomize"),
    ("physics reset", "backend", "reset"),
    ("physics push", "backend", "push"),
    ("observing (torch)", "", "_observe"),
    ("packing", "", "_pack"),
)
"""Parts of a step: title, where the callable is, its name."""


VIEWS = {
    *(
        "alias",
        "as_strided",
        "detach",
        "diagonal",
        "empty",
        "empty_like",
        "expand",
        "lift_fresh",
        "new_empty",
        "permute",
    ),
    *(
        "reshape",
        "select",
        "slice",
        "split",
        "split_with_sizes",
        "squeeze",
        "t",
        "transpose",
        "unbind",
        "unsqueeze",
        "view",
    ),
    "_unsafe_view",
}
"""Operations that launch nothing."""


class KernelCounter(TorchDispatchMode):
    """Counts torch operations that launch a kernel on a GPU."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run an operation, and count it unless it is a view."""
        self.count += function.overloadpacket.__name__ not in VIEWS
        return function(*args, **(kwargs or {}))


def count_kernels(environment: TrainingEnvironment) -> Counter[str]:
    """Torch kernels of a step without a log, by part; needs an environment that is neither captured nor compiled."""
    actions = torch.zeros(environment.num_envs, environment.num_actions, device=environment.device)
    environment.step(actions)
    environment.common_step_counter = 0
    found: Counter[str] = Counter()
    with KernelCounter() as counter:

        def counted(title: str, function: Callable[..., Any]) -> Callable[..., Any]:
            def call(*args: Any, **kwargs: Any) -> Any:
                before = counter.count
                result = function(*args, **kwargs)
                found[title] += counter.count - before
                return result

            return call

        with replaced_parts(environment, counted):
            environment.step(actions)
    found["everything else"] = counter.count - sum(found.values())
    return found


@contextmanager
def replaced_parts(
    environment: TrainingEnvironment, replacement: Callable[[str, Callable[..., Any]], Callable[..., Any]]
) -> Iterator[None]:
    """Every part's function replaced by ``replacement(title, function)``."""
    originals = []
    for title, path, name in PARTS:
        owner: Any = environment
        for attribute in filter(None, path.split(".")):
            owner = getattr(owner, attribute)
        function = getattr(owner, name)
        originals.append((owner, name, function))
        setattr(owner, name, replacement(title, function))
    try:
        yield
    finally:
        for owner, name, function in originals:
            setattr(owner, name, function)


def synchronize(device: torch.device) -> None:
    """Wait for the device."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def measure(environment: TrainingEnvironment, steps: int, scale: float) -> float:
    """Seconds per step over ``steps`` steps with random actions."""
    shape = (environment.num_envs, environment.num_actions)
    with torch.inference_mode():
        synchronize(environment.device)
        start = time.perf_counter()
        for _ in range(steps):
            environment.step(torch.randn(shape, device=environment.device) * scale)
        synchronize(environment.device)
    return (time.perf_counter() - start) / steps


def profile(environment: TrainingEnvironment, steps: int, scale: float) -> dict[str, float]:
    """Seconds per step of every part, device time included."""
    spent: dict[str, float] = defaultdict(float)

    def timed(title: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            synchronize(environment.device)
            start = time.perf_counter()
            result = function(*args, **kwargs)
            synchronize(environment.device)
            spent[title] += time.perf_counter() - start
            return result

        return call

    with replaced_parts(environment, timed):
        whole = measure(environment, steps, scale)
    parts = {title: seconds / steps for title, seconds in spent.items()}
    return {**parts, "everything else": whole - sum(parts.values())}


def main() -> None:
    """Measure, print, save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--task", default="go2-moe-cts", help="training task whose environment is measured")
    parser.add_argument("--backend", default="mujoco-warp")
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--num-envs", type=int, default=8192)
    parser.add_argument("--steps", type=int, default=500, help="steps of the measurement")
    parser.add_argument(
        "--warm-up", type=int, default=150, help="steps before it, so that robots stand, fall and climb"
    )
    parser.add_argument("--action-scale", type=float, default=0.5, help="standard deviation of the random actions")
    parser.add_argument("--capture", action="store_true", help="replay the torch parts as CUDA graphs")
    parser.add_argument(
        "--fuse", action=argparse.BooleanOptionalAction, help="compile the torch parts; default: on a GPU"
    )
    parser.add_argument("--count", action="store_true", help="count torch kernels instead")
    parser.add_argument("--out", type=Path, help="file for the numbers as JSON")
    parser.add_argument("overrides", nargs="*", help="settings of the task, key=value")
    arguments = parser.parse_args()

    task = find_task(arguments.task, arguments.overrides)
    configuration = replace(task.environment, num_envs=arguments.num_envs)
    start = time.perf_counter()
    environment = TrainingEnvironment(
        configuration,
        backend=arguments.backend,
        device=arguments.device,
        capture=arguments.capture,
        fuse=arguments.fuse,
    )
    if arguments.count:
        found = count_kernels(environment)
        print(f"{arguments.task} on {arguments.backend}: {found.total()} torch kernels a step")
        for title, number in found.most_common():
            print(f"{title:<34}{number:>8}")
        return
    synchronize(environment.device)
    built = time.perf_counter() - start
    environment.episode_length_buf = torch.randint_like(
        environment.episode_length_buf, high=environment.max_episode_length
    )
    measure(environment, arguments.warm_up, arguments.action_scale)
    seconds = measure(environment, arguments.steps, arguments.action_scale)
    parts = profile(environment, max(arguments.steps // 5, 10), arguments.action_scale)
    memory = torch.cuda.max_memory_allocated(environment.device) if environment.device.type == "cuda" else 0

    rate = environment.num_envs / seconds
    device = (
        torch.cuda.get_device_name(environment.device) if environment.device.type == "cuda" else platform.processor()
    )
    print(f"{arguments.task} on {arguments.backend}, {device}, capture={arguments.capture}, fuse={arguments.fuse}")
    print(f"{environment.num_envs} environments, {len(environment.palette.terrains)} tiles, built in {built:.1f} s")
    print(
        f"{1e3 * seconds:.2f} ms a step, {rate:,.0f} environment steps a second, "
        f"torch memory {memory / 2**30:.1f} GiB\n"
    )
    print(f"{'part':<34}{'ms':>8}{'share':>8}")
    total = sum(parts.values())
    for title, spent in sorted(parts.items(), key=lambda item: -item[1]):
        print(f"{title:<34}{1e3 * spent:>8.2f}{spent / total:>8.1%}")
    log = {name: float(value) for name, value in environment._log().items() if name.startswith("Physics/")}
    print("\n" + ", ".join(f"{name} {value:g}" for name, value in log.items()))
    if arguments.out is not None:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        numbers = {
            "task": arguments.task,
            "backend": arguments.backend,
            "device": device,
            "torch": torch.__version__,
            "num_envs": environment.num_envs,
            "capture": arguments.capture,
            "fuse": arguments.fuse,
            "overrides": arguments.overrides,
            "seconds_to_build": built,
            "seconds_per_step": seconds,
            "environment_steps_per_second": rate,
            "seconds_per_part": parts,
            "physics": log,
        }
        arguments.out.write_text(json.dumps(numbers, indent=2) + "\n")


if __name__ == "__main__":
    main()
