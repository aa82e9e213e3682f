"""What differs between the worlds of the mujoco_warp engine: friction, masses, and the constants of the motor law."""

from __future__ import annotations

from dataclasses import fields

import mujoco_warp
import numpy as np
import torch
import warp as wp

from ..base import BackendError, Randomization, Scene
from ..description import ModelFields
from ..motor_law import MotorLimits
from ..warp.motor_law import limit_arrays
from .arrays import Motors, shared_array, to_warp
from .model import SharedModel

BATCHED_FIELDS = (
    "geom_friction",
    "geom_size",
    "geom_aabb",
    "geom_rbound",
    "geom_dataid",
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
)
"""Model fields of which every world has its own."""
_SMALLEST_MASS = 0.01
"""Mass that a base keeps, whatever is taken from it [kg]."""


class WorldParameters:
    """Tensors over mujoco_warp's and the motor law's own memory, written under a mask, without asking the device."""

    def __init__(self, scene: Scene, shared: SharedModel, model: mujoco_warp.Model, device: torch.device) -> None:
        n, joints = scene.num_worlds, scene.robot.num_joints
        self._worlds, self._device, self._base = n, device, shared.base
        constants = scene.parameters
        self._nominal_stiffness = torch.tensor(constants.stiffness, dtype=torch.float32, device=device)
        self._nominal_damping = torch.tensor(constants.damping, dtype=torch.float32, device=device)
        self._stiffness = self._nominal_stiffness.repeat(n, 1)
        self._damping = self._nominal_damping.repeat(n, 1)
        self._strength = torch.ones((n, joints), dtype=torch.float32, device=device)
        self._offset = torch.zeros((n, joints), dtype=torch.float32, device=device)
        self.requested = torch.zeros((n, joints), dtype=torch.float32, device=device)
        self.delay = torch.zeros(n, dtype=torch.int32, device=device)
        motors = Motors()
        motors.joint_q, motors.joint_v = to_warp(shared.joint_q, int), to_warp(shared.joint_v, int)
        motors.limits = limit_arrays(MotorLimits.of(scene))
        motors.stiffness, motors.damping = shared_array(self._stiffness), shared_array(self._damping)
        motors.strength, motors.offset = shared_array(self._strength), shared_array(self._offset)
        motors.requested, motors.delay = shared_array(self.requested), shared_array(self.delay)
        for name in ("current", "previous", "torque"):
            setattr(motors, name, wp.zeros((n, joints), dtype=float))
        motors.limp, motors.limp_before = wp.full(n, 1, dtype=int), wp.full(n, 1, dtype=int)
        self.motors = motors
        self._friction = wp.to_torch(model.geom_friction)
        self._mass, self._inertia = wp.to_torch(model.body_mass), wp.to_torch(model.body_inertia)
        self._com = wp.to_torch(model.body_ipos)
        self._nominal_mass, self._nominal_inertia = self._mass.clone(), self._inertia.clone()
        self._nominal_com = self._com.clone()
        others = [i for i, body in enumerate(shared.bodies) if body != shared.base]
        self._others = torch.tensor(others, dtype=torch.int64, device=device)
        self._other_bodies = torch.tensor(shared.bodies[others], dtype=torch.int64, device=device)

    def write(self, randomization: Randomization, mask: torch.Tensor, *, whole: bool) -> bool:
        """Write what the randomization holds.

        Args:
            randomization: fields with one row for each masked world, or one for every world.
            mask: the worlds to change, (N,) bool.
            whole: whether the mask holds every world.

        Returns:
            Whether masses changed, so that constants which follow from them must be computed anew.

        Raises:
            BackendError: a field has another number of rows.
        """
        rows: dict[str, torch.Tensor] = {}
        for item in fields(Randomization):
            value = getattr(randomization, item.name)
            if value is not None:
                rows[item.name] = self._spread(item.name, value, mask, whole)

        def write(target: torch.Tensor, value: torch.Tensor) -> None:
            if whole:
                target.copy_(value)
                return
            target.copy_(torch.where(mask.view(-1, *(1,) * (target.dim() - 1)), value, target))

        if "stiffness_scale" in rows:
            write(self._stiffness, rows["stiffness_scale"] * self._nominal_stiffness)
        if "damping_scale" in rows:
            write(self._damping, rows["damping_scale"] * self._nominal_damping)
        if "motor_strength" in rows:
            write(self._strength, rows["motor_strength"])
        if "motor_offset" in rows:
            write(self._offset, rows["motor_offset"])
        if "friction" in rows:
            # in every geom, so that neither the larger coefficient nor the higher priority can win with another one
            write(self._friction[:, :, 0], rows["friction"][:, None].expand(-1, self._friction.shape[1]))
        base, bodies = self._base, self._other_bodies
        if "link_mass_scale" in rows:
            scale, column = rows["link_mass_scale"][:, self._others], mask[:, None]
            mass, inertia = self._mass[:, bodies], self._inertia[:, bodies]
            self._mass[:, bodies] = torch.where(column, self._nominal_mass[:, bodies] * scale, mass)
            scaled = self._nominal_inertia[:, bodies] * scale[:, :, None]
            self._inertia[:, bodies] = torch.where(column[:, :, None], scaled, inertia)
        if "base_mass_offset" in rows:
            mass = (self._nominal_mass[:, base] + rows["base_mass_offset"]).clamp(min=_SMALLEST_MASS)
            write(self._mass[:, base], mass)
        if "base_com_offset" in rows:
            write(self._com[:, base], self._nominal_com[:, base] + rows["base_com_offset"])
        return bool({"link_mass_scale", "base_mass_offset", "base_com_offset"} & set(rows))

    def describe(self, model: mujoco_warp.Model, shared: SharedModel) -> dict[str, list[float]]:
        """The first world as ``PhysicsBackend.describe`` says, read from the engine's own arrays."""

        def first(name: str) -> np.ndarray:
            return getattr(model, name).numpy()[0]  # an array of all worlds, or of one that stands for all

        bodies, dofs = shared.bodies, shared.joint_v
        joints = [int(shared.model.dof_jntid[d]) for d in dofs]
        limited = shared.model.jnt_limited[joints, None].astype(bool)
        feet = [int(np.flatnonzero(shared.geom_foot == f)[0]) for f in range(int(shared.geom_foot.max()) + 1)]
        floor, priority = shared.model.geom("floor").id, model.geom_priority.numpy()
        friction, strength = first("geom_friction"), self._strength[0].cpu().numpy()
        return ModelFields(
            total_mass=float(first("body_mass").sum()),
            body_mass=first("body_mass")[bodies],
            body_inertia=first("body_inertia")[bodies],
            joint_range=np.where(limited, first("jnt_range")[joints], [-np.inf, np.inf]),
            joint_armature=first("dof_armature")[dofs],
            joint_damping=first("dof_damping")[dofs],
            joint_friction_loss=first("dof_frictionloss")[dofs],
            stiffness=self._stiffness[0].cpu().numpy() * strength,
            damping=self._damping[0].cpu().numpy() * strength,
            torque_limit=self.motors.limits.torque.numpy() * strength,
            foot_friction=friction[feet, 0],
            floor_friction=float(friction[floor, 0]),
            foot_priority=priority[feet] - priority[floor],
        ).describe()

    def _spread(self, name: str, value: torch.Tensor, mask: torch.Tensor, whole: bool) -> torch.Tensor:
        """Spread the masked worlds' rows over all worlds, without asking the device how many are masked."""
        value = value.to(device=self._device, dtype=torch.float32)
        if len(value) == self._worlds:
            return value
        counted = self._device.type == "cpu" and len(value) != int(mask.sum())
        if whole or counted or len(value) == 0:
            wanted = self._worlds if whole else int(mask.sum())
            raise BackendError(f"Randomization.{name} has {len(value)} rows for {wanted} worlds; give one row for each")
        return value[(torch.cumsum(mask, 0) - 1).clamp(0, len(value) - 1)]
