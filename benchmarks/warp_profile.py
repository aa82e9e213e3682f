"""What a control period of the mujoco-warp engine costs while robots walk, by number of worlds, ground and solver settings.

Robots walk with the shipped policy (or ``--policy``) in the gauge's physics on the gauge's terrains, or in the training
physics on training tiles, so that contacts and solver iterations are those of real motion. For every case: milliseconds
of ``MujocoWarpBackend.step`` between two device events, the distribution of Newton iterations of the last substep, and
for some cases the kernels of one substep by their time, launched one by one and seen by ``torch.profiler`` (by Warp's own
event timing where the profiler sees no kernel, by the host's clock on a CPU).

    python benchmarks/warp_profile.py --time 150 --out profile.json
    python benchmarks/warp_profile.py --device cpu --worlds-scale 0.002 --steps 2 --walk 5 --out profile.json

Cases run in the order of their importance; when ``--time`` is over, the rest is named as left out. Kernels are compiled
inside that time unless Warp's cache has them.
"""

from __future__ import annotations

import argparse
import json
import re
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
import warp as wp
from gaitgauge.backends.base import PhysicsOptions, ResetState, Scene
from gaitgauge.backends.mujoco_warp import MujocoWarpBackend
from gaitgauge.backends.mujoco_warp.model import SMALLEST_TOLERANCE
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.observation import ObservationBuilder
from gaitgauge.robots import load_robot
from gaitgauge.robots.rotation import from_yaw
from gaitgauge.terrains.base import HeightField, Terrain
from gaitgauge.terrains.registry import make_terrain
from gaitgauge.terrains.training_tiles import NUM_TILE_LEVELS, make_tile
from gaitgauge.training.environment.configuration import TRAINING_PHYSICS
from gaitgauge.training.environment.terrain_configuration import ALL_TILES

GAUGE_BOXES = ("flat", "slope_fd", "slope_bd", "stairs_fd", "stairs_bd", "obstacle")
SCENES = ("gauge-boxes", "gauge-wave", "gauge-all", "tiles-boxes", "tiles-fields", "tiles-mix")


@dataclass(frozen=True, kw_only=True)
class Case:
    """One configuration. ``iterations``, ``ls_iterations``, ``tolerance`` and ``cone`` None are those of the preset."""

    scene: str
    worlds: int
    iterations: int | None = None
    ls_iterations: int | None = None
    tolerance: float | None = None
    cone: str | None = None
    spacing: float | None = None
    """Distance of the nodes of training tiles' height fields [m]; None for their own, 0.1 m."""
    watch: bool = True
    """Whether the gauge's watches run (tilt, penetration)."""
    sampled: bool = False
    """Whether a sample is taken, as in the quality episodes of the gauge."""
    kernels: bool = False
    """Whether the kernels of a substep are listed."""

    def physics(self) -> PhysicsOptions:
        """The options of the scene's physics with this case's changes."""
        base = load_suite("robogauge-1.1").physics if self.scene.startswith("gauge") else TRAINING_PHYSICS
        names = ("iterations", "ls_iterations", "tolerance", "cone")
        changes: dict[str, Any] = {n: getattr(self, n) for n in names if getattr(self, n) is not None}
        if not self.watch:
            changes |= {"watch_tilt": None, "watch_penetration": None}
        return replace(base, **changes)

    def title(self) -> str:
        """A short name for the table."""
        physics = self.physics()
        tolerance = max(physics.tolerance, SMALLEST_TOLERANCE)
        parts = [f"{physics.iterations} it", f"{physics.ls_iterations} ls", f"tol {tolerance:g}", physics.cone]
        parts += [f"nodes {self.spacing} m"] if self.spacing else []
        parts += ["no watches"] if not self.watch else []
        parts += ["sampled"] if self.sampled else []
        return ", ".join(parts)


