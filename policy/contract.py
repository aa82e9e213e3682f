"""The policy contract: everything that must agree between a policy and the loop that runs it.

It travels with every checkpoint and export in full precision, its hash with every result. A contract is checked when it
is made: one that exists is well-formed. Numbers are kept as Python floats, so that equal contracts have equal hashes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, Literal

from pydantic import Field

from ..files.parsing import LARGEST, Text, build, check_fields, parse_json, shown
from ..robots.base import Angle, Damping, Robot, Speed, Stiffness
from .observation_table import OBSERVATIONS, STANDARD, ObservationError, observation

SCHEMA_VERSION: Literal[1] = 1
HistoryOrder = Literal["frame-major", "term-major", "frame-major-newest-first"]

PER_JOINT = ("default_joint_position", "action_scale", "stiffness", "damping", "target_range")
"""Fields of a contract with a value for each joint."""
PRIVILEGED_TERMS = tuple(each.name for each in OBSERVATIONS.values() if each.privileged)
"""The project's own observation terms that no sensor of a robot measures."""

PHYSICS, ASSUMPTIONS, ASSUMED = "physics", "assumptions", "assumed"
"""Entries of a contract's provenance: ``trained`` and ``tuned``, lists of engines with version and settings; a list of sentences on what
the file does not say and an importer assumed; the same as one text."""


class ContractError(ValueError):
    """A contract is malformed, or does not fit the robot, suite or policy at hand."""


_MOST = 1000
"""Joints."""
_ActionScale = Annotated[float, Field(strict=True, ge=-100.0, le=100.0)]
_Factor = Annotated[float, Field(strict=True, ge=-1e6, le=1e6)]
_Clip = Annotated[float, Field(strict=True, gt=0.0, le=1e9)]
_Target = Annotated[float, Field(strict=True, ge=-1_000.0, le=1_000.0)]
_Period = Annotated[float, Field(strict=True, ge=0.0005, le=1.0)]


@dataclass(frozen=True, kw_only=True)
class ObservationTerm:
    """One block of the observation vector; ``joint_position`` is relative to the default pose, ``last_action`` the raw output."""

    name: Text
    """Name of an observation of ``observation_table``."""
    scale: Annotated[tuple[_Factor, ...], Field(min_length=1, max_length=_MOST)]
    """Factor per entry; one entry stands for all."""
    clip: _Clip | Annotated[tuple[_Clip, ...], Field(min_length=1, max_length=_MOST)] | None = None
    """Largest magnitude after scaling, for all entries or per entry; None for no clipping."""

    def __post_init__(self) -> None:
        check_fields(self, "contract", ContractError)
        try:
            observation(self.name)
        except ObservationError as error:
            raise ContractError(f"contract: {error}") from error


@dataclass(frozen=True, kw_only=True)
class History:
    """Past observations in a network's input; length 1 where the network keeps its own, for which ``start`` holds too."""

    length: Annotated[int, Field(strict=True, ge=1, le=1000)] = 1
    """Number of frames, the current one included."""
    order: HistoryOrder = "frame-major"
    """``frame-major``: whole frames, oldest first; ``frame-major-newest-first``: the same reversed; ``term-major``: all
    frames of the first term, oldest first, then the next term.
    """
    start: Literal["zeros", "repeat"] = "zeros"
    """Content of the frames before the first one: ``zeros``, as in the published training, or ``repeat`` for copies of
    the first frame, as the robot's own controller does it."""

    def __post_init__(self) -> None:
        check_fields(self, "contract", ContractError)


@dataclass(frozen=True, kw_only=True)
class PolicyContract:
    """Joint order, poses, scales and timing of a policy. The target of joint j is ``default + action_scale * action``.

    Raises:
        ContractError: a field has the wrong type, length or value; the message names it.
    """

    robot: Text
    """Robot registry name."""
    joint_names: Annotated[tuple[Text, ...], Field(min_length=1, max_length=_MOST)]
    """Joints in the policy's own order, for observations and actions."""
    default_joint_position: Annotated[tuple[Angle, ...], Field(min_length=1, max_length=_MOST)]
    """[rad], in the policy's joint order."""
    action_scale: Annotated[tuple[_ActionScale, ...], Field(min_length=1, max_length=_MOST)]
    """[rad] per unit of network output, per joint; negative where the network's joint turns the other way."""
    action_clip: _Clip | None = None
    """Largest magnitude of the raw action, None for no clipping."""
    target_range: tuple[tuple[_Target, _Target], ...] | None = None
    """Lowest and highest joint target per joint [rad], None for no limit."""
    stiffness: Annotated[tuple[Stiffness, ...], Field(min_length=1, max_length=_MOST)]
    """Motor kp the policy was made for [N·m/rad]."""
    damping: Annotated[tuple[Damping, ...], Field(min_length=1, max_length=_MOST)]
    """Motor kd the policy was made for [N·m·s/rad]."""
    control_period: _Period
    """[s]."""
    observation: Annotated[tuple[ObservationTerm, ...], Field(min_length=1)]
    history: History = History()
    command_limits: tuple[Speed, Speed, Speed]
    """Largest forward, lateral [m/s] and yaw [rad/s] command the policy was made for."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """Origin of the policy (training run, file, adapter); not part of the hash."""
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
        for joint, (low, high) in zip(names, self.target_range or (), strict=False):
            if low > high:
                raise ContractError(
                    f"contract: target_range of {shown(joint)} is {low:g} to {high:g} rad; it must rise"
                )
        terms = [t.name for t in self.observation]
        if len(set(terms)) != len(terms):
            raise ContractError(f"contract: observation has a term twice: {', '.join(terms)}")
        for term, width in zip(self.observation, self.term_widths, strict=True):
            clip = term.clip if isinstance(term.clip, tuple) else (0.0,)
            for name, values in (("scale", term.scale), ("clip", clip)):
                if len(values) not in (1, width):
                    raise ContractError(
                        f"contract: observation.{term.name}.{name} has {len(values)} entries; 1 or {width} are needed"
                    )

    @cached_property
    def num_joints(self) -> int:
        """Return the number of joints, which is the width of an action."""
        return len(self.joint_names)

    @cached_property
    def term_widths(self) -> tuple[int, ...]:
        """Return the width of each observation term."""
        return tuple(observation(term.name).width or self.num_joints for term in self.observation)

    @cached_property
    def frame_width(self) -> int:
        """Return the width of one observation frame."""
        return sum(self.term_widths)

    @cached_property
    def observation_width(self) -> int:
        """Return the width of the network's input."""
        return self.frame_width * self.history.length

    def to_dict(self) -> dict[str, Any]:
        """Return plain data, ready for JSON."""
        return asdict(self)

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


