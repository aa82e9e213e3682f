"""Compile kernels before they are needed (``gaitgauge warmup``)."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path

import torch

from ..backends.base import PhysicsOptions, Scene
from ..files.choices import cpu_threads
from ..gauge.suite import load_suite
from ..robots import Robot, load_robot
from ..terrains.gauge_terrains import LEVELS
from ..terrains.registry import gauge_terrain_names, make_terrain
from .console import Terminal
from .errors import UserError

_ENGINES = ("mujoco-warp", "newton")
_SUITE = "gaitgauge-1"


def run_warmup(
    architectures: Sequence[str], backends: Sequence[str], *, robot: str, cache: Path | None, threads: int | None
) -> None:
    """Compile the kernels of training and evaluating.

    Args:
        robot: name or path; its numbers of joints and feet are part of the kernels.

    Raises:
        UserError: no architecture and no GPU, or an engine without kernels.
    """
    backends = backends or ("mujoco-warp",)
    for name in backends:
        if name.partition(":")[0] not in _ENGINES:
            known = ", ".join(_ENGINES)
            raise UserError(f"the engine '{name}' has no kernels to compile; choose from: {known} (--backend)")
    if cache is not None:
        os.environ["WARP_CACHE_PATH"] = str(cache)  # before Warp is imported
    from ..backends.warp import warmup

    numbers = [warmup.check_architecture(text) for text in architectures]
    if not numbers and not torch.cuda.is_available():
        raise UserError("there is no GPU here; say which one the kernels are for, such as --arch sm_90 (H100, H200)")
    console = Terminal()
    scenes = scenes_of(load_robot(robot))
    for name in backends:
        began = time.perf_counter()
        if not numbers:
            with console.status(f"{name}: playing until nothing is left to compile …"):
                warmup.exercise_until_compiled(name, scenes, "cuda")
            console.say(f"{name}: all kernels for this GPU are there ({time.perf_counter() - began:.0f} s)")
            continue
        with console.status(f"{name}: playing on the CPU to see what is launched …"):
            warmup.exercise_until_compiled(name, scenes, "cpu")
            with warmup.recorded_launches() as launched:
                warmup.exercise(name, scenes, "cpu")
        seconds = time.perf_counter() - began
        console.say(f"{name}: {len(launched)} modules are launched (seen on the CPU in {seconds:.0f} s)")
        for number in numbers:
            with console.status(f"{name}: compiling for sm_{number} …"):
                done = warmup.compile_for(number, launched, threads=cpu_threads(threads))
            counts = f"{done.fresh} of {done.modules} compiled, the others were there"
            console.say(f"{name}, sm_{number}: {counts} ({done.seconds:.0f} s)")
    console.say(f"kernels are in {warmup.cache_folder()}")
    if cache is not None:
        console.say(f"programs find them with WARP_CACHE_PATH={cache}")
    if numbers:
        console.say("what an engine launches on a GPU alone is not seen from a CPU and is compiled at the first use")


def _training_physics() -> list[PhysicsOptions]:
    """Return the physics of every stretch of a training on all terrains."""
    from ..training.environment.stretches import settings_in
    from ..training.tasks import TASKS

    environment = TASKS["go2-moe-cts"].environment
    return [settings_in(environment, n).physics for n in range(len(environment.schedule.stretches) + 1)]


def scenes_of(robot: Robot) -> list[Scene]:
    """Return a few worlds of training and of the gauge, on level ground, on boxes and on a height field."""
    level = LEVELS[len(LEVELS) // 2]
    names = [n for n in gauge_terrain_names() if n in ("flat", "stairs_fd", "wave")]
    terrains = tuple(make_terrain(n, None if n == "flat" else level) for n in names)
    own = robot.parameters[robot.default_parameters]
    return [
        Scene(
            robot=robot,
            parameters=robot.parameters.get("training", own) if each in _training_physics() else own,
            terrains=terrains,
            terrain_index=tuple(range(len(terrains))),
            physics=each,
        )
        for each in dict.fromkeys((*_training_physics(), load_suite(_SUITE).physics))
    ]