def standard_cases() -> list[Case]:
    """What ``docs/reports/2026-11-27-performance.md`` asks about, most important first. Neighbours share a scene and are built once."""
    whole, few = 2709, 189
    cases = [Case(scene="gauge-all", worlds=whole, kernels=True)]
    cases += [Case(scene="gauge-all", worlds=whole, iterations=i) for i in (50, 30, 20, 10)]
    cases += [Case(scene="gauge-all", worlds=whole, tolerance=t) for t in (1e-5, 1e-4)]
    cases += [Case(scene="gauge-all", worlds=whole, iterations=20, sampled=True)]
    cases += [Case(scene="gauge-all", worlds=few, kernels=True)]
    cases += [Case(scene="gauge-all", worlds=few, iterations=i) for i in (20, 10)]
    cases += [Case(scene="gauge-all", worlds=few, tolerance=1e-5)]
    cases += [Case(scene="tiles-mix", worlds=8192, kernels=True), Case(scene="tiles-boxes", worlds=8192, kernels=True)]
    cases += [Case(scene="tiles-mix", worlds=8192, spacing=s) for s in (0.2, 0.4)]
    cases += [Case(scene="tiles-mix", worlds=8192, iterations=i) for i in (5, 20)]
    cases += [Case(scene="gauge-boxes", worlds=whole), Case(scene="gauge-boxes", worlds=whole, iterations=20)]
    cases += [Case(scene="gauge-wave", worlds=whole, iterations=20, kernels=True)]
    cases += [Case(scene="tiles-fields", worlds=8192), Case(scene="tiles-boxes", worlds=2048)]
    cases += [Case(scene="gauge-boxes", worlds=whole, cone="pyramidal")]
    cases += [Case(scene="gauge-boxes", worlds=whole, iterations=20, watch=False)]
    cases += [Case(scene="gauge-all", worlds=whole, ls_iterations=20)]
    return cases


def make_ground(scene: str, spacing: float | None) -> tuple[list[Terrain], np.ndarray]:
    """Terrains of a scene and the share of the worlds on each."""
    if scene.startswith("gauge"):
        names = {"gauge-boxes": GAUGE_BOXES, "gauge-wave": ("wave",), "gauge-all": (*GAUGE_BOXES, "wave")}[scene]
        terrains, shares = [], []
        for name in names:
            levels = [0] if name == "flat" else list(range(1, 11))
            terrains += [make_terrain(name, level) for level in levels]
            shares += [1.0 / len(levels)] * len(levels)
        return terrains, np.array(shares) / sum(shares)
    kinds = {
        "tiles-boxes": [t for t in ALL_TILES if make_tile(t.name, 0).height_field is None],
        "tiles-fields": [t for t in ALL_TILES if make_tile(t.name, 0).height_field is not None],
        "tiles-mix": list(ALL_TILES),
    }[scene]
    terrains, shares = [], []
    for kind in kinds:
        for level in range(NUM_TILE_LEVELS):
            tile = make_tile(kind.name, level)
            terrains.append(tile if spacing is None or tile.height_field is None else respaced(tile, spacing))
            shares.append(kind.share)
    return terrains, np.array(shares) / sum(shares)


def respaced(tile: Terrain, spacing: float) -> Terrain:
    """The tile with a field of another node distance: nodes lie on the old surface, linear between its nodes [m]."""
    field = tile.height_field
    assert field is not None
    heights = field.heights
    for axis, half in ((0, field.half_size[1]), (1, field.half_size[0])):
        old = np.linspace(-half, half, heights.shape[axis])
        new = np.linspace(-half, half, round(2 * half / spacing) + 1)
        heights = np.apply_along_axis(lambda line, new=new, old=old: np.interp(new, old, line), axis, heights)
    coarse = HeightField(center=field.center, half_size=field.half_size, heights=heights, base=field.base)
    return replace(tile, height_field=coarse)


