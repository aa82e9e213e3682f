"""The physics contract: N worlds of one robot, each on its own terrain, stepped together.

Every engine has the same frames and units: world frame ``_w`` (x forward, y left, z up), body frame ``_b`` (that of the robot's
base), SI units, quaternions wxyz. All tensors are torch tensors on the backend's device, first axis N (worlds). Floating point is
float64 in an engine that computes in it and float32 elsewhere.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from enum import Enum
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from ..robots.base import JointParameters, Robot
from ..terrains.base import Terrain

if TYPE_CHECKING:
    import torch  # for annotations alone: lists of engines, suites and tasks must not wait for torch


_Iterations = Annotated[int, Field(ge=1, le=10_000)]


def _known_dimension(value: int) -> int:
    if value not in (3, 4, 6):  # no Literal: a setting's text would not become its number
        raise PydanticCustomError("contact_dimension", "Input should be 3, 4 or 6")
    return value


_ContactDimension = Annotated[int, AfterValidator(_known_dimension)]

SMALLEST_BASE_MASS = 0.01
"""Smallest mass of a base [kg]; see ``Randomization.base_mass_offset``."""


class BackendError(RuntimeError):
    """A request that an engine cannot meet; the message says which, why and what to change."""


class DeviceError(BackendError):
    """A device that an engine cannot run on; ``reason`` is the message without the advice for the command line."""

    def __init__(self, reason: str, change: str) -> None:
        super().__init__(reason, change)
        self.reason = reason

    def __str__(self) -> str:
        return "; ".join(self.args)


@dataclass(frozen=True, kw_only=True)
class PhysicsOptions:
    """Options of the simulation."""

    timestep: Annotated[float, Field(ge=1e-5, le=0.1)] = 0.002
    """Length of one physics step (a substep of the control period) [s]."""
    substeps: Annotated[int, Field(ge=1, le=1000)] = 10
    """Physics steps per control period."""
    cone: Literal["elliptic", "pyramidal"] = "elliptic"
    """Friction cone: ``elliptic`` or ``pyramidal``."""
    impratio: Annotated[float, Field(gt=0.0, le=1e6)] = 100.0
    """Ratio of frictional to normal constraint impedance (elliptic cone)."""
    iterations: _Iterations = 100
    """Largest number of solver iterations."""
    ls_iterations: _Iterations = 50
    """Largest number of line-search iterations."""
    tolerance: Annotated[float, Field(ge=0.0, le=1.0)] = 1e-8
    """Solver tolerance."""
    foot_condim: _ContactDimension | None = None
    """Contact dimension of the feet (3 sliding, 4 with torsion, 6 with rolling too); None keeps the robot file's."""
    self_collision: bool = True
    """True where the robot's own parts collide."""
    torque_limits: bool = True
    """True where motor torque is clipped to the parameter set's ``torque_limit``."""
    torque_speed_limit: bool = False
    """True where these limits follow the joint's speed: the torque in the direction of motion falls from the speed of full torque
    to zero at the no-load speed. Needs ``torque_limits`` and a parameter set with its motors' speeds."""
    watch_tilt: Annotated[float, Field(gt=0.0, le=3.1416)] | None = None
    """Watched tilt of the base's z axis against the world's [rad]; ``PhysicsState.tilt_substep`` records its first substep."""
    watch_penetration: Annotated[float, Field(gt=0.0, le=10.0)] | None = None
    """Watched depth of the robot in the terrain without floor and walls [m], recorded in ``PhysicsState.penetration_substep``."""
    contacts_per_world: Annotated[int, Field(ge=1, le=10_000)] | None = None
    """Contact capacity of a world in engines with fixed buffers; None lets the engine choose."""
    deterministic: bool = False
    """True for run-to-run identical results on a GPU."""

    @property
    def control_period(self) -> float:
        """Return the length of a control period [s]."""
        return self.timestep * self.substeps


