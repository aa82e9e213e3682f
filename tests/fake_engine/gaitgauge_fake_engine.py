"""An engine without physics, for tests of everything above the backends: it does what a script says and nothing else.

It is a plug-in like anybody's: the folder beside this file is what an installation leaves of one.

Bases glide along a prescribed twist, joints are unit inertias on the real motor law (or sit exactly on their targets),
contact forces are whatever the script says (by default the feet share the weight). Falls, divergence, penetration and
overflow happen at given times. What the contract says about latency, masks, samples, watches, limits and randomized
motors is honoured exactly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import ClassVar

import torch
from gaitgauge.backends.arguments import check_force, check_push, check_randomization, check_start, check_step
from gaitgauge.backends.base import (
    CAPABILITY_NAMES,
    BackendError,
    Capability,
    PhysicsBackend,
    PhysicsState,
    Randomization,
    ResetState,
    Scene,
    Support,
)
from gaitgauge.backends.devices import find_device
from gaitgauge.backends.motor_law import MotorLimits, motor_torque

GRAVITY = 9.81
"""[m/s²]; it acts on nothing, it only turns masses into weights."""
FALL_RATE = 2.0 * math.pi
"""Roll rate of a falling robot [rad/s]."""
FALL_DURATION = 0.25
"""Time from upright to lying on the side [s]."""
FALL_DEPTH = 0.2
"""How far the base sinks while it falls [m]."""
FOOT_POINTS = ((0.19, 0.14), (0.19, -0.14), (-0.19, 0.14), (-0.19, -0.14))
"""Feet FL, FR, RL, RR in the base's xy plane [m]; they are fixed to the base, ``Robot.stand_height`` below it."""

Motion = Callable[["FakeBackend"], tuple[torch.Tensor, torch.Tensor]]
FootForce = Callable[["FakeBackend"], torch.Tensor]


@dataclass(frozen=True, kw_only=True, eq=False)
class FakeScript:
    """What happens in a ``FakeBackend``. Times are (N,), seconds since the last reset; infinity or None for never."""

    motion: Motion | None = None
    """Called at every substep with the backend, whose ``state`` is the one before it; returns the base's linear and
    angular velocity in the body frame, (N, 3) each [m/s, rad/s]. None: the base keeps its velocities."""
    joint_law: str = "motor"
    """``motor``: every joint is a ``joint_inertia`` on the motor law; ``track``: joints jump to their targets."""
    joint_inertia: float = 1.0
    """[kg·m²]."""
    total_mass: float = 15.0
    """Mass of the robot before ``base_mass_offset`` [kg]."""
    foot_force: FootForce | None = None
    """Ground force on each foot, world frame [N], (N, F, 3); None: each foot carries the same share of the weight."""
    fall_time: torch.Tensor | None = None
    """From here on the base rolls onto its side whatever the motion says, then lies still and carries the weight."""
    diverge_time: torch.Tensor | None = None
    """From here on the world's state is NaN and ``diverged`` is set."""
    penetration_time: torch.Tensor | None = None
    """From here on the robot is deeper in the terrain than the scene's ``watch_penetration``."""
    overflow_time: torch.Tensor | None = None
    """From here on ``overflowed`` is set."""


