"""Settings of the training environment.

Progress is a fraction of the run: environment steps taken so far (per environment) over ``ScheduleConfiguration.horizon_steps``.
Defaults are chosen for policies that transfer; ``docs/reference/training-settings.md`` lists every difference from the published
code and its reason.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Annotated, Literal

from pydantic import Field

from ...backends.base import TRAINING_PHYSICS, PhysicsOptions
from ...files.parsing import Count, NotNegative, Positive, Seed, Share, Text
from ...robots.base import Angle, Damping, Inertia, Torque
from ..configuration import Ramp, Range, check_rising
from .reward_configuration import DEFAULT_REWARDS, Extent, Metres, RewardConfiguration
from .reward_configuration import OwnReward as OwnReward
from .reward_configuration import OwnTerm as OwnTerm
from .terrain_configuration import TRAINING_TERRAIN, TerrainConfiguration

_Factor = Annotated[float, Field(ge=0.0, le=100.0)]
_SpeedFactor = Annotated[float, Field(ge=0.01, le=100.0)]
_Friction = Annotated[float, Field(ge=0.0, le=10.0)]
_Kilograms = Annotated[float, Field(ge=-1_000.0, le=1_000.0)]
_Shift = Annotated[float, Field(ge=-10.0, le=10.0)]
_Delay = Annotated[float, Field(ge=0.0, le=1.0)]
_STATIONARY = Ramp(start=0.0, end=0.1, begin=0.0, until=0.05)


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """Settings of the environment that change at a fraction of the run. The physics is built anew there, and episodes begin anew on the
    levels reached; a setting that is also given on the command line holds throughout.
    """

    name: str
    """Name in messages and settings."""
    begin: Share
    """Fraction of the run at which the stretch begins; 1 for never."""
    settings: str
    """``environment.…=value``, separated by spaces."""


@dataclass(frozen=True, kw_only=True)
class ScheduleConfiguration:
    """Number of steps of a whole run, and the fraction of it at which the run begins."""

    horizon_steps: Count = 240_000
    """Environment steps, per environment, of the whole run; every ramp and stage is a fraction of it. A task sets it to the steps of its
    iterations, unless it is given on the command line."""
    begin: Share = 0.0
    """Fraction of the run that counts as done at its start: a run that begins with trained networks need not begin with the commands of a
    robot that cannot walk yet."""
    stretches: tuple[Stretch, ...] = ()
    """Later parts of the run with other settings, in order."""


@dataclass(frozen=True, kw_only=True)
class JointConfiguration:
    """Joint and motor constants of the training physics."""

    parameters: str = "training"
    """Name of the robot's parameter set."""
    armature: Inertia | None = None
    """Rotor inertia of every joint [kg·m²]; None keeps the set's."""
    joint_damping: Damping | None = None
    """Passive damping of every joint [N·m·s/rad]; None keeps the set's."""
    friction_loss: Torque | None = None
    """Dry friction of every joint [N·m]; None keeps the set's. 0 spares the solver twelve constraints per world."""
    driven: tuple[str, ...] = ()
    """Roles of the joints that the policy drives, or their beginnings (``hip``); motors hold all others in the standing pose. Empty for
    the robot's own choice, all joints where its description says nothing."""
    rigid: bool = False
    """Make the joints that the policy does not drive rigid in the training physics, which has fewer degrees of freedom then."""
    moving: tuple[str, ...] = ()
    """Roles of joints, or their beginnings (``waist``), that ``rigid`` leaves to the motors that hold them. On a waist that gives way the
    pelvis of a G1 sways about its yaw axis with each step; a policy that learns with a rigid waist never sees that."""


@dataclass(frozen=True, kw_only=True)
class GaitConfiguration:
    """A clock that the policy sees: sine, then cosine, of one phase for each foot. It stands at half a cycle under a zero command."""

    period: Positive | None = None
    """Time of a gait cycle [s]; None for no clock."""
    offsets: tuple[Share, ...] = (0.25, 0.75)
    """Share of a cycle by which each foot's phase is ahead, in the order of ``foot_names``. A step's middle is at phase 0."""
    swing_share: Annotated[float, Field(gt=0.0, le=1.0)] = 0.4
    """Share of a cycle in which a foot is to be in the air."""
    swing_height: Metres = 0.09
    """Clearance that is asked for in the middle of a step [m]."""


