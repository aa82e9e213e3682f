"""The test bench: small scenes that fit an engine's capabilities, and calls of the engine with numpy arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, fields
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from ...robots.anatomy.body_plan import body_plan
from ...robots.base import JointParameters, Robot
from ...terrains.base import Terrain
from ..base import Capability, PhysicsBackend, PhysicsOptions, PhysicsState, Randomization, ResetState, Scene, Support

FLAT = Terrain(name="conformance_flat", family="flat")
WORLDS = 4
"""Number of worlds in nearly every scene, so that an engine with compiled sizes compiles once."""
STIFF_LOAD = 6.478
"""Mass times leg length for which ``Bench.stiff`` has kp 800, kd 16 and armature 0.1: a Go2's [kg·m]."""


class ConformanceError(AssertionError):
    """A breach of the contract by an engine; the message gives both values."""


def expect(condition: ArrayLike, message: str) -> None:
    """Raise ``ConformanceError`` with the message unless the condition holds, everywhere."""
    if not np.all(condition):
        raise ConformanceError(message)


def expect_close(what: str, actual: ArrayLike, expected: ArrayLike, tolerance: ArrayLike) -> float:
    """Compare arrays, the first axis being worlds, and return the largest difference.

    Args:
        what: name of the quantity with its unit, for the message.
        expected: the reference's values; broadcast against ``actual``.
        tolerance: largest allowed magnitude of the difference, broadcast too.

    Raises:
        ConformanceError: a value is not finite or too far off.
    """
    found = np.asarray(actual, dtype=np.float64)
    wanted = np.broadcast_to(np.asarray(expected, dtype=np.float64), found.shape)
    allowed = np.broadcast_to(np.asarray(tolerance, dtype=np.float64), found.shape)
    error = np.abs(found - wanted)
    bad = ~(error <= allowed)
    if bad.any():
        # NaN first, then the worst excess over the tolerance
        excess = np.where(np.isnan(error), np.inf, error - allowed)
        worst = np.unravel_index(int(np.argmax(excess)), excess.shape)
        at = "" if not worst else f" at {tuple(int(i) for i in worst)}"
        raise ConformanceError(
            f"{what}: {found[worst]:.6g} instead of {wanted[worst]:.6g}{at}; "
            f"off by {error[worst]:.3g}, allowed {allowed[worst]:.3g}"
        )
    return float(error.max()) if error.size else 0.0


class Worlds:
    """An engine's worlds with numpy arrays in and out. Arrays are (N, …), in the contract's units and frames."""

    def __init__(self, backend: PhysicsBackend) -> None:
        self.backend = backend
        self.robot = backend.scene.robot
        self.count = backend.num_worlds
        self.default_pose = np.tile(np.asarray(self.robot.default_joint_position), (self.count, 1))

    def precision(self, double: float, single: float) -> float:
        """Return a tolerance by the engine's floating-point type."""
        return single if self.backend.dtype == torch.float32 else double

    def read(self) -> SimpleNamespace:
        """Return copies of all fields of the present state; floating point as float64."""
        return _snapshot(self.backend.state)

    def read_sample(self) -> SimpleNamespace:
        """Return copies of all fields of the sample."""
        return _snapshot(self.backend.sample)

    def reset(self, worlds: ArrayLike | None = None, **arguments: Any) -> None:
        """Reset with fields of ``ResetState``, which may have one row for all worlds; by default the base is upright at (0, 0, 1)."""
        terrain_index = arguments.pop("terrain_index", None)
        arguments = {"base_position": (0.0, 0.0, 1.0), "base_quaternion": (1.0, 0.0, 0.0, 0.0), **arguments}
        rows = {k: np.broadcast_to(v, (self.count, np.shape(v)[-1])) for k, v in arguments.items() if v is not None}
        tensors = {name: self._tensor(value) for name, value in rows.items()}
        start = ResetState(terrain_index=self._tensor(terrain_index, torch.int64), **tensors)
        self.backend.reset(start, self._tensor(worlds, torch.bool))

    def step(self, targets: Any = None, *, worlds: Any = None, substeps: int | None = None, **when: ArrayLike) -> None:
        """Step as ``PhysicsBackend.step`` does; ``when``: ``delay`` and ``sample_at``."""
        numbers = {name: self._tensor(value, torch.int64) for name, value in when.items()}
        mask = self._tensor(worlds, torch.bool)
        self.backend.step(self._tensor(targets), worlds=mask, substeps=substeps, **numbers)

    def run(self, seconds: float) -> None:
        """Step whole control periods with unchanged targets."""
        for _ in range(round(seconds / self.backend.scene.physics.control_period)):
            self.step()

    def randomize(self, worlds: ArrayLike | None = None, **values: ArrayLike) -> None:
        """Randomize as ``PhysicsBackend.randomize`` does; every value has a row for each world of the mask."""
        randomization = Randomization(**{name: self._tensor(value) for name, value in values.items()})
        self.backend.randomize(randomization, self._tensor(worlds, torch.bool))

    def push(self, worlds: ArrayLike | None = None, **velocities: ArrayLike) -> None:
        """Push as ``PhysicsBackend.push`` does."""
        tensors = {name: self._tensor(value) for name, value in velocities.items()}
        self.backend.push(self._tensor(worlds, torch.bool), **tensors)

    def apply_force(self, force_w: ArrayLike) -> None:
        """Apply a force as ``PhysicsBackend.apply_force`` does."""
        self.backend.apply_force(self._tensor(force_w))

    def _tensor(self, value: ArrayLike | None, dtype: torch.dtype | None = None) -> Any:
        """Return a tensor on the engine's device, by default in its floating-point type; None for None."""
        if value is None:
            return None
        return torch.tensor(np.asarray(value), dtype=dtype or self.backend.dtype, device=self.backend.device)


