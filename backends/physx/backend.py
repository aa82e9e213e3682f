"""NVIDIA PhysX on the CPU: reduced coordinates, its TGS solver, float32."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch

from ..base import Capability, PhysicsOptions
from ..sequential import SequentialBackend, World
from .limits import LIMITS
from .usd import POSITION_ITERATIONS, SCENE_SETTINGS, VELOCITY_ITERATIONS
from .world import PhysxWorld, in_use


class PhysxBackend(SequentialBackend):
    """PhysX by ovphysx, one instance a world."""

    name: ClassVar[str] = "physx"
    family: ClassVar[str] = "PhysX"
    own_dry_friction: ClassVar[bool] = True
    precision: ClassVar[torch.dtype] = torch.float32
    limits: ClassVar[Mapping[str, Capability]] = LIMITS

    @classmethod
    def forkable(cls) -> bool:
        """See ``PhysicsBackend.forkable``: the library's threads are not there in a forked process."""
        return not in_use()

    @classmethod
    def solver_settings(cls, physics: PhysicsOptions) -> Mapping[str, float | str]:
        """See ``PhysicsBackend.solver_settings``: PhysX's own, which ``physics`` does not change."""
        return {
            "cone": "elliptic",
            "solver": str(SCENE_SETTINGS["physxScene:solverType"]),
            "position_iterations": POSITION_ITERATIONS,
            "velocity_iterations": VELOCITY_ITERATIONS,
            "licence": "NVIDIA Omniverse",
        }

    def build(self, terrain: int) -> World:
        """See ``SequentialBackend.build``."""
        return PhysxWorld(self.scene, self.robot, self.scene.terrains[terrain])