TRAINING_PHYSICS = PhysicsOptions(
    timestep=0.005,
    substeps=4,
    cone="pyramidal",
    impratio=1.0,
    iterations=6,
    ls_iterations=20,
    tolerance=1e-6,
    foot_condim=3,
    torque_limits=True,
    torque_speed_limit=True,
)
"""Physics that is fast and has converged: 200 Hz, four substeps, sliding friction only; legs meet each other. A pyramidal cone with
a high ``impratio`` needs many more iterations: with 100 and 6, contacts kick. The conformance check ``contact/training`` holds
engines to it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """The input of a backend: robot, terrains and physics."""

    robot: Robot
    parameters: JointParameters
    """Joint and motor constants, usually one of ``robot.parameters``."""
    terrains: tuple[Terrain, ...]
    """The palette of terrains. Worlds refer to it by index, and may change their terrain at a reset."""
    terrain_index: tuple[int, ...]
    """Terrain of every world at the start; its length is the number of worlds."""
    physics: PhysicsOptions = PhysicsOptions()

    def __post_init__(self) -> None:
        if self.terrain_index:
            self.check_terrains(min(self.terrain_index), max(self.terrain_index))

    def check_terrains(self, first: int, last: int) -> None:
        """Raise ``BackendError`` unless the smallest and the largest index of some worlds are in the palette."""
        if first < 0 or last >= len(self.terrains):
            count = len(self.terrains)
            raise BackendError(f"terrain_index holds {first} to {last}, but the terrains are 0 to {count - 1}")

    @property
    def num_worlds(self) -> int:
        """Return the number of worlds."""
        return len(self.terrain_index)


@dataclass(kw_only=True)
class PhysicsState:
    """State of all worlds after a step. Forces and torques are those of the last substep; poses and velocities those after it.

    N worlds, J joints, F feet, B collision bodies, in the robot's orders. A backend may return views of its own memory, which
    change with the next call; ``clone()`` a state that must last.
    """

    time: torch.Tensor
    """Simulated time since the world's last reset [s], (N,)."""
    base_position_w: torch.Tensor
    """Origin of the base body [m], (N, 3)."""
    base_quaternion_w: torch.Tensor
    """Orientation of the base, wxyz, (N, 4)."""
    base_linear_velocity_w: torch.Tensor
    """Velocity of the base origin [m/s], (N, 3)."""
    base_angular_velocity_b: torch.Tensor
    """Angular velocity in the body frame [rad/s], (N, 3)."""
    joint_position: torch.Tensor
    """[rad], (N, J)."""
    joint_velocity: torch.Tensor
    """[rad/s], (N, J)."""
    joint_torque: torch.Tensor
    """Motor torque applied in the last substep, after limits and strength [N·m], (N, J)."""
    foot_position_w: torch.Tensor
    """Centres of the feet, each the mean of its shapes' centres [m], (N, F, 3)."""
    foot_velocity_w: torch.Tensor
    """Velocities of the foot centres [m/s], (N, F, 3)."""
    foot_contact_force_w: torch.Tensor
    """Net force of the ground on all shapes of each foot [N], (N, F, 3)."""
    foot_normal_force: torch.Tensor
    """Sum over a foot's ground contacts of the normal force, along each contact's own normal [N], (N, F)."""
    foot_tangential_force: torch.Tensor
    """Sum over a foot's ground contacts of the magnitude of the tangential force [N], (N, F)."""
    body_contact_force_w: torch.Tensor
    """Net force of the ground on each collision body without its foot's shapes [N], (N, B, 3)."""
    trunk_contact_force_w: torch.Tensor
    """Net force of the ground on the robot's trunk shapes, included in the base's entry above [N], (N, 3)."""
    ground_force_w: torch.Tensor
    """Net force of all ground contacts on the robot [N], (N, 3)."""
    ground_moment_w: torch.Tensor
    """Net moment of all ground contacts about ``contact_center_w`` [N·m], (N, 3)."""
    contact_center_w: torch.Tensor
    """Mean position of the active ground contact points (force > 0) [m], (N, 3); zero without contact."""
    contact_count: torch.Tensor
    """Number of active ground contact points, (N,)."""
    tilt_substep: torch.Tensor
    """First substep (1-based) of the last step at which ``watch_tilt`` was exceeded, 0 if none, (N,) int64."""
    penetration_substep: torch.Tensor
    """First substep (1-based) of the last step at which ``watch_penetration`` was exceeded, 0 if none, (N,) int64."""
    diverged: torch.Tensor
    """The world's state became invalid since its last reset (NaN, infinity or the engine's own alarm), (N,) bool."""
    overflowed: torch.Tensor
    """Contacts or constraints were dropped for lack of capacity since the world's last reset, (N,) bool."""

    def clone(self) -> PhysicsState:
        """Copy every tensor."""
        return replace(self, **{f.name: getattr(self, f.name).clone() for f in fields(self)})