def _snapshot(state: PhysicsState) -> SimpleNamespace:
    def copy(tensor: torch.Tensor) -> NDArray:
        values = tensor.detach().cpu().numpy()
        return np.array(values, dtype=np.float64 if values.dtype.kind == "f" else values.dtype)

    return SimpleNamespace(**{f.name: copy(getattr(state, f.name)) for f in fields(PhysicsState)})


@dataclass(frozen=True, kw_only=True)
class Bench:
    """The engine under test, for a check."""

    make: Callable[[Scene, str], PhysicsBackend]
    """Function that builds the engine's worlds of a scene on a device."""
    capabilities: Mapping[str, Capability]
    """The engine's declaration."""
    robot: Robot
    """The robot in every scene; four-legged, its feet spheres."""
    device: str = "cpu"
    """The device under test."""

    @property
    def gpu(self) -> bool:
        """Return whether the device under test is a GPU."""
        return not self.device.startswith("cpu")

    def supports(self, *names: str) -> bool:
        """Return whether the engine supports all named capabilities, exactly or approximately."""
        return all(self.capabilities[name].support is not Support.NONE for name in names)

    def bound(self, capability: str, *, exact: float, approximate: float) -> float:
        """Return a tolerance by the engine's declared support of a capability."""
        return exact if self.capabilities[capability].support is Support.EXACT else approximate

    def physics(self, **changes: Any) -> PhysicsOptions:
        """Return the default physics options without unsupported ones, with the changes."""
        options: dict[str, Any] = {
            "cone": "elliptic" if self.supports("elliptic_cone") else "pyramidal",
            "foot_condim": None if self.supports("foot_condim_6") else 3,
            "self_collision": self.supports("self_collision"),
            "torque_limits": False,
        }
        return PhysicsOptions(**(options | changes))

    def soft(self, **changes: float) -> JointParameters:
        """Return the robot's default joint parameters without dry friction; a change is one value for all joints."""
        base = self.robot.parameters[self.robot.default_parameters]
        values = {f.name: getattr(base, f.name) for f in fields(JointParameters)}
        values["friction_loss"] = (0.0,) * self.robot.num_joints
        values.update({name: (value,) * self.robot.num_joints for name, value in changes.items()})
        return JointParameters(**values)

    def stiff(self) -> JointParameters:
        """Return joints that hold the standing pose nearly rigidly, by constants in proportion to mass times leg length."""
        plan = body_plan(self.robot)
        load = plan.mass * plan.leg_length / STIFF_LOAD
        gains = {"stiffness": 800.0 * load, "damping": 16.0 * load, "torque_limit": 1000.0 * load}
        return self.soft(**gains, armature=0.1 * load, joint_damping=0.0)

    @contextmanager
    def worlds(self, parameters: JointParameters | None = None, **scene: Any) -> Iterator[Worlds]:
        """Build a scene, from ``scene``'s arguments, in the engine; close it at the end."""
        with closing(self.make(self.scene(parameters, **scene), self.device)) as backend:
            yield Worlds(backend)

    def scene(
        self,
        parameters: JointParameters | None = None,
        *,
        terrains: Sequence[Terrain] = (FLAT,),
        terrain_index: Sequence[int] | None = None,
        **physics: Any,
    ) -> Scene:
        """Return a scene that fits the engine.

        Args:
            parameters: joint constants, ``soft()`` where None.
            terrain_index: terrain of each world; None for ``WORLDS`` worlds on the first one.
            physics: changes to ``physics()``.
        """
        return Scene(
            robot=self.robot,
            parameters=parameters or self.soft(),
            terrains=tuple(terrains),
            terrain_index=(0,) * WORLDS if terrain_index is None else tuple(terrain_index),
            physics=self.physics(**physics),
        )
