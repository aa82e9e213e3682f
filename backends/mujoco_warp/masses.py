"""Friction and masses of the mujoco_warp engine, which differ between worlds as the motors do."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import mujoco_warp
import numpy as np
import torch
import warp as wp

from ..base import SMALLEST_BASE_MASS
from ..description import FootContact, ModelFields
from ..warp.motors import MotorTensors
from .model import SharedModel

BATCHED_FIELDS = (
    "geom_friction", "geom_solref", "geom_size", "geom_aabb", "geom_rbound", "geom_dataid",
    "body_mass", "body_inertia", "body_ipos", "body_subtreemass", "body_invweight0", "dof_invweight0",
)  # fmt: skip
"""Model fields with an entry for every world."""


class WorldMasses:
    """Friction and masses: tensors over mujoco_warp's own memory."""

    def __init__(self, shared: SharedModel, model: mujoco_warp.Model, device: torch.device) -> None:
        self._base = shared.base
        self._friction, self._reference = wp.to_torch(model.geom_friction), wp.to_torch(model.geom_solref)
        self._feet = torch.tensor(np.flatnonzero(shared.roles["foot"] >= 0), dtype=torch.int64, device=device)
        self._nominal_moments = self._friction[0, self._feet, 1:].clone()
        self._nominal_time = self._reference[0, self._feet, 0].clone()
        self._mass, self._inertia = wp.to_torch(model.body_mass), wp.to_torch(model.body_inertia)
        self._com = wp.to_torch(model.body_ipos)
        self._nominal_mass, self._nominal_inertia = self._mass.clone(), self._inertia.clone()
        self._nominal_com = self._com.clone()
        others = [i for i, body in enumerate(shared.bodies) if body != shared.base]
        self._others = torch.tensor(others, dtype=torch.int64, device=device)
        self._other_bodies = torch.tensor(shared.bodies[others], dtype=torch.int64, device=device)

    def write(self, rows: Mapping[str, torch.Tensor], mask: torch.Tensor) -> bool:
        """Write fields of a ``Randomization``.

        Args:
            rows: one row for every world, by the field's name.
            mask: the worlds to change, (N,) bool.

        Returns:
            True where masses changed, so that derived constants must be computed anew.
        """

        def put(target: torch.Tensor, columns: Any, values: torch.Tensor) -> None:
            where = mask.view(-1, *(1,) * (values.dim() - 1))
            target[:, columns] = torch.where(where, values, target[:, columns])

        if "friction" in rows:
            # in every geom, so that no other coefficient acts by its size or priority
            put(self._friction[..., 0], slice(None), rows["friction"][:, None])
        if "foot_torsion" in rows:
            put(self._friction[..., 1:], self._feet, self._nominal_moments * rows["foot_torsion"][:, None, None])
        if "foot_softness" in rows:
            put(self._reference[..., 0], self._feet, self._nominal_time * rows["foot_softness"][:, None])
        base, bodies = self._base, self._other_bodies
        if "link_mass_scale" in rows:
            scale = rows["link_mass_scale"][:, self._others]
            put(self._mass, bodies, self._nominal_mass[:, bodies] * scale)
            put(self._inertia, bodies, self._nominal_inertia[:, bodies] * scale[:, :, None])
        if "base_mass_offset" in rows:
            mass = self._nominal_mass[:, base] + rows["base_mass_offset"]
            put(self._mass, base, mass.clamp(min=SMALLEST_BASE_MASS))
        if "base_com_offset" in rows:
            put(self._com, base, self._nominal_com[:, base] + rows["base_com_offset"])
        return bool({"link_mass_scale", "base_mass_offset", "base_com_offset"} & set(rows))


def describe_model(model: mujoco_warp.Model, shared: SharedModel, motors: MotorTensors) -> dict[str, list[float]]:
    """Return the first world in the terms of ``PhysicsBackend.describe``, from the engine's own arrays."""

    def first(name: str) -> np.ndarray:
        return getattr(model, name).numpy()[0]  # an array of all worlds, or of one for all

    bodies, dofs = shared.bodies, shared.joint_v
    joints = [int(shared.model.dof_jntid[d]) for d in dofs]
    limited = shared.model.jnt_limited[joints, None].astype(bool)
    feet = [int(np.flatnonzero(shared.roles["foot"] == f)[0]) for f in range(int(shared.roles["foot"].max()) + 1)]
    floor, priority = shared.model.geom("floor").id, model.geom_priority.numpy()
    friction = first("geom_friction")
    return ModelFields(
        total_mass=float(first("body_mass").sum()),
        body_mass=first("body_mass")[bodies],
        body_inertia=first("body_inertia")[bodies],
        joint_range=np.where(limited, first("jnt_range")[joints], [-np.inf, np.inf]),
        joint_armature=first("dof_armature")[dofs],
        joint_damping=first("dof_damping")[dofs],
        joint_friction_loss=first("dof_frictionloss")[dofs],
        **motors.described(),
        foot_friction=friction[feet, 0],
        floor_friction=float(friction[floor, 0]),
        foot_priority=priority[feet] - priority[floor],
        foot_contact=FootContact.of_mujoco(
            dimension=shared.model.geom_condim[[*feet, floor]],
            friction=friction[[*feet, floor]],
            softness=first("geom_solref")[[*feet, floor]],
            priority=priority[[*feet, floor]],
            pyramidal=shared.model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL,
        ),
    ).describe()
