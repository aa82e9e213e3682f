"""Drake on the CPU: convex contact by its SAP solver, float64, the same to the last bit in every process."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from ..base import Capability, PhysicsOptions, Scene
from ..sequential import SequentialBackend, World
from .hydroelastic import MODULUS
from .limits import LIMITS
from .plant import APPROXIMATION, RELAXATION, Plant, build_plant
from .world import DrakeWorld


class DrakeBackend(SequentialBackend):
    """Drake's multibody plant, one context a world."""

    name: ClassVar[str] = "drake"
    family: ClassVar[str] = "Drake"
    own_dry_friction: ClassVar[bool] = False
    limits: ClassVar[Mapping[str, Capability]] = LIMITS

    @classmethod
    def solver_settings(cls, physics: PhysicsOptions) -> Mapping[str, float | str]:
        """See ``PhysicsBackend.solver_settings``: Drake's own, which ``physics`` does not change."""
        return {
            "cone": "elliptic",
            "approximation": APPROXIMATION,
            "relaxation_time": RELAXATION * physics.timestep,
            "hydroelastic_modulus": MODULUS,
            "licence": "BSD-3-Clause",
        }

    def __init__(self, scene: Scene, *, device: str = "cpu", threads: int = 1) -> None:
        self._plants: dict[int, Plant] = {}
        super().__init__(scene, device=device, threads=threads)

    def build(self, terrain: int) -> World:
        """See ``SequentialBackend.build``; worlds on one terrain share its plant."""
        if terrain not in self._plants:
            self._plants[terrain] = build_plant(self.scene, self.robot, self.scene.terrains[terrain])
        return DrakeWorld(self._plants[terrain], self.robot, self.scene.physics.timestep)
