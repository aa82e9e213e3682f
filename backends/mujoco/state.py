"""Read a ``PhysicsState`` out of MuJoCo's arrays: poses and velocities as views, contact forces computed at the first access."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from ..base import PhysicsState, Scene
from .model import FOOT_SITE, slots_per_shape

RECORDED = ("qpos", "qvel", "sensordata", "actuator_force", "site_xpos")
"""Arrays recorded after each substep. Only qpos and qvel are new; the others belong to the substep's beginning."""

Records = dict[str, NDArray[np.float64]]
"""Arrays (rows, substeps, …) by the names in ``RECORDED``."""

_FLAGS = {"tilt_substep": np.int64, "penetration_substep": np.int64, "diverged": np.bool_, "overflowed": np.bool_}


class StateLayout:
    """Places of the robot's joints, feet and sensors in MuJoCo's arrays."""

    def __init__(self, model: mujoco.MjModel, scene: Scene) -> None:
        robot = scene.robot
        self.timestep = scene.physics.timestep
        self.joint_q = _as_slice(np.array([model.joint(j).qposadr[0] for j in robot.joint_names]))
        self.joint_v = _as_slice(np.array([model.joint(j).dofadr[0] for j in robot.joint_names]))
        self.foot_sites = np.array([model.site(FOOT_SITE.format(f)).id for f in robot.foot_names])

        def columns(name: str) -> NDArray[np.int64]:
            sensor = model.sensor(name)
            return np.arange(sensor.adr[0], sensor.adr[0] + sensor.dim[0])

        self.foot_velocity = np.stack([columns(f"velocity_{f}") for f in robot.foot_names])
        self.foot_net = np.stack([columns(f"net_{shape}") for shape in robot.foot_geoms])
        self.foot_each = np.stack([columns(f"each_{shape}") for shape in robot.foot_geoms])
        self.shape_slots = slots_per_shape(model, robot)
        # the first shape of each foot; None where a foot has one shape
        starts = np.cumsum([0, *map(len, robot.soles)])[:-1]
        self.sole_starts = starts if len(robot.foot_geoms) > len(robot.soles) else None
        self.body_net = np.stack([columns(f"body_{b}") for b in robot.collision_bodies])
        self.trunk_net = np.stack([columns(f"trunk_{shape}") for shape in robot.trunk_shapes])
        self.ground = columns("ground_net")
        self.points = columns("ground_each").reshape(-1, 7)
        self.penetration = int(columns("penetration")[1]) if scene.physics.watch_penetration is not None else None
        # a foot's body reports the foot's force too, which is subtracted there
        bodies = {model.body(b).id: i for i, b in enumerate(robot.collision_bodies)}
        owners = [(foot, bodies.get(model.geom(sole[0]).bodyid[0])) for foot, sole in enumerate(robot.soles)]
        self.foot_owner = [(foot, owner) for foot, owner in owners if owner is not None]

    def by_foot(self, of_shapes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum values of the feet's shapes, (N, G, …), over each foot, (N, F, …)."""
        return of_shapes if self.sole_starts is None else np.add.reduceat(of_shapes, self.sole_starts, axis=1)


class BatchState(PhysicsState):
    """State of all worlds over MuJoCo's arrays ``time``, ``qpos``, ``qvel``, ``torque``, ``sites`` and ``sensors``."""

    def __init__(self, layout: StateLayout, arrays: Mapping[str, NDArray[np.float64]]) -> None:
        self._layout, self._arrays = layout, arrays
        n = len(arrays["time"])
        qpos, qvel = arrays["qpos"], arrays["qvel"]
        self.flags: dict[str, NDArray] = {name: np.zeros(n, kind) for name, kind in _FLAGS.items()}
        self._has_forces = np.zeros(n, dtype=bool)
        self._complete = True
        self._computed: dict[str, torch.Tensor] = {}
        self.time = torch.from_numpy(arrays["time"])
        self.base_position_w = torch.from_numpy(qpos[:, 0:3])
        self.base_quaternion_w = torch.from_numpy(qpos[:, 3:7])
        self.base_linear_velocity_w = torch.from_numpy(qvel[:, 0:3])
        self.base_angular_velocity_b = torch.from_numpy(qvel[:, 3:6])
        if isinstance(layout.joint_q, slice) and isinstance(layout.joint_v, slice):
            self.joint_position = torch.from_numpy(qpos[:, layout.joint_q])
            self.joint_velocity = torch.from_numpy(qvel[:, layout.joint_v])
        for name, array in self.flags.items():
            setattr(self, name, torch.from_numpy(array))

    def __getattr__(self, name: str) -> torch.Tensor:
        # reached only for fields computed on demand
        if name.startswith("_") or name not in _FIELDS:
            raise AttributeError(name)
        if name not in self._computed:
            compute = self._compute_torque if name == "joint_torque" else self._compute
            self._computed |= {k: torch.from_numpy(v) for k, v in compute().items()}
        return self._computed[name]

    def renew(self, rows: slice | NDArray[np.int64]) -> None:
        """Discard computed fields after a step of some worlds."""
        self._computed = {}
        if not self._complete:
            self._has_forces[rows] = True
            self._complete = bool(self._has_forces.all())

    def forget_forces(self, rows: NDArray[np.int64]) -> None:
        """Zero the forces of worlds after a reset, until their next step."""
        self._computed = {}
        self._has_forces[rows] = False
        self._complete = False

    def take(self, now: BatchState, rows: NDArray[np.int64], records: Records, at: NDArray[np.int64]) -> None:
        """Become, for the stepped worlds ``rows``, the state after substep ``at``, (rows,) from 1, 0 for none, of the step to ``now``."""
        self._computed = {}
        wanted = np.flatnonzero(at > 0)
        worlds, step = rows[wanted], at[wanted]
        last = records["qpos"].shape[1]
        mine, live = self._arrays, now._arrays
        # a substep records the positions that the substep before has led to
        following, final = np.minimum(step, last - 1), step == last
        velocity = self._layout.foot_velocity
        mine["qpos"][worlds] = records["qpos"][wanted, step - 1]
        mine["qvel"][worlds] = records["qvel"][wanted, step - 1]
        mine["torque"][worlds] = records["actuator_force"][wanted, step - 1]
        mine["sensors"][worlds] = records["sensordata"][wanted, step - 1]
        last_one, later = final[:, None, None], records["sensordata"][wanted, following]
        speeds = np.where(last_one, live["sensors"][worlds][:, velocity], later[:, velocity])
        for foot, columns in enumerate(velocity):
            mine["sensors"][worlds[:, None], columns] = speeds[:, foot]
        mine["sites"][worlds] = np.where(last_one, live["sites"][worlds], records["site_xpos"][wanted, following])
        mine["time"][worlds] = live["time"][worlds] - (last - step) * self._layout.timestep
        for name, flag in self.flags.items():
            flag[worlds] = now.flags[name][worlds]
        self._has_forces[worlds] = True
        self._complete = bool(self._has_forces.all())

    def clone(self) -> PhysicsState:
        """Copy every tensor."""
        return PhysicsState(**{name: getattr(self, name).clone() for name in _FIELDS})

    def _compute_torque(self) -> dict[str, NDArray]:
        """Compute the motor torques."""
        torque = self._arrays["torque"].copy()
        if not self._complete:
            torque[~self._has_forces] = 0
        return {"joint_torque": torque}

    def _compute(self) -> dict[str, NDArray]:
        """Compute contacts, feet, and joints that do not lie side by side."""
        layout, sensors = self._layout, self._arrays["sensors"]
        n = len(sensors)
        # MuJoCo reports the force of the first object on the second: the robot's on the ground
        feet = layout.by_foot(-sensors[:, layout.foot_net])
        each = sensors[:, layout.foot_each].reshape(n, -1, layout.shape_slots, 3)
        bodies = -sensors[:, layout.body_net]
        for foot, owner in layout.foot_owner:
            bodies[:, owner] -= feet[:, foot]
        ground = sensors[:, layout.ground]
        force = -ground[:, 0:3]
        points = sensors[:, layout.points]
        active = points[:, :, 1] > 0
        count = active.sum(1)
        center = (points[:, :, 4:7] * active[..., None]).sum(1) / np.maximum(count, 1)[:, None]
        out = {
            "foot_contact_force_w": feet,
            "foot_normal_force": layout.by_foot(each[..., 0].sum(-1)),
            "foot_tangential_force": layout.by_foot(np.hypot(each[..., 1], each[..., 2]).sum(-1)),
            "body_contact_force_w": bodies,
            "trunk_contact_force_w": -sensors[:, layout.trunk_net].sum(1),
            "ground_force_w": force,
            "ground_moment_w": -ground[:, 3:6] + np.cross(ground[:, 6:9] - center, force),
            "contact_center_w": center,
            "contact_count": count.astype(np.int64),
        }
        if not self._complete:
            for array in out.values():
                array[~self._has_forces] = 0
        out["foot_position_w"] = self._arrays["sites"][:, layout.foot_sites]
        out["foot_velocity_w"] = sensors[:, layout.foot_velocity]
        out["joint_position"] = self._arrays["qpos"][:, layout.joint_q]
        out["joint_velocity"] = self._arrays["qvel"][:, layout.joint_v]
        return out


_FIELDS = tuple(item.name for item in fields(PhysicsState))


def _as_slice(index: NDArray[np.int64]) -> slice | NDArray[np.int64]:
    """Return consecutive indices as a slice, which gives views; other indices as they are."""
    if (np.diff(index) == 1).all():
        return slice(int(index[0]), int(index[-1]) + 1)
    return index