def rotate(quaternion: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Turn vectors (…, 3) from the body frame into the world frame by quaternions (…, 4), wxyz."""
    axis, vector = torch.broadcast_tensors(quaternion[..., 1:], vector)
    twice_cross = 2.0 * torch.linalg.cross(axis, vector)
    return vector + quaternion[..., :1] * twice_cross + torch.linalg.cross(axis, twice_cross)


def turn(quaternion: torch.Tensor, angular_velocity_b: torch.Tensor, duration: float) -> torch.Tensor:
    """Orientation (N, 4) after ``duration`` [s] at a constant angular velocity in the body frame (N, 3) [rad/s]."""
    if not bool(angular_velocity_b.any()):
        return quaternion / quaternion.norm(dim=-1, keepdim=True)
    rate = angular_velocity_b.norm(dim=-1, keepdim=True)
    half_angle = 0.5 * duration * rate
    w1, v1 = quaternion[..., :1], quaternion[..., 1:]
    w2, v2 = torch.cos(half_angle), torch.sin(half_angle) * angular_velocity_b / rate.clamp_min(1e-12)
    w = w1 * w2 - (v1 * v2).sum(-1, keepdim=True)
    turned = torch.cat([w, w1 * v2 + w2 * v1 + torch.linalg.cross(v1, v2)], dim=-1)
    return turned / turned.norm(dim=-1, keepdim=True)


_STATE = tuple(f.name for f in fields(PhysicsState))


def _rows_of(mask: torch.Tensor) -> torch.Tensor | slice:
    """The masked rows as an index; all of them are a slice, which is copied several times faster."""
    return slice(None) if bool(mask.all()) else mask


class FakeBackend(PhysicsBackend):
    """N worlds that follow a ``FakeScript``. Deterministic, float64, on any torch device.

    Attributes:
        script: what happens; may be replaced at any time.
        targets: joint targets that act at present [rad], (N, J); meaningless where ``limp``.
        limp: worlds whose motors have had no target since the reset, (N,) bool.
        terrain_index: terrain of each world, (N,) int64.
        randomized: present values of every field of ``Randomization``, all worlds; ``friction`` is NaN where never set.
        resets: how often each world was reset, (N,) int64.
    """

    name: ClassVar[str] = "fake"

    @classmethod
    def capabilities(cls) -> Mapping[str, Capability]:
        """Only what concerns motors and bookkeeping is real."""
        motors = (
            "gains",
            "motor_strength",
            "motor_speed",
            "motor_offset",
            "latency",
            "torque_limits",
            "torque_speed_limit",
        )
        exact = (*motors, "push", "deterministic", "gpu")
        noted = Capability(
            support=Support.APPROXIMATE, note="accepted and recorded, without effect: there is no physics"
        )
        return {name: Capability(support=Support.EXACT) if name in exact else noted for name in CAPABILITY_NAMES}

    def __init__(
        self, scene: Scene, *, device: str = "cpu", threads: int = 1, script: FakeScript | None = None
    ) -> None:
        """Build the worlds.

        Raises:
            BackendError: the robot does not have four feet, or the torch device is not there.
        """
        if len(scene.robot.foot_names) != len(FOOT_POINTS):
            feet = len(scene.robot.foot_names)
            raise BackendError(
                f"backend 'fake' knows robots with {len(FOOT_POINTS)} feet, '{scene.robot.name}' has {feet}"
            )
        self.scene = scene
        self.device = find_device(device, self.name)
        self.dtype = torch.float64
        self.script = script or FakeScript()
        robot, worlds = scene.robot, scene.num_worlds
        self.joint_count, self.foot_count = robot.num_joints, len(robot.foot_names)
        self.default_pose = self._tensor(robot.default_joint_position).expand(worlds, -1)
        self.stiffness = self._tensor(scene.parameters.stiffness)
        self.damping = self._tensor(scene.parameters.damping)
        self.limits = MotorLimits.of(scene).to(device=self.device, dtype=self.dtype)
        self.foot_points_b = self._tensor([(x, y, -robot.stand_height) for x, y in FOOT_POINTS])
        bodies = robot.collision_bodies
        self.base_index = bodies.index(robot.base_body) if robot.base_body in bodies else 0

        def full(value: float, *shape: int) -> torch.Tensor:
            return torch.full((worlds, *shape), value, dtype=self.dtype, device=self.device)

        self.targets = self.default_pose.clone()
        self.limp = torch.ones(worlds, dtype=torch.bool, device=self.device)
        self.terrain_index = torch.tensor(scene.terrain_index, dtype=torch.int64, device=self.device)
        self.resets = torch.zeros(worlds, dtype=torch.int64, device=self.device)
        self.force_w = full(0.0, 3)
        self.randomized = Randomization(
            friction=full(math.nan),
            foot_torsion=full(1.0),
            foot_softness=full(1.0),
            base_mass_offset=full(0.0),
            link_mass_scale=full(1.0, len(bodies)),
            base_com_offset=full(0.0, 3),
            stiffness_scale=full(1.0, self.joint_count),
            damping_scale=full(1.0, self.joint_count),
            motor_strength=full(1.0, self.joint_count),
            motor_speed=full(1.0, self.joint_count),
            motor_offset=full(0.0, self.joint_count),
        )
        count = full(0.0).long()
        upright = full(0.0, 4)
        upright[:, 0] = 1.0
        self._substeps_since_reset = count.clone()
        self._state = PhysicsState(
            time=full(0.0),
            base_position_w=full(0.0, 3),
            base_quaternion_w=upright,
            base_linear_velocity_w=full(0.0, 3),
            base_angular_velocity_b=full(0.0, 3),
            joint_position=self.default_pose.clone(),
            joint_velocity=full(0.0, self.joint_count),
            joint_torque=full(0.0, self.joint_count),
            foot_position_w=full(0.0, self.foot_count, 3),
            foot_velocity_w=full(0.0, self.foot_count, 3),
            foot_contact_force_w=full(0.0, self.foot_count, 3),
            foot_normal_force=full(0.0, self.foot_count),
            foot_tangential_force=full(0.0, self.foot_count),
            body_contact_force_w=full(0.0, len(bodies), 3),
            trunk_contact_force_w=full(0.0, 3),
            ground_force_w=full(0.0, 3),
            ground_moment_w=full(0.0, 3),
            contact_center_w=full(0.0, 3),
            contact_count=count.clone(),
            tilt_substep=count.clone(),
            penetration_substep=count.clone(),
            diverged=full(0.0).bool(),
            overflowed=full(0.0).bool(),
        )
        self._place_feet(torch.ones_like(self.limp))
        self._sample = self._state.clone()

    def reset(self, start: ResetState, worlds: torch.Tensor | None = None) -> None:
        """Put worlds into a state, as the contract says."""
        check_start(self.scene, start, worlds)
        mask, state = self._mask(worlds), self._state
        for f in fields(PhysicsState):
            getattr(state, f.name)[mask] = 0
        state.base_position_w[mask] = self._rows(start.base_position, mask)
        state.base_quaternion_w[mask] = self._rows(start.base_quaternion, mask)
        state.joint_position[mask] = self._rows(
            self.default_pose if start.joint_position is None else start.joint_position, mask
        )
        if start.base_linear_velocity is not None:
            state.base_linear_velocity_w[mask] = self._rows(start.base_linear_velocity, mask)
        if start.base_angular_velocity is not None:
            state.base_angular_velocity_b[mask] = self._rows(start.base_angular_velocity, mask)
        if start.joint_velocity is not None:
            state.joint_velocity[mask] = self._rows(start.joint_velocity, mask)
        if start.terrain_index is not None:
            self.terrain_index[mask] = start.terrain_index.to(self.device, torch.int64)[mask]
        self.limp[mask] = start.held_target is None
        if start.held_target is not None:
            self.targets[mask] = self._rows(start.held_target, mask)
        self.force_w[mask] = 0.0
        self._substeps_since_reset[mask] = 0
        self.resets[mask] += 1
        self._place_feet(mask)

    def step(
        self,
        joint_targets: torch.Tensor | None,
        *,
        delay: torch.Tensor | None = None,
        sample_at: torch.Tensor | None = None,
        worlds: torch.Tensor | None = None,
        substeps: int | None = None,
    ) -> None:
        """Advance one control period, as the contract says."""
        count = check_step(
            self.scene, joint_targets, delay=delay, sample_at=sample_at, worlds=worlds, substeps=substeps
        )
        mask, state = self._mask(worlds), self._state
        late = torch.zeros_like(self._substeps_since_reset) if delay is None else delay.to(self.device)
        state.tilt_substep[mask] = 0
        state.penetration_substep[mask] = 0
        for substep in range(1, count + 1):
            self._take_targets(joint_targets, mask & (late == substep - 1))
            self._advance(mask)
            self._watch(mask, substep)
            if sample_at is not None:
                asked = mask & (sample_at.to(self.device) == substep)
                if not bool(asked.any()):
                    continue
                self._report(asked)
                rows = _rows_of(asked)
                for name in _STATE:
                    getattr(self._sample, name)[rows] = getattr(state, name)[rows]
        self._take_targets(joint_targets, mask & (late >= count))
        self._report(mask)

    def randomize(self, randomization: Randomization, worlds: torch.Tensor | None = None) -> None:
        """Record the values; those of the motors act."""
        check_randomization(self.scene, randomization, worlds)
        mask = self._mask(worlds)
        for f in fields(Randomization):
            value = getattr(randomization, f.name)
            if value is not None:
                getattr(self.randomized, f.name)[mask] = value.to(self.device, self.dtype)

    def push(
        self,
        worlds: torch.Tensor | None = None,
        *,
        linear_velocity_w: torch.Tensor | None = None,
        angular_velocity_b: torch.Tensor | None = None,
    ) -> None:
        """Set base velocities; a scripted motion overrides them at the next substep."""
        check_push(self.scene, worlds, linear_velocity_w=linear_velocity_w, angular_velocity_b=angular_velocity_b)
        mask, state = self._mask(worlds)[:, None], self._state
        for old, new in (
            (state.base_linear_velocity_w, linear_velocity_w),
            (state.base_angular_velocity_b, angular_velocity_b),
        ):
            if new is not None:
                new = new.to(self.device, self.dtype)
                old.copy_(torch.where(mask & ~new.isnan(), new, old))
        self._place_feet(mask[:, 0])

    def apply_force(self, force_w: torch.Tensor) -> None:
        """External force; it accelerates the base as a point mass of the robot's mass, unless a motion is scripted."""
        check_force(self.scene, force_w)
        self.force_w.copy_(force_w)

    @property
    def mass(self) -> torch.Tensor:
        """Mass of each robot [kg], (N,)."""
        assert self.randomized.base_mass_offset is not None
        return self.script.total_mass + self.randomized.base_mass_offset

    def _tensor(self, values: object) -> torch.Tensor:
        return torch.tensor(values, dtype=self.dtype, device=self.device)

    def _mask(self, worlds: torch.Tensor | None) -> torch.Tensor:
        return torch.ones_like(self.limp) if worlds is None else worlds.to(self.device)

    def _rows(self, value: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        return value.to(self.device, self.dtype)[mask]

    def _since(self, moment: torch.Tensor | None) -> torch.Tensor:
        """Worlds whose time, at the end of the present substep, has reached ``moment``."""
        if moment is None:
            return torch.zeros_like(self.limp)
        half_step = 0.5 * self.scene.physics.timestep
        return self._state.time >= moment.to(self.device, self.dtype) - half_step

    def _take_targets(self, joint_targets: torch.Tensor | None, takers: torch.Tensor) -> None:
        if joint_targets is not None:
            acting = joint_targets.to(self.device, self.dtype)
            self.targets.copy_(torch.where(takers[:, None], acting, self.targets))
            self.limp &= ~takers

    def _advance(self, mask: torch.Tensor) -> None:
        """One physics step of the masked worlds: semi-implicit Euler, the state's forces aside."""
        state, script, h = self._state, self.script, self.scene.physics.timestep
        torque = self._torque()
        if script.joint_law == "track":
            joint_position = torch.where(self.limp[:, None], state.joint_position, self.targets)
            joint_velocity = (joint_position - state.joint_position) / h
        elif script.joint_law == "motor":
            joint_velocity = state.joint_velocity + h / script.joint_inertia * torque
            joint_position = state.joint_position + h * joint_velocity
        else:
            raise BackendError(f"joint_law '{script.joint_law}' is unknown; FakeScript takes 'motor' or 'track'")
        if script.motion is None:
            linear_w = state.base_linear_velocity_w + h * self.force_w / self.mass[:, None]
            angular_b = state.base_angular_velocity_b.clone()
        else:
            linear_b, angular_b = script.motion(self)
            linear_w, angular_b = rotate(state.base_quaternion_w, linear_b), angular_b.clone()
        self._substeps_since_reset += mask.long()
        state.time.copy_(self._substeps_since_reset.to(self.dtype) * h)
        if script.fall_time is not None:
            fallen = self._since(script.fall_time)
            lying = self._since(script.fall_time + FALL_DURATION)
            falling = (fallen & ~lying).to(self.dtype)
            linear_w, angular_b = linear_w.clone(), angular_b
            linear_w[fallen], angular_b[fallen] = 0.0, 0.0
            linear_w[:, 2] -= falling * FALL_DEPTH / FALL_DURATION
            angular_b[:, 0] += falling * FALL_RATE
        new = {
            "base_position_w": state.base_position_w + h * linear_w,
            "base_quaternion_w": turn(state.base_quaternion_w, angular_b, h),
            "base_linear_velocity_w": linear_w,
            "base_angular_velocity_b": angular_b,
            "joint_position": joint_position,
            "joint_velocity": joint_velocity,
            "joint_torque": torque,
        }
        if script.diverge_time is not None:
            gone = self._since(script.diverge_time)[:, None]
            new = {name: torch.where(gone, torch.full_like(value, math.nan), value) for name, value in new.items()}
        everywhere = bool(mask.all())
        for name, value in new.items():
            old = getattr(state, name)
            old.copy_(value if everywhere else torch.where(mask[:, None], value, old))
        moved = (new["base_position_w"], new["base_quaternion_w"], new["joint_position"])  # what velocities spoil, too
        state.diverged |= mask & ~torch.cat(moved, dim=1).isfinite().all(dim=1)
        if script.overflow_time is not None:
            state.overflowed |= mask & self._since(script.overflow_time)

    def _torque(self) -> torch.Tensor:
        """Motor law of ``JointParameters`` with the randomized factors, (N, J) [N·m]."""
        state, model = self._state, self.randomized
        assert model.stiffness_scale is not None and model.damping_scale is not None
        assert model.motor_strength is not None and model.motor_offset is not None and model.motor_speed is not None
        torque = motor_torque(
            self.targets - state.joint_position + model.motor_offset,
            state.joint_velocity,
            stiffness=self.stiffness * model.stiffness_scale,
            damping=self.damping * model.damping_scale,
            strength=model.motor_strength,
            speed=model.motor_speed,
            limits=self.limits,
        )
        return torch.where(self.limp[:, None], torch.zeros_like(torque), torque)

    def _watch(self, mask: torch.Tensor, substep: int) -> None:
        """Record the first substep at which a watch tripped."""
        physics, state = self.scene.physics, self._state
        if physics.watch_tilt is not None:
            lean = state.base_quaternion_w[:, 1:3].square().sum(1)  # 1 - 2 lean is the cosine of the tilt
            tilted = 1.0 - 2.0 * lean < math.cos(physics.watch_tilt)
            state.tilt_substep[mask & tilted & (state.tilt_substep == 0)] = substep
        if physics.watch_penetration is not None:
            deep = self._since(self.script.penetration_time)
            state.penetration_substep[mask & deep & (state.penetration_substep == 0)] = substep

    def _place_feet(self, mask: torch.Tensor) -> None:
        """Foot positions and velocities of the masked worlds: points fixed to the base."""
        state = self._state
        quaternion = state.base_quaternion_w[:, None, :]
        arm_b = self.foot_points_b.expand(self.num_worlds, -1, -1)
        arm_w = rotate(quaternion, arm_b)
        spin_b = torch.linalg.cross(state.base_angular_velocity_b[:, None, :].expand_as(arm_b), arm_b)
        rows = _rows_of(mask)
        state.foot_position_w[rows] = (state.base_position_w[:, None, :] + arm_w)[rows]
        state.foot_velocity_w[rows] = (state.base_linear_velocity_w[:, None, :] + rotate(quaternion, spin_b))[rows]

    def _report(self, mask: torch.Tensor) -> None:
        """Fill what follows from poses and script: feet and contacts of the masked worlds."""
        self._place_feet(mask)
        state, script, rows = self._state, self.script, _rows_of(mask)
        weight = self.mass * GRAVITY
        fallen = self._since(script.fall_time)
        if script.foot_force is None:
            force = torch.zeros_like(state.foot_contact_force_w)
            force[..., 2] = weight[:, None] / self.foot_count
        else:
            force = script.foot_force(self).to(self.device, self.dtype)
        force = torch.where(fallen[:, None, None], torch.zeros_like(force), force)
        body = torch.zeros_like(state.body_contact_force_w)
        body[:, self.base_index, 2] = torch.where(fallen, weight, torch.zeros_like(weight))
        points = torch.cat([state.foot_position_w, state.base_position_w[:, None, :]], dim=1)
        forces = torch.cat([force, body[:, self.base_index, None, :]], dim=1)
        active = (forces.norm(dim=-1) > 0.0).to(self.dtype)
        center = (points * active[..., None]).sum(1) / active.sum(1, keepdim=True).clamp_min(1.0)
        moment = torch.linalg.cross(points - center[:, None, :], forces).sum(1)
        for old, new in (
            (state.foot_contact_force_w, force),
            (state.foot_normal_force, force[..., 2]),
            (state.foot_tangential_force, force[..., :2].norm(dim=-1)),
            (state.body_contact_force_w, body),
            (state.trunk_contact_force_w, body[:, self.base_index]),
            (state.ground_force_w, forces.sum(1)),
            (state.ground_moment_w, moment),
            (state.contact_center_w, center),
            (state.contact_count, active.sum(1).long()),
        ):
            old[rows] = new[rows]
