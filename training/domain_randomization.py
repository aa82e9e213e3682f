"""What differs between worlds, and from episode to episode in one world (paper, domain randomization table)."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch

from ..backends.base import PhysicsBackend, Randomization
from .environment_configuration import RandomizationConfiguration, Range

MOTOR_COLUMNS = ("stiffness", "damping", "motor_strength", "motor_offset")
"""Names of the uniform numbers that a reset takes, one column per joint each."""


@dataclass(frozen=True, kw_only=True)
class BodyParameters:
    """Drawn once per world."""

    friction: torch.Tensor
    """Effective sliding friction, (N,)."""
    base_mass_offset: torch.Tensor
    """[kg], (N,)."""
    link_mass_scale: torch.Tensor
    """(N, bodies)."""
    base_com_offset: torch.Tensor
    """[m], (N, 3)."""

    def apply(self, backend: PhysicsBackend) -> None:
        """Write the values into the physics of all worlds."""
        backend.randomize(Randomization(**{f.name: getattr(self, f.name) for f in fields(self)}))


def draw_bodies(
    ranges: RandomizationConfiguration, num_envs: int, num_bodies: int, generator: torch.Generator
) -> BodyParameters:
    """Draw friction, masses and centres of mass for ``num_envs`` worlds, on the generator's device."""

    def between(bounds: Range, *shape: int) -> torch.Tensor:
        values = torch.empty(num_envs, *shape, device=generator.device)
        return values.uniform_(bounds[0], bounds[1], generator=generator)

    return BodyParameters(
        friction=between(ranges.friction),
        base_mass_offset=between(ranges.base_mass),
        link_mass_scale=between(ranges.link_mass, num_bodies),
        base_com_offset=between(ranges.base_com, 3),
    )


@dataclass(kw_only=True)
class MotorParameters:
    """Drawn anew at every reset of a world, (N, J) each."""

    stiffness_scale: torch.Tensor
    damping_scale: torch.Tensor
    motor_strength: torch.Tensor
    motor_offset: torch.Tensor
    """[rad]."""

    @classmethod
    def nominal(cls, num_envs: int, num_joints: int, device: torch.device | str) -> MotorParameters:
        """Motors as the robot's parameter set says."""
        ones = torch.ones(num_envs, num_joints, device=device)
        return cls(
            stiffness_scale=ones.clone(),
            damping_scale=ones.clone(),
            motor_strength=ones.clone(),
            motor_offset=torch.zeros_like(ones),
        )

    def redraw(
        self, ranges: RandomizationConfiguration, uniform: dict[str, torch.Tensor], worlds: torch.Tensor
    ) -> None:
        """New values, in place, for the masked worlds, from uniform numbers by the names of ``MOTOR_COLUMNS``."""
        for name, values in (
            ("stiffness", self.stiffness_scale),
            ("damping", self.damping_scale),
            ("motor_strength", self.motor_strength),
            ("motor_offset", self.motor_offset),
        ):
            low, high = getattr(ranges, name)
            drawn = uniform[name] * (high - low) + low
            values.copy_(torch.where(worlds[:, None], drawn, values))

    def apply(self, backend: PhysicsBackend) -> None:
        """Write all worlds' values into the physics.

        All rows are written every time: selecting the rows of a mask would wait for the device to count them.
        """
        backend.randomize(
            Randomization(
                stiffness_scale=self.stiffness_scale,
                damping_scale=self.damping_scale,
                motor_strength=self.motor_strength,
                motor_offset=self.motor_offset,
            )
        )
