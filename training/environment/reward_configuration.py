"""Settings of the rewards: weights, shapes of the terms, and limits that the terms leave free.

A command or a task names all of them in one group, ``environment.rewards``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from ...files.parsing import NotNegative, Positive, Share
from ..configuration import Ramp, Range, check_rising

Extent = Annotated[float, Field(ge=0.0, le=10.0)]
Metres = Annotated[float, Field(gt=0.0, le=100.0)]
_VERTICAL_VELOCITY = Ramp(start=-2.0, end=0.0, begin=0.0, until=0.1)
_BASE_HEIGHT = Ramp(start=-1.0, end=-10.0, begin=0.0, until=0.2)


FOOT_TERMS = ("foot_tilt", "foot_slip", "feet_apart", "air_time", "clock_height", "clock_contact")
"""Terms that are about the steps of the feet (``feet.FootInputs``)."""


@dataclass(frozen=True, kw_only=True)
class OwnTerm:
    """A function of one's own."""

    name: str
    """Name in the log and in settings."""
    function: str
    """The function, as ``module:function``."""


@dataclass(frozen=True, kw_only=True)
class OwnReward(OwnTerm):
    """Reward term of one's own: a function of ``StepInputs`` to one number for each world, (N,)."""

    weight: Ramp | float
    """Weight per second; penalties are negative."""


@dataclass(frozen=True, kw_only=True)
class PoseWeights:
    """Weight of each joint in ``pose`` by its role, which ``robots.anatomy.roles`` tells from the model."""

    hip_roll: float = 1.0
    """Legs to the side."""
    hip_pitch: float = 0.0
    """Thighs forward and back."""
    hip_yaw: float = 1.0
    """Feet that point inwards or outwards."""
    knee: float = 0.0
    """Knees."""
    ankle: float = 1.0
    """Ankles, in pitch, roll and yaw."""
    waist: float = 1.0
    """Waist, in pitch, roll and yaw."""
    arm: float = 1.0
    """Shoulders, elbows, wrists and hands."""
    head: float = 1.0
    """Head and neck."""


@dataclass(frozen=True, kw_only=True)
class RewardWeights:
    """Weights of the reward terms, per second: each step's term is multiplied by its weight and the control period. 0 leaves a term out.

    Formulas are in ``rewards.py``; the paper's table of rewards is the source where nothing else is said.
    """

    linear_tracking: float = 1.0
    """Tracking of the commanded horizontal velocity."""
    yaw_tracking: float = 0.5
    """Tracking of the commanded yaw rate."""
    turn_error: float = 0.0
    """Absolute error of the yaw rate in turns on the spot, at most 1 rad/s. Unlike the tracking kernel it has the same slope far below and
    above the commanded rate."""
    progress: float = 0.0
    """Velocity along the command as a share of it. Unlike the tracking kernels it has a slope where the robot stands before an obstacle."""
    vertical_velocity: Ramp = _VERTICAL_VELOCITY
    """Squared vertical velocity; fades once the robot walks, since climbing needs it."""
    roll_pitch_rate: float = -0.05
    """Squared roll and pitch rates."""
    joint_acceleration: float = -2.5e-7
    """Squared joint accelerations."""
    joint_power: float = -2e-5
    """Absolute mechanical power."""
    torque: float = -1e-4
    """Squared motor torques."""
    base_height: Ramp = _BASE_HEIGHT
    """Squared error of the base's height over the ground below the trunk; grows against sagging."""
    action_rate: float = -0.01
    """Squared first difference of the actions."""
    action_smoothness: float = -0.01
    """Squared second difference of the actions."""
    collision: float = -1.0
    """Number of thighs, calves and what hangs on them that touch something."""
    base_collision: float = 0.0
    """The base touches something; head and chin too."""
    joint_limits: float = -2.0
    """Joint angle beyond the soft limits [rad]."""
    joint_speed_limits: float = 0.0
    """Joint speed beyond the soft limit of the motor's own [rad/s]. In suites without a limit of torque over speed, as the published one,
    a policy may otherwise move its legs faster than the robot's motors can."""
    foot_regulation: float = -0.05
    """Squared foot speed close to the ground."""
    hip_regulation: float = -0.05
    """Absolute deviation of the hips from the standing pose [rad]."""
    hip_symmetry: float = 0.0
    """Left-right asymmetry of the hips at forward commands; the paper's fast task."""
    roll: float = 0.0
    """Squared sideways component of gravity; the gauge's orientation metric looks at roll alone."""
    torque_change: float = 0.0
    """Squared change of the motor torques between control steps [N²·m²]; the gauge's smoothness metric."""
    stand_still: float = 0.0
    """Absolute deviation from the standing pose [rad] under the zero command."""
    termination: float = 0.0
    """Falls, counted once and not per second."""
    alive: float = 0.0
    """Not falling."""
    orientation: float = 0.0
    """Squared horizontal part of gravity in the base's frame."""
    pose: float = 0.0
    """Squared deviations from the standing pose [rad²], weighted by role (``pose_weights``)."""
    foot_tilt: float = 0.0
    """Squared sine of the angle of each sole to the horizontal."""
    foot_slip: float = 0.0
    """Squared horizontal speed of feet that carry [m²/s²]."""
    feet_apart: float = 0.0
    """Distance that a left foot is too close to its right counterpart [m] (``least_apart``)."""
    air_time: float = 0.0
    """Time for which half of the feet have carried alone, up to ``longest_step`` [s], under a command to move."""
    clock_height: float = 0.0
    """Tracking of the clearance that the gait clock asks for (``environment.gait``)."""
    clock_contact: float = 0.0
    """Share of the feet that carry or swing as the gait clock asks."""
    own: tuple[OwnReward, ...] = ()
    """Terms of one's own."""


