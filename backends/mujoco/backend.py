"""The reference engine: MuJoCo on the CPU, many worlds on a thread pool (``mujoco.batch.Batch``), float64, bit-reproducible.

Every world has a model of its own, a copy of its terrain's, so that friction, masses and gains can differ. The motor law is
an affine actuator inside the model and acts at every physics step; where its limits follow the speed, every physics step gets
a target with an allowed torque. After a step, positions and velocities are those of the new state, forces those of the last
substep; the penetration watch sees the contacts at the start of each substep.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from time import perf_counter
from typing import ClassVar

import mujoco
import mujoco.batch
import numpy as np
import torch
from numpy.typing import NDArray

from ..arguments import check_force, check_push, check_randomization, check_start, check_step
from ..base import (
    CAPABILITY_NAMES,
    SMALLEST_BASE_MASS,
    BackendError,
    Capability,
    PhysicsBackend,
    Randomization,
    ResetState,
    Scene,
    Support,
)
from ..devices import find_device
from ..motor_law import MotorLimits
from .model import CONTACT_SLOTS, ROUND_SLOTS, build_models, describe_model
from .state import RECORDED, BatchState, Records, StateLayout

_STAGE = mujoco.mjtStage.mjSTAGE_VEL.value
_WARNING = mujoco.mjtWarning
_INVALID = [w.value for w in (_WARNING.mjWARN_BADQPOS, _WARNING.mjWARN_BADQVEL, _WARNING.mjWARN_BADQACC)]
_FULL = [w.value for w in (_WARNING.mjWARN_CONTACTFULL, _WARNING.mjWARN_CNSTRFULL)]

Array = NDArray[np.float64]


class MujocoBackend(PhysicsBackend):
    """MuJoCo (C engine) on the CPU. Results do not depend on the number of threads nor on the other worlds."""

    torque_motors: ClassVar[bool] = True
    velocity_targets: ClassVar[bool] = True
    name: ClassVar[str] = "mujoco"
    family: ClassVar[str] = "MuJoCo"
    parallel_processes: ClassVar[bool] = True
    _state: BatchState
    _sample: BatchState

    @classmethod
    def capabilities(cls) -> Mapping[str, Capability]:
        """Declare everything but GPU execution as exact."""
        exact = {name: Capability(support=Support.EXACT) for name in CAPABILITY_NAMES}
        exact["gpu"] = Capability(support=Support.NONE, note="runs on CPU threads")
        exact["penetration"] = Capability(support=Support.EXACT, note="seen one substep late")
        slots = f"single points of the {CONTACT_SLOTS} strongest contacts, {ROUND_SLOTS} for each foot; more on soles"
        exact["contact_forces"] = Capability(support=Support.EXACT, note=slots)
        return exact

    def __init__(self, scene: Scene, *, device: str = "cpu", threads: int = 1) -> None:
        self.device = find_device(device, self.name, gpu=False)
        self.scene = scene
        self.dtype = torch.float64
        n, joints = scene.num_worlds, scene.robot.num_joints
        self._limits, self._direct = MotorLimits.of(scene), scene.parameters.motor == "torque"
        self._by_velocity = np.array(scene.robot.driven_by_velocity)
        self._palette = build_models(scene)
        self._terrain = np.asarray(scene.terrain_index, dtype=np.int64)
        nominal = self._palette[0]
        self._models = [copy.copy(self._palette[t]) for t in self._terrain]
        try:
            self._batch = mujoco.batch.Batch(nominal, n, threads, True)
        except ValueError as error:
            raise BackendError(f"MuJoCo cannot make {n} worlds: {error}; ask for fewer") from error
        self._batch.set_models(self._models)
        self.engine_seconds: float = 0.0
        self._qpos, self._qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        tilt = scene.physics.watch_tilt
        self._tilt_bound = 0.0 if tilt is None else 0.5 * (1.0 - np.cos(tilt))
        self._applied, self._time = self._batch.bind("xfrc_applied"), self._batch.bind("time")
        self._index_model(nominal)
        self._randomized: dict[str, Array] = {}  # NaN where a world was never given one
        self._limp = np.ones(n, dtype=bool)
        self._held, self._offset, self._gain, self._kd_over_kp = (np.zeros((n, joints)) for _ in range(4))
        self._strength, self._speed = (np.ones((n, joints)) for _ in range(2))
        self._read_gains(range(n))
        self._warned = np.zeros((n, 2), dtype=np.int64)
        self._beyond = np.zeros(n, dtype=bool)
        """Worlds in which a motor was beyond its limit by speed in their last step."""
        self._live = {
            "time": self._time,
            "qpos": self._qpos,
            "qvel": self._qvel,
            "torque": self._batch.bind("actuator_force"),
            "sites": self._batch.bind("site_xpos"),
            "sensors": self._batch.bind("sensordata"),
        }
        layout = StateLayout(nominal, scene)
        self._state = BatchState(layout, self._live)
        self._sample = BatchState(layout, {k: v.copy() for k, v in self._live.items()})
        self._deep = layout.penetration
        self._everyone = np.arange(n)
        self._rooms: dict[tuple[int, int], tuple[Array, Records]] = {}
        self.reset(replace(self.standing(), held_target=None))

    def _index_model(self, model: mujoco.MjModel) -> None:
        """Find the robot's base, joints and bodies in MuJoCo's arrays."""
        robot = self.scene.robot
        free = model.joint(model.body(robot.base_body).jntadr[0])
        self._base = model.body(robot.base_body).id
        if free.type[0] != mujoco.mjtJoint.mjJNT_FREE or free.qposadr[0] != 0:
            base = f"body '{robot.base_body}' of robot '{robot.name}'"
            raise BackendError(f"{base} must carry a free joint and come first")
        self._joint_q = np.array([model.joint(j).qposadr[0] for j in robot.joint_names])
        self._joint_v = np.array([model.joint(j).dofadr[0] for j in robot.joint_names])
        self._bodies = np.array([model.body(b).id for b in robot.collision_bodies])
        self._feet = np.array([model.geom(name).id for name in robot.foot_geoms])

    def _rows(self, worlds: torch.Tensor | None) -> NDArray[np.int64]:
        """Return the indices of the masked worlds."""
        return self._everyone if worlds is None else np.flatnonzero(worlds.numpy())

    def reset(self, start: ResetState, worlds: torch.Tensor | None = None) -> None:
        """See ``PhysicsBackend.reset``."""
        check_start(self.scene, start, worlds)
        rows = self._rows(worlds)
        if len(rows) == 0:
            return
        if start.terrain_index is not None:
            self._switch_terrain(rows, start.terrain_index.numpy())
        self._batch.reset(rows.astype(np.int32), stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        self._qpos[rows, 0:3] = start.base_position.numpy()[rows]
        self._qpos[rows, 3:7] = start.base_quaternion.numpy()[rows]
        pose, asked = np.asarray(self.scene.robot.default_joint_position), start.joint_position
        self._qpos[np.ix_(rows, self._joint_q)] = pose if asked is None else asked.numpy()[rows]
        for columns, value in (
            (np.arange(0, 3), start.base_linear_velocity),
            (np.arange(3, 6), start.base_angular_velocity),
            (self._joint_v, start.joint_velocity),
        ):
            self._qvel[np.ix_(rows, columns)] = 0.0 if value is None else value.numpy()[rows]
        self._limp[rows] = start.held_target is None
        self._held[rows] = 0.0 if start.held_target is None else start.held_target.numpy()[rows]
        self._batch.forward(rows.astype(np.int32), stage=_STAGE)
        self._warned[rows] = self._warning_counts(rows)
        for flags in self._state.flags.values():
            flags[rows] = 0
        self._state.forget_forces(rows)

    def _switch_terrain(self, rows: NDArray[np.int64], index: NDArray[np.int64]) -> None:
        """Give worlds another model of the palette, with their own randomization."""
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
        total = check_step(self.scene, joint_targets, delay, sample_at, worlds, substeps)
        rows = self._rows(worlds)
        n = len(rows)
        if n == 0:
            return
        those = slice(None) if n == self.num_worlds else rows  # a slice gives views without copies
        held, offset, some_limp = self._held[those], self._offset[those], bool(self._limp[those].any())
        targets, waits = held, None
        if joint_targets is not None:
            targets = np.asarray(joint_targets.numpy(), dtype=np.float64)[those]
            if not np.isfinite(targets).all():
                broken = np.logical_not(np.isfinite(targets).all(axis=1))
                targets = np.where(broken[:, None], held, targets)
                self._state.flags["diverged"][rows[broken]] = True
            if delay is not None:
                waits = np.arange(total) < delay.numpy()[those, None]
        control, records = self._memory(n, total)
        control[:] = (targets + offset)[:, None]
        if waits is not None:
            np.copyto(control, (held + offset)[:, None], where=waits[..., None])
        if some_limp and waits is None:
            waits = np.full((n, total), joint_targets is None)
        if self._limits.by_speed or (some_limp and waits is not None):
            loose = np.zeros((n, total), dtype=bool) if waits is None else waits & self._limp[those, None]
            records = self._play_following(rows, control, loose)
        else:
            self._play(rows, control, records)
        if joint_targets is not None:  # a target that waits for the whole step acts from the next one on
            self._held[those] = targets
            if some_limp:
                self._limp[those] = False
        began = perf_counter()
        self._batch.forward(self._ids(rows), stage=_STAGE)
        self.engine_seconds += perf_counter() - began
        seen = self._watch(those, records)
        self._flag(rows)
        flags = self._state.flags
        self.eventful = seen or bool(flags["diverged"][those].any() or flags["overflowed"][those].any())
        self._state.renew(those)
        if sample_at is not None:
            at = sample_at.numpy()[those]
            if at.any():
                self._sample.take(self._state, rows, records, at)

    def _ids(self, rows: NDArray[np.int64]) -> NDArray[np.int32] | None:
        """Return world indices for MuJoCo: None for all."""
        return None if len(rows) == self.num_worlds else rows.astype(np.int32)

    def _memory(self, n: int, count: int) -> tuple[Array, Records]:
        """Return memory for the controls of ``n`` worlds over ``count`` substeps, (n, count, J), and for their records.

        All ``n`` share one memory, so that it stays in the processor's caches.
        """
        if (n, count) not in self._rooms:
            whole = self.num_worlds
            if n == whole:
                shapes = {name: getattr(self._batch, name).shape[1:] for name in RECORDED}
                records = {name: np.zeros((n, count, *shape)) for name, shape in shapes.items()}
                self._rooms[n, count] = np.zeros((n, count, self._held.shape[1])), records
            else:
                control, records = self._memory(whole, count)
                self._rooms[n, count] = control[:n], {name: array[:n] for name, array in records.items()}
        return self._rooms[n, count]

    def _play(self, rows: NDArray[np.int64], control: Array, records: Records) -> None:
        """Step worlds with the given controls, (rows, substeps, J), and record them after each substep."""
        began = perf_counter()
        self._batch.rollout(control.shape[1], control, ids=self._ids(rows), record=RECORDED, out=records)
        self.engine_seconds += perf_counter() - began

    def _play_following(self, rows: NDArray[np.int64], control: Array, loose: NDArray[np.bool_]) -> Records:
        """Step worlds as ``_play`` does, where targets may have to follow the state, and return the records.

        The targets of ``loose`` motors, (rows, substeps), follow it, and those of motors beyond a limit by speed. Whether a world
        had one of those shows afterwards: it goes back and is played singly, as is its next step, since they come in rows.
        The results are those of playing all worlds singly, which takes several times as long.
        """
        singly = loose.any(axis=1) | self._beyond[rows]
        some = np.flatnonzero(~singly)
        worlds, asked = rows[some], control[some]
        records = self._memory(len(some), control.shape[1])[1]
        if len(some):
            state, warned = self._batch.state[worlds], self._warning_counts(worlds)
            position, velocity = (array[worlds][:, None] for array in (self._qpos, self._qvel))
            self._play(worlds, asked, records)
            if self._limits.by_speed:
                position, velocity = (
                    np.concatenate([first, records[name][:, :-1]], axis=1)[:, :, columns]
                    for first, name, columns in ((position, "qpos", self._joint_q), (velocity, "qvel", self._joint_v))
                )
                _, beyond = self._follow(worlds[:, None], asked, position, velocity)
                again = self._beyond[worlds] = beyond.any(axis=(1, 2))
                back = worlds[again]
                self._batch.state[back] = state[again]
                self._warned[back] += self._warning_counts(back) - warned[again]
                singly[some[again]] = True
        if not singly.any():
            return records
        merged = {name: np.empty((len(rows), *array.shape[1:])) for name, array in records.items()}
        for name, array in merged.items():
            array[some] = records[name]
        for name, array in self._play_singly(rows[singly], control[singly], loose[singly]).items():
            merged[name][singly] = array
        return merged

    def _play_singly(self, rows: NDArray[np.int64], control: Array, loose: NDArray[np.bool_]) -> Records:
        """Step worlds as ``_play`` does, substep by substep, with targets that follow the state.

        ``loose`` motors, (rows, substeps), get a target with zero torque; motors beyond a limit by speed get the limit's target.
        """
        parts, beyond = [], np.zeros(len(rows), dtype=bool)
        for substep in range(control.shape[1]):
            position, velocity = self._qpos[np.ix_(rows, self._joint_q)], self._qvel[np.ix_(rows, self._joint_v)]
            target, cut = self._follow(rows, control[:, substep], position, velocity)
            beyond |= cut.any(axis=1)
            now, records = self._memory(len(rows), 1)
            now[:] = np.where(loose[:, substep, None], self._free(rows, position, velocity), target)[:, None]
            self._play(rows, now, records)
            parts.append({name: array.copy() for name, array in records.items()})
        self._beyond[rows] = beyond
        return {name: np.concatenate([p[name] for p in parts], axis=1) for name in RECORDED}

    def _free(self, rows: NDArray[np.int64], position: Array, velocity: Array) -> Array | float:
        """Return the target without torque, (…, J), at joint positions and velocities of that shape."""
        return 0.0 if self._direct else np.where(self._by_velocity, 0.0, position) + self._kd_over_kp[rows] * velocity

    def _follow(
        self, rows: NDArray[np.int64], target: Array, position: Array, velocity: Array
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Return the targets, (…, J), of which motors give no more than their limits by speed allow, and which were beyond."""
        if not self._limits.by_speed:
            return target, np.zeros(target.shape, dtype=bool)
        free, gain, strength = self._free(rows, position, velocity), self._gain[rows], self._strength[rows]
        asked = gain * (target - free)
        lower, upper = self._limits.bounds(velocity / self._speed[rows])
        given = asked.clip(lower * strength, upper * strength)
        cut = (given != asked) & (gain > 0.0)
        if not cut.any():
            return target, cut
        return np.where(cut, free + np.divide(given, gain, out=np.zeros_like(given), where=cut), target), cut

    def _watch(self, those: slice | NDArray[np.int64], records: Records) -> bool:
        """Record the first substep beyond each watched limit, and return whether there was any."""
        physics, seen = self.scene.physics, {}
        if physics.watch_tilt is not None:
            qpos = records["qpos"]
            seen["tilt_substep"] = qpos[:, :, 4] ** 2 + qpos[:, :, 5] ** 2 > self._tilt_bound
        if self._deep is not None:
            limit = -float(physics.watch_penetration or 0.0)  # no contact reads 0
            seen["penetration_substep"] = records["sensordata"][:, :, self._deep] < limit
        exceeded = False
        for name, over in seen.items():
            some = bool(over.any())
            self._state.flags[name][those] = np.where(over.any(1), over.argmax(1) + 1, 0) if some else 0
            exceeded |= some
        return exceeded

    def _warning_counts(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the number of MuJoCo's invalid-state and buffer-full warnings so far, (rows, 2)."""
        numbers = self._batch.warning[rows, :, 1]
        return np.stack([numbers[:, _INVALID].sum(1), numbers[:, _FULL].sum(1)], axis=1)

    def _flag(self, rows: NDArray[np.int64]) -> None:
        """Set ``diverged`` and ``overflowed`` from MuJoCo's warnings."""
        if not self._batch.warning[:, :, 1].any():
            return
        new = self._warning_counts(rows) > self._warned[rows]
        self._state.flags["diverged"][rows] |= new[:, 0]
        self._state.flags["overflowed"][rows] |= new[:, 1]

    def randomize(self, randomization: Randomization, worlds: torch.Tensor | None = None) -> None:
        """See ``PhysicsBackend.randomize``. Worlds without a change are skipped: a model's constants are slow to compute."""
        check_randomization(self.scene, randomization, worlds)
        rows = self._rows(worlds)
        values = {f.name: value for f in fields(Randomization) if (value := getattr(randomization, f.name)) is not None}
        for name, value in values.items():
            if len(value) != len(rows):
                count = f"{len(value)} rows for {len(rows)} worlds"
                raise BackendError(f"Randomization.{name} has {count}; give one row for each")
        changed: set[int] = set()
        for name, value in values.items():
            new = value.to(torch.float64).numpy()
            known = self._randomized.setdefault(name, np.full((self.num_worlds, *new.shape[1:]), np.nan))
            differ = (known[rows] != new).reshape(len(rows), -1).any(axis=1)
            known[rows[differ]] = new[differ]
            changed.update(rows[differ].tolist())
        for row in changed:
            self._apply_randomization(row)
        self._read_gains(sorted(changed))
        if changed:
            self._batch.set_models(self._models)

    def _apply_randomization(self, row: int) -> None:
        """Write a world's randomization into its model, starting from its terrain's nominal values."""
        values = {name: v[row] for name, v in self._randomized.items() if not np.isnan(v[row]).any()}
        model, nominal = self._models[row], self._palette[self._terrain[row]]
        if "friction" in values:
            model.geom_friction[:, 0] = values["friction"]
        if "foot_torsion" in values:
            model.geom_friction[self._feet, 1:] = nominal.geom_friction[self._feet, 1:] * values["foot_torsion"]
        if "foot_softness" in values:
            model.geom_solref[self._feet, 0] = nominal.geom_solref[self._feet, 0] * values["foot_softness"]
        model.body_mass[:] = nominal.body_mass
        model.body_inertia[:] = nominal.body_inertia
        if "link_mass_scale" in values:
            others = self._bodies != self._base
            scale = values["link_mass_scale"][others]
            model.body_mass[self._bodies[others]] *= scale
            model.body_inertia[self._bodies[others]] *= scale[:, None]
        if "base_mass_offset" in values:
            mass = float(nominal.body_mass[self._base] + values["base_mass_offset"])
            model.body_mass[self._base] = max(mass, SMALLEST_BASE_MASS)
        if "base_com_offset" in values:
            model.body_ipos[self._base] = nominal.body_ipos[self._base] + values["base_com_offset"]
        if not values.keys().isdisjoint(("link_mass_scale", "base_mass_offset", "base_com_offset")):
            mujoco.mj_setConst(model, mujoco.MjData(model))
        ones = np.ones(self.scene.robot.num_joints)
        strength = values.get("motor_strength", ones)
        kp_scale, kd_scale = values.get("stiffness_scale", ones), values.get("damping_scale", ones)
        # a torque is commanded as it is: no gain acts on it
        scale = ones if self._direct else np.where(self._by_velocity, kd_scale, kp_scale)
        model.actuator_gainprm[:, 0] = nominal.actuator_gainprm[:, 0] * scale * strength
        model.actuator_biasprm[:, 1] = np.where(self._by_velocity | self._direct, 0.0, -model.actuator_gainprm[:, 0])
        model.actuator_biasprm[:, 2] = nominal.actuator_biasprm[:, 2] * kd_scale * strength
        model.actuator_forcerange[:] = nominal.actuator_forcerange * strength[:, None]
        self._strength[row], self._speed[row] = strength, values.get("motor_speed", 1.0)
        self._offset[row] = np.where(self._by_velocity | self._direct, 0.0, values.get("motor_offset", 0.0))

    def _read_gains(self, rows: Sequence[int] | NDArray[np.int64]) -> None:
        """Read kp and strength of each motor, and kd/kp, from which the torque-free target follows."""
        for row in rows:
            model = self._models[row]
            gain, damping = model.actuator_gainprm[:, 0], -model.actuator_biasprm[:, 2]
            self._gain[row] = gain
            self._kd_over_kp[row] = np.divide(damping, gain, out=np.zeros_like(gain), where=gain > 0)

    def push(
        self,
        worlds: torch.Tensor | None = None,
        *,
        linear_velocity_w: torch.Tensor | None = None,
        angular_velocity_b: torch.Tensor | None = None,
    ) -> None:
        """See ``PhysicsBackend.push``."""
        check_push(self.scene, worlds, linear_velocity_w, angular_velocity_b)
        rows = self._rows(worlds)
        for first, value in ((0, linear_velocity_w), (3, angular_velocity_b)):
            if value is not None:
                new, columns = value.numpy()[rows], slice(first, first + 3)
                self._qvel[rows, columns] = np.where(np.isnan(new), self._qvel[rows, columns], new)
        self._batch.forward(rows.astype(np.int32), stage=_STAGE)

    def apply_force(self, force_w: torch.Tensor) -> None:
        """See ``PhysicsBackend.apply_force``."""
        check_force(self.scene, force_w)
        self._applied.reshape(self.num_worlds, -1, 6)[:, self._base, 0:3] = force_w.numpy()

    def describe(self) -> Mapping[str, list[float]]:
        """See ``PhysicsBackend.describe``."""
        return describe_model(self._models[0], self.scene.robot)

    def close(self) -> None:
        """Drop the worlds."""
        self._models.clear()
