"""How near mujoco_warp's Newton solver comes to the exact solution in one physics step, and with how many iterations.

    python benchmarks/solver_accuracy.py                   # robots that walk, and robots thrown over
    python benchmarks/solver_accuracy.py --worlds 20 --states 2

One robot stands on each terrain and level of the gauge (or on the first ``--worlds`` of them), walks with the shipped
policy, half of them thrown over. At some states one physics step of the suite ``robogauge-1.1`` is done again and again
with other solver settings, always from the same positions, velocities and warm start. The constraint problem that
mujoco_warp set up is solved in float64 besides, by Newton's method with an exact line search. Printed is the error of the
velocity after the step: by how much the solver alone is off. ``contact_accuracy.py`` compares what walking robots feel. Runs on the CPU.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco_warp
import numpy as np
import torch
from mujoco_warp._src.types import ConstraintType

SETTINGS = [(100, 1e-6), (20, 1e-6), (10, 1e-6), (6, 1e-6), (100, 1e-5), (100, 1e-4), (100, 1e-3), (100, 1e-8)]
"""Largest number of iterations, and tolerance."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """min ½ (a - a₀)ᵀ M (a - a₀) + Σ s(J a - r) over accelerations a, with mujoco_warp's rows. V velocities, R rows."""

    mass: np.ndarray
    """M, (V, V)."""
    smooth: np.ndarray
    """M a₀, (V,)."""
    jacobian: np.ndarray
    """J, (R, V)."""
    reference: np.ndarray
    """r, (R,)."""
    stiffness: np.ndarray
    """(R,)."""
    dry: np.ndarray
    """Largest dry-friction force of rows that are such, infinity for two-sided and NaN for one-sided rows, (R,)."""
    cones: list[tuple[np.ndarray, np.ndarray, float]]
    """Rows, friction coefficients and scaled sliding coefficient of each contact with an elliptic cone."""

    def force(self, slack: np.ndarray) -> np.ndarray:
        """Constraint forces at J a - r."""
        force = -self.stiffness * slack
        one_sided = np.isnan(self.dry)
        force = np.where(one_sided, np.maximum(force, 0.0), np.clip(force, -self.dry, self.dry))
        for rows, friction, mu in self.cones:
            force[rows] = cone_force(slack[rows], self.stiffness[rows], friction, mu)
        return force

    def gradient(self, acceleration: np.ndarray) -> np.ndarray:
        """Of the cost."""
        slack = self.jacobian @ acceleration - self.reference
        return self.mass @ acceleration - self.smooth - self.jacobian.T @ self.force(slack)

    def hessian(self, acceleration: np.ndarray) -> np.ndarray:
        """Of the cost; the cones' by central differences."""
        slack = self.jacobian @ acceleration - self.reference
        linear = np.where(np.isnan(self.dry), slack < 0.0, np.abs(self.stiffness * slack) < self.dry)
        for rows, _, _ in self.cones:
            linear[rows] = False
        hessian = self.mass + (self.jacobian[linear].T * self.stiffness[linear]) @ self.jacobian[linear]
        for rows, friction, mu in self.cones:
            step = 1e-6 * max(1.0, np.abs(slack[rows]).max())
            moved = [slack[rows] + sign * step * np.eye(len(rows)) for sign in (1.0, -1.0)]
            ahead, behind = (
                np.array([cone_force(s, self.stiffness[rows], friction, mu) for s in each]) for each in moved
            )
            slope = (behind - ahead) / (2.0 * step)
            hessian += self.jacobian[rows].T @ (0.5 * (slope + slope.T)) @ self.jacobian[rows]
        return hessian

    def solve(self, start: np.ndarray) -> np.ndarray:
        """The accelerations of least cost, (V,).

        Raises:
            RuntimeError: the method did not get there.
        """
        acceleration = start.astype(np.float64)
        for _ in range(200):
            direction = -np.linalg.solve(self.hessian(acceleration), self.gradient(acceleration))
            low, high = 0.0, 1.0
            while self.gradient(acceleration + high * direction) @ direction < 0.0 and high < 1e3:
                high *= 2.0
            for _ in range(60):
                middle = 0.5 * (low + high)
                downhill = self.gradient(acceleration + middle * direction) @ direction < 0.0
                low, high = (middle, high) if downhill else (low, middle)
            acceleration = acceleration + high * direction
            if np.linalg.norm(high * direction) < 1e-8:
                return acceleration
        raise RuntimeError("the float64 solver did not converge")


def cone_force(slack: np.ndarray, stiffness: np.ndarray, friction: np.ndarray, mu: float) -> np.ndarray:
    """Force of one contact with MuJoCo's elliptic cone, normal first."""
    normal, tangent = mu * slack[0], friction * slack[1:]
    length = float(np.linalg.norm(tangent))
    if normal >= mu * length:
        return np.zeros_like(slack)
    if mu * normal + length <= 0.0:
        return -stiffness * slack
    press = -stiffness[0] / (mu * mu * (1.0 + mu * mu)) * (normal - mu * length) * mu
    return np.concatenate([[press], -press / length * tangent * friction])


