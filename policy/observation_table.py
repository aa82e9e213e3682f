"""The table of observations: everything that the package knows about one entry of a policy's input.

An installed package adds an observation with an entry point of the group ``gaitgauge.observations`` that refers to an
``Observation``; a plug-in is loaded when a contract first names it. A training task names one as ``module:name``
(``environment.observations.policy``), which is known in that process alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from ..files.parsing import did_you_mean, shown
from ..files.plugins import load_plugin, plugins, raised

if TYPE_CHECKING:
    import torch

    from ..backends.base import PhysicsState

GROUP = "gaitgauge.observations"
HEIGHT_SCAN = "height_scan"
"""Height of the base over the ground at points of a grid about it, which turns with the heading."""
ACTION_BEFORE_LAST = "action_before_last"
"""The builder remembers it: the ``last_action`` of the control step before."""
WITHOUT_WHEELS = "joint_pos_rel_without_wheel"
"""robot_lab's angles of joints, those of wheels being zero."""
_WIDEST = 1000


class ObservationError(ValueError):
    """An observation is unknown, malformed or fails; the message is one sentence."""


@dataclass(frozen=True, kw_only=True)
class Observation:
    """One observation of N robots with J joints."""

    name: str
    """Name in contracts; the ending ``_b`` means the base's frame."""
    build: Callable[[PhysicsState, torch.Tensor, torch.Tensor], torch.Tensor]
    """The true value (N, width) in physical units from the state, the command (N, 3) and the last raw action (N, J). Joints come
    in the robot's order. The function must not change its arguments, and no row may depend on another one."""
    width: int | None
    """Number of entries; None for one entry per joint."""
    unit: str
    """Unit for people, for example ``rad/s``; empty for none."""
    noise: str | float | None = None
    """Half width of the uniform noise: a field of the suite's noise and of the training's, or a number in the observation's
    unit; None for an observation without noise. Suites with the published noise stream add none to plug-ins."""
    mirror: tuple[float, ...] | Literal["joints"] | None = None
    """Left-right mirror image: a sign for each entry, or ``joints`` for that of joint angles; None where it is not known, and
    training with symmetry refuses it."""
    mirror_source: tuple[int, ...] | None = None
    """Entry that each entry of the mirror image comes from, for example ``(1, 0)`` for left and right; None: its own."""
    scale: tuple[float, ...] = (1.0,)
    """Factor that this project and legged_gym put on it, one for all entries or one per entry."""
    scales_in_use: tuple[tuple[float, ...], ...] = ((1.0,),)
    """Factors of training codes, none first, then those of legged_gym and Isaac Lab; ``doctor`` tries them."""
    privileged: bool = False
    """No sensor of a robot measures it."""
    exteroceptive: bool = False
    """A map of the ground gives it, which cameras or lidars make; boards rank policies that see it apart."""
    foreign_names: tuple[str, ...] = ()
    """Names in Isaac Lab, mjlab and ``deploy.yaml``; exports write the first one."""
    policy_order: bool = False
    """Its joints are in the policy's order already."""
    about_default_pose: bool = False
    """The contract's default pose is subtracted after the noise [rad]."""

    def __post_init__(self) -> None:
        """Check the fields; raise ``ObservationError`` where one is malformed."""
        where = f"observation {shown(self.name)}"
        if not isinstance(self.name, str) or not self.name.isidentifier():
            raise ObservationError(f"{where} has no usable name; use letters, digits and underscores")
        if not callable(self.build):
            raise ObservationError(f"{where} has build {shown(self.build)}; a function is needed")
        if self.width is not None and (type(self.width) is not int or not 1 <= self.width <= _WIDEST):
            raise ObservationError(
                f"{where} has width {shown(self.width)}; 1 to {_WIDEST}, or None per joint, is allowed"
            )
        signs = None if self.mirror == "joints" else self.mirror
        for field, values in (("mirror", signs), ("mirror_source", self.mirror_source)):
            if values is not None and len(values) != self.width:
                raise ObservationError(f"{where} has {len(values)} entries in {field}; its width is {self.width}")
        if self.mirror_source is not None and sorted(self.mirror_source) != list(range(len(self.mirror_source))):
            raise ObservationError(f"{where} has mirror_source {self.mirror_source}; it must name every entry once")
        if len(self.scale) not in (1, self.width):
            raise ObservationError(f"{where} has {len(self.scale)} entries in scale; 1 or its width are needed")

    def half_width(self, noise: Any) -> float:
        """Return the half width of the noise that a suite's or a training's ``noise`` settings give it, in its own unit."""
        return float(getattr(noise, self.noise, 0.0) if isinstance(self.noise, str) else self.noise or 0.0)


