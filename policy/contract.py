"""The policy contract: everything that must agree between a policy and the loop that runs it.

It travels with every checkpoint and export in full precision, its hash with every result. A contract is checked when it
is made: one that exists is well-formed. Numbers are kept as Python floats, so that equal contracts have equal hashes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from itertools import accumulate, product
from typing import Annotated, Any, Literal

from pydantic import Field

from ..files.parsing import LARGEST, Text, build, check_fields, parse_json, shown
from ..robots.base import Angle, Damping, HeldJoint, Robot, Speed, Stiffness
from .observation_table import HEIGHT_SCAN, OBSERVATIONS, STANDARD, observation
from .observation_term import MOST, Clip, Target
from .observation_term import RESTING as RESTING
from .observation_term import ContractError as ContractError
from .observation_term import Encoder as Encoder
from .observation_term import History as History
from .observation_term import HistoryOrder as HistoryOrder
from .observation_term import ObservationTerm as ObservationTerm
from .observation_term import Part as Part

SCHEMA_VERSION: Literal[1] = 1

PER_JOINT = ("default_joint_position", "action_scale", "action_offset", "stiffness", "damping", "target_range")
"""Fields of a contract with a value for each joint."""
PER_ENTRY = ("scale", "clip", "reference")
"""Fields of a term with one value, or a value for each of its entries."""
PRIVILEGED_TERMS = tuple(each.name for each in OBSERVATIONS.values() if each.privileged)
"""The project's own observation terms that no sensor of a robot measures."""
EXTEROCEPTIVE_TERMS = tuple(each.name for each in OBSERVATIONS.values() if each.exteroceptive)
"""The project's own observation terms that look at the ground."""
KindOfObservations = Literal["measurable", "exteroceptive", "privileged"]

PHYSICS, ASSUMPTIONS, ASSUMED = "physics", "assumptions", "assumed"
"""Entries of a contract's provenance: ``trained`` and ``tuned``, lists of engines with version and settings; a list of sentences on what
the file does not say and an importer assumed; the same as one text."""


_LATER = frozenset(
    {"action_offset", "layout", "memory", "encoder", "velocity_joints", "held"}
    | {"reference", "values", "period", "offsets", "waves", "at_rest"}
    | {"size", "spacing", "fastest"}
)
"""Fields that hashes of older contracts lack."""
REPEATABLE = ("gait_phase", "constant")
"""Terms that an observation may have more than once."""
_ActionScale = Annotated[float, Field(strict=True, ge=-100.0, le=100.0)]
_Period = Annotated[float, Field(strict=True, ge=0.0005, le=1.0)]


