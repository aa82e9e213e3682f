"""The policy contract: everything that must agree between a policy and the loop that runs it.

It travels with every checkpoint and export in full precision, its hash with every result. A contract is checked when it
is made: one that exists is well-formed. Numbers are kept as Python floats, so that equal contracts have equal hashes.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields
from functools import cached_property
from typing import Any

from ..robots.base import Robot

SCHEMA_VERSION = 1

# Width of each observation term for a robot with J joints; None stands for J.
TERM_WIDTH: Mapping[str, int | None] = {
    "base_linear_velocity_b": 3,
    "base_angular_velocity_b": 3,
    "projected_gravity_b": 3,
    "command": 3,
    "joint_position": None,
    "joint_velocity": None,
    "last_action": None,
}
HISTORY_ORDERS = ("frame-major", "term-major", "frame-major-newest-first")
HISTORY_STARTS = ("zeros", "repeat")


class ContractError(ValueError):
    """A contract is malformed, or does not fit the robot, suite or policy at hand."""


def _number(name: str, value: Any, *, positive: bool = False) -> float:
    # The comparison is exact for whole numbers of any size, and false for NaN.
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or not -sys.float_info.max <= value <= sys.float_info.max:
        raise ContractError(f"contract field '{name}' must be a finite number, not {value!r}")
    if positive and value <= 0:
        raise ContractError(f"contract field '{name}' must be above zero, not {value!r}")
    return float(value)


def _entries(name: str, values: Any) -> Iterable[Any]:
    if isinstance(values, (str, Mapping)) or not isinstance(values, Iterable):
        raise ContractError(f"contract field '{name}' must be a list, not {values!r}")
    return values


def _numbers(name: str, values: Any, count: int | None = None) -> tuple[float, ...]:
    numbers = tuple(_number(f"{name}[{i}]", v) for i, v in enumerate(_entries(name, values)))
    if count is not None and len(numbers) != count:
        raise ContractError(f"contract field '{name}' has {len(numbers)} entries; {count} are needed")
    return numbers


def _text(name: str, value: Any) -> str:
    if not isinstance(value, str) or not value:
        raise ContractError(f"contract field '{name}' must be a text, not {value!r}")
    return value


@dataclass(frozen=True, kw_only=True)
class ObservationTerm:
    """One block of the observation vector. ``joint_position`` is relative to the default pose; ``last_action`` is the
    raw output.
    """

    name: str
    """A key of ``TERM_WIDTH``."""
    scale: tuple[float, ...]
    """Factor per entry; one entry stands for all."""
    clip: float | tuple[float, ...] | None = None
    """Largest magnitude after scaling, for all entries or per entry; None for no clipping."""

    def __post_init__(self) -> None:
        if _text("observation.name", self.name) not in TERM_WIDTH:
            raise ContractError(f"unknown observation term '{self.name}'; choose from: {', '.join(TERM_WIDTH)}")
        where = f"observation.{self.name}"
        object.__setattr__(self, "scale", _numbers(f"{where}.scale", self.scale))
        if self.clip is None:
            return
        if isinstance(self.clip, (int, float)):
            object.__setattr__(self, "clip", _number(f"{where}.clip", self.clip, positive=True))
        else:
            object.__setattr__(self, "clip", _numbers(f"{where}.clip", self.clip))


@dataclass(frozen=True, kw_only=True)
class History:
    """Past observations that the network expects in its input. A network that keeps its own history has length 1
    here; ``start`` holds for its history too.
    """

    length: int = 1
    """Number of frames, the current one included."""
    order: str = "frame-major"
    """``frame-major``: whole frames, oldest first; ``frame-major-newest-first``: the same reversed; ``term-major``: all
    frames of the first term, oldest first, then the next term.
    """
    start: str = "zeros"
    """What fills the frames before the first one: ``zeros``, as in the published training, or ``repeat`` for copies of
    the first frame, as the robot's own controller does it."""

    def __post_init__(self) -> None:
        if isinstance(self.length, bool) or not isinstance(self.length, int) or self.length < 1:
            raise ContractError(
                f"contract field 'history.length' must be a whole number of at least 1, not {self.length!r}"
            )
        for name, value, allowed in (("order", self.order, HISTORY_ORDERS), ("start", self.start, HISTORY_STARTS)):
            if value not in allowed:
                raise ContractError(f"contract field 'history.{name}' is {value!r}; choose from: {', '.join(allowed)}")


