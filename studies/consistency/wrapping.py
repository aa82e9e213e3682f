"""Backends that stand before another one and change a single thing, so that the runner of episodes need not know.

``RetimedBackend`` lets an engine run with another timestep under a protocol that counts substeps; ``PerturbedBackend`` puts
state and targets off by a hair, to see what chaos alone makes of an episode.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from ...backends.base import BackendError, PhysicsBackend, PhysicsState, ResetState, Scene
from ...backends.wrapped import WrappedBackend
from ...gauge.play.noise import uniform_hash


class PerturbedBackend(WrappedBackend):
    """Every reset puts joints and base height off by a relative amount, by another one in every episode and segment of it.

    With ``targets`` the joint targets are put off as well, in every control step: single precision does not round at the start
    alone.
    """

    def __init__(self, inner: PhysicsBackend, magnitude: float, *, draw: int = 0, targets: bool = False) -> None:
        """Perturb ``inner``.

        Args:
            magnitude: largest relative change. It never is below four roundings of the engine's numbers.
            draw: number of the perturbation; each has other signs and sizes.
            targets: whether the joint targets are put off too.
        """
        super().__init__(inner)
        robot, device = inner.scene.robot, inner.device
        self._magnitude = max(magnitude, 4.0 * torch.finfo(inner.dtype).eps)
        self._draw, self._targets = draw, targets
        self._pose = torch.tensor(robot.default_joint_position, dtype=inner.dtype, device=device)
        self._index = torch.arange(robot.num_joints + 1, device=device)
        self._key = torch.zeros(inner.num_worlds, dtype=torch.int64, device=device)
        self._step = torch.zeros_like(self._key)
        self.assign(range(inner.num_worlds), [""] * inner.num_worlds)

    def assign(self, worlds: Sequence[int], names: Sequence[str]) -> None:
        """Say what worlds play from the next reset on; the name decides about the perturbation."""
        keys = [zlib.crc32(f"{self._draw} {name}".encode()) for name in names]
        self._key[torch.tensor(list(worlds), device=self.device)] = torch.tensor(keys, device=self.device)

    def _factors(self) -> torch.Tensor:
        """Return one plus the relative error of this step, for joints and base height, (K, J + 1)."""
        unit = 2.0 * uniform_hash(self._key[:, None], self._step[:, None], self._index) - 1.0
        return 1.0 + self._magnitude * unit.to(self.dtype)

    def reset(self, start: ResetState, worlds: torch.Tensor | None = None) -> None:
        """See ``PhysicsBackend.reset``."""
        if worlds is None:
            self._step.zero_()
        else:
            self._step.masked_fill_(worlds, 0)
        factors = self._factors()
        position = start.base_position.to(self.dtype).clone()
        position[:, 2] *= factors[:, -1]
        asked = start.joint_position
        joints = self._pose.expand(self.num_worlds, -1) if asked is None else asked.to(self.dtype)
        self.inner.reset(replace(start, base_position=position, joint_position=joints * factors[:, :-1]), worlds)

    def step(self, joint_targets: torch.Tensor | None, **arguments: Any) -> None:
        """See ``PhysicsBackend.step``."""
        if self._targets and joint_targets is not None:
            self._step += 1
            joint_targets = joint_targets.to(self.dtype) * self._factors()[:, :-1]
        self.inner.step(joint_targets, **arguments)


class RetimedBackend(WrappedBackend):
    """An engine with another timestep behind a scene that counts its own substeps.

    Delays and sampling times are rounded to the engine's grid; the substep at which a watch tripped is counted in the outer
    scene's substeps again. A reset's single limp substep is one of the engine's own.
    """

    def __init__(self, inner: PhysicsBackend, scene: Scene) -> None:
        """Stand before ``inner``, whose control period must be that of ``scene``. Raises BackendError: the control periods differ."""
        mine, theirs = scene.physics, inner.scene.physics
        if abs(mine.control_period - theirs.control_period) > 1e-9:
            raise BackendError(
                f"a timestep of {theirs.timestep:g} s with {theirs.substeps} substeps gives a control period of "
                f"{theirs.control_period:g} s instead of {mine.control_period:g} s; choose a timestep that divides it"
            )
        super().__init__(inner, scene)
        self._ratio = mine.timestep / theirs.timestep
        self._inner_substeps = theirs.substeps

    @property
    def state(self) -> PhysicsState:
        """The engine's state, with substeps counted as the outer scene does."""
        return _RetimedState(self.inner.state, self._ratio, self.scene.physics.substeps)

    @property
    def sample(self) -> PhysicsState:
        """The same for the sample."""
        return _RetimedState(self.inner.sample, self._ratio, self.scene.physics.substeps)

    def step(
        self,
        joint_targets: torch.Tensor | None,
        *,
        delay: torch.Tensor | None = None,
        sample_at: torch.Tensor | None = None,
        substeps: int | None = None,
        **arguments: Any,
    ) -> None:
        """See ``PhysicsBackend.step``."""
        count = self._inner_substeps if substeps is None else max(1, round(substeps * self._ratio))
        if delay is not None:
            delay = torch.round(delay * self._ratio).to(torch.int64)
        if sample_at is not None:
            nearest = torch.round(sample_at * self._ratio).to(torch.int64).clamp(min=1)
            sample_at = torch.where(sample_at > 0, nearest, torch.zeros_like(nearest))
        self.inner.step(joint_targets, delay=delay, sample_at=sample_at, substeps=count, **arguments)


class _RetimedState(PhysicsState):
    """A view of a state with watches in other substeps."""

    def __init__(self, state: PhysicsState, ratio: float, substeps: int) -> None:
        self._state = state
        for name in ("tilt_substep", "penetration_substep"):
            inner = getattr(state, name)
            setattr(self, name, torch.ceil(inner / ratio - 1e-6).to(torch.int64).clamp(max=substeps))

    def __getattr__(self, name: str) -> torch.Tensor:
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._state, name)

    def clone(self) -> PhysicsState:
        """Copy every tensor."""
        copied = self._state.clone()
        copied.tilt_substep, copied.penetration_substep = self.tilt_substep, self.penetration_substep
        return copied