def _base_linear_velocity(state: PhysicsState, command: torch.Tensor, last_action: torch.Tensor) -> torch.Tensor:
    from ..robots.rotation import rotate_inverse  # waits for torch, which a contract need not

    return rotate_inverse(state.base_quaternion_w, state.base_linear_velocity_w)


def _projected_gravity(state: PhysicsState, command: torch.Tensor, last_action: torch.Tensor) -> torch.Tensor:
    from ..robots.rotation import projected_gravity

    return projected_gravity(state.base_quaternion_w)


def _pose_command(state: PhysicsState, command: torch.Tensor, last_action: torch.Tensor) -> torch.Tensor:
    """Return the pose that a command leads to within 1 s: place [m] in the horizontal frame of the heading, and turn [rad], (N, 3).

    The base's velocities count by their horizontal parts, the turning by its part about the vertical. RoboGauge 1.1.8,
    task family go2_lab_pose.
    """
    import torch

    from ..robots.rotation import in_heading, projected_gravity, rotate_inverse

    quaternion = state.base_quaternion_w
    inverse = torch.cat((quaternion[:, :1], -quaternion[:, 1:]), dim=1)
    velocity_b = torch.cat((command[:, :2], torch.zeros_like(command[:, :1])), dim=1)
    forward, left = in_heading(quaternion, rotate_inverse(inverse, velocity_b)).unbind(1)
    turn = -command[:, 2] * projected_gravity(quaternion)[:, 2]
    small = turn.abs() <= 1e-3
    safe = torch.where(small, torch.ones_like(turn), turn)
    along = torch.where(small, 1.0 - turn**2 / 6.0, torch.sin(safe) / safe)
    across = torch.where(small, turn / 2.0 - turn**3 / 24.0, (1.0 - torch.cos(safe)) / safe)
    return torch.stack((along * forward - across * left, across * forward + along * left, turn), dim=1)


_VECTOR, _AXIAL_VECTOR, _PLANAR_COMMAND = (1.0, -1.0, 1.0), (-1.0, 1.0, -1.0), (1.0, -1.0, -1.0)
_OWN = (
    Observation(
        name="base_linear_velocity_b",
        build=_base_linear_velocity,
        width=3,
        unit="m/s",
        noise="base_linear_velocity",
        mirror=_VECTOR,
        scale=(2.0,),
        scales_in_use=((1.0,), (2.0,)),
        privileged=True,
        foreign_names=("base_lin_vel",),
    ),
    Observation(
        name="base_angular_velocity_b",
        build=lambda state, command, last_action: state.base_angular_velocity_b,
        width=3,
        unit="rad/s",
        noise="base_angular_velocity",
        mirror=_AXIAL_VECTOR,
        scale=(0.25,),
        scales_in_use=((1.0,), (0.25,), (0.2,)),
        foreign_names=("base_ang_vel",),
    ),
    Observation(
        name="projected_gravity_b",
        build=_projected_gravity,
        width=3,
        unit="",
        noise="projected_gravity",
        mirror=_VECTOR,
        foreign_names=("projected_gravity",),
    ),
    Observation(
        name="command",
        build=lambda state, command, last_action: command,
        width=3,
        unit="m/s and rad/s",
        mirror=_PLANAR_COMMAND,
        scale=(2.0, 2.0, 0.25),
        scales_in_use=((1.0,), (2.0, 2.0, 0.25)),
        foreign_names=("velocity_commands", "command", "keyboard_velocity_commands"),
    ),
    Observation(
        name="pose_command",
        build=_pose_command,
        width=3,
        unit="m and rad",
        mirror=_PLANAR_COMMAND,
        foreign_names=("pose_command",),
    ),
    Observation(
        name="joint_position",
        build=lambda state, command, last_action: state.joint_position,
        width=None,
        unit="rad",
        noise="joint_position",
        mirror="joints",
        foreign_names=("joint_pos_rel", "joint_pos", WITHOUT_WHEELS),
        about_default_pose=True,
    ),
    Observation(
        name="joint_velocity",
        build=lambda state, command, last_action: state.joint_velocity,
        width=None,
        unit="rad/s",
        noise="joint_velocity",
        mirror="joints",
        scale=(0.05,),
        scales_in_use=((1.0,), (0.1,), (0.05,)),
        foreign_names=("joint_vel_rel", "joint_vel"),
    ),
    Observation(
        name="last_action",
        build=lambda state, command, last_action: last_action,
        width=None,
        unit="",
        mirror="joints",
        foreign_names=("last_action", "actions"),
        policy_order=True,
    ),
    Observation(
        name=ACTION_BEFORE_LAST,
        build=lambda state, command, last_action: last_action,
        width=None,
        unit="",
        mirror="joints",
        policy_order=True,
    ),
    Observation(
        name="command_linear",
        build=lambda state, command, last_action: command[:, :2],
        width=2,
        unit="m/s",
        mirror=(1.0, -1.0),
        foreign_names=("command_lin_vel",),
    ),
    Observation(
        name="command_turning",
        build=lambda state, command, last_action: command[:, 2:],
        width=1,
        unit="rad/s",
        mirror=(-1.0,),
        foreign_names=("command_ang_vel",),
    ),
    # The next three have no function of the state alone: the builder makes them of what the contract's term says.
    Observation(
        name=HEIGHT_SCAN,
        build=lambda state, command, last_action: state.base_position_w[:, 2:],
        width=1,
        unit="m",
        foreign_names=("height_scan", "height_scanner"),
        noise="height_scan",
        exteroceptive=True,
    ),
    Observation(
        name="gait_phase",
        build=lambda state, command, last_action: command[:, :2],
        width=2,
        unit="",
        foreign_names=("gait_phase", "phase"),
    ),
    Observation(name="constant", build=lambda state, command, last_action: command[:, :1], width=1, unit=""),
)
OBSERVATIONS: dict[str, Observation] = {each.name: each for each in _OWN}
"""All observations that this process knows by name: the project's own first, then plug-ins in the order they were loaded."""
STANDARD = (
    "base_angular_velocity_b", "projected_gravity_b", "command", "joint_position", "joint_velocity", "last_action",
)  # fmt: skip
"""Observations of the standard contract, in its order."""
_OWN_NAMES = frozenset(OBSERVATIONS)