@dataclass(frozen=True, kw_only=True)
class OwnTermination(OwnTerm):
    """An end of episodes of one's own: a function of ``StepInputs`` and ``TerminationConfiguration`` to (N,) bool."""

    time_out: bool = False
    """True if the end is no failure: the learner bootstraps the missing future."""


@dataclass(frozen=True, kw_only=True)
class OwnObservation(OwnTerm):
    """Something more that teacher and critic see: a function of ``ObservationInputs`` to (N, width), without noise, of the order of one."""


@dataclass(frozen=True, kw_only=True)
class OwnEvent(OwnTerm):
    """Something more that happens to the physics: a function of the environment and a mask of the worlds that begin an episode, (N,) bool,
    called in every step after resets and pushes.
    """


@dataclass(frozen=True, kw_only=True)
class NoiseConfiguration:
    """Half-widths of the uniform noise that every observation gets, in physical units. 0 turns an entry off."""

    base_angular_velocity: NotNegative = 0.8
    """[rad/s]. The gauge's value; the published training used 0.2."""
    projected_gravity: NotNegative = 0.05
    """Per component of the unit vector. The gauge adds none."""
    joint_position: NotNegative = 0.01
    """[rad]."""
    joint_velocity: NotNegative = 3.0
    """[rad/s]. The gauge's value; the published training used 1.5."""
    height_scan: NotNegative = 0.05
    """Of each height that a policy with ``height_scan`` sees [m]. The gauge adds 0.02 m."""


@dataclass(frozen=True, kw_only=True)
class ObservationConfiguration:
    """Inputs of the networks."""

    history_length: Annotated[int, Field(ge=1, le=1000)] = 5
    """Frames in the student's history, the current one included."""
    history_start: Literal["zeros", "repeat"] = "repeat"
    """Contents of the history at the start of an episode: ``repeat`` for copies of the first frame, as the robot's own controller fills
    it, or ``zeros`` as published. It becomes part of the policy contract."""
    noise: NoiseConfiguration = NoiseConfiguration()
    scan_length: Metres = 1.6
    """Extent of the height scan along the heading [m]."""
    scan_width: Metres = 1.0
    """Extent of the height scan across the heading [m]."""
    scan_spacing: Metres = 0.1
    """Distance between scan points [m]."""
    foot_force_scale: Positive = 1e-3
    """Factor on the feet's contact forces, which teacher and critic see [1/N]."""
    height_offset: float = 0.5
    """Height of the base over the ground that a scan entry of 0 stands for [m]."""
    scan_cell: Metres = 0.05
    """Cell of the height rasters that the scan is read from [m]; the nearest node counts."""
    scan_delay: Annotated[float, Field(ge=0.0, le=1.0)] = 0.06
    """Age of the map when a policy with ``height_scan`` sees it [s], in whole control periods. The gauge's value."""
    policy: tuple[str, ...] = ()
    """Observations that the policy sees behind the standard ones: names of installed ones, or ``module:name`` of a
    ``policy.observation_table.Observation`` of one's own, which this process alone knows. They become part of the policy contract."""
    own: tuple[OwnObservation, ...] = ()
    """Entries of one's own behind those of ``privileged``. The mirror images of ``training.algorithm.symmetry`` do not know them."""


@dataclass(frozen=True, kw_only=True)
class CommandStage:
    """Ranges that commands are drawn from, from a fraction of the run on."""

    begin: Share
    """Fraction of the run at which the stage begins."""
    forward: Range
    """Forward velocity [m/s]."""
    lateral: Range
    """Lateral velocity [m/s]."""
    yaw: Range
    """Yaw rate [rad/s]."""

    def __post_init__(self) -> None:
        check_rising(self, "forward", "lateral", "yaw")


