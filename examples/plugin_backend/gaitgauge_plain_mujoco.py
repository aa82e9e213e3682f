"""An example of a third party's engine: MuJoCo's C API in a Python loop, one model and one data per world."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, ClassVar

import mujoco
import numpy as np
import torch
from gaitgauge.backends import (
    BackendError,
    Capability,
    PhysicsBackend,
    PhysicsState,
    Randomization,
    ResetState,
    Scene,
    Support,
)
from gaitgauge.backends.arguments import check_force, check_push, check_randomization, check_start, check_step
from gaitgauge.backends.base import CAPABILITY_NAMES
from gaitgauge.backends.motor_law import MotorLimits, motor_torque
from gaitgauge.terrains.base import Terrain

CANNOT = {
    "gpu": "runs on the CPU",
    "link_mass": "only the base's mass can be changed",
    "penetration": "contacts are read at the end of a step only",
}
MOTOR_FIELDS = ("stiffness_scale", "damping_scale", "motor_strength", "motor_speed", "motor_offset")


_BODY_FORCES = ("body_contact_force_w", "trunk_contact_force_w")


class PlainMujocoBackend(PhysicsBackend):
    """See ``PhysicsBackend`` for what each method promises."""

    name: ClassVar[str] = "plain-mujoco"
    parallel_processes: ClassVar[bool] = True

    @classmethod
    def capabilities(cls) -> Mapping[str, Capability]:
        """Everything is exact or not there."""
        exact = {name: Capability(support=Support.EXACT) for name in CAPABILITY_NAMES}
        return exact | {name: Capability(support=Support.NONE, note=note) for name, note in CANNOT.items()}

    def __init__(self, scene: Scene, *, device: str = "cpu", threads: int = 1) -> None:
        if torch.device(device).type != "cpu":
            raise BackendError(f"backend '{self.name}' runs on the CPU, not on '{device}'; use device 'cpu'")
        if scene.physics.watch_penetration is not None:
            raise BackendError(f"backend '{self.name}' cannot watch penetration; leave watch_penetration None")
        self.scene, self.device, self.dtype = scene, torch.device("cpu"), torch.float64
        n, robot, constants = scene.num_worlds, scene.robot, scene.parameters
        self._kp, self._kd = np.asarray(constants.stiffness), np.asarray(constants.damping)
        self._limits = MotorLimits.of(scene)
        self._palette = [self._build(terrain) for terrain in scene.terrains]
        self._terrain = list(scene.terrain_index)
        self._changes: list[dict[str, Any]] = [{} for _ in range(n)]
        nominal = self._palette[0]
        joints = [nominal.joint(name) for name in robot.joint_names]
        self._at_q = np.array([j.qposadr[0] for j in joints])
        self._at_v = np.array([j.dofadr[0] for j in joints])
        self._base = nominal.body(robot.base_body).id
        # terrains differ in their number of geoms, so a foot's number is another one on each
        self._feet = [np.array([m.geom(name).id for name in robot.foot_names]) for m in self._palette]
        self._body_of = {nominal.body(name).id: i for i, name in enumerate(robot.collision_bodies)}
        self._motors = {name: np.full((n, robot.num_joints), float(name != "motor_offset")) for name in MOTOR_FIELDS}
        self._target = np.full((n, robot.num_joints), np.nan)
        self._limp = np.ones(n, dtype=bool)
        self._models: list[mujoco.MjModel] = []
        self._data: list[mujoco.MjData] = []
        for row in range(n):
            self._models.append(copy.copy(self._palette[self._terrain[row]]))
            self._data.append(mujoco.MjData(self._models[row]))
        self._state, self._arrays = self._allocate()
        self._sample, self._sample_arrays = self._allocate()
        upright = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1)
        self.reset(ResetState(base_position=torch.zeros(n, 3), base_quaternion=upright))

    def _build(self, terrain: Terrain) -> mujoco.MjModel:
        """Model of the robot on one terrain; whatever is fixed to the world body is ground."""
        robot, physics, constants = self.scene.robot, self.scene.physics, self.scene.parameters
        spec = mujoco.MjSpec.from_file(str(robot.mjcf))
        spec.option.timestep, spec.option.impratio = physics.timestep, physics.impratio
        spec.option.iterations, spec.option.ls_iterations = physics.iterations, physics.ls_iterations
        spec.option.tolerance = physics.tolerance
        spec.option.cone = getattr(mujoco.mjtCone, f"mjCONE_{physics.cone.upper()}")
        # the motor law is ours, and a bad state is reported instead of being reset behind our back
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION | mujoco.mjtDisableBit.mjDSBL_AUTORESET
        for geom in spec.geoms:
            if geom.name in robot.foot_names and physics.foot_condim is not None:
                geom.condim = physics.foot_condim
            if not physics.self_collision and geom.contype:
                geom.contype, geom.conaffinity = 2, 1
        for j, name in enumerate(robot.joint_names):
            joint = spec.joint(name)
            joint.armature, joint.frictionloss = constants.armature[j], constants.friction_loss[j]
            joint.damping = np.array([constants.joint_damping[j], 0.0, 0.0])
        world, kinds = spec.worldbody, mujoco.mjtGeom
        world.add_geom(type=kinds.mjGEOM_PLANE, size=[0.0, 0.0, 1.0])
        for box in terrain.boxes:
            world.add_geom(type=kinds.mjGEOM_BOX, size=box.half_size, pos=box.center, quat=box.quaternion)
        field = terrain.height_field
        if field is not None:
            top = max(float(field.heights.max()), 1e-6)
            rows, columns = field.heights.shape
            size = np.array([*field.half_size, top, field.base])
            spec.add_hfield(name="field", nrow=rows, ncol=columns, size=size, userdata=field.heights.ravel())
            world.add_geom(type=kinds.mjGEOM_HFIELD, hfieldname="field", pos=[*field.center, 0.0])
        model = spec.compile()
        if field is not None:
            model.hfield_data[:] = (field.heights / top).ravel()  # again: the compiler normalizes them
        return model

    def _allocate(self) -> tuple[PhysicsState, dict[str, np.ndarray]]:
        n, robot = self.num_worlds, self.scene.robot
        j, f, b = robot.num_joints, len(robot.foot_names), len(robot.collision_bodies)
        shapes: dict[str, tuple[int, ...]] = {"base_quaternion_w": (4,), "body_contact_force_w": (b, 3)}
        shapes |= dict.fromkeys(("joint_position", "joint_velocity", "joint_torque"), (j,))
        shapes |= dict.fromkeys(("foot_position_w", "foot_velocity_w", "foot_contact_force_w"), (f, 3))
        shapes |= dict.fromkeys(("foot_normal_force", "foot_tangential_force"), (f,))
        kinds: dict[str, type] = {"tilt_substep": np.int64, "penetration_substep": np.int64}
        kinds |= {"contact_count": np.int64, "diverged": np.bool_, "overflowed": np.bool_}
        arrays = {}
        for field in fields(PhysicsState):
            vector: tuple[int, ...] = (3,) if field.name.endswith(("_w", "_b")) else ()
            shape = shapes.get(field.name, vector)
            arrays[field.name] = np.zeros((n, *shape), dtype=kinds.get(field.name, np.float64))
        return PhysicsState(**{name: torch.from_numpy(a) for name, a in arrays.items()}), arrays

    @property
    def state(self) -> PhysicsState:
        """State after the last call."""
        return self._state

    @property
    def sample(self) -> PhysicsState:
        """State after the substep asked for."""
        return self._sample

    def _rows(self, worlds: torch.Tensor | None) -> list[int]:
        return list(range(self.num_worlds)) if worlds is None else torch.nonzero(worlds).flatten().tolist()

    def reset(self, start: ResetState, worlds: torch.Tensor | None = None) -> None:
        """Put worlds into a state."""
        check_start(self.scene, start, worlds)
        for row in self._rows(worlds):
            if start.terrain_index is not None and int(start.terrain_index[row]) != self._terrain[row]:
                self._terrain[row] = int(start.terrain_index[row])
                self._models[row] = copy.copy(self._palette[self._terrain[row]])
                self._data[row] = mujoco.MjData(self._models[row])
                self._change_model(row)
            data, pose = self._data[row], self.scene.robot.default_joint_position
            mujoco.mj_resetData(self._models[row], data)
            data.qpos[0:3], data.qpos[3:7] = start.base_position[row], start.base_quaternion[row]
            data.qpos[self._at_q] = pose if start.joint_position is None else start.joint_position[row]
            data.qvel[0:3] = 0.0 if start.base_linear_velocity is None else start.base_linear_velocity[row]
            data.qvel[3:6] = 0.0 if start.base_angular_velocity is None else start.base_angular_velocity[row]
            data.qvel[self._at_v] = 0.0 if start.joint_velocity is None else start.joint_velocity[row]
            self._limp[row] = start.held_target is None
            self._target[row] = np.nan if start.held_target is None else start.held_target[row]
            for array in self._arrays.values():
                array[row] = 0
            self._publish(row, self._arrays)

    def step(
        self,
        joint_targets: torch.Tensor | None,
        *,
        delay: torch.Tensor | None = None,
        sample_at: torch.Tensor | None = None,
        worlds: torch.Tensor | None = None,
        substeps: int | None = None,
    ) -> None:
        """Advance one control period."""
        count = check_step(
            self.scene, joint_targets, delay=delay, sample_at=sample_at, worlds=worlds, substeps=substeps
        )
        for row in self._rows(worlds):
            late = 0 if delay is None else int(delay[row])
            wanted = 0 if sample_at is None else int(sample_at[row])
            self._arrays["tilt_substep"][row] = 0
            for substep in range(1, count + 1):
                if substep == late + 1:
                    self._take_target(row, joint_targets)
                self._substep(row)
                self._watch_tilt(row, substep)
                if substep == wanted:
                    self._publish_contacts(row, self._sample_arrays)
                    self._publish(row, self._sample_arrays)
            if late >= count:
                self._take_target(row, joint_targets)
            self._publish_contacts(row, self._arrays)
            self._publish(row, self._arrays)

    def _take_target(self, row: int, joint_targets: torch.Tensor | None) -> None:
        if joint_targets is not None:
            self._target[row], self._limp[row] = joint_targets[row], False

    def _substep(self, row: int) -> None:
        """One physics step with the motor law of the contract; a world that is no longer finite stands still."""
        model, data = self._models[row], self._data[row]
        torque = np.zeros(len(self._at_v))
        if not self._limp[row]:
            motors = {name: values[row] for name, values in self._motors.items()}
            torque = motor_torque(
                self._target[row] - data.qpos[self._at_q] + motors["motor_offset"],
                data.qvel[self._at_v],
                stiffness=self._kp * motors["stiffness_scale"],
                damping=self._kd * motors["damping_scale"],
                strength=motors["motor_strength"],
                speed=motors["motor_speed"],
                limits=self._limits,
            )
        self._arrays["joint_torque"][row] = torque
        if np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all() and np.isfinite(torque).all():
            data.qfrc_applied[self._at_v] = torque
            mujoco.mj_step(model, data)
        else:
            self._arrays["diverged"][row] = True
        warned = [data.warning[int(w)].number for w in mujoco.mjtWarning.__members__.values() if w.name != "mjNWARNING"]
        bad, full = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_CONTACTFULL)
        self._arrays["diverged"][row] |= any(warned[int(bad) : int(bad) + 3])
        self._arrays["overflowed"][row] |= any(warned[int(full) : int(full) + 2])

    def _watch_tilt(self, row: int, substep: int) -> None:
        limit, found = self.scene.physics.watch_tilt, self._arrays["tilt_substep"]
        if limit is not None and found[row] == 0:
            x, y = self._data[row].qpos[4:6]
            if 1.0 - 2.0 * (x * x + y * y) < np.cos(limit):
                found[row] = substep

    def _publish(self, row: int, out: dict[str, np.ndarray]) -> None:
        """Write poses and velocities; only the kinematics are computed, so that reading changes nothing."""
        model, data = self._models[row], self._data[row]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        out["time"][row] = data.time
        out["base_position_w"][row], out["base_quaternion_w"][row] = data.qpos[0:3], data.qpos[3:7]
        out["base_linear_velocity_w"][row], out["base_angular_velocity_b"][row] = data.qvel[0:3], data.qvel[3:6]
        out["joint_position"][row], out["joint_velocity"][row] = data.qpos[self._at_q], data.qvel[self._at_v]
        feet, twist = self._feet[self._terrain[row]], np.zeros(6)
        out["foot_position_w"][row] = data.geom_xpos[feet]
        for i, geom in enumerate(feet):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_GEOM, geom, twist, 0)
            out["foot_velocity_w"][row, i] = twist[3:]
        if out is not self._arrays:
            for name in ("joint_torque", "tilt_substep", "diverged", "overflowed"):
                out[name][row] = self._arrays[name][row]

    def _publish_contacts(self, row: int, out: dict[str, np.ndarray]) -> None:
        """Sum up the ground contacts of the step just taken."""
        model, data, feet = self._models[row], self._data[row], self._feet[self._terrain[row]].tolist()
        for name in ("foot_contact_force_w", "foot_normal_force", "foot_tangential_force", *_BODY_FORCES):
            out[name][row] = 0.0
        points, forces, torques, local = [], [], [], np.zeros(6)
        for i in range(data.ncon):
            contact = data.contact[i]
            first, second = model.geom_bodyid[contact.geom1], model.geom_bodyid[contact.geom2]
            if first != 0 and second != 0:
                continue  # two bodies of the robot
            mujoco.mj_contactForce(model, data, i, local)
            if local[0] <= 0.0:
                continue
            # MuJoCo gives the force on the second geom
            sign, geom = (1.0, contact.geom2) if first == 0 else (-1.0, contact.geom1)
            frame = contact.frame.reshape(3, 3)
            force = sign * frame.T @ local[:3]
            points.append(contact.pos.copy())
            forces.append(force)
            torques.append(sign * frame.T @ local[3:])
            if geom not in feet:
                out["body_contact_force_w"][row, self._body_of[int(model.geom_bodyid[geom])]] += force
                if model.geom(geom).name in self.scene.robot.trunk_shapes:
                    out["trunk_contact_force_w"][row] += force
            else:
                foot = feet.index(geom)
                out["foot_contact_force_w"][row, foot] += force
                out["foot_normal_force"][row, foot] += local[0]
                out["foot_tangential_force"][row, foot] += np.hypot(local[1], local[2])
        center = np.mean(points, axis=0) if points else np.zeros(3)
        out["contact_count"][row], out["contact_center_w"][row] = len(points), center
        out["ground_force_w"][row] = np.sum(forces, axis=0) if points else 0.0
        out["ground_moment_w"][row] = (
            np.sum(np.cross(np.array(points) - center, forces) + np.array(torques), axis=0) if points else 0.0
        )

    def randomize(self, randomization: Randomization, worlds: torch.Tensor | None = None) -> None:
        """Change the model of some worlds."""
        check_randomization(self.scene, randomization, worlds)
        if randomization.link_mass_scale is not None:
            raise BackendError(f"backend '{self.name}' cannot scale link masses; leave link_mass_scale None")
        for name in ("friction", "base_mass_offset", "base_com_offset", *MOTOR_FIELDS):
            values = getattr(randomization, name)
            if values is None:
                continue
            for row, value in zip(self._rows(worlds), values.numpy(), strict=True):
                if name in MOTOR_FIELDS:
                    self._motors[name][row] = value
                else:
                    self._changes[row][name] = value.copy()
        for row in self._rows(worlds):
            self._change_model(row)

    def _change_model(self, row: int) -> None:
        """Write a world's randomization into its model, from the nominal values of its terrain's."""
        model, nominal, changes = self._models[row], self._palette[self._terrain[row]], self._changes[row]
        if "friction" in changes:
            model.geom_friction[:, 0] = changes["friction"]
        model.body_mass[self._base] = nominal.body_mass[self._base] + changes.get("base_mass_offset", 0.0)
        model.body_ipos[self._base] = nominal.body_ipos[self._base] + changes.get("base_com_offset", 0.0)
        mujoco.mj_setConst(model, mujoco.MjData(model))

    def push(
        self,
        worlds: torch.Tensor | None = None,
        *,
        linear_velocity_w: torch.Tensor | None = None,
        angular_velocity_b: torch.Tensor | None = None,
    ) -> None:
        """Set base velocities; NaN keeps the present value."""
        check_push(self.scene, worlds, linear_velocity_w=linear_velocity_w, angular_velocity_b=angular_velocity_b)
        for row in self._rows(worlds):
            for start, velocity in ((0, linear_velocity_w), (3, angular_velocity_b)):
                if velocity is not None:
                    old, new = self._data[row].qvel[start : start + 3], velocity[row].numpy()
                    old[:] = np.where(np.isnan(new), old, new)
            self._publish(row, self._arrays)

    def apply_force(self, force_w: torch.Tensor) -> None:
        """Force on the base's centre of mass, where MuJoCo's applied body forces act."""
        check_force(self.scene, force_w)
        for data, force in zip(self._data, force_w.numpy(), strict=True):
            data.xfrc_applied[self._base, :3] = force