@dataclass(frozen=True, kw_only=True)
class PolicyContract:
    """Joint order, poses, scales and timing of a policy. The target of joint j is ``default + action_scale * action``.

    Raises:
        ContractError: a field has the wrong type, length or value; the message names it.
    """

    robot: str
    """Robot registry name."""
    joint_names: tuple[str, ...]
    """Joints in the policy's own order, for observations and actions."""
    default_joint_position: tuple[float, ...]
    """[rad], in the policy's joint order."""
    action_scale: tuple[float, ...]
    """[rad] per unit of network output, per joint."""
    action_clip: float | None = None
    """Largest magnitude of the raw action, None for no clipping."""
    target_range: tuple[tuple[float, float], ...] | None = None
    """Lowest and highest joint target per joint [rad], None for no limit."""
    stiffness: tuple[float, ...]
    """Motor kp the policy was made for [N·m/rad]."""
    damping: tuple[float, ...]
    """Motor kd the policy was made for [N·m·s/rad]."""
    control_period: float
    """[s]."""
    observation: tuple[ObservationTerm, ...]
    history: History = History()
    command_limits: tuple[float, float, float]
    """Largest forward, lateral [m/s] and yaw [rad/s] command the policy was made for."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """Where the policy comes from (training run, file, adapter); not part of the hash."""
    schema_version: int = SCHEMA_VERSION

    def __post_init__(self) -> None:
        def put(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        if self.schema_version != SCHEMA_VERSION:
            raise ContractError(
                f"contract field 'schema_version' is {self.schema_version!r}; this gaitgauge reads {SCHEMA_VERSION}"
            )
        _text("robot", self.robot)
        if isinstance(self.joint_names, str) or not isinstance(self.joint_names, Sequence) or not self.joint_names:
            raise ContractError(f"contract field 'joint_names' must be a list of names, not {self.joint_names!r}")
        names = tuple(_text(f"joint_names[{i}]", n) for i, n in enumerate(self.joint_names))
        if len(set(names)) != len(names):
            raise ContractError(f"contract field 'joint_names' has a name twice: {', '.join(names)}")
        put("joint_names", names)
        joints = len(names)
        for name in ("default_joint_position", "action_scale", "stiffness", "damping"):
            put(name, _numbers(name, getattr(self, name), joints))
        put("command_limits", _numbers("command_limits", self.command_limits, 3))
        put("control_period", _number("control_period", self.control_period, positive=True))
        if self.action_clip is not None:
            put("action_clip", _number("action_clip", self.action_clip, positive=True))
        if self.target_range is not None:
            ranges = list(_entries("target_range", self.target_range))
            if len(ranges) != joints:
                raise ContractError(f"contract field 'target_range' has {len(ranges)} entries; {joints} are needed")
            put("target_range", tuple(_numbers(f"target_range[{i}]", r, 2) for i, r in enumerate(ranges)))
        put("observation", tuple(self.observation))
        if not self.observation:
            raise ContractError("contract field 'observation' lists no terms")
        if len({t.name for t in self.observation}) != len(self.observation):
            raise ContractError(
                f"contract field 'observation' has a term twice: {', '.join(t.name for t in self.observation)}"
            )
        for term in self.observation:
            width = TERM_WIDTH[term.name] or joints
            clip = term.clip if isinstance(term.clip, tuple) else (0.0,)
            for name, entries in (("scale", term.scale), ("clip", clip)):
                if len(entries) not in (1, width):
                    raise ContractError(
                        f"contract field 'observation.{term.name}.{name}' has {len(entries)} entries; "
                        f"1 or {width} are needed"
                    )
        if not isinstance(self.provenance, Mapping):
            raise ContractError(f"contract field 'provenance' must be a table, not {self.provenance!r}")

    @cached_property
    def num_joints(self) -> int:
        """Number of joints, which is the width of an action."""
        return len(self.joint_names)

    @cached_property
    def frame_width(self) -> int:
        """Width of one observation frame."""
        return sum(TERM_WIDTH[t.name] or len(self.joint_names) for t in self.observation)

    @cached_property
    def observation_width(self) -> int:
        """Width of the network's input."""
        return self.frame_width * self.history.length

    def to_dict(self) -> dict[str, Any]:
        """Plain data, ready for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> PolicyContract:
        """Read what ``to_dict`` wrote, as it comes back from JSON.

        Raises:
            ContractError: a field is unknown, missing or malformed.
        """
        values = _checked_fields(cls, data, "")
        terms = _entries("observation", values["observation"])
        values["observation"] = tuple(
            ObservationTerm(**_checked_fields(ObservationTerm, t, f"observation[{i}].")) for i, t in enumerate(terms)
        )
        if "history" in values:
            values["history"] = History(**_checked_fields(History, values["history"], "history."))
        return cls(**values)

    @classmethod
    def from_json(cls, text: str) -> PolicyContract:
        """Read a contract from JSON text.

        Raises:
            ContractError: not JSON, or not a contract.
        """
        try:
            data = json.loads(text)
        except json.JSONDecodeError as error:
            raise ContractError(f"the contract is not valid JSON: {error}") from error
        return cls.from_dict(data)

    def to_json(self) -> str:
        """JSON text in full precision."""
        return json.dumps(self.to_dict(), indent=2)

    @property
    def hash(self) -> str:
        """SHA-256 over everything but the provenance, hexadecimal."""
        data = self.to_dict()
        del data["provenance"]
        return hashlib.sha256(json.dumps(data, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _checked_fields(kind: type, data: Any, prefix: str) -> dict[str, Any]:
    """The entries of ``data``, which must be those of the dataclass ``kind`` and no others."""
    if not isinstance(data, Mapping):
        raise ContractError(
            f"contract {'field ' + repr(prefix[:-1]) if prefix else 'data'} must be a table, not {data!r}"
        )
    known = {f.name: f for f in fields(kind)}
    for name in data:
        if name not in known:
            raise ContractError(f"unknown contract field '{prefix}{name}'; allowed are: {', '.join(known)}")
    for name, entry in known.items():
        if name not in data and entry.default is MISSING and entry.default_factory is MISSING:
            raise ContractError(f"contract field '{prefix}{name}' is missing")
    return dict(data)


def check_robot(contract: PolicyContract, robot: Robot) -> tuple[int, ...]:
    """Check that a policy is for this robot.

    Returns:
        For each joint of the policy, its index in the robot's joint order.

    Raises:
        ContractError: another robot, or joint names that are not those of the robot in some order.
    """
    if contract.robot != robot.name:
        raise ContractError(f"the policy is for robot '{contract.robot}', not for '{robot.name}'")
    if sorted(contract.joint_names) != sorted(robot.joint_names):
        raise ContractError(
            f"the policy's joints are not those of robot '{robot.name}': "
            f"the policy has {', '.join(contract.joint_names)}; the robot has {', '.join(robot.joint_names)}"
        )
    return tuple(robot.joint_names.index(n) for n in contract.joint_names)


def difference(a: PolicyContract, b: PolicyContract) -> str:
    """What differs between two contracts, one line per field (``field: value in a -> value in b``); empty if they are
    equal.

    The provenance does not count.
    """
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


def go2_contract(
    robot: Robot, *, history: History | None = None, provenance: Mapping[str, Any] | None = None
) -> PolicyContract:
    """The interface that the CTS family of policies for the Unitree Go2 shares (paper, section on observations).

    Angular velocity, gravity, command, joint positions, joint velocities and the last action make 45 entries; an action
    moves the target by 0.25 rad per unit around the standing pose, every 0.02 s.

    Args:
        robot: gives the joints, the standing pose, the gains and the command limits.
        history: frames in the network's input, None for the current one alone.
        provenance: where the policy comes from.
    """
    motors = robot.parameters[robot.default_parameters]
    return PolicyContract(
        robot=robot.name,
        joint_names=robot.joint_names,
        default_joint_position=robot.default_joint_position,
        action_scale=(0.25,) * robot.num_joints,
        stiffness=motors.stiffness,
        damping=motors.damping,
        control_period=0.02,
        observation=(
            ObservationTerm(name="base_angular_velocity_b", scale=(0.25,)),
            ObservationTerm(name="projected_gravity_b", scale=(1.0,)),
            ObservationTerm(name="command", scale=(2.0, 2.0, 0.25)),
            ObservationTerm(name="joint_position", scale=(1.0,)),
            ObservationTerm(name="joint_velocity", scale=(0.05,)),
            ObservationTerm(name="last_action", scale=(1.0,)),
        ),
        history=history or History(),
        command_limits=robot.command_limits,
        provenance=provenance or {},
    )