@dataclass(frozen=True, kw_only=True)
class PolicyContract:
    """Joint order, poses, scales and timing of a policy. The target of joint j is ``offset + action_scale * action``.

    Raises:
        ContractError: a field has the wrong type, length or value; the message names it.
    """

    robot: Text
    """Robot registry name."""
    joint_names: Annotated[tuple[Text, ...], Field(min_length=1, max_length=MOST)]
    """Joints in the policy's own order, for observations and actions."""
    default_joint_position: Annotated[tuple[Angle, ...], Field(min_length=1, max_length=MOST)]
    """[rad], in the policy's joint order."""
    action_scale: Annotated[tuple[_ActionScale, ...], Field(min_length=1, max_length=MOST)]
    """[rad] per unit of network output, per joint, [rad/s] for velocity_joints; negative where the network's joint turns the other
    way."""
    action_offset: Annotated[tuple[Angle, ...], Field(min_length=1, max_length=MOST)] | None = None
    """Joint target at an action of zero [rad], None for the default pose."""
    action_clip: Clip | None = None
    """Largest magnitude of the network's output, for targets and ``last_action`` alike; None for no clipping."""
    target_range: tuple[tuple[Target, Target], ...] | None = None
    """Lowest and highest joint target per joint [rad, rad/s], None for no limit."""
    stiffness: Annotated[tuple[Stiffness, ...], Field(min_length=1, max_length=MOST)]
    """Motor kp the policy was made for [N·m/rad]."""
    damping: Annotated[tuple[Damping, ...], Field(min_length=1, max_length=MOST)]
    """Motor kd the policy was made for [N·m·s/rad]."""
    control_period: _Period
    """[s]."""
    observation: Annotated[tuple[ObservationTerm, ...], Field(min_length=1)]
    history: History = field(default_factory=History)
    layout: tuple[Part, ...] = ()
    """Parts of the network's input, where terms have histories of their own or the network several inputs; empty: the history."""
    memory: tuple[tuple[Text, Text], ...] = ()
    """Input and output of an ONNX file for each recurrent state, zeros at a reset; empty: found by their names."""
    encoder: Encoder | None = None
    command_limits: tuple[Speed, Speed, Speed]
    """Largest forward, lateral [m/s] and yaw [rad/s] command the policy was made for."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """Origin of the policy (training run, file, adapter); not part of the hash."""
    velocity_joints: tuple[Text, ...] = ()
    """Joints with targets of velocity [rad/s] instead of angle, as wheels have: torque = damping · (target − speed)."""
    held: Annotated[tuple[HeldJoint, ...], Field(max_length=MOST)] = ()
    """Joints that the policy does not drive, in any order: their motors hold them at an angle with gains of their own. Joints that
    the robot's description holds need no entry, and those that the robot lacks do no harm."""
    schema_version: Literal[1] = SCHEMA_VERSION

    def __post_init__(self) -> None:
        check_fields(self, "contract", ContractError)
        names, joints = self.joint_names, len(self.joint_names)
        if len(set(names)) != joints:
            raise ContractError(f"contract: joint_names has a name twice: {shown(list(names))}")
        for name in PER_JOINT:
            entries = getattr(self, name)
            if entries is not None and len(entries) != joints:
                raise ContractError(f"contract: {name} has {len(entries)} entries; {joints} are needed")
        twice = [joint.name for joint in self.held if [*names, *(h.name for h in self.held)].count(joint.name) > 1]
        if twice:
            raise ContractError(f"contract: held names {shown(twice[0])}, which is in joint_names too or held twice")
        for joint in self.velocity_joints:
            if joint not in names:
                raise ContractError(f"contract: velocity_joints names {shown(joint)}, which is none of joint_names")
            if angle := self.default_joint_position[names.index(joint)]:
                raise ContractError(
                    f"contract: default_joint_position of {shown(joint)} is {angle:g}; of velocity_joints it is 0"
                )
        for joint, (low, high) in zip(names, self.target_range or (), strict=False):
            if low > high:
                raise ContractError(
                    f"contract: target_range of {shown(joint)} is {low:g} to {high:g} rad; it must rise"
                )
        terms = [t.name for t in self.observation]
        if len(set(once := [t for t in terms if t not in REPEATABLE])) != len(once):
            raise ContractError(f"contract: observation has a term twice: {', '.join(terms)}")
        for term, width in zip(self.observation, self.term_widths, strict=True):
            for name in PER_ENTRY:
                values = getattr(term, name)
                if isinstance(values, tuple) and len(values) not in (1, width):
                    raise ContractError(
                        f"contract: observation.{term.name}.{name} has {len(values)} entries; 1 or {width} are needed"
                    )
        for part in self.layout:
            if strange := [name for name in part.terms if name not in terms]:
                raise ContractError(
                    f"contract: layout has the term {shown(strange[0])}; the observation has {', '.join(terms)}"
                )
        if self.encoder and self.encoder.input and self.encoder.input not in self.input_widths:
            known = ", ".join(n for n in self.input_widths if n) or "none"
            raise ContractError(
                f"contract: encoder.input is {shown(self.encoder.input)}; the inputs that layout names are: {known}"
            )

    @cached_property
    def num_joints(self) -> int:
        """Return the number of joints, which is the width of an action."""
        return len(self.joint_names)

    @cached_property
    def term_widths(self) -> tuple[int, ...]:
        """Return the width of each observation term."""
        return tuple(term.width(self.num_joints) for term in self.observation)

    @cached_property
    def scan_points(self) -> int:
        """Return the number of points of the height scan, 0 without one."""
        widths = zip(self.observation, self.term_widths, strict=True)
        return sum(width for term, width in widths if term.name == HEIGHT_SCAN)

    @cached_property
    def frame_width(self) -> int:
        """Return the width of one observation frame."""
        return sum(self.term_widths)

    @cached_property
    def frames(self) -> int:
        """Return the number of frames that have to be kept, the current one included."""
        return max((part.length or self.history.length for part in self.layout), default=self.history.length)

    @cached_property
    def inputs(self) -> Mapping[str, tuple[int, ...]]:
        """Return each input's entries as places in the kept frames (H, F), oldest first, by the input's name, ``""`` for the only one."""
        names, widths = [t.name for t in self.observation], self.term_widths
        begins = list(accumulate((0, *widths)))
        found: dict[str, tuple[int, ...]] = {}
        for part in self.layout or (Part(),):
            length, order = part.length or self.history.length, part.order or self.history.order
            frames = list(range(self.frames - length, self.frames))
            if order.endswith("newest-first"):
                frames.reverse()
            chosen = [i for name in part.terms for i, n in enumerate(names) if n == name]
            terms = chosen or list(range(len(names)))
            blocks = product(frames, terms) if order.startswith("frame") else ((f, t) for t in terms for f in frames)
            places = (self.frame_width * f + begins[t] + i for f, t in blocks for i in range(widths[t]))
            found[part.input] = found.get(part.input, ()) + tuple(places)
        return found

    @cached_property
    def input_widths(self) -> Mapping[str, int]:
        """Return the width of each input, in order."""
        return {name: len(places) for name, places in self.inputs.items()}

    @cached_property
    def observation_width(self) -> int:
        """Return the width of the network's input, all inputs together."""
        return sum(self.input_widths.values())

    def to_dict(self) -> dict[str, Any]:
        """Return plain data, ready for JSON; what came after the first contracts stands there only where it is used."""
        data = asdict(self)
        pairs: list[tuple[Any, dict[str, Any]]] = [
            (self, data),
            *zip(self.observation, data["observation"], strict=True),
        ]
        for made, found in pairs:
            for entry in fields(made):
                if entry.name in _LATER and getattr(made, entry.name) == entry.default:
                    del found[entry.name]
        return data

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> PolicyContract:
        """Read what ``to_dict`` wrote; raise ``ContractError`` where a field is unknown, missing or malformed."""
        return build(cls, data, "contract", ContractError)

    @classmethod
    def from_json(cls, text: str) -> PolicyContract:
        """Read a contract from JSON text; raise ``ContractError`` where it is no JSON or no contract."""
        if len(text) > LARGEST:
            raise ContractError(f"the contract is not read: it is larger than {LARGEST / 1e6:g} MB")
        return cls.from_dict(parse_json(text, "the contract", ContractError))

    def to_json(self) -> str:
        """Return the JSON text in full precision."""
        return json.dumps(self.to_dict(), indent=2)

    @property
    def hash(self) -> str:
        """Return the SHA-256 over everything but the provenance, hexadecimal."""
        data = self.to_dict()
        del data["provenance"]
        return hashlib.sha256(json.dumps(data, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def kind_of_observations(contract: PolicyContract) -> KindOfObservations:
    """Return whether a robot's sensors can measure every observation of a policy, and whether it looks at the ground."""
    seen = [observation(t.name) for t in contract.observation]
    if any(each.privileged for each in seen):
        return "privileged"
    return "exteroceptive" if any(each.exteroceptive for each in seen) else "measurable"


def check_robot(contract: PolicyContract, robot: Robot) -> tuple[int, ...]:
    """Check that a policy is for this robot.

    Returns:
        For each joint of the policy, its index in the robot's joint order.

    Raises:
        ContractError: another robot, or joint names that are not, in some order, those of the robot or of one of its variants, and that
            do not make them up with the joints that the policy holds, or a target of angle without stiffness.
    """
    if contract.robot != robot.name:
        raise ContractError(
            f"the policy is for robot '{contract.robot}', not for '{robot.name}'; leave --robot out, or give a "
            f"policy for '{robot.name}'"
        )
    held = [joint.name for joint in held_joints(contract, robot)]
    if sorted([*contract.joint_names, *held]) != sorted(robot.joint_names):
        names = {name: len(each.driven_joints) for name, each in (robot.variants or {}).items()}
        variants = "".join(f", or the {count} of its variant '{name}'" for name, count in names.items())
        also = f" and holds {', '.join(held)}" if held else ""
        raise ContractError(
            f"the policy's joints are not those of robot '{robot.name}': "
            f"the policy has {', '.join(contract.joint_names)}{also}; the robot has {', '.join(robot.joint_names)}{variants}; joints "
            "that the policy does not drive belong into held of its contract"
        )
    wheels = set(robot.velocity_joints or ()) & set(contract.joint_names)
    if set(contract.velocity_joints) != wheels:
        ours, theirs = (", ".join(sorted(names)) or "no joint" for names in (contract.velocity_joints, wheels))
        raise ContractError(
            f"the policy gives targets of velocity to {ours}, robot '{robot.name}' takes them for {theirs}; mend velocity_joints of "
            "the policy's contract"
        )
    own = robot.parameters[robot.default_parameters].stiffness
    index = tuple(robot.joint_names.index(n) for n in contract.joint_names)
    for name, stiffness, i in zip(contract.joint_names, contract.stiffness, index, strict=True):
        if stiffness == 0.0 and own[i] > 0.0:
            raise ContractError(
                f"the policy's stiffness of '{name}' is 0, so that its target of angle moves nothing; give its kp, or a robot with "
                "wheels there (velocity_joints)"
            )
    return index


def held_joints(contract: PolicyContract, robot: Robot) -> tuple[HeldJoint, ...]:
    """Return the joints that are held while a policy plays: those of its contract, and those that the robot's variant holds else.

    Joints of the contract that the robot lacks are left out: a G1 of 12 joints has rigid arms.
    """
    own = [joint for joint in contract.held if joint.name in robot.joint_names]
    variant, named = robot.driving(contract.joint_names), {joint.name for joint in own}
    return (*own, *(joint for joint in (variant.held if variant else ()) if joint.name not in named))


def reordered(contract: PolicyContract, joint_names: Sequence[str]) -> PolicyContract:
    """Return the contract with all its joints in the order of ``joint_names``; every value per joint goes with its joint."""
    index = [contract.joint_names.index(name) for name in joint_names]

    def moved(values: Any) -> Any:
        return tuple(values[i] for i in index) if isinstance(values, tuple) and len(values) == len(index) else values

    terms = tuple(
        term
        if observation(term.name).width
        else replace(term, **{name: moved(getattr(term, name)) for name in PER_ENTRY})
        for term in contract.observation
    )
    values = {name: moved(getattr(contract, name)) for name in PER_JOINT}
    return replace(contract, joint_names=tuple(joint_names), observation=terms, **values)


def standard_contract(
    robot: Robot, *, history: History | None = None, provenance: Mapping[str, Any] | None = None
) -> PolicyContract:
    """Return the interface that the CTS family of policies for the Unitree Go2 shares (paper, section on observations).

    Angular velocity, gravity, command, joint positions, joint velocities and the last action make 45 entries; an action
    moves the target around the standing pose by the robot's action scale, 0.25 rad per unit for the Go2, every 0.02 s. Angles
    of wheels stay out of the observation.

    Args:
        robot: gives the joints that a policy drives, the standing pose, the gains and the command limits.
        history: frames in the network's input, None for the current one alone.
    """
    motors = robot.parameters[robot.default_parameters]
    names = robot.driven_joints or robot.joint_names
    index = [robot.joint_names.index(name) for name in names]

    def driven(values: Sequence[Any]) -> tuple[Any, ...]:
        return tuple(values[i] for i in index)

    scales = {name: OBSERVATIONS[name].scale for name in STANDARD}
    if robot.velocity_joints:
        scales["joint_position"] = without_wheels(scales["joint_position"], driven(robot.driven_by_velocity))
    return PolicyContract(
        robot=robot.name,
        joint_names=names,
        default_joint_position=driven(robot.default_joint_position),
        action_scale=driven(robot.action_scale or (0.25,) * robot.num_joints),
        stiffness=driven(motors.stiffness),
        damping=driven(motors.damping),
        control_period=0.02,
        observation=tuple(ObservationTerm(name=name, scale=scale) for name, scale in scales.items()),
        history=history or History(),
        command_limits=robot.command_limits,
        velocity_joints=tuple(name for name in names if name in (robot.velocity_joints or ())),
        provenance=provenance or {},
    )


def without_wheels(scale: Sequence[float], wheels: Sequence[bool]) -> tuple[float, ...]:
    """Return the factor on each joint's angle, zero for those that are wheels: the angle of a wheel says nothing."""
    return tuple(
        0.0 if wheel else one for one, wheel in zip(tuple(scale) * (len(wheels) // len(scale)), wheels, strict=True)
    )
