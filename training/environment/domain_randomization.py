"""Draw the physical differences between worlds and between a world's episodes (paper, domain randomization table)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch

from ...backends.base import PhysicsBackend, Randomization
from ...robots.base import JointParameters
from .configuration import RandomizationConfiguration, Range

MOTOR_COLUMNS = ("stiffness", "damping", "motor_strength", "motor_speed", "motor_offset")
"""Names of the uniform numbers that a reset takes, one column per joint each."""


def outside(ranges: RandomizationConfiguration, measured: JointParameters, joints: Sequence[str]) -> list[str]:
    """Return a sentence for each constant of a measured set that lies outside of the range that training draws it from.

    Args:
        joints: names of the joints, in the set's order.
    """
    every = range(len(joints))
    values: dict[str, tuple[Sequence[float] | None, Range]] = {
        "stiffness": (measured.stiffness_factor, ranges.stiffness),
        "damping": (measured.damping_factor, ranges.damping),
        "motor_offset": (measured.target_offset, ranges.motor_offset),
        "delay": (None if measured.delay is None else [measured.delay] * len(joints), ranges.delay),
    }
    sentences = []
    for name, (found, (low, high)) in values.items():
        beyond = [j for j in every if found is not None and not low <= found[j] <= high]
        if found is not None and beyond:
            worst = max(beyond, key=lambda j: max(low - found[j], found[j] - high))
            whose = (
                "all joints"
                if len(beyond) == len(joints)
                else ", ".join(joints[j].removesuffix("_joint") for j in beyond)
            )
            span = f"{low:g} to {high:g} (environment.randomization.{name})"
            sentences.append(f"{name} of {whose} was measured outside of {span}, up to {found[worst]:.3g}")
    return sentences


def draw_bodies(
    ranges: RandomizationConfiguration, num_envs: int, num_bodies: int, generator: torch.Generator
) -> dict[str, torch.Tensor]:
    """Draw once per world, on the generator's device, by the names of ``Randomization``: effective sliding friction (N,), mass added to
    the base [kg] (N,), factors on the other bodies' masses (N, bodies), the shift of the base's centre of mass [m] (N, 3), and, where
    they vary, factors on the feet's torsion and softness (N,).
    """

    def between(bounds: Range, *shape: int) -> torch.Tensor:
        values = torch.empty(num_envs, *shape, device=generator.device)
        return values.uniform_(bounds[0], bounds[1], generator=generator)

    drawn = {
        "friction": between(ranges.friction),
        "base_mass_offset": between(ranges.base_mass),
        "link_mass_scale": between(ranges.link_mass, num_bodies),
        "base_com_offset": between(ranges.base_com, 3),
    }
    feet = {"foot_torsion": ranges.foot_torsion, "foot_softness": ranges.foot_softness}
    drawn |= {name: between(bounds) for name, bounds in feet.items() if bounds != (1.0, 1.0)}
    if ranges.foot_torsion_ends and "foot_torsion" in drawn:
        low, high = ranges.foot_torsion
        stretched = (drawn["foot_torsion"] - 0.5 * (low + high)) / (1.0 - 2.0 * ranges.foot_torsion_ends)
        drawn["foot_torsion"] = (stretched + 0.5 * (low + high)).clamp(low, high)
    return drawn


class MotorParameters:
    """Drawn anew at every reset of a world."""

    NEUTRAL: ClassVar[dict[str, float]] = {
        "stiffness_scale": 1.0,
        "damping_scale": 1.0,
        "motor_strength": 1.0,
        "motor_speed": 1.0,
        "motor_offset": 0.0,
    }
    """Fields of ``Randomization`` in the order of ``MOTOR_COLUMNS``, for motors without randomization; offsets in rad."""

    def __init__(
        self,
        ranges: RandomizationConfiguration,
        num_envs: int,
        num_joints: int,
        device: torch.device | str,
        offset: Sequence[float] | None = None,
    ) -> None:
        """Prepare motors as the robot's parameter set says; ``offset`` is the one that a measured set has [rad], (J,)."""
        bounds = [getattr(ranges, name) for name in MOTOR_COLUMNS]
        shift = torch.zeros(len(self.NEUTRAL), num_joints, device=device)
        if offset is not None:
            shift[-1] = torch.tensor(offset, device=device)
        self._low = torch.tensor([low for low, _ in bounds], device=device)[:, None] + shift
        self._span = torch.tensor([high - low for low, high in bounds], device=device)[:, None]
        neutral = torch.tensor(list(self.NEUTRAL.values()), device=device)[:, None]
        self._varied = [
            name for name, bound in zip(self.NEUTRAL, bounds, strict=True) if set(bound) != {self.NEUTRAL[name]}
        ]
        self.values = neutral.repeat(num_envs, 1, num_joints) + shift
        """All of them, (N, 5, J)."""

    def redraw(self, uniform: torch.Tensor, worlds: torch.Tensor) -> None:
        """Draw new values, in place, for the masked worlds, from uniform numbers (N, 5 J)."""
        drawn = uniform.view(self.values.shape) * self._span + self._low
        torch.where(worlds[:, None, None], drawn, self.values, out=self.values)

    def apply(self, backend: PhysicsBackend) -> None:
        """Write all worlds' values that vary into the physics: an engine need not support the others.

        All rows are written every time: selecting the rows of a mask would wait for the device to count them.
        """
        values = self.by_name()
        backend.randomize(Randomization(**{name: values[name] for name in self._varied}))

    def by_name(self) -> dict[str, torch.Tensor]:
        """Return the values by the names of ``Randomization``, (N, J) each."""
        return dict(zip(self.NEUTRAL, self.values.unbind(1), strict=True))
