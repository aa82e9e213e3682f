"""Control steps a second and memory of the Warp engines, with everything that training does to it.

Each control step is one of a standing and stepping Go2 in the physics of training (``TRAINING_PHYSICS``): new joint targets
and latencies, physics, reading the whole state, resets of 2 % of the worlds on a new terrain of the palette, and new friction,
gains, strengths and offsets for these.
Every configuration runs in a process of its own, so that memory is measured from a clean start.

    python benchmarks/warp_throughput.py --out throughput.json
    python benchmarks/warp_throughput.py --worlds 8192 --ground boxes field --steps 400
    python benchmarks/warp_throughput.py --plot memory.svg throughput.json   # memory by number of worlds, nothing measured

From a checkout that is not installed, a link named ``gaitgauge`` to the repository in a folder on PYTHONPATH is enough.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
from importlib.metadata import version
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gaitgauge.backends.base import Scene

SIZES = (1024, 2048, 4096, 8192, 16384, 32768, 65536)
GROUNDS = ("plane", "boxes", "field")
BOXES = 24
PALETTE = 16
RESET_SHARE = 0.02
WARMUP = 50


def make_palette(ground: str) -> tuple:
    """Terrains of one kind, different from each other, centred on the origin."""
    import numpy as np
    from gaitgauge.terrains.base import Box, HeightField, Terrain

    if ground == "plane":
        return (Terrain(name="plane", family="plane"),)
    random = np.random.default_rng(0)
    terrains = []
    for i in range(PALETTE):
        if ground == "boxes":
            # a staircase of long treads that rises from the middle to both sides
            rise, tread = 0.02 + 0.008 * i, 0.31
            steps = [(side * (0.8 + tread * (k + 0.5)), rise * (k + 1)) for k in range(BOXES // 2) for side in (1, -1)]
            boxes = tuple(Box(center=(x, 0.0, h / 2), half_size=(tread / 2, 4.0, h / 2)) for x, h in steps)
            terrains.append(Terrain(name="boxes", family="boxes", level=i, boxes=boxes))
        else:
            heights = 0.02 + (0.01 + 0.003 * i) * random.random((161, 161))
            field = HeightField(center=(0.0, 0.0), half_size=(8.0, 8.0), heights=heights)
            terrains.append(Terrain(name="field", family="field", level=i, height_field=field))
    return tuple(terrains)


def training_scene(ground: str, worlds: int) -> Scene:
    """Go2s in the training's physics."""
    from gaitgauge.backends.base import TRAINING_PHYSICS, Scene
    from gaitgauge.robots import load_robot

    robot = load_robot("go2")
    terrains = make_palette(ground)
    return Scene(
        robot=robot,
        parameters=robot.parameters["training"],
        terrains=terrains,
        terrain_index=tuple(i % len(terrains) for i in range(worlds)),
        physics=TRAINING_PHYSICS,
    )