def kind_of_observations(contract: PolicyContract) -> Literal["measurable", "privileged"]:
    """Return whether a robot's sensors can measure every observation of a policy."""
    return "privileged" if any(observation(t.name).privileged for t in contract.observation) else "measurable"


def check_robot(contract: PolicyContract, robot: Robot) -> tuple[int, ...]:
    """Check that a policy is for this robot.

    Returns:
        For each joint of the policy, its index in the robot's joint order.

    Raises:
        ContractError: another robot, or joint names that are not those of the robot in some order.
    """
    if contract.robot != robot.name:
        raise ContractError(
            f"the policy is for robot '{contract.robot}', not for '{robot.name}'; leave --robot out, or give a "
            f"policy for '{robot.name}'"
        )
    if sorted(contract.joint_names) != sorted(robot.joint_names):
        raise ContractError(
            f"the policy's joints are not those of robot '{robot.name}': "
            f"the policy has {', '.join(contract.joint_names)}; the robot has {', '.join(robot.joint_names)}"
        )
    return tuple(robot.joint_names.index(n) for n in contract.joint_names)


def reordered(contract: PolicyContract, joint_names: Sequence[str]) -> PolicyContract:
    """Return the contract with all its joints in the order of ``joint_names``; every value per joint goes with its joint."""
    index = [contract.joint_names.index(name) for name in joint_names]

    def moved(values: Any) -> Any:
        return tuple(values[i] for i in index) if isinstance(values, tuple) and len(values) == len(index) else values

    terms = tuple(
        term if observation(term.name).width else replace(term, scale=moved(term.scale), clip=moved(term.clip))
        for term in contract.observation
    )
    values = {name: moved(getattr(contract, name)) for name in PER_JOINT}
    return replace(contract, joint_names=tuple(joint_names), observation=terms, **values)


def other_width(contract: PolicyContract, width: int) -> str:
    """Return a contract's observation width as part of a sentence on a network with another width, and the history that would fit."""
    frames, rest = divmod(width, contract.frame_width)
    fits = f"; {frames} frames are {width}: history = {{ length = {frames} }}" if frames and not rest else ""
    return f"but its contract's observation has {contract.observation_width}{fits}"


def difference(a: PolicyContract, b: PolicyContract) -> str:
    """Return two contracts' differences but for provenance, lines ``field: value in a -> value in b``; empty where they are equal."""
    left, right = _flat(a), _flat(b)
    lines = [
        f"{n}: {left.get(n, 'absent')} -> {right.get(n, 'absent')}" for n in left | right if left.get(n) != right.get(n)
    ]
    return "\n".join(lines)


def _flat(contract: PolicyContract) -> dict[str, str]:
    rows: dict[str, str] = {}
    for name, value in contract.to_dict().items():
        if name == "observation":
            rows["observation"] = ", ".join(t["name"] for t in value)
            for term in value:
                rows[f"observation.{term['name']}.scale"] = repr(term["scale"])
                rows[f"observation.{term['name']}.clip"] = repr(term["clip"])
        elif name == "history":
            rows.update({f"history.{key}": repr(entry) for key, entry in value.items()})
        elif name != "provenance":
            rows[name] = repr(value)
    return rows


def standard_contract(
    robot: Robot, *, history: History | None = None, provenance: Mapping[str, Any] | None = None
) -> PolicyContract:
    """Return the interface that the CTS family of policies for the Unitree Go2 shares (paper, section on observations).

    Angular velocity, gravity, command, joint positions, joint velocities and the last action make 45 entries; an action
    moves the target around the standing pose by the robot's action scale, 0.25 rad per unit for the Go2, every 0.02 s.

    Args:
        robot: gives the joints, the standing pose, the gains and the command limits.
        history: frames in the network's input, None for the current one alone.
    """
    motors = robot.parameters[robot.default_parameters]
    return PolicyContract(
        robot=robot.name,
        joint_names=robot.joint_names,
        default_joint_position=robot.default_joint_position,
        action_scale=robot.action_scale or (0.25,) * robot.num_joints,
        stiffness=motors.stiffness,
        damping=motors.damping,
        control_period=0.02,
        observation=tuple(ObservationTerm(name=name, scale=OBSERVATIONS[name].scale) for name in STANDARD),
        history=history or History(),
        command_limits=robot.command_limits,
        provenance=provenance or {},
    )