@dataclass(frozen=True, kw_only=True)
class CommandConfiguration:
    """Commands of the robot (paper, command design)."""

    stages: tuple[CommandStage, ...] = (
        CommandStage(begin=0.0, forward=(-0.5, 0.5), lateral=(-0.5, 0.5), yaw=(-1.0, 1.0)),
        CommandStage(begin=0.1, forward=(-1.0, 1.0), lateral=(-1.0, 1.0), yaw=(-1.5, 1.5)),
        CommandStage(begin=0.3, forward=(-2.0, 2.0), lateral=(-1.0, 1.0), yaw=(-2.0, 2.0)),
    )
    """Ranges over the run; a terrain's own limits cap every stage."""
    curriculum: bool = True
    """Draw commands from stage after stage; otherwise from the last stage's ranges throughout (paper, command curriculum)."""
    interval: Positive = 5.0
    """Time between two draws [s]."""
    dynamic: bool = True
    """Raise the smallest speed drawn until the robot can still leave its tile in the rest of the episode (paper, dynamic command
    sampling)."""
    required_distance: float = 5.0
    """Distance that the commands of an episode shall add up to at least [m] (``dynamic``)."""
    straight_probability: Share = 0.3
    """Share of the uniform draws with zero yaw rate. Published: 0; the gauge's commands are all straight or a pure turn."""
    heading_gain: NotNegative = 0.0
    """Yaw rate commanded in straight draws for each radian by which the robot is off the heading it had when the command was drawn [1/s],
    within the range: a robot that turned away is told to turn back. 0 commands no yaw there."""
    extreme_probability: Share = 0.2
    """Share of draws with every axis at a limit or zero."""
    extreme_zero_probability: tuple[float, float, float] = (1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0)
    """Chance of the forward, lateral and yaw speed of an extreme command to be zero. Published: 0, 0 and 1/3, and 0, 1 and 1/3 for the
    fast task."""
    flip_probability: Share = 0.2
    """Chance that an extreme command is followed by its opposite."""
    stationary_probability: Ramp = _STATIONARY
    """Share of stationary draws, without linear velocity."""
    stationary_yaw_probability: Share = 0.25
    """Chance that a stationary command keeps its yaw rate, so that the robot turns on the spot. Published: always."""
    stationary_longest: NotNegative = 3.0
    """Longest stationary command [s]."""
    crossing_probability: Share = 0.0
    """Share of the episodes, on tiles with an edge, with one command throughout, straight ahead or straight back at half the highest
    speed or more: the robot is to leave its tile, as the gauge's level tests ask, and has time to climb tall steps."""
    generator: str = "gaitgauge.training.environment.commands:CommandGenerator"
    """``module:class`` that draws commands, this one or one derived from it."""

    @property
    def drawn_stages(self) -> tuple[CommandStage, ...]:
        """Return the stages that commands go through."""
        return self.stages if self.curriculum else tuple(replace(stage, begin=0.0) for stage in self.stages[-1:])


@dataclass(frozen=True, kw_only=True)
class ResetConfiguration:
    """Start of an episode."""

    joint_scale: Range = (0.5, 1.5)
    """Factor on the standing pose, per joint, within the joint limits."""
    velocity: float = 0.5
    """Largest component of the base's linear [m/s] and angular [rad/s] velocity."""
    clearance: float | None = None
    """Height of the base over the highest ground below the robot [m]; None for the robot's ``stand_height``."""
    footprint: tuple[Extent, Extent] = (0.5, 0.4)
    """Length and width of the area below the robot in which ``clearance`` is measured [m]."""

    def __post_init__(self) -> None:
        check_rising(self, "joint_scale")


@dataclass(frozen=True, kw_only=True)
class RandomizationConfiguration:
    """Ranges of the differences between worlds (paper, domain randomization table), uniform."""

    friction: tuple[_Friction, _Friction] = (0.2, 1.25)
    """Effective sliding friction, once per world. Published: 0.5 to 1.5; the gauge judges 0.2 to 1.0."""
    foot_torsion: tuple[NotNegative, NotNegative] = (1.0, 1.0)
    """Factor on the feet's torsional and rolling friction, once per world; acts with physics.foot_condim 4 or 6."""
    foot_torsion_ends: Annotated[float, Field(ge=0.0, lt=0.5)] = 0.0
    """Share of the worlds at each end of foot_torsion; the rest are between."""
    foot_softness: tuple[Positive, Positive] = (1.0, 1.0)
    """Factor on the time constant of the feet's contacts, once per world."""
    base_mass: tuple[_Kilograms, _Kilograms] = (-1.0, 1.0)
    """Added to the base's mass [kg], once per world."""
    link_mass: tuple[_Factor, _Factor] = (0.9, 1.1)
    """Factor on the mass of each other body, once per world."""
    base_com: tuple[_Shift, _Shift] = (-0.03, 0.03)
    """Shift of the base's centre of mass per axis [m], once per world."""
    stiffness: tuple[_Factor, _Factor] = (0.9, 1.1)
    """Factor on kp per joint, every reset."""
    damping: tuple[_Factor, _Factor] = (0.9, 1.1)
    """Factor on kd per joint, every reset."""
    motor_offset: tuple[Angle, Angle] = (-0.035, 0.035)
    """Added to the motor's position error per joint [rad], every reset."""
    motor_strength: tuple[_Factor, _Factor] = (0.8, 1.2)
    """Factor on the torque per joint after its limit, every reset."""
    motor_speed: tuple[_SpeedFactor, _SpeedFactor] = (1.0, 1.0)
    """Factor on the speeds at which a motor's torque falls and ends, per joint, every reset; needs torque_speed_limit to act."""
    delay: tuple[_Delay, _Delay] = (0.0, 0.02)
    """Time for which the previous target still acts [s], in whole substeps, every control step."""

    def __post_init__(self) -> None:
        check_rising(self, *(f.name for f in fields(self) if f.name != "foot_torsion_ends"))


