"""The solver in one kernel beside mujoco_warp's own, on robots that walk in training's worlds: time and results.

    python benchmarks/solver_speed.py --worlds 16384 --out solver.json
    python benchmarks/solver_speed.py --device cpu --worlds 8 --steps 2 --walk 5

For each kind of contact: milliseconds of a control period (the solvers in turn, twice), milliseconds that the solve takes of a
substep (its kernels in a CUDA graph), and, for one state, by how much acceleration and forces differ, relative to a world's largest,
whether states of rows and numbers of iterations do, and whether the solver repeats itself to the last bit.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco_warp
import torch
import warp as wp
from gaitgauge.backends.base import PhysicsOptions
from gaitgauge.backends.upstream.fused_solver.solve import knows, plain_solve, solve
from mujoco_warp._src import solver
from warp_profile import SCENES, Case, Walkers, measure

SOLVERS: dict[str, Callable[..., None]] = {"mujoco_warp": plain_solve, "one kernel": solve}
CONTACTS: dict[str, dict[str, Any]] = {
    "training": {},
    "torsion": {"foot_condim": 4},
    "cones": {"cone": "elliptic", "impratio": 10.0, "foot_condim": 4},
    "cones, 10 iterations": {"cone": "elliptic", "impratio": 10.0, "foot_condim": 4, "iterations": 10},
    "cones, 20 iterations": {"cone": "elliptic", "impratio": 10.0, "foot_condim": 4, "iterations": 20},
}
"""Kinds of contact: changes of the training physics."""
_LAUNCHES = 40
"""Of a graph, for a time."""


@dataclass(frozen=True, kw_only=True)
class ContactCase(Case):
    """A case with contacts of its own."""

    contacts: str

    def physics(self) -> PhysicsOptions:
        """The options of the scene's physics with these contacts."""
        return replace(super().physics(), **CONTACTS[self.contacts])


def use(walkers: Walkers, function: Callable[..., None]) -> None:
    """Let the engine solve with this function from now on."""
    solver.solve = function
    walkers.backend._graphs.clear()


def substep_milliseconds(walkers: Walkers, function: Callable[..., None]) -> float:
    """Of a solve alone, with the constraints as they are."""
    model, data = walkers.backend._model, walkers.backend._data
    with walkers.backend._scope():
        if walkers.device.type != "cuda":
            began = time.perf_counter()
            function(model, data)
            return 1e3 * (time.perf_counter() - began)
        stream = wp.Stream(wp.device_from_torch(walkers.device))
        with wp.ScopedStream(stream):
            function(model, data)
            with wp.ScopedCapture(stream=stream) as capture:
                function(model, data)
            wp.capture_launch(capture.graph)
            wp.synchronize_stream(stream)
            began = time.perf_counter()
            for _ in range(_LAUNCHES):
                wp.capture_launch(capture.graph)
            wp.synchronize_stream(stream)
            return 1e3 * (time.perf_counter() - began) / _LAUNCHES


def differences(walkers: Walkers) -> dict[str, float]:
    """Both solvers on the state that the robots are in."""
    model, data = walkers.backend._model, walkers.backend._data
    names = {"acceleration": data.qacc, "constraint force": data.qfrc_constraint, "row force": data.efc.force}
    found: dict[str, dict[str, torch.Tensor]] = {}
    with walkers.backend._scope():
        solver.solve = lambda model, data: None
        mujoco_warp.forward(model, data)  # all but the solve
        rows = wp.to_torch(data.nefc)
        used = torch.arange(data.njmax, device=rows.device) < rows[:, None]
        for label, function in (*SOLVERS.items(), ("again", solve)):
            for array in names.values():
                array.fill_(float("nan"))
            function(model, data)
            found[label] = {name: wp.to_torch(array).clone() for name, array in names.items()}
            found[label] |= {
                "iterations": wp.to_torch(data.solver_niter).clone(),
                "state": wp.to_torch(data.efc.state).clone()[:, : data.njmax],
            }
            found[label]["row force"].masked_fill_(~used, 0.0)
    plain, own, again = (found[label] for label in (*SOLVERS, "again"))
    result = {"known": float(knows(model, data)), "rows": float(rows.float().mean())}
    for name in names:
        size = plain[name].abs().amax(1).clamp(min=1.0)
        off = ((own[name] - plain[name]).abs().amax(1) / size).float()
        result[f"{name}, 99 %"] = float(off.quantile(0.99))
        result[f"{name}, most"] = float(off.max())
        result["repeats"] = float(result.get("repeats", 1.0) and bool((own[name] == again[name]).all()))
    result["states that differ"] = float(((plain["state"] != own["state"]) & used).sum() / used.sum())
    result["iterations"] = float(own["iterations"].float().mean())
    result["iterations that differ"] = float((plain["iterations"] != own["iterations"]).float().mean())
    return result


def main() -> None:
    """Measure each kind of contact, print a table, save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default="pretrained")
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--scene", default="tiles-mix", choices=SCENES)
    parser.add_argument("--worlds", type=int, default=16384)
    parser.add_argument("--contacts", nargs="+", choices=CONTACTS, default=list(CONTACTS))
    parser.add_argument("--walk", type=int, default=40, help="control steps before anything is measured")
    parser.add_argument("--steps", type=int, default=20, help="control steps of each measurement")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for contacts in options.contacts:
        walkers = Walkers(
            case := ContactCase(scene=options.scene, worlds=options.worlds, contacts=contacts),
            options.policy,
            options.device,
        )
        for _ in range(options.walk):
            walkers.step(sampled=False)
        times: dict[str, list[float]] = {label: [] for label in SOLVERS}
        for _ in range(2):
            for label, function in SOLVERS.items():
                use(walkers, function)
                times[label].append(measure(walkers, case, options.steps)["milliseconds"])
        row: dict[str, Any] = {"contacts": contacts, "worlds": options.worlds, "period": times}
        row["solve"] = {label: substep_milliseconds(walkers, function) for label, function in SOLVERS.items()}
        row |= differences(walkers)
        rows.append(row)
        print(f"{contacts}: {row['rows']:.1f} rows, {row['iterations']:.2f} iterations", flush=True)
        for label in SOLVERS:
            every = ", ".join(f"{value:.2f}" for value in times[label])
            print(
                f"  {label:<12} control period {statistics.fmean(times[label]):7.2f} ms ({every}), "
                f"solve {row['solve'][label]:.3f} ms",
                flush=True,
            )
        told = ("acceleration", "constraint force", "row force")
        print(
            "  differ by", "; ".join(f"{n} {row[f'{n}, 99 %']:.1e}, {row[f'{n}, most']:.1e}" for n in told), flush=True
        )
        print(
            f"  states {row['states that differ']:.1e}, iterations {row['iterations that differ']:.1e}, "
            f"repeats itself: {bool(row['repeats'])}",
            flush=True,
        )
    if options.out:
        options.out.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