@dataclass(frozen=True, kw_only=True, eq=False)
class ResetState:
    """State of worlds after a reset. N worlds, J joints."""

    base_position: torch.Tensor
    """World frame [m], (N, 3)."""
    base_quaternion: torch.Tensor
    """Orientation of the base, wxyz, (N, 4)."""
    joint_position: torch.Tensor | None = None
    """[rad], (N, J); None for the robot's default pose."""
    base_linear_velocity: torch.Tensor | None = None
    """World frame [m/s], (N, 3); None for rest."""
    base_angular_velocity: torch.Tensor | None = None
    """Body frame [rad/s], (N, 3); None for rest."""
    joint_velocity: torch.Tensor | None = None
    """[rad/s], (N, J); None for rest."""
    held_target: torch.Tensor | None = None
    """Joint targets that act until the first step's own take effect [rad], (N, J); None leaves the motors limp."""
    terrain_index: torch.Tensor | None = None
    """New terrain of each world, (N,) int64, into ``scene.terrains``; None keeps it."""


@dataclass(frozen=True, kw_only=True)
class Randomization:
    """Per-world changes of the model; a field left None stays as it is. W is the number of masked worlds."""

    friction: torch.Tensor | None = None
    """Sliding friction coefficient that acts in every contact of the world, (W,)."""
    foot_torsion: torch.Tensor | None = None
    """Factor on the feet's torsional and rolling friction, (W,); feet of contact dimension 3 have neither."""
    foot_softness: torch.Tensor | None = None
    """Factor on the time constant of the feet's contacts, (W,)."""
    base_mass_offset: torch.Tensor | None = None
    """Mass added to the base body's nominal mass [kg], (W,); inertia and centre of mass stay (a point load at the centre of mass).
    The sum is at least ``SMALLEST_BASE_MASS``."""
    link_mass_scale: torch.Tensor | None = None
    """Factor on each collision body's nominal mass and inertia except the base's, (W, B); the base's entry is ignored."""
    base_com_offset: torch.Tensor | None = None
    """Shift of the base's centre of mass, body frame [m], (W, 3)."""
    stiffness_scale: torch.Tensor | None = None
    """Factor on kp, (W, J)."""
    damping_scale: torch.Tensor | None = None
    """Factor on kd, (W, J)."""
    motor_strength: torch.Tensor | None = None
    """Factor on the motor torque after its limit, (W, J)."""
    motor_speed: torch.Tensor | None = None
    """Factor on the speeds at which a motor's torque falls and ends, (W, J); no effect without a limit by speed."""
    motor_offset: torch.Tensor | None = None
    """Offset of the position error inside the motor law [rad], (W, J)."""


class Support(Enum):
    """An engine's support of a capability."""

    EXACT = "exact"
    APPROXIMATE = "approximate"
    NONE = "not supported"


@dataclass(frozen=True, kw_only=True)
class Capability:
    """One capability of an engine, with a note on its limits."""

    support: Support
    note: str = ""


