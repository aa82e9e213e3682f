"""Drake on the CPU: convex contact by its SAP solver, float64, the same to the last bit in every process."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from ..base import Capability, PhysicsOptions, Scene, Support
from ..sequential import SequentialBackend, World
from .plant import APPROXIMATION, Plant, build_plant
from .world import DrakeWorld


def _roughly(note: str) -> Capability:
    return Capability(support=Support.APPROXIMATE, note=note)


def _none(note: str) -> Capability:
    return Capability(support=Support.NONE, note=note)


class DrakeBackend(SequentialBackend):
    """Drake's multibody plant, one context a world."""

    name: ClassVar[str] = "drake"
    own_dry_friction: ClassVar[bool] = False
    limits: ClassVar[Mapping[str, Capability]] = {
        "height_field": _roughly("hydroelastic contact: the robot's shapes are compliant there, their forces come from areas"),
        "foot_contact": _none("the feet's contacts are the same in all worlds, but for sliding friction"),
        "joint_friction": _roughly("an explicit torque that changes sign over a small speed: a joint at rest creeps"),
        "elliptic_cone": _roughly("friction is the exact cone of a hard contact; impratio has no meaning here"),
        "foot_condim_6": _none("contacts slide, they have no torsional or rolling friction"),
        "contact_forces": _roughly("forces of hard contacts: a touchdown's impulse falls into one physics step; no moments"),
        "penetration": Capability(support=Support.EXACT, note="seen one substep late"),
    }

    @classmethod
    def solver_settings(cls, physics: PhysicsOptions) -> Mapping[str, float | str]:
        """See ``PhysicsBackend.solver_settings``: Drake's own, which ``physics`` does not change."""
        return {"cone": "elliptic", "approximation": APPROXIMATION, "contact": "point; hydroelastic on height fields"}

    def __init__(self, scene: Scene, *, device: str = "cpu", threads: int = 1) -> None:
        self._plants: dict[int, Plant] = {}
        super().__init__(scene, device=device, threads=threads)

    def build(self, terrain: int) -> World:
        """See ``SequentialBackend.build``; worlds on one terrain share its plant."""
        if terrain not in self._plants:
            self._plants[terrain] = build_plant(self.scene, self.robot, self.scene.terrains[terrain])
        return DrakeWorld(self._plants[terrain], self.robot, self.scene.physics.timestep)