class Walkers:
    """Worlds full of walking robots."""

    def __init__(self, case: Case, policy: str, device: str) -> None:
        torch.manual_seed(0)
        self.robot = load_robot("go2")
        terrains, shares = make_ground(case.scene, case.spacing)
        n = case.worlds
        index = np.minimum(np.searchsorted(np.cumsum(shares), (np.arange(n) + 0.5) / n), len(terrains) - 1)
        parameters = self.robot.parameters["gauge" if case.scene.startswith("gauge") else "training"]
        scene = Scene(
            robot=self.robot,
            parameters=parameters,
            terrains=tuple(terrains),
            terrain_index=tuple(int(i) for i in index),
            physics=case.physics(),
        )
        self.device = torch.device(device)
        began = perf_counter()
        self.backend = MujocoWarpBackend(scene, device=device)
        self.build_seconds = perf_counter() - began
        loaded = load_policy(policy, self.robot)
        self._session = loaded.session(n, device=device)
        self._builder = ObservationBuilder(loaded.contract, self.robot, n, device)
        self._action = torch.zeros(n, self.robot.num_joints, device=device)
        poses = [terrains[i].spawns["level_search" if case.scene.startswith("gauge") else "train"] for i in index]
        self._spawn = torch.tensor([p.position for p in poses], device=device, dtype=torch.float32)
        self._spawn[:, 2] += self.robot.stand_height + 0.02
        self._heading = from_yaw(torch.tensor([p.yaw for p in poses], device=device, dtype=torch.float32))
        self._command = torch.rand(n, 3, device=device) - 0.5
        self._command[:, 0] = 0.3 + 0.7 * torch.rand(n, device=device)
        self._substeps = scene.physics.substeps
        self.reset(torch.ones(n, dtype=torch.bool, device=device))

    def reset(self, mask: torch.Tensor) -> None:
        """Put the masked robots back to their start."""
        self.backend.reset(ResetState(base_position=self._spawn, base_quaternion=self._heading), mask)
        self._builder.reset(mask)
        self._session.reset(mask)
        self._action.masked_fill_(mask[:, None], 0.0)

    def act(self) -> torch.Tensor:
        """Joint targets of the next control period; robots that lie start anew."""
        state = self.backend.state
        upright = 1.0 - 2.0 * state.base_quaternion_w[:, 1:3].square().sum(1)
        self.reset((upright < 0.3) | state.diverged)
        self._action = self._session.act(self._builder.build(self.backend.state, self._command, self._action))
        return self._builder.targets(self._action)

    def set_solver(self, case: Case) -> None:
        """Take over the case's iterations and tolerance without building anew."""
        physics, backend = case.physics(), self.backend
        backend._model.opt.iterations = physics.iterations
        backend._model.opt.tolerance.fill_(max(physics.tolerance, SMALLEST_TOLERANCE))
        backend._graphs.clear()

    def step(self, *, sampled: bool) -> None:
        """One control period."""
        targets, at = self.act(), None
        if sampled:
            at = torch.full((self.backend.num_worlds,), self._substeps, device=self.device)
        self.backend.step(targets, sample_at=at)


def needs_new_scene(before: Case | None, case: Case) -> bool:
    """Whether two cases differ in more than what ``Walkers.set_solver`` changes."""
    free = {"iterations": None, "tolerance": None, "kernels": False, "sampled": False}
    return before is None or replace(before, **free) != replace(case, **free)


def measure(walkers: Walkers, case: Case, steps: int) -> dict[str, Any]:
    """Milliseconds a control period, iterations of the solver, and how the worlds were."""
    backend, gpu = walkers.backend, walkers.device.type == "cuda"
    for _ in range(3 if gpu else 1):
        walkers.step(sampled=case.sampled)  # records the graph
    niter = wp.to_torch(backend._data.solver_niter)
    milliseconds, iterations, contacts = [], [], []
    for _ in range(steps):
        targets, at = walkers.act(), None
        if case.sampled:
            at = torch.full((case.worlds,), backend.scene.physics.substeps, device=walkers.device)
        if gpu:
            start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
            start.record()
            backend.step(targets, sample_at=at)
            end.record()
            torch.cuda.synchronize()
            milliseconds.append(start.elapsed_time(end))
        else:
            began = perf_counter()
            backend.step(targets, sample_at=at)
            milliseconds.append(1e3 * (perf_counter() - began))
        iterations.append(niter.cpu().clone())
        contacts.append(int(backend._data.nacon.numpy()[0]) / case.worlds)
    every = torch.stack(iterations).float()
    state = backend.state
    return {
        "milliseconds": float(np.median(milliseconds)),
        "milliseconds_mean": float(np.mean(milliseconds)),
        "iterations_mean": float(every.mean()),
        "iterations_99": float(every.flatten().quantile(0.99)) if every.numel() < 2**24 else None,
        "iterations_largest": int(every.max()),
        "at_limit": float((every >= case.physics().iterations).float().mean()),
        "contacts_per_world": float(np.mean(contacts)),
        "overflowed": float(state.overflowed.float().mean()),
        "diverged": float(state.diverged.float().mean()),
        "build_seconds": walkers.build_seconds,
    }