@dataclass(frozen=True, kw_only=True)
class RewardShapes:
    """Widths of the tracking kernels, and the reference of each measured quantity."""

    tracking_sigma: Positive = 0.25
    """Width of the tracking kernels, exp(-error²/sigma) [m²/s² and rad²/s²]."""
    dynamic_sigma: bool = True
    """Let sigma grow with command and terrain level (paper, dynamic velocity tracking precision adjustment)."""
    sigma_linear_range: Range = (0.5, 1.5)
    """Commanded speed between which sigma grows to the terrain's largest [m/s]."""
    turn_error_time: NotNegative = 0.0
    """Time over which ``turn_error`` averages the error, exponentially [s]; 0 for that of each step. Within a step of a gait the yaw rate
    swings about its mean: the mean's own error then costs what the swing leaves of it."""
    sigma_yaw_range: Range = (1.0, 2.0)
    """Commanded yaw rate between which sigma grows to the terrain's largest [rad/s]."""
    progress_along: Literal["command", "straight", "base"] = "straight"
    """Heading that a command refers to in ``progress``, in being stuck and in the commanded way to the next level. ``command``: the
    robot's heading when the command was drawn, turned by the yaw rates commanded since; a robot that turns at another rate drifts away
    from it without observing that. ``base``: the robot's present heading; turning away from a step then costs nothing. ``straight``: as
    ``command`` during straight commands, which hold the heading, and as ``base`` in arcs."""
    base_height_target: Metres = 0.38
    """Height of the base over the ground below the trunk, from which ``base_height`` measures the error [m]."""
    trunk_area: tuple[Extent, Extent] = (0.4, 0.3)
    """Length and width of the area below the base [m]: the base's height is measured from the mean of the height scan's points in it."""
    foot_height_scale: Positive = 0.025
    """Foot regulation fades with foot height over this share of ``base_height_target``."""
    pose_weights: PoseWeights = PoseWeights()
    least_apart: Extent = 0.15
    """Distance between left and right feet, across the heading, that ``feet_apart`` asks for [m]."""
    longest_step: Positive = 0.4
    """Time on one foot up to which ``air_time`` grows [s]."""
    clock_sigma: Positive = 0.008
    """Width of ``clock_height``, exp(-error²/sigma) [m²]."""
    foot_height_over: Literal["foot", "base"] = "foot"
    """Ground that foot height is measured from: ``foot`` (below that foot) or ``base`` (mean below the trunk)."""

    def __post_init__(self) -> None:
        check_rising(self, "sigma_linear_range", "sigma_yaw_range", strictly=True)


@dataclass(frozen=True, kw_only=True)
class RewardLimits:
    """Forces, angles and speeds up to which a term is zero."""

    collision_force: float = 0.1
    """Contact force from which a thigh, a calf or the base counts as touching [N]."""
    foot_contact_force: Positive = 5.0
    """Contact force from which a foot carries [N]."""
    soft_limit: Share = 0.9
    """Share of a joint's range, about its middle, that is free of the joint-limit penalty."""
    soft_speed_limit: Share = 0.9
    """Share of the motors' no-load speed that is free of the penalty on joint speeds."""


@dataclass(frozen=True, kw_only=True)
class RewardConfiguration(RewardLimits, RewardShapes, RewardWeights):
    """Weights of the reward terms per second, shapes of the terms, and limits that they leave free."""


DEFAULT_REWARDS = RewardConfiguration()
