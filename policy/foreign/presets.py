"""The contracts of training codes and controllers that people use, as data (``presets.toml``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ...files.parsing import Name, Text, did_you_mean, read_toml, shown
from ...robots import Robot, RobotError
from ...robots.anatomy.body_plan import body_plan
from ..base import PolicyError
from ..contract import History, ObservationTerm, PolicyContract, reordered, standard_contract

_FILE = Path(__file__).parent / "presets.toml"
_ENDS, _SIDES = {"F": "front", "R": "rear"}, {"L": "left", "R": "right"}
_OF_ROBOT = ("stiffness", "damping", "default_joint_position")
_LEGS = {"FL": (1.0, 1.0), "FR": (1.0, -1.0), "RL": (-1.0, 1.0), "RR": (-1.0, -1.0)}
JointOrder = Literal["legs", "kinds"]
LegOrder = Annotated[tuple[Literal["FL", "FR", "RL", "RR"], ...], Field(min_length=4, max_length=4)]
_PerJoint = float | Mapping[Text, float]


@dataclass(frozen=True, kw_only=True)
class RobotValues:
    """The values of a preset that belong to one robot; see ``presets.toml``."""

    stiffness: _PerJoint
    """kp [N·m/rad]."""
    damping: _PerJoint
    """kd [N·m·s/rad]."""
    default_joint_position: _PerJoint
    """[rad]."""


@dataclass(frozen=True, kw_only=True)
class Preset:
    """How a training code or controller runs its policies, on any robot with four legs of three joints."""

    name: Name
    title: Text
    order: JointOrder
    """Joints leg by leg, or all joints of one kind after the other."""
    legs: LegOrder
    """Order of the legs: front or rear, left or right."""
    action_scale: _PerJoint
    """[rad] per unit of output."""
    observation: Annotated[tuple[ObservationTerm, ...], Field(min_length=1)]
    action_clip: float | None = None
    history: History = field(default_factory=History)
    """Order and start of the frames, where a network's input holds more than one."""
    robots: Mapping[Name, RobotValues] = field(default_factory=dict)
    """By the name of a robot."""


@dataclass(frozen=True, kw_only=True)
class _Presets:
    preset: tuple[Preset, ...]


@cache
def presets() -> Mapping[str, Preset]:
    """Return all presets by name, in the order of the file; raise ``PolicyError`` where the file is malformed."""
    return {each.name: each for each in read_toml(_FILE, _Presets, "file of presets", PolicyError).preset}


def find_preset(name: str) -> Preset:
    """Return a preset by its name; raise ``PolicyError`` with the nearest known name where there is none."""
    if name not in presets():
        hint = did_you_mean(name, presets()) or ";"
        raise PolicyError(f"there is no preset {shown(name)}{hint} choose from {', '.join(presets())}")
    return presets()[name]


class Quadruped:
    """The joints of a robot with four legs of three joints by place."""

    def __init__(self, robot: Robot) -> None:
        """Read the legs off the robot's model; raise ``PolicyError`` for a robot with other legs."""
        try:
            plan = body_plan(robot)
        except RobotError as error:
            raise PolicyError(f"presets are for robots with four legs of three joints; {error}") from error
        place = np.sign(plan.foot_position[:, :2] - plan.foot_position[:, :2].mean(0))
        corners = {name: [leg for leg, at in enumerate(place) if tuple(at) == signs] for name, signs in _LEGS.items()}
        if len(robot.joint_names) != 12 or any(len(plan.legs[i]) != 3 for i in range(len(plan.legs))):
            corners = {}
        if [len(legs) for legs in corners.values()] != [1] * 4:
            told = f"{len(robot.joint_names)} joints and {len(plan.legs)} legs"
            raise PolicyError(
                f"presets are for robots with a leg of three joints at each corner; robot '{robot.name}' has {told}; write a "
                "contract.toml (--contract)"
            )
        self.robot, self._plan = robot, plan
        self._legs = {name: plan.legs[legs[0]] for name, legs in corners.items()}

    def joint_order(self, order: JointOrder, legs: LegOrder) -> tuple[str, ...]:
        """Return the joints leg by leg, or kind by kind, with the legs in this order."""
        listed: list[tuple[int, ...]] = [self._legs[name] for name in legs]
        chosen = listed if order == "legs" else list(zip(*listed, strict=True))
        return tuple(self.robot.joint_names[joint] for group in chosen for joint in group)

    def spread(self, value: Any, names: Sequence[str]) -> list[float]:
        """Return a value for each joint of ``names``: a number stands for all, a table goes by parts of legs."""
        if isinstance(value, int | float):
            return [float(value)] * len(names)
        if not isinstance(value, Mapping):
            return [float(v) for v in value]
        spread = []
        for name in names:
            joint = self.robot.joint_names.index(name)
            corner, part = next(leg for leg, joints in self._legs.items() if joint in joints), self._plan.part(joint)
            keys = (f"{_ENDS[corner[0]]}_{part}", f"{_SIDES[corner[1]]}_{part}", part)
            spread.append(float(next(value[key] for key in keys if key in value)))
        return spread


def preset_contract(preset: Preset, robot: Robot | Quadruped, *, frames: int = 1) -> PolicyContract:
    """Return the contract of a preset for a robot, with so many frames in the network's input.

    Raises:
        PolicyError: the robot is not one with four legs of three joints.
    """
    body = robot if isinstance(robot, Quadruped) else Quadruped(robot)
    names, own = body.joint_order(preset.order, preset.legs), preset.robots.get(body.robot.name)
    rest = "command limits and control period"
    if own is None:
        rest = f"pose, gains, {rest}"
    provenance = {"adapter": f"preset {preset.name}", "assumed": f"{rest} of robot '{body.robot.name}'"}
    values = reordered(standard_contract(body.robot, provenance=provenance), names).to_dict()
    values |= {} if own is None else asdict(own)
    values |= {"action_scale": preset.action_scale, "action_clip": preset.action_clip}
    values |= {name: body.spread(values[name], names) for name in (*_OF_ROBOT, "action_scale")}
    order = preset.history.order if frames > 1 else "frame-major"
    history = replace(preset.history, length=frames, order=order)
    return replace(PolicyContract.from_dict(values), observation=preset.observation, history=history)


def fitting_presets(robot: Robot, width: int) -> dict[str, PolicyContract]:
    """Return the contracts of all presets that a robot and a network's input of this width allow, by name."""
    try:
        body = Quadruped(robot)
    except PolicyError:
        return {}
    found = {}
    for preset in presets().values():
        frames, rest = divmod(width, preset_contract(preset, body).frame_width)
        if frames and not rest:
            found[preset.name] = preset_contract(preset, body, frames=frames)
    return found