# ---- kernels of one substep ------------------------------------------------------------------------------------------


def kernel_table(walkers: Walkers, case: Case) -> dict[str, Any]:
    """Kernels of one control period, launched one by one: name, launches and microseconds for each substep."""
    walkers.act()
    substeps = walkers.backend.scene.physics.substeps

    def period() -> None:
        with walkers.backend._scope():
            walkers.backend._control_period(substeps, masked=True, sampled=case.sampled)

    if walkers.device.type != "cuda":
        with host_clock() as seen:
            period()
        return _summary("host clock", seen, substeps)
    period()
    torch.cuda.synchronize()
    activity = torch.profiler.ProfilerActivity.CUDA
    with torch.profiler.profile(activities=[activity]) as profile:
        period()
        torch.cuda.synchronize()
    seen = defaultdict(list)
    for event in profile.events():
        if event.device_type == torch.autograd.DeviceType.CUDA:
            seen[short_name(event.name)].append(event.time_range.elapsed_us())
    if any(sum(times) > 0.0 for times in seen.values()):
        return _summary("torch.profiler", seen, substeps)
    wp.timing_begin(cuda_filter=wp.TIMING_ALL)
    period()
    timed = defaultdict(list)
    for result in wp.timing_end():
        timed[short_name(result.name)].append(1e3 * result.elapsed)
    return _summary("warp events", timed, substeps)


def short_name(name: str) -> str:
    """A kernel's name without what Warp adds to tell variants apart."""
    name = re.sub(r"^forward kernel ", "", name)
    name = re.sub(r"_cuda_kernel_(forward|backward).*$", "", name)
    return re.sub(r"_[0-9a-f]{8,}$|__locals__kernel|_[0-9a-f]{8}(?=_|$)", "", name)


@contextmanager
def host_clock() -> Iterator[dict[str, list[float]]]:
    """Time every launch with the host's clock [us]; for the CPU, where a launch returns when it is done."""
    seen: dict[str, list[float]] = defaultdict(list)
    plain = {name: getattr(wp, name) for name in ("launch", "launch_tiled")}

    def timed(launch: Callable[..., Any]) -> Callable[..., Any]:
        def call(kernel: Any, *arguments: Any, **options: Any) -> Any:
            began = perf_counter()
            result = launch(kernel, *arguments, **options)
            seen[short_name(kernel.key)].append(1e6 * (perf_counter() - began))
            return result

        return call

    for name, launch in plain.items():
        setattr(wp, name, timed(launch))
    try:
        yield seen
    finally:
        for name, launch in plain.items():
            setattr(wp, name, launch)


def _summary(method: str, seen: dict[str, list[float]], substeps: int) -> dict[str, Any]:
    rows = [
        {"name": name, "launches": len(times) / substeps, "microseconds": sum(times) / substeps}
        for name, times in seen.items()
    ]
    rows.sort(key=lambda r: -float(r["microseconds"]))
    return {
        "method": method,
        "launches": sum(float(r["launches"]) for r in rows),
        "microseconds": sum(float(r["microseconds"]) for r in rows),
        "kernels": rows,
    }


# ---- the run ----------------------------------------------------------------------------------------------------------