def measure(name: str, ground: str, worlds: int, device: str, steps: int) -> dict:
    """Build, warm up and time one configuration."""
    import torch
    from gaitgauge.backends import make_backend
    from gaitgauge.backends.base import Randomization, ResetState

    gpu = device.startswith("cuda")

    def synchronize() -> None:
        if gpu:
            torch.cuda.synchronize(device)

    def free() -> int:
        return torch.cuda.mem_get_info(device)[0] if gpu else 0

    if gpu:
        torch.zeros(1, device=device)
        from warp import init

        init()
    scene = training_scene(ground, worlds)
    robot, terrains = scene.robot, scene.terrains
    free_before, start = free(), perf_counter()
    backend = make_backend(name, scene, device=device)
    synchronize()
    build_seconds = perf_counter() - start
    pose = torch.tensor(robot.default_joint_position, device=device)
    quaternion = torch.tensor([1.0, 0.0, 0.0, 0.0], device=device).repeat(worlds, 1)
    position = torch.zeros((worlds, 3), device=device)
    flags = {"overflowed": torch.zeros(worlds, dtype=torch.bool, device=device)}
    flags["diverged"] = flags["overflowed"].clone()

    def reset(mask: torch.Tensor | None) -> None:
        position[:, :2] = 1.2 * torch.rand((worlds, 2), device=device) - 0.6
        position[:, 2] = robot.stand_height
        index = torch.randint(len(terrains), (worlds,), device=device)
        backend.reset(ResetState(base_position=position, base_quaternion=quaternion, terrain_index=index), mask)

    def random_parameters(mask: torch.Tensor | None) -> None:
        def scale(low: float, high: float) -> torch.Tensor:
            return low + (high - low) * torch.rand((worlds, robot.num_joints), device=device)

        backend.randomize(
            Randomization(
                friction=0.5 + torch.rand(worlds, device=device),
                stiffness_scale=scale(0.9, 1.1),
                damping_scale=scale(0.9, 1.1),
                motor_strength=scale(0.8, 1.2),
                motor_offset=scale(-0.035, 0.035),
            ),
            mask,
        )

    def control_step() -> torch.Tensor:
        targets = pose + 0.25 * torch.randn((worlds, robot.num_joints), device=device)
        backend.step(targets, delay=torch.randint(0, 5, (worlds,), device=device))
        state = backend.state
        observation = torch.cat(
            [
                state.base_quaternion_w,
                state.base_linear_velocity_w,
                state.base_angular_velocity_b,
                state.joint_position,
                state.joint_velocity,
                state.joint_torque,
                state.foot_position_w.flatten(1),
                state.foot_velocity_w.flatten(1),
                state.foot_contact_force_w.flatten(1),
                state.body_contact_force_w.flatten(1),
                state.ground_moment_w,
            ],
            dim=1,
        )
        flags["overflowed"] |= state.overflowed
        flags["diverged"] |= state.diverged
        mask = (torch.rand(worlds, device=device) < RESET_SHARE) | state.diverged
        reset(mask)
        # mujoco-warp takes a row for every world with a mask, without asking the GPU how many it selects
        random_parameters(mask if name == "mujoco-warp" else None)
        return observation.abs().mean()

    reset(None)
    masses = Randomization(
        base_mass_offset=2.0 * torch.rand(worlds, device=device) - 1.0,
        base_com_offset=0.06 * torch.rand((worlds, 3), device=device) - 0.03,
        link_mass_scale=0.9 + 0.2 * torch.rand((worlds, len(robot.collision_bodies)), device=device),
    )
    backend.randomize(masses)
    random_parameters(None)
    for _ in range(WARMUP if gpu else 2):
        control_step()
    synchronize()
    start = perf_counter()
    for _ in range(steps):
        mean = control_step()
    synchronize()
    seconds = perf_counter() - start
    used = free_before - free()
    targets = pose.repeat(worlds, 1)
    start = perf_counter()
    for _ in range(steps):
        backend.step(targets)
    synchronize()
    physics_seconds = perf_counter() - start
    return {
        "backend": name,
        "ground": ground,
        "worlds": worlds,
        "steps": steps,
        "control_steps_per_second": worlds * steps / seconds,
        "control_steps_per_second_without_resets": worlds * steps / physics_seconds,
        "milliseconds_per_control_step": 1e3 * seconds / steps,
        "build_seconds": build_seconds,
        "bytes_per_world": used / worlds,
        "overflowed_share": float(flags["overflowed"].float().mean()),
        "diverged_share": float(flags["diverged"].float().mean()),
        "mean_observation": float(mean),
    }