def observation(name: str) -> Observation:
    """Return the observation of a name, plug-ins included; raise ``ObservationError`` where there is none or it is broken."""
    if name in OBSERVATIONS:
        return OBSERVATIONS[name]
    installed = plugins(GROUP)
    if name not in installed:
        names = dict.fromkeys((*OBSERVATIONS, *installed))
        near = did_you_mean(name, names)
        raise ObservationError(f"unknown observation term {shown(name)}{near or ';'} choose from: {', '.join(names)}")
    found = load_plugin(installed[name], ObservationError)
    if not isinstance(found, Observation) or found.name != name:
        raise ObservationError(
            f"plug-in {shown(name)} is no gaitgauge.policy.observation_table.Observation of that name"
        )
    return register(found)


def register(made: Observation) -> Observation:
    """Make an observation known in this process, and return it as it is used: errors of its function are one sentence.

    Raises:
        ObservationError: another observation has that name.
    """
    known = OBSERVATIONS.get(made.name)
    if known is not None and (made.name in _OWN_NAMES or replace(known, build=made.build) != made):
        raise ObservationError(f"observation {shown(made.name)} has a name that is taken; choose another")
    OBSERVATIONS[made.name] = replace(made, build=_checked(made))
    return OBSERVATIONS[made.name]


def _checked(made: Observation) -> Callable[[PhysicsState, torch.Tensor, torch.Tensor], torch.Tensor]:
    """Return a plug-in's function with its errors and the shape of its results checked."""

    def build(state: PhysicsState, command: torch.Tensor, last_action: torch.Tensor) -> torch.Tensor:
        expected = (len(command), last_action.shape[1] if made.width is None else made.width)
        try:
            value = made.build(state, command, last_action)
            shape = tuple(value.shape)
        except (Exception, SystemExit) as error:
            raise ObservationError(f"observation {shown(made.name)} {raised(error)}; mend it") from error
        if shape != expected:
            raise ObservationError(
                f"observation {shown(made.name)} gave numbers of shape {shape}; {expected} is needed"
            )
        return value

    return build


def foreign_observation(foreign_name: str) -> Observation:
    """Return the first observation, the project's own first, with this foreign name; raise ``ObservationError`` where none has it."""
    known: dict[str, Observation] = {}
    for name in dict.fromkeys((*OBSERVATIONS, *plugins(GROUP))):
        found = observation(name)
        known |= {each: found for each in found.foreign_names if each not in known}
        if foreign_name in known:
            return known[foreign_name]
    raise ObservationError(f"asks for the observation '{foreign_name}'; supported are: {', '.join(known)}")
