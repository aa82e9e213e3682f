"""Describe the model of the Newton engine."""

from __future__ import annotations

import numpy as np

from ..base import Scene
from ..description import ModelFields
from ..warp.motors import MotorTensors
from .model import WorldModel


def describe_newton(scene: Scene, world: WorldModel, motors: MotorTensors, dry: np.ndarray) -> dict[str, list[float]]:
    """Return the first world in the terms of ``PhysicsBackend.describe``; ``dry`` is the motor kernel's dry friction [N·m], (J,)."""
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
        foot_friction=friction[feet],
        floor_friction=float(friction[floor]),
    ).describe()