def in_own_process(name: str, ground: str, worlds: int, device: str, steps: int) -> dict:
    """Run ``measure`` in a fresh interpreter; a configuration that fails is a row with its error."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "row.json"
        command = [sys.executable, __file__, "--single", ground, str(worlds), "--device", device, "--steps", str(steps)]
        command += ["--backend", name]
        done = subprocess.run(
            [*command, "--out", str(out)], capture_output=True, text=True, env=os.environ, check=False
        )
        if out.exists():
            return json.loads(out.read_text())
        reason = (done.stderr.strip() or done.stdout.strip() or f"exit status {done.returncode}").splitlines()[-1]
        return {"backend": name, "ground": ground, "worlds": worlds, "error": reason}


def hardware(device: str) -> dict:
    """What the numbers were measured on."""
    import torch

    packages = ("torch", "warp-lang", "mujoco", "mujoco-warp", "newton")
    entry = {"python": platform.python_version(), "versions": {p: version(p) for p in packages}}
    entry["device"] = torch.cuda.get_device_name(device) if device.startswith("cuda") else platform.processor()
    return entry


def plot_memory(sources: list[Path], target: Path) -> None:
    """Draw memory for each world over the number of worlds, one line for each engine and ground, as an SVG.

    Raises:
        SystemExit: no source has a measured row.
    """
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams["svg.hashsalt"] = "gaitgauge"  # the same file each time
    from matplotlib import pyplot

    lines: dict[str, dict[int, float]] = {}
    devices = []
    for source in sources:
        content = json.loads(source.read_text())
        devices.append(content["hardware"]["device"])
        for row in content["rows"]:
            if row.get("bytes_per_world"):
                label = f"{row.get('backend', 'mujoco-warp')}, {row['ground']}"
                lines.setdefault(label, {})[row["worlds"]] = row["bytes_per_world"] / 1e3
    if not lines:
        raise SystemExit(f"no memory was measured in {', '.join(map(str, sources))}")
    figure, axes = pyplot.subplots(figsize=(6.0, 3.6), layout="constrained")
    for label, points in sorted(lines.items()):
        worlds = sorted(points)
        axes.plot(worlds, [points[n] for n in worlds], marker="o", label=label)
    axes.set_xscale("log", base=2)
    ticks = sorted({n for points in lines.values() for n in points})
    axes.set_xticks(ticks, [f"{n:,}" for n in ticks])
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("worlds")
    axes.set_ylabel("memory for each world [kB]")
    axes.set_title(", ".join(sorted(set(devices))))
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(target, metadata={"Date": None})
    pyplot.close(figure)


def main() -> None:
    """Measure all configurations asked for, print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", nargs="+", default=["mujoco-warp"], help="engines")
    parser.add_argument("--worlds", type=int, nargs="+", default=list(SIZES), help="numbers of worlds")
    parser.add_argument("--ground", nargs="+", choices=GROUNDS, default=["boxes", "field"], help="kinds of ground")
    parser.add_argument("--steps", type=int, default=200, help="control steps to time")
    parser.add_argument("--device", default="cuda", help="cuda, cuda:1 or cpu")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument(
        "--single", nargs=2, metavar=("GROUND", "WORLDS"), help="measure one configuration in this process"
    )
    parser.add_argument(
        "--plot",
        type=Path,
        nargs="+",
        metavar="FILE",
        help="draw memory into the first file (SVG) from the others (JSON)",
    )
    arguments = parser.parse_args()
    if arguments.plot:
        if len(arguments.plot) < 2:
            parser.error("--plot needs the SVG file to write and at least one JSON file to read")
        plot_memory(arguments.plot[1:], arguments.plot[0])
        return
    if arguments.single:
        ground, worlds = arguments.single[0], int(arguments.single[1])
        row = measure(arguments.backend[0], ground, worlds, arguments.device, arguments.steps)
        text = json.dumps(row)
        if arguments.out is None:
            print(text)
        else:
            arguments.out.write_text(text)
        return
    print(
        f"{'backend':12} {'ground':8} {'worlds':>7} {'M control steps/s':>18} {'physics alone':>15} {'kB/world':>9} {'overflowed':>11}"
    )
    rows = []
    for name, ground, worlds in product(arguments.backend, arguments.ground, arguments.worlds):
        row = in_own_process(name, ground, worlds, arguments.device, arguments.steps)
        rows.append(row)
        if "error" in row:
            print(f"{name:12} {ground:8} {worlds:7} {row['error']}", flush=True)
            continue
        rate, alone = row["control_steps_per_second"] / 1e6, row["control_steps_per_second_without_resets"] / 1e6
        memory = row["bytes_per_world"] / 1e3
        share = row["overflowed_share"]
        print(f"{name:12} {ground:8} {worlds:7} {rate:18.3f} {alone:15.3f} {memory:9.1f} {share:11.2%}", flush=True)
        if arguments.out is not None:
            arguments.out.write_text(json.dumps({"hardware": hardware(arguments.device), "rows": rows}, indent=2))


if __name__ == "__main__":
    main()
