"""The reference engine: MuJoCo on the CPU, many worlds on a thread pool (``mujoco.batch.Batch``), float64, bit-reproducible.

Every world runs on a model of its own, a copy of its terrain's, so that friction, masses and gains can differ. The motor
law is an affine actuator inside the model and is therefore evaluated at every physics step. After a step, positions and
velocities are those of the new state, forces those of the step just taken; the penetration watch sees the contacts with
which each substep started.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import fields
from typing import ClassVar

import mujoco
import mujoco.batch
import numpy as np
import torch
from numpy.typing import NDArray

from .base import (
    CAPABILITY_NAMES,
    BackendError,
    Capability,
    PhysicsBackend,
    PhysicsState,
    Randomization,
    Scene,
    Support,
)
from .mujoco_model import CONTACT_SLOTS, FOOT_SLOTS, build_models

_STAGE = mujoco.mjtStage.mjSTAGE_VEL.value
_INVALID = [
    w.value
    for w in (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
]
_FULL = [w.value for w in (mujoco.mjtWarning.mjWARN_CONTACTFULL, mujoco.mjtWarning.mjWARN_CNSTRFULL)]

Array = NDArray[np.float64]


class MujocoBackend(PhysicsBackend):
    """MuJoCo (C engine) on the CPU. Results do not depend on the number of threads nor on the other worlds."""

    name: ClassVar[str] = "mujoco"

    @classmethod
    def capabilities(cls) -> Mapping[str, Capability]:
        """Exact in everything but GPU execution."""
        exact = {name: Capability(support=Support.EXACT) for name in CAPABILITY_NAMES}
        exact["gpu"] = Capability(support=Support.NONE, note="runs on CPU threads")
        exact["penetration"] = Capability(support=Support.EXACT, note="seen one substep late")
        exact["contact_forces"] = Capability(
            support=Support.EXACT, note=f"single points of the {CONTACT_SLOTS} strongest contacts, {FOOT_SLOTS} for each foot"
        )
        return exact

    def __init__(self, scene: Scene, *, device: str = "cpu", threads: int = 1) -> None:
        if torch.device(device).type != "cpu":
            raise BackendError(f"backend 'mujoco' runs on the CPU, not on device '{device}'; use --device cpu, or mujoco-warp")
        self.scene = scene
        self.device = torch.device("cpu")
        self.dtype = torch.float64
        n, robot = scene.num_worlds, scene.robot
        self._palette = build_models(scene)
        self._terrain = np.asarray(scene.terrain_index, dtype=np.int64)
        nominal = self._palette[0]
        self._models = [copy.copy(self._palette[t]) for t in self._terrain]
        self._batch = mujoco.batch.Batch(nominal, n, threads, True)
        self._batch.set_models(self._models)
        self._qpos, self._qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._ctrl, self._applied = self._batch.bind("ctrl"), self._batch.bind("xfrc_applied")
        self._time = self._batch.bind("time")
        self._torque = self._batch.bind("actuator_force")
        self._sites = self._batch.bind("site_xpos")
        self._sensors = self._batch.bind("sensordata")
        self._index_model(nominal)
        self._randomized: dict[int, dict[str, Array]] = {}
        joints = robot.num_joints
        self._held = np.zeros((n, joints))
        self._offset = np.zeros((n, joints))
        self._limp = np.ones(n, dtype=bool)
        self._kd_over_kp = np.zeros((n, joints))
        self._update_gain_ratio(range(n))
        self._warned = np.zeros((n, 2), dtype=np.int64)
        self._state, self._state_arrays = self._allocate()
        self._sample, self._sample_arrays = self._allocate()
        stand = torch.tensor([0.0, 0.0, robot.stand_height], dtype=torch.float64).repeat(n, 1)
        self.reset(base_position=stand, base_quaternion=torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).repeat(n, 1))

    # ---- layout -------------------------------------------------------------------------------------------------

    def _index_model(self, model: mujoco.MjModel) -> None:
        """Find where the robot's joints, feet and sensors lie in MuJoCo's arrays."""
        robot = self.scene.robot
        free = model.joint(model.body(robot.base_body).jntadr[0])
        self._base = model.body(robot.base_body).id
        if free.type[0] != mujoco.mjtJoint.mjJNT_FREE or free.qposadr[0] != 0:
            raise BackendError(f"body '{robot.base_body}' of robot '{robot.name}' must carry a free joint and come first")
        self._joint_q = np.array([model.joint(j).qposadr[0] for j in robot.joint_names])
        self._joint_v = np.array([model.joint(j).dofadr[0] for j in robot.joint_names])
        self._foot_sites = np.array([model.site(f).id for f in robot.foot_names])
        self._bodies = np.array([model.body(b).id for b in robot.collision_bodies])

        def columns(name: str) -> NDArray[np.int64]:
            sensor = model.sensor(name)
            return np.arange(sensor.adr[0], sensor.adr[0] + sensor.dim[0])

        self._at_velocity = np.stack([columns(f"velocity_{f}") for f in robot.foot_names])
        self._at_net = np.stack([columns(f"net_{f}") for f in robot.foot_names])
        self._at_each = np.stack([columns(f"each_{f}") for f in robot.foot_names])
        self._at_body = np.stack([columns(f"body_{b}") for b in robot.collision_bodies])
        self._at_ground = columns("ground_net")
        self._at_points = columns("ground_each").reshape(CONTACT_SLOTS, 7)
        watched = self.scene.physics.watch_penetration is not None
        self._at_penetration = columns("penetration") if watched else None
        # the body that a foot geom belongs to reports its force too: it is subtracted there
        owner = [model.geom(f).bodyid[0] for f in robot.foot_names]
        self._foot_owner = [int(np.flatnonzero(self._bodies == o)[0]) for o in owner]

    def _allocate(self) -> tuple[PhysicsState, dict[str, NDArray]]:
        """A state of zeros, and the numpy views of its tensors."""
        n, robot = self.num_worlds, self.scene.robot
        j, f, b = robot.num_joints, len(robot.foot_names), len(robot.collision_bodies)
        shapes: dict[str, tuple[int, ...]] = {
            "base_position_w": (3,),
            "base_quaternion_w": (4,),
            "base_linear_velocity_w": (3,),
            "base_angular_velocity_b": (3,),
            "joint_position": (j,),
            "joint_velocity": (j,),
            "joint_torque": (j,),
            "foot_position_w": (f, 3),
            "foot_velocity_w": (f, 3),
            "foot_contact_force_w": (f, 3),
            "foot_normal_force": (f,),
            "foot_tangential_force": (f,),
            "body_contact_force_w": (b, 3),
            "ground_force_w": (3,),
            "ground_moment_w": (3,),
            "contact_center_w": (3,),
        }
        types = {"tilt_substep": np.int64, "penetration_substep": np.int64, "contact_count": np.int64}
        flags = ("diverged", "overflowed")
        arrays: dict[str, NDArray] = {}
        for item in fields(PhysicsState):
            kind = bool if item.name in flags else types.get(item.name, np.float64)
            arrays[item.name] = np.zeros((n, *shapes.get(item.name, ())), dtype=kind)
        return PhysicsState(**{k: torch.from_numpy(v) for k, v in arrays.items()}), arrays

    # ---- reading ------------------------------------------------------------------------------------------------

    @property
    def state(self) -> PhysicsState:
        """State after the last call; the tensors change with the next one."""
        return self._state

    @property
    def sample(self) -> PhysicsState:
        """Snapshot taken by the last ``step(sample_at=…)``."""
        return self._sample

    def _read(self, out: dict[str, NDArray], rows: NDArray[np.int64] | slice, *, forces: bool = True) -> None:
        """Write the present state of the given worlds into ``out``."""
        qpos, qvel, sensors = self._qpos[rows], self._qvel[rows], self._sensors[rows]
        out["time"][rows] = self._time[rows]
        out["base_position_w"][rows] = qpos[:, 0:3]
        out["base_quaternion_w"][rows] = qpos[:, 3:7]
        out["base_linear_velocity_w"][rows] = qvel[:, 0:3]
        out["base_angular_velocity_b"][rows] = qvel[:, 3:6]
        out["joint_position"][rows] = qpos[:, self._joint_q]
        out["joint_velocity"][rows] = qvel[:, self._joint_v]
        out["foot_position_w"][rows] = self._sites[rows][:, self._foot_sites]
        out["foot_velocity_w"][rows] = sensors[:, self._at_velocity]
        names = ("tilt_substep", "penetration_substep", "diverged", "overflowed")
        if out is not self._state_arrays:
            for name in names:
                out[name][rows] = self._state_arrays[name][rows]
        if not forces:
            for name in (
                "joint_torque",
                "foot_contact_force_w",
                "foot_normal_force",
                "foot_tangential_force",
                "body_contact_force_w",
                "ground_force_w",
                "ground_moment_w",
                "contact_center_w",
                "contact_count",
            ):
                out[name][rows] = 0
            return
        out["joint_torque"][rows] = self._torque[rows]
        # MuJoCo reports the force of the first object on the second: the robot's on the ground
        feet = -sensors[:, self._at_net]
        out["foot_contact_force_w"][rows] = feet
        each = sensors[:, self._at_each].reshape(len(feet), len(self._at_each), FOOT_SLOTS, 3)
        out["foot_normal_force"][rows] = each[..., 0].sum(-1)
        out["foot_tangential_force"][rows] = np.hypot(each[..., 1], each[..., 2]).sum(-1)
        bodies = -sensors[:, self._at_body]
        for foot, owner in enumerate(self._foot_owner):
            bodies[:, owner] -= feet[:, foot]
        out["body_contact_force_w"][rows] = bodies
        ground = sensors[:, self._at_ground]
        force = -ground[:, 0:3]
        points = sensors[:, self._at_points]
        active = points[:, :, 1] > 0
        count = active.sum(1)
        center = (points[:, :, 4:7] * active[..., None]).sum(1) / np.maximum(count, 1)[:, None]
        out["ground_force_w"][rows] = force
        out["ground_moment_w"][rows] = -ground[:, 3:6] + np.cross(ground[:, 6:9] - center, force)
        out["contact_center_w"][rows] = center
        out["contact_count"][rows] = count

    # ---- acting -------------------------------------------------------------------------------------------------

    def _rows(self, worlds: torch.Tensor | None) -> NDArray[np.int64]:
        """Indices of the masked worlds."""
        if worlds is None:
            return np.arange(self.num_worlds)
        if worlds.dtype != torch.bool or worlds.shape != (self.num_worlds,):
            raise BackendError(
                f"the mask of worlds must be {self.num_worlds} booleans, not {tuple(worlds.shape)} of {worlds.dtype}"
            )
        return np.flatnonzero(worlds.numpy())

    def reset(
        self,
        worlds: torch.Tensor | None = None,
        *,
        base_position: torch.Tensor,
        base_quaternion: torch.Tensor,
        joint_position: torch.Tensor | None = None,
        base_linear_velocity: torch.Tensor | None = None,
        base_angular_velocity: torch.Tensor | None = None,
        joint_velocity: torch.Tensor | None = None,
        held_target: torch.Tensor | None = None,
        terrain_index: torch.Tensor | None = None,
    ) -> None:
        """See ``PhysicsBackend.reset``."""
        rows = self._rows(worlds)
        if len(rows) == 0:
            return
        if terrain_index is not None:
            self._switch_terrain(rows, terrain_index.numpy())
        self._batch.reset(rows.astype(np.int32), stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        self._qpos[rows, 0:3] = base_position.numpy()[rows]
        self._qpos[rows, 3:7] = base_quaternion.numpy()[rows]
        pose = np.asarray(self.scene.robot.default_joint_position)
        self._qpos[np.ix_(rows, self._joint_q)] = pose if joint_position is None else joint_position.numpy()[rows]
        for columns, value in (
            (np.arange(0, 3), base_linear_velocity),
            (np.arange(3, 6), base_angular_velocity),
            (self._joint_v, joint_velocity),
        ):
            self._qvel[np.ix_(rows, columns)] = 0.0 if value is None else value.numpy()[rows]
        self._limp[rows] = held_target is None
        self._held[rows] = 0.0 if held_target is None else held_target.numpy()[rows]
        self._batch.forward(rows.astype(np.int32), stage=_STAGE)
        self._warned[rows] = self._warning_counts(rows)
        for name in ("diverged", "overflowed", "tilt_substep", "penetration_substep"):
            self._state_arrays[name][rows] = 0
        self._read(self._state_arrays, rows, forces=False)

    def _switch_terrain(self, rows: NDArray[np.int64], index: NDArray[np.int64]) -> None:
        """Give worlds another model of the palette, with their own randomization on it."""
        changed = [int(r) for r in rows if index[r] != self._terrain[r]]
        for r in changed:
            self._terrain[r] = index[r]
            self._models[r] = copy.copy(self._palette[index[r]])
            self._apply_randomization(r)
        if changed:
            self._batch.set_models(self._models)

    def step(
        self,
        joint_targets: torch.Tensor | None,
        *,
        delay: torch.Tensor | None = None,
        sample_at: torch.Tensor | None = None,
        worlds: torch.Tensor | None = None,
        substeps: int | None = None,
    ) -> None:
        """See ``PhysicsBackend.step``."""
        rows = self._rows(worlds)
        if len(rows) == 0:
            return
        total = self.scene.physics.substeps if substeps is None else substeps
        ids = rows.astype(np.int32)
        switch = np.full(self.num_worlds, -1, dtype=np.int64)
        if joint_targets is not None:
            targets = joint_targets.to(torch.float64).numpy()
            switch[rows] = 0 if delay is None else delay.numpy()[rows]
        sample = np.zeros(self.num_worlds, dtype=np.int64)
        if sample_at is not None:
            sample[rows] = sample_at.numpy()[rows]
        state = self._state_arrays
        state["tilt_substep"][rows] = 0
        state["penetration_substep"][rows] = 0
        for start, count in self._segments(rows, switch, sample, total):
            due = rows[switch[rows] == start]
            if len(due):
                self._held[due] = targets[due]
                self._limp[due] = False
            self._write_ctrl(rows)
            self._batch.step(ids, count, _STAGE)
            done = start + count
            self._watch(rows, done)
            due = rows[sample[rows] == done]
            if len(due):
                self._flag(due)
                self._read(self._sample_arrays, due)
        self._flag(rows)
        self._read(self._state_arrays, slice(None) if len(rows) == self.num_worlds else rows)

    def _segments(
        self, rows: NDArray[np.int64], switch: NDArray[np.int64], sample: NDArray[np.int64], total: int
    ) -> list[tuple[int, int]]:
        """(first substep, number of substeps) of the runs between which nothing has to be looked at or changed."""
        physics = self.scene.physics
        if physics.watch_tilt is not None or physics.watch_penetration is not None or self._limp[rows].any():
            breaks = np.arange(total + 1)
        else:
            breaks = np.unique(np.concatenate([[0, total], switch[rows], sample[rows]]))
            breaks = breaks[(breaks >= 0) & (breaks <= total)]
        return [(int(a), int(b - a)) for a, b in zip(breaks[:-1], breaks[1:], strict=True)]

    def _write_ctrl(self, rows: NDArray[np.int64]) -> None:
        """Targets of the affine motors; limp motors get the target at which the law gives no torque."""
        ctrl = self._held[rows] + self._offset[rows]
        limp = self._limp[rows]
        if limp.any():
            loose = rows[limp]
            ctrl[limp] = self._qpos[np.ix_(loose, self._joint_q)] + self._kd_over_kp[loose] * (
                self._qvel[np.ix_(loose, self._joint_v)]
            )
        self._ctrl[rows] = ctrl

    def _watch(self, rows: NDArray[np.int64], substep: int) -> None:
        """Record the first substep at which a watched limit was exceeded."""
        physics, state = self.scene.physics, self._state_arrays
        if physics.watch_tilt is not None:
            quaternion = self._qpos[rows, 3:7]
            upright = 1.0 - 2.0 * (quaternion[:, 1] ** 2 + quaternion[:, 2] ** 2)
            over = rows[(upright < np.cos(physics.watch_tilt)) & (state["tilt_substep"][rows] == 0)]
            state["tilt_substep"][over] = substep
        if self._at_penetration is not None:
            found, distance = self._sensors[rows][:, self._at_penetration].T
            deep = (found > 0) & (distance < -float(physics.watch_penetration or 0.0))
            over = rows[deep & (state["penetration_substep"][rows] == 0)]
            state["penetration_substep"][over] = substep

    def _warning_counts(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Number of MuJoCo's invalid-state and buffer-full warnings so far, (rows, 2)."""
        numbers = self._batch.warning[rows, :, 1]
        return np.stack([numbers[:, _INVALID].sum(1), numbers[:, _FULL].sum(1)], axis=1)

    def _flag(self, rows: NDArray[np.int64]) -> None:
        """Set ``diverged`` and ``overflowed`` from MuJoCo's warnings."""
        new = self._warning_counts(rows) > self._warned[rows]
        self._state_arrays["diverged"][rows] |= new[:, 0]
        self._state_arrays["overflowed"][rows] |= new[:, 1]

    # ---- changing the model ---------------------------------------------------------------------------------------

    def randomize(self, randomization: Randomization, worlds: torch.Tensor | None = None) -> None:
        """See ``PhysicsBackend.randomize``."""
        rows = self._rows(worlds)
        for item in fields(Randomization):
            value = getattr(randomization, item.name)
            if value is None:
                continue
            if len(value) != len(rows):
                raise BackendError(f"Randomization.{item.name} has {len(value)} rows for {len(rows)} worlds; give one row for each")
            for row, entry in zip(rows, value.to(torch.float64).numpy(), strict=True):
                self._randomized.setdefault(int(row), {})[item.name] = entry
        for row in rows:
            self._apply_randomization(int(row))
        self._update_gain_ratio(rows)
        self._batch.set_models(self._models)

    def _apply_randomization(self, row: int) -> None:
        """Write a world's randomization into its model, starting from its terrain's nominal values."""
        values = self._randomized.get(row, {})
        model, nominal = self._models[row], self._palette[self._terrain[row]]
        if "friction" in values:
            model.geom_friction[:, 0] = values["friction"]
        inertial = False
        model.body_mass[:] = nominal.body_mass
        model.body_inertia[:] = nominal.body_inertia
        if "link_mass_scale" in values:
            others = self._bodies != self._base
            scale = values["link_mass_scale"][others]
            model.body_mass[self._bodies[others]] *= scale
            model.body_inertia[self._bodies[others]] *= scale[:, None]
            inertial = True
        if "base_mass_offset" in values:
            model.body_mass[self._base] = max(float(nominal.body_mass[self._base] + values["base_mass_offset"]), 0.01)
            inertial = True
        if "base_com_offset" in values:
            model.body_ipos[self._base] = nominal.body_ipos[self._base] + values["base_com_offset"]
            inertial = True
        if inertial:
            mujoco.mj_setConst(model, mujoco.MjData(model))
        ones = np.ones(self.scene.robot.num_joints)
        strength = values.get("motor_strength", ones)
        model.actuator_gainprm[:, 0] = nominal.actuator_gainprm[:, 0] * values.get("stiffness_scale", ones) * strength
        model.actuator_biasprm[:, 1] = -model.actuator_gainprm[:, 0]
        model.actuator_biasprm[:, 2] = nominal.actuator_biasprm[:, 2] * values.get("damping_scale", ones) * strength
        model.actuator_forcerange[:] = nominal.actuator_forcerange * strength[:, None]
        self._offset[row] = values.get("motor_offset", 0.0)

    def _update_gain_ratio(self, rows: range | NDArray[np.int64]) -> None:
        """kd/kp of each motor, from which the torque-free target of a limp motor follows."""
        for row in rows:
            model = self._models[row]
            gain = model.actuator_gainprm[:, 0]
            self._kd_over_kp[row] = np.divide(-model.actuator_biasprm[:, 2], gain, out=np.zeros_like(gain), where=gain > 0)

    def push(
        self,
        worlds: torch.Tensor | None = None,
        *,
        linear_velocity_w: torch.Tensor | None = None,
        angular_velocity_b: torch.Tensor | None = None,
    ) -> None:
        """See ``PhysicsBackend.push``."""
        rows = self._rows(worlds)
        for first, value in ((0, linear_velocity_w), (3, angular_velocity_b)):
            if value is not None:
                new = value.numpy()[rows]
                old = self._qvel[rows, first : first + 3]
                self._qvel[rows, first : first + 3] = np.where(np.isnan(new), old, new)
        self._batch.forward(rows.astype(np.int32), stage=_STAGE)
        self._state_arrays["base_linear_velocity_w"][rows] = self._qvel[rows, 0:3]
        self._state_arrays["base_angular_velocity_b"][rows] = self._qvel[rows, 3:6]
        self._state_arrays["foot_velocity_w"][rows] = self._sensors[rows][:, self._at_velocity]

    def apply_force(self, force_w: torch.Tensor) -> None:
        """See ``PhysicsBackend.apply_force``."""
        applied = self._applied.reshape(self.num_worlds, -1, 6)
        applied[:, self._base, 0:3] = force_w.numpy()

    def close(self) -> None:
        """Drop the worlds."""
        self._models.clear()
