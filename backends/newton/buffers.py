"""Memory that the Newton engine shares between torch and Warp, contacts and masses, and a description of the model in it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import mujoco
import newton
import numpy as np
import torch
import warp as wp

from ..base import SMALLEST_BASE_MASS, Scene
from ..description import FootContact, ModelFields
from ..warp.motors import MotorTensors
from ..warp.structures import filled
from . import kernels
from .model import WorldModel
from .solvers import SolverAdapter


def contact_structure(contacts: newton.Contacts, force: Any, shape_body: Any) -> Any:
    """Return Newton's contacts as a structure for kernels."""
    kind: Any = kernels.ContactArrays
    own = {"force": force, "shape_body": shape_body}
    return filled(kind, **{n: getattr(contacts, f"rigid_contact_{n}") for n in kind.vars if n not in own}, **own)


class MassTensors:
    """Views of a model's masses, inertias and friction, with their nominal and randomized values."""

    def __init__(self, world: WorldModel, worlds: int, device: torch.device) -> None:
        model, layout = world.model, world.layout
        self._mass = wp.to_torch(model.body_mass).view(worlds, layout.bodies)
        self._inverse_mass = wp.to_torch(model.body_inv_mass).view(worlds, layout.bodies)
        self._inertia = wp.to_torch(model.body_inertia).view(worlds, layout.bodies, 3, 3)
        self._inverse_inertia = wp.to_torch(model.body_inv_inertia).view(worlds, layout.bodies, 3, 3)
        self._nominal_mass, self._nominal_inertia = self._mass[0].clone(), self._inertia[0].clone()
        self._base = layout.base
        self._order = torch.tensor(layout.collision_bodies, dtype=torch.int64, device=device)
        self._scale = torch.ones((worlds, layout.bodies), dtype=torch.float32, device=device)
        self.friction = wp.to_torch(model.shape_material_mu).view(worlds, layout.shapes)
        """Sliding friction of every shape, (N, S)."""
        names = ("mu_torsional", "mu_rolling", "ke", "kd")
        contact = {name: wp.to_torch(getattr(model, f"shape_material_{name}")) for name in names}
        self.contact = {name: values.view(worlds, layout.shapes) for name, values in contact.items()}
        """Torsional and rolling friction, stiffness and damping of every shape's contacts, (N, S) each."""
        self._nominal_contact = {name: values[0].clone() for name, values in self.contact.items()}
        self._foot = torch.as_tensor(layout.shape_foot, device=device)[: layout.shapes] >= 0
        self.base_offset = torch.zeros(worlds, dtype=torch.float32, device=device)
        """Mass added to the base [kg], (N,)."""
        self.link_scale = torch.ones((worlds, len(self._order)), dtype=torch.float32, device=device)
        """Factor on mass and inertia of each collision body, (N, B); the base's is ignored."""
        self.com_offset = torch.zeros((worlds, 3), dtype=torch.float32, device=device)
        """Shift of the base's centre of mass [m], (N, 3)."""
        self.nominal_com = wp.vec3(*world.reference.body_ipos[layout.base + 1])

    def feet(self, rows: Mapping[str, torch.Tensor]) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """Yield contact parameters of every shape, and the values that randomized feet of each world have, (N, S) both.

        A time constant of s times MuJoCo's has 1 / s² of the stiffness and 1 / s of the damping.
        """
        powers = {"foot_torsion": {"mu_torsional": 1, "mu_rolling": 1}, "foot_softness": {"ke": -2, "kd": -1}}
        for field in powers.keys() & rows.keys():
            for name, power in powers[field].items():
                nominal = self._nominal_contact[name]
                yield self.contact[name], nominal * torch.where(self._foot, rows[field][:, None] ** power, 1.0)

    def write(self, adapter: SolverAdapter) -> None:
        """Write masses and inertias into the model and tell the solver."""
        self._scale[:, self._order] = self.link_scale
        self._scale[:, self._base] = 1.0
        self._mass.copy_(self._nominal_mass * self._scale)
        self._mass[:, self._base] = (self._nominal_mass[self._base] + self.base_offset).clamp(min=SMALLEST_BASE_MASS)
        self._inertia.copy_(self._nominal_inertia * self._scale[..., None, None])
        self._inverse_mass.copy_(1.0 / self._mass)
        self._inverse_inertia.copy_(torch.linalg.inv(self._inertia))
        adapter.inertia_changed()


def describe_newton(
    scene: Scene, world: WorldModel, motors: MotorTensors, dry: np.ndarray, *, soft: bool
) -> dict[str, list[float]]:
    """Return the first world in the terms of ``PhysicsBackend.describe``.

    Args:
        dry: the motor kernel's dry friction [N·m], (J,).
        soft: True for a solver with MuJoCo's contacts.
    """
    model, layout = world.model, world.layout
    dofs, bodies = layout.joint_v, layout.collision_bodies

    def first(name: str, count: int) -> np.ndarray:
        return getattr(model, name).numpy()[:count]

    mass = first("body_mass", layout.bodies)
    limits = [first(f"joint_limit_{end}", layout.dofs)[dofs] for end in ("lower", "upper")]
    friction = first("shape_material_mu", layout.shapes)
    feet = [int(np.flatnonzero(layout.shape_foot == f)[0]) for f in range(len(scene.robot.foot_names))]
    floor = int(np.flatnonzero(layout.shape_ground)[0])  # the first shape of the ground
    return ModelFields(
        total_mass=float(mass.sum()),
        body_mass=mass[bodies],
        body_inertia=first("body_inertia", layout.bodies)[bodies],
        joint_range=np.stack(limits, axis=1),
        joint_armature=first("joint_armature", layout.dofs)[dofs],
        joint_damping=first("joint_damping", layout.dofs)[dofs],
        joint_friction_loss=np.maximum(dry, first("joint_friction", layout.dofs)[dofs]),
        **motors.described(),
        foot_contact=_foot_contact(scene, world.reference) if soft else None,
        foot_friction=friction[feet],
        floor_friction=float(friction[floor]),
    ).describe()


def _foot_contact(scene: Scene, reference: mujoco.MjModel) -> FootContact:
    """Return the contacts of the feet with a plane of MuJoCo's default properties."""
    feet = [reference.geom(sole[0]).id for sole in scene.robot.soles]
    return FootContact.of_mujoco(
        dimension=[*reference.geom_condim[feet], 3],
        friction=[*reference.geom_friction[feet], (1.0, 0.005, 0.0001)],
        softness=[*reference.geom_solref[feet], (0.02, 1.0)],
        priority=[*reference.geom_priority[feet], 0],
        pyramidal=scene.physics.cone == "pyramidal",
    )
