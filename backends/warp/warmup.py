"""Compile the kernels of the engines on Warp ahead of time, also for a GPU of another machine.

With the GPU, some steps of an engine compile all kernels. Without it, the engine runs on the CPU while every launch is recorded,
and the launched kernels are compiled for the other architecture, into the folder and under the names of later look-ups. Kernels
that an engine launches on a GPU alone are missed and compiled at their first use.

A kernel's name holds a hash. With ``wp.static`` in a loop the hash includes expressions resolved by the function's last build, so
it depends on earlier builds of the process. The names that count are those of a program that finds all kernels compiled and builds
nothing; therefore engines are played until a process builds nothing, and names are taken before builds.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch
import warp as wp

from ...files.parsing import one_line
from ..base import BackendError, Randomization, Scene
from ..registry import make_backend

_DEFAULT_BLOCK = 256
"""Threads of a block for a launch without a block size."""
_MOST_PLAYS = 5
"""Most plays: a kernel's name can change once for each function with ``wp.static`` that it shares; two suffice so far."""


@dataclass(frozen=True, kw_only=True)
class Compiled:
    """Result of a compilation."""

    modules: int
    """Number of modules, each counted for every block size."""
    fresh: int
    """Number of new modules among them."""
    seconds: float


def exercise(backend: str, scenes: Iterable[Scene], device: str) -> None:
    """Play an engine for some steps, which compiles their kernels; raise ``BackendError`` for an unknown engine or device."""
    for scene in scenes:
        with closing(make_backend(backend, scene, device=device)) as physics:
            count = physics.num_worlds
            options: dict[str, Any] = {"device": physics.device, "dtype": physics.dtype}
            start = physics.standing()
            pose = start.held_target
            half = torch.arange(count, device=physics.device) % 2 == 0
            physics.randomize(_as_in_training(scene, count, options))
            physics.reset(start)
            physics.step(pose)
            physics.step(pose, sample_at=torch.ones(count, dtype=torch.int64, device=physics.device), worlds=half)
            physics.push(half, linear_velocity_w=torch.zeros(count, 3, **options))
            physics.reset(start, half)
            physics.step(pose)


def _as_in_training(scene: Scene, count: int, options: dict[str, Any]) -> Randomization:
    """Return training's randomization at nominal values, because changed masses need kernels of their own."""
    robot = scene.robot
    joints = torch.ones(count, robot.num_joints, **options)
    return Randomization(
        friction=torch.full((count,), 0.8, **options),
        base_mass_offset=torch.zeros(count, **options),
        link_mass_scale=torch.ones(count, len(robot.collision_bodies), **options),
        base_com_offset=torch.zeros(count, 3, **options),
        stiffness_scale=joints,
        damping_scale=joints,
        motor_strength=joints,
        motor_offset=torch.zeros_like(joints),
    )


def exercise_until_compiled(backend: str, scenes: Sequence[Scene], device: str) -> int:
    """Play an engine in new processes until one finds all kernels compiled, and return the number of processes.

    Raises:
        BackendError: unknown engine or device, or the kernels have other names each time.
    """
    for plays in range(1, _MOST_PLAYS + 1):
        before = _compiled_files()
        # a process without earlier builds, like the programs that will use these kernels
        spawn = multiprocessing.get_context("spawn")
        answer, reply = spawn.Pipe(duplex=False)
        process = spawn.Process(target=_exercise_and_reply, args=(reply, backend, scenes, device), daemon=True)
        process.start()
        reply.close()
        try:
            refusal = answer.recv()
        except EOFError:
            killed = f"the program that compiled kernels of {backend} was killed, for want of memory perhaps"
            raise BackendError(f"{killed}; its finished kernels are kept: call again") from None
        process.join()
        if refusal is not None:
            raise BackendError(refusal)
        if _compiled_files() == before:
            return plays
    raise BackendError(
        f"{backend} compiled kernels anew in each of {_MOST_PLAYS} programs that ran one after another; their folder is "
        f"'{cache_folder()}': see that nothing else clears it"
    )


def _exercise_and_reply(reply: Connection, backend: str, scenes: Sequence[Scene], device: str) -> None:
    """Play, and send the refusal or None; end quietly where no process waits for the answer any more."""
    refusal = None
    try:
        exercise(backend, scenes, device)
    except BackendError as error:
        refusal = str(error)
    with suppress(BrokenPipeError):
        reply.send(refusal)


def _compiled_files() -> set[Path]:
    return {path for path in Path(cache_folder()).glob("*/*") if path.suffix in (".o", ".cubin", ".ptx")}


def supported_architectures() -> list[int]:
    """Return the architectures that the compiler knows, such as 90 for ``sm_90``; needs no GPU."""
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    wp.init()
    return list(wp.get_cuda_supported_archs())


def cache_folder() -> str:
    """Return the folder of compiled kernels."""
    wp.init()
    return str(wp.config.kernel_cache_dir)


@contextmanager
def recorded_launches() -> Iterator[dict[Any, set[int]]]:
    """Note the block sizes of every launch inside the context, by module."""
    seen: dict[Any, set[int]] = {}
    original = {name: getattr(wp, name) for name in ("launch", "launch_tiled")}

    def noting(launch: Callable[..., Any]) -> Callable[..., Any]:
        def noted(kernel: Any, *args: Any, **options: Any) -> Any:
            block = options.get("block_dim") or _DEFAULT_BLOCK
            seen.setdefault(kernel.module, set()).add(int(block))
            return launch(kernel, *args, **options)

        return noted

    for name, launch in original.items():
        setattr(wp, name, noting(launch))
    try:
        yield seen
    finally:
        for name, launch in original.items():
            setattr(wp, name, launch)


def compile_for(architecture: int, launched: dict[Any, set[int]], *, threads: int = 1) -> Compiled:
    """Compile modules, given with their block sizes, for an architecture (90 for ``sm_90``) into Warp's cache, where missing."""
    began = time.perf_counter()
    for module, blocks in launched.items():
        for block in blocks:
            module.get_module_hash(block)  # Warp keeps the hash; after the first build below it would differ
    # a module's default block size is part of it, so one module is compiled by one thread
    with ThreadPoolExecutor(threads) as pool:
        results = list(pool.map(lambda item: _compile(architecture, *item), launched.items()))
    fresh = [each for result in results for each in result]
    return Compiled(modules=len(fresh), fresh=sum(fresh), seconds=time.perf_counter() - began)


def _compile(architecture: int, module: Any, blocks: Iterable[int]) -> list[bool]:
    """Compile a module once for each block size, and return whether each is new."""
    usual = module.options["block_dim"]
    before = set(Path(cache_folder()).glob(f"*/*.sm{architecture}*"))
    fresh = []
    for block in sorted(blocks):
        module.options["block_dim"] = block  # not by wp.set_module_options, which drops the hashes
        try:
            (path,) = wp.compile_aot_module(module, arch=architecture, use_ptx=False)
        finally:
            module.options["block_dim"] = usual
        fresh.append(Path(path) not in before)
    return fresh


def check_architecture(text: str) -> int:
    """Return the number of an architecture such as ``sm_90`` or ``90``; raise ``BackendError`` where the compiler lacks it."""
    known = {f"sm_{number}": number for number in supported_architectures()}
    number = known.get(f"sm_{text.removeprefix('sm_')}")
    if number is None:
        choice = f"choose from: {', '.join(known)} (--arch)"
        raise BackendError(f"the architecture '{one_line(text, 80)}' is not known to Warp's compiler; {choice}")
    return number
