"""Play worlds one after the other, each in an object of its own: arguments, motors, latency, watches and readout for every such engine."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import fields
from time import perf_counter
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from ..arguments import check_force, check_push, check_randomization, check_start, check_step
from ..base import (
    BackendError,
    Capability,
    PhysicsBackend,
    PhysicsState,
    Randomization,
    ResetState,
    Scene,
    Support,
)
from ..description import ModelFields
from ..devices import find_device
from ..motor_law import MotorLimits, motor_torque
from .limits import declare
from .robot import RobotModel, read_robot
from .world import Array, Base, World

_MOTOR_FIELDS = ("stiffness_scale", "damping_scale", "motor_strength", "motor_speed", "motor_offset")
_FORCES = (
    "foot_contact_force_w", "foot_normal_force", "foot_tangential_force", "body_contact_force_w", "trunk_contact_force_w",
    "ground_force_w", "ground_moment_w", "contact_center_w", "contact_count",
)  # fmt: skip
_KINDS = {"tilt_substep": np.int64, "penetration_substep": np.int64, "contact_count": np.int64} | dict.fromkeys(
    ("diverged", "overflowed"), np.bool_
)
_NEEDED = {"foot_torsion": "foot_contact", "foot_softness": "foot_contact", "base_mass_offset": "base_mass"} | {
    "link_mass_scale": "link_mass", "base_com_offset": "base_com", "stiffness_scale": "gains", "damping_scale": "gains"
}  # fmt: skip
"""Capability of a field of ``Randomization`` where it has another name."""


class SequentialBackend(PhysicsBackend):
    """An engine on the CPU with an object for each world. A subclass declares its limits and builds a ``World``.

    A world that cannot be stepped (a value that is not finite, an error of the engine) is ``diverged`` and stands still until
    its reset.
    """

    torque_motors: ClassVar[bool] = True
    velocity_targets: ClassVar[bool] = True
    parallel_processes: ClassVar[bool] = True
    precision: ClassVar[torch.dtype] = torch.float64
    """Floating-point type of the engine."""
    limits: ClassVar[Mapping[str, Capability]]
    """Capabilities that are not exact."""
    own_dry_friction: ClassVar[bool]
    """True where the engine applies the joints' dry friction; else an explicit torque substitutes it."""

    @classmethod
    def capabilities(cls) -> Mapping[str, Capability]:
        """Declare everything as exact but ``limits``."""
        return declare(cls.limits)

    @abstractmethod
    def build(self, terrain: int) -> World:
        """Build a world on a terrain of the palette."""

    def __init__(self, scene: Scene, *, device: str = "cpu", threads: int = 1) -> None:
        self.device = find_device(device, self.name, gpu=False)
        self.scene, self.dtype = scene, self.precision
        self._refuse()
        n, joints, physics = scene.num_worlds, scene.robot.num_joints, scene.physics
        self.robot: RobotModel = read_robot(scene)
        self._kp, self._kd = np.asarray(scene.parameters.stiffness), np.asarray(scene.parameters.damping)
        self._limits, self._direct = MotorLimits.of(scene), scene.parameters.motor == "torque"
        self._by_velocity = np.array(scene.robot.driven_by_velocity)
        self._dry = np.zeros(joints) if self.own_dry_friction else np.asarray(scene.parameters.friction_loss)
        self._motors = {name: np.full((n, joints), float(name != "motor_offset")) for name in _MOTOR_FIELDS}
        self._changes: list[dict[str, Array]] = [{} for _ in range(n)]
        self._target, self._limp = np.zeros((n, joints)), np.ones(n, dtype=bool)
        self._force = np.zeros((n, 3))
        tilt = physics.watch_tilt
        self._tilt_bound = np.inf if tilt is None else 0.5 * (1.0 - np.cos(tilt))
        self._deep = np.inf if physics.watch_penetration is None else physics.watch_penetration
        self._foot_of = [shape.foot for shape in self.robot.shapes]
        self._body_of = [self.robot.links[shape.link].collision_body for shape in self.robot.shapes]
        self.engine_seconds = 0.0
        self._state, self._now = self._allocate()
        self._sample, self._then = self._allocate()
        self._terrain = list(scene.terrain_index)
        self._idle: dict[int, list[World]] = {}
        self._worlds = [self.build(terrain) for terrain in self._terrain]
        self.reset(ResetState(base_position=torch.zeros(n, 3), base_quaternion=torch.eye(4)[:1].expand(n, 4)))

    def _refuse(self) -> None:
        """Raise ``BackendError``, with the option to change, for a scene beyond the engine's capabilities."""
        scene, physics = self.scene, self.scene.physics
        if physics.cone != "elliptic":
            lacks = f"backend '{self.name}' has no pyramidal friction cone, its contacts slide on a true cone"
            raise BackendError(f"{lacks}; use PhysicsOptions(cone='elliptic')")
        for name, asked, change in (
            ("height_field", any(t.height_field is not None for t in scene.terrains), "use terrains of boxes"),
            ("foot_condim_6", (physics.foot_condim or 3) > 3, "use PhysicsOptions(foot_condim=3), or None"),
            ("joint_friction", any(scene.parameters.friction_loss), "use joint parameters with friction_loss = 0"),
            ("penetration", physics.watch_penetration is not None, "use PhysicsOptions(watch_penetration=None)"),
        ):
            if asked:
                self._demand(name, change)

    def _demand(self, name: str, change: str) -> None:
        """Raise ``BackendError`` unless the engine supports a capability."""
        found = self.capabilities()[name]
        if found.support is Support.NONE:
            raise BackendError(f"backend '{self.name}' has no support for {name} ({found.note}); {change}")

    def _allocate(self) -> tuple[PhysicsState, dict[str, NDArray[Any]]]:
        """Return a state over new arrays."""
        robot, n = self.scene.robot, self.num_worlds
        j, f = (robot.num_joints,), len(robot.foot_names)
        shapes: dict[str, tuple[int, ...]] = {"base_quaternion_w": (4,)}
        shapes["body_contact_force_w"] = (len(robot.collision_bodies), 3)
        shapes |= dict.fromkeys(("joint_position", "joint_velocity", "joint_torque"), j)
        shapes |= dict.fromkeys(("foot_position_w", "foot_velocity_w", "foot_contact_force_w"), (f, 3))
        shapes |= dict.fromkeys(("foot_normal_force", "foot_tangential_force"), (f,))
        arrays: dict[str, NDArray[Any]] = {}
        real = np.float32 if self.precision is torch.float32 else np.float64
        for item in fields(PhysicsState):
            row = shapes.get(item.name, (3,) if item.name.endswith(("_w", "_b")) else ())
            arrays[item.name] = np.zeros((n, *row), dtype=_KINDS.get(item.name, real))
        return PhysicsState(**{name: torch.from_numpy(array) for name, array in arrays.items()}), arrays

    def _rows(self, worlds: torch.Tensor | None) -> list[int]:
        """Return the indices of the masked worlds."""
        return list(range(self.num_worlds)) if worlds is None else np.flatnonzero(worlds.numpy()).tolist()

    def reset(self, start: ResetState, worlds: torch.Tensor | None = None) -> None:
        """See ``PhysicsBackend.reset``."""
        check_start(self.scene, start, worlds)

        def asked(value: torch.Tensor | None, row: int, otherwise: Any) -> Array:
            return np.array(otherwise if value is None else value[row].numpy(), dtype=np.float64)

        pose = self.scene.robot.default_joint_position
        for row in self._rows(worlds):
            if start.terrain_index is not None:
                self._move(row, int(start.terrain_index[row]))
            quaternion = asked(start.base_quaternion, row, None)
            base = Base(
                position=asked(start.base_position, row, None),
                quaternion=quaternion / np.linalg.norm(quaternion),
                linear_velocity=asked(start.base_linear_velocity, row, np.zeros(3)),
                angular_velocity=asked(start.base_angular_velocity, row, np.zeros(3)),
            )
            still = np.zeros(len(pose))
            self._worlds[row].place(
                base, asked(start.joint_position, row, pose), asked(start.joint_velocity, row, still)
            )
            self._limp[row] = start.held_target is None
            self._target[row] = asked(start.held_target, row, still)
            self._force[row] = 0.0
            for array in self._now.values():
                array[row] = 0
            self._read_motion(row, self._now)

    def _move(self, row: int, terrain: int) -> None:
        """Give a world another terrain, with its own randomization."""
        if terrain == self._terrain[row]:
            return
        self._idle.setdefault(self._terrain[row], []).append(self._worlds[row])
        spare = self._idle.get(terrain)
        self._worlds[row] = spare.pop() if spare else self.build(terrain)
        self._terrain[row] = terrain
        self._worlds[row].change(self._changes[row])

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
        count = check_step(self.scene, joint_targets, delay, sample_at, worlds, substeps)
        targets = None if joint_targets is None else joint_targets.numpy().astype(np.float64)
        now, self.eventful = self._now, False
        for row in self._rows(worlds):
            late = 0 if delay is None else int(delay[row])
            wanted = 0 if sample_at is None else int(sample_at[row])
            now["tilt_substep"][row] = now["penetration_substep"][row] = 0
            now["diverged"][row] |= not self._finite(row)
            for substep in range(1, count + 1):
                if targets is not None and substep == late + 1:
                    self._target[row], self._limp[row] = targets[row], False
                self._substep(row)
                self._watch(row, substep)
                if substep == wanted:
                    now["diverged"][row] |= not self._finite(row)
                    self._read_contacts(row, self._then)
                    self._read_motion(row, self._then)
            now["diverged"][row] |= not self._finite(row)
            if targets is not None and late >= count:
                self._target[row], self._limp[row] = targets[row], False
            self._read_contacts(row, now)
            self._read_motion(row, now)
            flags = ("tilt_substep", "penetration_substep", "diverged", "overflowed")
            self.eventful |= any(bool(now[name][row]) for name in flags)

    def _substep(self, row: int) -> None:
        """Take one physics step of a world by the motor law."""
        world, now = self._worlds[row], self._now
        now["time"][row] += self.scene.physics.timestep
        if now["diverged"][row]:
            return
        position, velocity = world.joints()
        torque = np.zeros(len(position))
        if not self._limp[row]:
            factors = {name: values[row] for name, values in self._motors.items()}
            target, kp, kd = (
                self._target[row],
                self._kp * factors["stiffness_scale"],
                self._kd * factors["damping_scale"],
            )
            as_is = self._by_velocity | self._direct
            torque = motor_torque(
                np.where(as_is, target, target + factors["motor_offset"] - position),
                velocity,
                stiffness=1.0 if self._direct else np.where(self._by_velocity, kd, kp),
                damping=0.0 if self._direct else kd,
                strength=factors["motor_strength"],
                speed=factors["motor_speed"],
                limits=self._limits,
            )
        now["joint_torque"][row] = torque
        if not self.own_dry_friction:
            torque = torque - np.clip(self.robot.friction_slope * velocity, -self._dry, self._dry)
        began = perf_counter()
        try:
            sound = bool(np.isfinite(torque).all())
            if sound:
                world.step(torque, self._force[row])
        except RuntimeError:  # the engine's own alarm
            sound = False
        self.engine_seconds = (self.engine_seconds or 0.0) + perf_counter() - began
        now["diverged"][row] = not sound

    def _finite(self, row: int) -> bool:
        """Return whether a world's motion is finite."""
        world = self._worlds[row]
        base = world.base()
        every = (*world.joints(), base.position, base.quaternion, base.linear_velocity, base.angular_velocity)
        return all(np.isfinite(values).all() for values in every)

    def _watch(self, row: int, substep: int) -> None:
        """Record the first substep beyond each watched limit."""
        now = self._now
        if self._tilt_bound < np.inf and not now["tilt_substep"][row]:
            _, x, y, _ = self._worlds[row].base().quaternion
            now["tilt_substep"][row] = substep * (x * x + y * y > self._tilt_bound)
        if self._deep < np.inf and not now["penetration_substep"][row] and not now["diverged"][row]:
            deepest = max((each.depth for each in self._worlds[row].contacts() if each.terrain), default=0.0)
            now["penetration_substep"][row] = substep * (deepest > self._deep)

    def _read_motion(self, row: int, out: dict[str, NDArray[Any]]) -> None:
        """Write poses, velocities and flags of a world."""
        world = self._worlds[row]
        base = world.base()
        out["base_position_w"][row], out["base_quaternion_w"][row] = base.position, base.quaternion
        out["base_linear_velocity_w"][row] = base.linear_velocity
        out["base_angular_velocity_b"][row] = base.angular_velocity
        out["joint_position"][row], out["joint_velocity"][row] = world.joints()
        out["foot_position_w"][row], out["foot_velocity_w"][row] = world.feet()
        if out is not self._now:
            for name in ("time", "joint_torque", "tilt_substep", "penetration_substep", "diverged", "overflowed"):
                out[name][row] = self._now[name][row]

    def _read_contacts(self, row: int, out: dict[str, NDArray[Any]]) -> None:
        """Write the sums over a world's ground contacts."""
        for name in _FORCES:
            out[name][row] = 0
        if self._now["diverged"][row]:
            return
        found = self._worlds[row].contacts()
        for each in found:
            foot, body = self._foot_of[each.shape], self._body_of[each.shape]
            if foot >= 0:
                out["foot_contact_force_w"][row, foot] += each.force_w
                out["foot_normal_force"][row, foot] += each.normal
                out["foot_tangential_force"][row, foot] += each.tangential
            elif body >= 0:
                out["body_contact_force_w"][row, body] += each.force_w
            if self.robot.shapes[each.shape].trunk:
                out["trunk_contact_force_w"][row] += each.force_w
            out["ground_force_w"][row] += each.force_w
        points = [each.point_w for each in found if each.normal > 0.0]
        if points:
            center = np.mean(points, axis=0)
            out["contact_center_w"][row], out["contact_count"][row] = center, len(points)
            arms = np.array([each.point_w for each in found]) - center
            moments = np.cross(arms, [each.force_w for each in found]).sum(axis=0)
            out["ground_moment_w"][row] = moments + sum(each.moment_w for each in found)

    def randomize(self, randomization: Randomization, worlds: torch.Tensor | None = None) -> None:
        """See ``PhysicsBackend.randomize``."""
        check_randomization(self.scene, randomization, worlds)
        rows = self._rows(worlds)
        asked = {f.name: value for f in fields(Randomization) if (value := getattr(randomization, f.name)) is not None}
        for name, value in asked.items():
            self._demand(_NEEDED.get(name, name), f"leave Randomization.{name} None")
            if len(value) != len(rows):
                given = f"{len(value)} rows for {len(rows)} worlds"
                raise BackendError(f"Randomization.{name} has {given}; give one row for each")
        for name, value in asked.items():
            for row, entry in zip(rows, value.numpy().astype(np.float64), strict=True):
                if name in _MOTOR_FIELDS:
                    self._motors[name][row] = entry
                else:
                    self._changes[row][name] = entry
        if not asked.keys() <= set(_MOTOR_FIELDS):
            for row in rows:
                self._worlds[row].change(self._changes[row])

    def push(
        self,
        worlds: torch.Tensor | None = None,
        *,
        linear_velocity_w: torch.Tensor | None = None,
        angular_velocity_b: torch.Tensor | None = None,
    ) -> None:
        """See ``PhysicsBackend.push``."""
        check_push(self.scene, worlds, linear_velocity_w, angular_velocity_b)
        for row in self._rows(worlds):
            world = self._worlds[row]
            base = world.base()

            def pushed(old: Array, asked: torch.Tensor | None, row: int = row) -> Array:
                new = old if asked is None else asked[row].numpy()
                return np.where(np.isnan(new), old, new)

            base = Base(
                position=base.position,
                quaternion=base.quaternion,
                linear_velocity=pushed(base.linear_velocity, linear_velocity_w),
                angular_velocity=pushed(base.angular_velocity, angular_velocity_b),
            )
            world.place(base, *world.joints())
            self._read_motion(row, self._now)

    def apply_force(self, force_w: torch.Tensor) -> None:
        """See ``PhysicsBackend.apply_force``."""
        check_force(self.scene, force_w)
        self._force[:] = force_w.numpy()

    def describe(self) -> Mapping[str, list[float]] | None:
        """See ``PhysicsBackend.describe``."""
        if not (constants := self._worlds[0].constants()):
            return None
        factors = {name: values[0] for name, values in self._motors.items()}
        strength = factors["motor_strength"]
        passive = {"joint_friction_loss": self._dry} | constants
        return ModelFields(
            stiffness=self._kp * factors["stiffness_scale"] * strength,
            damping=self._kd * factors["damping_scale"] * strength,
            torque_limit=self._limits.torque * strength,
            **passive,
        ).describe()

    def close(self) -> None:
        """Free the worlds."""
        for world in (*self._worlds, *(each for idle in self._idle.values() for each in idle)):
            world.close()
        self._worlds.clear()
        self._idle.clear()