@dataclass(frozen=True, kw_only=True)
class PushConfiguration:
    """Sudden changes of the base's velocity."""

    interval: NotNegative = 4.0
    """Time between pushes of one world [s]; 0 for none."""
    linear: NotNegative = 0.4
    """Largest change of the horizontal velocity per axis [m/s]."""
    angular: NotNegative = 0.6
    """Largest change of the angular velocity per axis [rad/s]."""
    add: bool = True
    """Add the change to the velocity; otherwise it replaces the velocity, as published, which stops a fast robot dead."""


@dataclass(frozen=True, kw_only=True)
class TerminationConfiguration:
    """Conditions that end an episode early (``training/environment/terminations.py``)."""

    trunk_contact: NotNegative | None = None
    """Force of the ground on the trunk, head and chin apart, that ends an episode [N]. None for never."""
    tilt: Positive | None = 1.4
    """Angle between the base's z axis and the world's [rad]; None for no limit."""
    joint_velocity: Positive = 150.0
    """Joint speed beyond anything real, which counts as a diverged world [rad/s]."""
    low: Metres | None = None
    """Height of the base over the ground below the trunk under which an episode ends [m]. None for never."""
    stuck: Positive | None = None
    """Time without progress after which a robot that did as commanded before is stuck [s]: its episode ends as a failure and moves the
    level down. None for never."""
    stuck_from: NotNegative = 0.1
    """Fraction of the run from which being stuck ends episodes: a robot that cannot walk yet is always stuck."""
    own: tuple[OwnTermination, ...] = ()
    """Rules of one's own."""


@dataclass(frozen=True, kw_only=True)
class EnvironmentConfiguration:
    """Everything about the training environment."""

    robot: str = "go2"
    """Registry name of the robot, or the path of its description."""
    num_envs: Annotated[int, Field(ge=1, le=10_000_000)] = 8192
    """Number of worlds."""
    seed: Seed = 0
    """Seed of every draw the environment makes."""
    episode_length: Positive = 25.0
    """Longest episode [s], at least one control period."""
    physics: PhysicsOptions = TRAINING_PHYSICS
    joints: JointConfiguration = JointConfiguration()
    gait: GaitConfiguration = GaitConfiguration()
    schedule: ScheduleConfiguration = ScheduleConfiguration()
    observations: ObservationConfiguration = ObservationConfiguration()
    rewards: RewardConfiguration = DEFAULT_REWARDS
    commands: CommandConfiguration = CommandConfiguration()
    terrain: TerrainConfiguration = TRAINING_TERRAIN
    reset: ResetConfiguration = ResetConfiguration()
    randomization: RandomizationConfiguration = RandomizationConfiguration()
    push: PushConfiguration = PushConfiguration()
    termination: TerminationConfiguration = TerminationConfiguration()
    events: tuple[OwnEvent, ...] = ()
    """Events of one's own."""
    scenarios: tuple[Text, ...] = ()
    """Scenario files that some worlds play, such as ``gaitgauge worst`` writes; a folder stands for its TOML files."""
    scenario_share: Annotated[float, Field(gt=0.0, le=0.9)] = 0.2
    """Share of the worlds that play ``scenarios``, the same number for each file; an episode there lasts as long as its commands."""
    scenario_variation: Annotated[float, Field(ge=0.0, le=0.9)] = 0.1
    """Largest share by which commands, forces, loads, friction and latency differ from the file's, and moments, in seconds; loads differ
    from world to world, all else from episode to episode."""
    log_interval: Count = 8
    """Environment steps between two logs of finished episodes; each log costs the learner's logger time."""

    def __post_init__(self) -> None:
        if self.episode_length < self.physics.control_period:
            raise ValueError(
                f"episode_length is {self.episode_length:g} s; it must be at least one control period, "
                f"{self.physics.control_period:g} s"
            )