def run(cases: list[Case], arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Measure the cases in their order until the time is over; prints and stores each row at once."""
    began, rows = perf_counter(), []
    walkers, before = None, None
    print(f"{'scene':13} {'worlds':>6}  {'settings':40} {'ms':>7} {'niter':>6} {'99 %':>5} {'most':>4} {'limit':>7}")
    for case in cases:
        row: dict[str, Any] = {"case": asdict(case), "title": case.title()}
        rows.append(row)
        if perf_counter() - began > arguments.time:
            row["left_out"] = True
            continue
        if needs_new_scene(before, case):
            if walkers is not None:
                walkers.backend.close()
            walkers = None
            if arguments.device.startswith("cuda"):
                torch.cuda.empty_cache()
            walkers = Walkers(case, arguments.policy, arguments.device)
            for _ in range(arguments.walk):
                walkers.step(sampled=False)
        assert walkers is not None
        walkers.set_solver(case)
        before = case
        row |= measure(walkers, case, arguments.steps)
        if case.kernels:
            row["kernels"] = kernel_table(walkers, case)
        row["elapsed"] = perf_counter() - began
        print(
            f"{case.scene:13} {case.worlds:6}  {case.title():40} {row['milliseconds']:7.2f} {row['iterations_mean']:6.2f} "
            f"{row['iterations_99'] or 0:5.0f} {row['iterations_largest']:4} {row['at_limit']:7.3%}",
            flush=True,
        )
        store(arguments, rows)
    return rows


def store(arguments: argparse.Namespace, rows: list[dict[str, Any]]) -> None:
    """Write what is known so far."""
    if arguments.out is None:
        return
    gpu = arguments.device.startswith("cuda")
    device = torch.cuda.get_device_name(arguments.device) if gpu else "cpu"
    arguments.out.write_text(json.dumps({"device": device, "rows": rows}, indent=1) + "\n")


def print_kernels(rows: list[dict[str, Any]], most: int) -> None:
    """The kernels of one substep of each case that asked for them."""
    for row in rows:
        if "kernels" not in row:
            continue
        table, case = row["kernels"], row["case"]
        print(f"\n{case['scene']}, {case['worlds']} worlds, {row['title']}: kernels of one substep ({table['method']})")
        print(f"{'us':>9} {'share':>6} {'launches':>8}  kernel")
        for kernel in table["kernels"][:most]:
            share = kernel["microseconds"] / table["microseconds"]
            print(f"{kernel['microseconds']:9.1f} {share:6.1%} {kernel['launches']:8.1f}  {kernel['name']}")
        print(f"{table['microseconds']:9.1f} {1:6.1%} {table['launches']:8.1f}  all")


def main(argv: list[str] | None = None) -> None:
    """Measure the standard cases, print tables and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", help="cuda, cuda:1 or cpu")
    parser.add_argument("--time", type=float, default=150.0, help="seconds after which no further case begins")
    parser.add_argument("--steps", type=int, default=20, help="control periods timed for each case")
    parser.add_argument("--walk", type=int, default=60, help="control periods walked before, on a new scene")
    parser.add_argument("--scene", nargs="+", choices=SCENES, help="only the cases of these scenes")
    parser.add_argument("--cases", type=int, help="only the first cases")
    parser.add_argument("--worlds-scale", type=float, default=1.0, help="factor on the numbers of worlds")
    parser.add_argument("--policy", default="pretrained", help="policy that walks")
    parser.add_argument("--most", type=int, default=25, help="kernels listed for each case")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    arguments = parser.parse_args(argv)
    cases = [
        replace(c, worlds=max(1, round(c.worlds * arguments.worlds_scale)))
        for c in standard_cases()
        if not arguments.scene or c.scene in arguments.scene
    ][: arguments.cases]
    rows = run(cases, arguments)
    for row in rows:
        if row.get("left_out"):
            print(f"left out for lack of time: {row['case']['scene']}, {row['case']['worlds']} worlds, {row['title']}")
    print_kernels(rows, arguments.most)
    store(arguments, rows)


if __name__ == "__main__":
    main()