def problems(backend: Any) -> list[Problem | None]:
    """The constraint problem of each world's last step; None where there is no constraint."""
    model, data = backend._model, backend._data
    names = ("J", "aref", "D", "frictionloss", "type", "id")
    rows = {name: getattr(data.efc, name).numpy() for name in names}
    address, dimension = data.contact.efc_address.numpy(), data.contact.dim.numpy()
    friction, ratio = data.contact.friction.numpy().astype(np.float64), backend.scene.physics.impratio
    counts, smooth, packed = data.nefc.numpy(), data.qfrc_smooth.numpy(), data.M.numpy().reshape(data.nworld, -1)
    entries, starts, columns = model.M_rownnz.numpy(), model.M_rowadr.numpy(), model.M_colind.numpy()
    size, found = model.nv, []
    for world in range(data.nworld):
        count = int(counts[world])
        if count == 0:
            found.append(None)
            continue
        mass = np.zeros((size, size))
        for i in range(size):
            place = slice(starts[i], starts[i] + entries[i])
            mass[i, columns[place]] = mass[columns[place], i] = packed[world, place]
        kind, id_ = rows["type"][world, :count], rows["id"][world, :count]
        dry = np.full(count, np.nan)
        dry[kind == ConstraintType.FRICTION_DOF] = rows["frictionloss"][world, :count][
            kind == ConstraintType.FRICTION_DOF
        ]
        cones = []
        for row in np.flatnonzero(kind == ConstraintType.CONTACT_ELLIPTIC):
            contact = id_[row]
            if address[contact, 0] == row:
                of, own = address[contact, : dimension[contact]], friction[contact, : dimension[contact] - 1]
                cones.append((of, own, float(own[0] / np.sqrt(ratio))))
        found.append(
            Problem(
                mass=mass,
                smooth=smooth[world, :size].astype(np.float64),
                jacobian=rows["J"][world, :count, :size].astype(np.float64),
                reference=rows["aref"][world, :count].astype(np.float64),
                stiffness=rows["D"][world, :count].astype(np.float64),
                dry=dry,
                cones=cones,
            )
        )
    return found


def walkers(worlds: int) -> Any:
    """Robots on all terrains of the gauge, from ``warp_profile.py``."""
    path = Path(__file__).with_name("warp_profile.py")
    spec = importlib.util.spec_from_file_location("warp_profile", path)
    assert spec is not None and spec.loader is not None
    profile = importlib.util.module_from_spec(spec)
    sys.modules["warp_profile"] = profile
    spec.loader.exec_module(profile)
    return profile.Walkers(profile.Case(scene="gauge-all", worlds=worlds), "pretrained", "cpu")


def main(argv: list[str] | None = None) -> None:
    """Walk, solve and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=61, help="robots")
    parser.add_argument("--states", type=int, default=12, help="states looked at, one control period apart")
    parser.add_argument("--walk", type=int, default=30, help="control periods walked before")
    arguments = parser.parse_args(argv)
    crowd = walkers(arguments.worlds)
    backend, motion = crowd.backend, crowd.backend._motion
    thrown = torch.arange(arguments.worlds) % 2 == 1
    backend.push(thrown, angular_velocity_b=6.0 * torch.randn(arguments.worlds, 3))
    for _ in range(arguments.walk):
        crowd.step(sampled=False)
    timestep = backend.scene.physics.timestep
    moving = [motion.qpos, motion.qvel, motion.warmstart]
    errors: dict[Any, list] = {s: [] for s in SETTINGS}
    iterations: dict[Any, list] = {s: [] for s in SETTINGS}
    for _ in range(arguments.states):
        crowd.step(sampled=False)
        before = [a.numpy().copy() for a in moving]
        exact: list[np.ndarray | None] = []
        for setting in SETTINGS:
            for array, values in zip(moving, before, strict=True):
                array.assign(values)
            backend._model.opt.iterations = setting[0]
            backend._model.opt.tolerance.fill_(setting[1])
            mujoco_warp.step(backend._model, backend._data)
            found = backend._data.qacc.numpy().astype(np.float64)[:, : backend._model.nv]
            if not exact:
                each = zip(problems(backend), found, strict=True)
                exact = [None if p is None else p.solve(start) for p, start in each]
            iterations[setting].extend(backend._data.solver_niter.numpy())
            for one, other in zip(found, exact, strict=True):
                if other is not None:
                    off = timestep * np.abs(one - other)
                    errors[setting].append((off[:3].max(), off[6:].max()))
        for array, values in zip(moving, before, strict=True):
            array.assign(values)
        backend._model.opt.iterations = backend.scene.physics.iterations
    print("                       off: base velocity [m/s]       joint velocity [rad/s]             iterations")
    print("iterations tolerance    median    99 %      most    median    99 %      most     mean   99 %   most")
    for setting in SETTINGS:
        base, joints = np.array(errors[setting]).T
        used = np.array(iterations[setting])
        values = [f(e) for e in (base, joints) for f in (np.median, lambda e: np.quantile(e, 0.99), np.max)]
        text = " ".join(f"{v:9.1e}" for v in values)
        print(
            f"{setting[0]:10} {setting[1]:9.0e} {text} {used.mean():8.2f} {np.quantile(used, 0.99):6.0f} {used.max():6}"
        )


if __name__ == "__main__":
    main()