# Everything that a backend declares, in the documentation's order: terrain, randomization, actions, model, reports.
CAPABILITY_NAMES: tuple[str, ...] = (
    "plane", "boxes", "height_field", "per_world_terrain",
    "friction", "foot_contact", "base_mass", "link_mass", "base_com", "gains", "motor_strength", "motor_speed", "motor_offset",
    "latency", "push", "external_force",
    "torque_limits", "torque_speed_limit", "joint_friction", "elliptic_cone", "foot_condim_6", "self_collision",
    "contact_forces", "penetration", "deterministic", "gpu",
)  # fmt: skip


# Keys of ``PhysicsBackend.describe``, in the order of reports.
DESCRIPTION_KEYS: tuple[str, ...] = (
    "total_mass", "body_mass", "body_inertia",
    "joint_range", "joint_armature", "joint_damping", "joint_friction_loss",
    "stiffness", "damping", "torque_limit", "contact_friction",
    "contact_dimension", "contact_torsion", "contact_rolling", "contact_cone", "contact_softness", "contact_restitution",
)  # fmt: skip


class PhysicsBackend(ABC):
    """N worlds of one robot. See the module docstring for frames and units.

    A wrong mask, shape, terrain or number of substeps raises ``BackendError`` before anything changes; ``arguments.py`` holds
    these checks for all engines.
    """

    name: ClassVar[str]
    """Registry name, for example ``mujoco``."""
    family: ClassVar[str] = ""
    """Contact model for people; engines of one family are relatives. Empty for an engine of its own family."""

    scene: Scene
    device: torch.device
    dtype: torch.dtype
    _state: PhysicsState
    _sample: PhysicsState
    parallel_processes: ClassVar[bool] = False
    """True for an engine on the CPU that plays faster as one process a core than as one process with threads. Several processes may
    then build worlds at the same time, here and on a cluster; results may not depend on their number."""
    velocity_targets: ClassVar[bool] = False
    """True where a target of ``Robot.velocity_joints`` is a velocity; ``make_backend`` refuses such robots else."""
    torque_motors: ClassVar[bool] = False
    """True for an engine that knows ``motor = "torque"``: a joint's target is its motor's torque [N·m], before limits and
    strength. Motors by network need it."""
    state_stays: ClassVar[bool] = False
    """True where ``state`` is always the same tensors, in float32, which every call changes in place."""
    engine_seconds: float | None = None
    """Wall-clock time spent inside the engine's own stepping so far [s]; None where it is not measured."""
    eventful: bool = True
    """False where the engine knows that ``tilt_substep``, ``penetration_substep``, ``diverged`` and ``overflowed`` are zero in
    all worlds of the last step, so that callers may skip the check."""

    @classmethod
    @abstractmethod
    def capabilities(cls) -> Mapping[str, Capability]:
        """Return one entry for each of ``CAPABILITY_NAMES``."""

    @classmethod
    def forkable(cls) -> bool:
        """Return whether a forked process can build worlds; False where the library is at work here and would not survive a fork."""
        return True

    @classmethod
    def solver_settings(cls, physics: PhysicsOptions) -> Mapping[str, float | str]:
        """Return the solver options in force, by name, for the results of a run with ``physics``.

        An engine that changes or ignores options overrides this method.
        """
        names = ("cone", "impratio", "iterations", "ls_iterations", "tolerance")
        return {name: getattr(physics, name) for name in names}

    @abstractmethod
    def __init__(self, scene: Scene, *, device: str = "cpu", threads: int = 1) -> None:
        """Build the worlds; every world starts at the origin in the default pose and must be reset before its first step.

        Raises:
            BackendError: the scene needs a capability that the engine lacks.
        """

    @property
    def num_worlds(self) -> int:
        """Return the number of worlds N."""
        return self.scene.num_worlds

    @property
    def state(self) -> PhysicsState:
        """Return the state after the last call: what an engine keeps in ``_state``. Its tensors may change with the next call."""
        return self._state

    @property
    def sample(self) -> PhysicsState:
        """Return the state snapshot of ``step(sample_at=…)``, kept in ``_sample``; rows of worlds without a request are stale."""
        return self._sample

    @abstractmethod
    def reset(self, start: ResetState, worlds: torch.Tensor | None = None) -> None:
        """Put worlds into a state; ``state`` is fresh afterwards (positions, velocities; forces are zero).

        Randomization persists. External forces and the watches are cleared.

        Args:
            start: N rows in every field; only the masked worlds' count.
            worlds: mask (N,) bool of the worlds to reset, None for all.
        """

    def standing(self) -> ResetState:
        """Return a start for ``reset``: robots upright at standing height over the origin; the motors hold the default pose."""
        import torch

        robot, n = self.scene.robot, self.num_worlds
        rows = ([0.0, 0.0, robot.stand_height], [1.0, 0.0, 0.0, 0.0], robot.default_joint_position)
        place, upright, pose = (torch.tensor([row], device=self.device, dtype=self.dtype).expand(n, -1) for row in rows)
        return ResetState(base_position=place, base_quaternion=upright, held_target=pose)

    @abstractmethod
    def step(
        self,
        joint_targets: torch.Tensor | None,
        *,
        delay: torch.Tensor | None = None,
        sample_at: torch.Tensor | None = None,
        worlds: torch.Tensor | None = None,
        substeps: int | None = None,
    ) -> None:
        """Advance one control period.

        Args:
            joint_targets: [rad], (N, J); None: targets do not change (limp motors stay limp).
            delay: number of substeps for which the previous target still acts, (N,) int64 in 0..substeps; None for 0.
            sample_at: substep (1-based) after which ``sample`` is filled for the world, 0 for none, (N,) int64.
            worlds: mask (N,) bool of the worlds to step, None for all. The others do not change.
            substeps: number of physics steps, None for ``scene.physics.substeps``.
        """

    @abstractmethod
    def randomize(self, randomization: Randomization, worlds: torch.Tensor | None = None) -> None:
        """Change the model of some worlds. ``worlds`` is a mask (N,) bool, None for all; each field has a row per masked world."""

    @abstractmethod
    def push(
        self,
        worlds: torch.Tensor | None = None,
        *,
        linear_velocity_w: torch.Tensor | None = None,
        angular_velocity_b: torch.Tensor | None = None,
    ) -> None:
        """Set base velocities, (N, 3) each, of the masked worlds. NaN entries keep the present value."""

    @abstractmethod
    def apply_force(self, force_w: torch.Tensor) -> None:
        """Apply an external force to the base's centre of mass [N], (N, 3), until the next call or the world's reset."""

    def describe(self) -> Mapping[str, list[float]] | None:
        """Return the first world's model as the engine holds it at present, randomization included; None where unknown.

        Returns:
            Some of ``DESCRIPTION_KEYS``: ``total_mass`` [kg] (1); ``body_mass`` [kg] (B) and ``body_inertia``, the principal
            moments of each body in rising order [kg·m²] (3 B); ``joint_range`` [rad], lower and upper limit of each joint
            (2 J); ``joint_armature`` [kg·m²], ``joint_damping`` [N·m·s/rad], ``joint_friction_loss`` [N·m], ``stiffness``
            [N·m/rad], ``damping`` [N·m·s/rad] and ``torque_limit`` [N·m], infinity for none (J each);
            ``contact_friction``, the sliding coefficient that acts between each foot and the floor, ``contact_dimension`` (3
            sliding, 4 with torsion, 6 with rolling), the coefficients ``contact_torsion`` and ``contact_rolling`` [m], 0 where they
            do not act, ``contact_softness``, the time constant of the contact's spring [s], 0 for a hard contact, and
            ``contact_restitution``, the share of the speed after a bounce (F each); ``contact_cone``, the number of faces of the
            friction cone, infinity for a true one (1).
        """
        return None

    def close(self) -> None:  # noqa: B027  (an engine may have nothing to free)
        """Free the engine's resources. A closed backend must not be used again."""


def unsupported(needed: Sequence[str], capabilities: Mapping[str, Capability]) -> list[str]:
    """Return the names in ``needed`` that the engine does not support at all."""
    return [n for n in needed if capabilities[n].support is Support.NONE]
