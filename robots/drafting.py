"""Write a first ``robot.toml`` for any MuJoCo model of a legged robot: read the model, guess the rest, and say so."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..files.parsing import build, one_line, parse_json
from .apart import run_apart
from .base import JointParameters
from .checking import compiled
from .loading import RobotError
from .standing import MOST_SAG, stand_still
from .surveying import GRAVITY, Remarked, Survey

_CLEARANCE = 0.02
"""Height above the ground at which an episode is to start [m]."""
_GUESSED = "guessed"
_STIFFER = (1.0, 2.0, 4.0, 8.0)
"""Factors of the guessed stiffness that are tried in turn."""
_MOST_TILT = 0.2
"""Largest tilt [rad] of a robot that stands with a guessed stiffness; ``robot check`` allows more."""
_LINE = 100
"""Longest line of a list [characters]."""


@dataclass(frozen=True)
class Entry:
    """A line of the description."""

    key: str
    """Name, with its table's before a dot."""
    value: Any
    remark: str = ""
    """Origin of the value."""


@dataclass(frozen=True, kw_only=True)
class Draft:
    """A first description of a robot."""

    name: str
    entries: tuple[Entry, ...]
    model: str
    """The model as MJCF with added names and feet that the description needs; empty where the file itself has them."""

    @property
    def guesses(self) -> list[str]:
        """Return the guesses as sentences."""
        guessed = [entry for entry in self.entries if entry.remark.startswith(_GUESSED)]
        return [f"{each.key} = {' '.join(_toml(each.value).split())} ({each.remark})" for each in guessed]

    def text(self, mjcf: str) -> str:
        """Return the text of the ``robot.toml``; ``mjcf`` is the model's path relative to it."""
        lines = [
            f"# A first description of {self.name}, made from its model: go through what is guessed. SI units and radians.",
            "# A value per joint is one number for all joints, a list in the order of `joint_names`, or a table whose keys",
            "# are joint names or words of them. docs/reference/robot-file.md explains every key.",
            "",
        ]
        table = ""
        for entry in self.entries:
            group, _, key = entry.key.rpartition(".")
            if group != table:
                lines += ["", f"[{group}]"]
                table = group
            if entry.remark:
                lines.append(f"# {one_line(entry.remark)}")
            lines.append(f"{key} = {_toml(mjcf if key == 'mjcf' else entry.value)}")
        return "\n".join(lines) + "\n"


def draft_robot(model: Path, name: str | None = None, *, folder: Path | None = None) -> Draft:
    """Read a model in a process of its own, and guess the values that it lacks.

    Args:
        model: MJCF of the robot alone.
        name: of the robot; None for the model's.
        folder: for the description and a model with names; None for the model's folder.

    Raises:
        RobotError: MuJoCo cannot compile the model, or it is no legged robot on a free base.
    """
    if not model.is_file():
        raise RobotError(f"there is no model '{one_line(model)}'; give the MJCF file of the robot")
    text = run_apart(partial(_draft, model, name, folder or model.parent), model)
    return build(Draft, parse_json(text, "the draft", RobotError), "the draft", RobotError)


def _draft(path: Path, name: str | None, home: Path) -> str:
    spec, model = compiled(path)
    survey = Survey(path, spec, model)
    title = name or (spec.modelname if spec.modelname not in ("", "MuJoCo Model") else path.stem)
    pose, how = survey.default_pose()
    joints = list(dict.fromkeys([j for leg in survey.legs for j in leg.joints] + survey.hinges))
    survey.place(pose)
    length = float(np.mean([survey.leg_length(leg) for leg in survey.legs]))
    fast = min(2.0, round(math.sqrt(GRAVITY * length), 1))
    height = math.ceil(1000 * (survey.depth() + _CLEARANCE)) / 1000
    sites = [model.site(s).name for s in range(model.nsite) if model.site_bodyid[s] == survey.base]
    imu = next((site for site in sites if "imu" in site.lower()), None)
    order = f"{_GUESSED} order: leg by leg, the front left one first, from the base outwards"
    feet = f"{_GUESSED}: the shape at the end of each leg, legs in the same order"
    if survey.added_feet:
        spheres = f"{survey.added_feet} are small spheres added at the ends of shapes that are a whole shank"
        feet += f"; {spheres}, since a foot's position is the centre of its shape"
    trunk = f"{_GUESSED}: the largest shape of the base; others count as head and sensors"
    above = f"{_GUESSED}: {_CLEARANCE:g} m above where the feet touch the ground in the default pose"
    commands = f"{_GUESSED} from legs of {length:.3f} m: forward, sideways [m/s], turning [rad/s]"
    entries = [
        Entry("name", re.sub(r"[^a-z0-9_-]+", "-", title.lower()).strip("-_") or "robot"),
        Entry("title", title),
        Entry("mjcf", path.name),
        Entry("joint_names", [model.joint(j).name for j in joints], order),
        Entry("default_joint_position", [round(pose[j], 4) for j in joints], how),
        Entry("base_body", survey.body_name(survey.base)),
        Entry("foot_names", [survey.geom_name(leg.foot, "foot") for leg in survey.legs], feet),
        Entry("collision_bodies", survey.colliding_bodies()),
        Entry("trunk_shapes", [survey.geom_name(survey.trunk(), "trunk")], trunk),
        *([Entry("imu_site", imu)] if imu else []),
        Entry("stand_height", height, above),
        Entry("command_limits", [fast, round(fast / 2, 2), fast], commands),
        Entry("action_scale", 0.25, f"{_GUESSED}: how far an output of 1 moves a joint's target [rad]"),
        Entry("default_parameters", "gauge"),
    ]
    motors = _standing_motors(survey, pose, joints, length)
    entries += [Entry(f"parameters.gauge.{key}", value, remark) for key, (value, remark) in motors.items()]
    text = ""
    if survey.renamed:
        for kind in ("meshdir", "texturedir"):
            setattr(spec, kind, str(path.parent.resolve() / getattr(spec, kind)))
        text = spec.to_xml()
        for assets in {spec.meshdir, spec.texturedir}:  # absolute for this process, relative to the folder in the draft
            text = text.replace(f'dir="{assets}', f'dir="{os.path.relpath(assets, home.resolve())}')
    return json.dumps(asdict(Draft(name=entries[0].value, entries=tuple(entries), model=text)))


def _standing_motors(
    survey: Survey, pose: Mapping[int, float], joints: list[int], length: float
) -> dict[str, Remarked]:
    """Return constants of the joints; a guessed stiffness is doubled until the placed robot stands."""
    first = survey.motors(joints, length)
    guess, remark = first["stiffness"]
    if not remark.startswith(_GUESSED):
        return first
    angles = {survey.model.joint(j).name: round(pose[j], 4) for j in joints}
    height, stances = survey.feet_depth(), []
    for stiffer in _STIFFER:
        motors = first if stiffer == 1.0 else survey.motors(joints, length, stiffer)
        constants: dict[str, Any] = {
            key: tuple(np.broadcast_to(value, len(joints)).tolist()) for key, (value, _) in motors.items()
        }
        held = len(survey.legs) == 2  # two legs fall over whatever their stiffness
        stances.append(stand_still(survey.spec.copy(), angles, JointParameters(**constants), height, upright=held))
        if stances[-1].stands(lowest=1.0 - MOST_SAG * length / height, most_tilt=_MOST_TILT):
            if stiffer > 1.0:
                raised = f"{remark}, and raised from {guess:g}, with which it does not stand well"
                motors["stiffness"] = (motors["stiffness"][0], raised)
            return motors
        if stances[-1].apart_after is not None:
            break
    how = "it flies apart" if stances[0].apart_after is not None else str(stances[0])
    weak = f"it does not stand well with it, nor with up to {motors['stiffness'][0]:g}: {how}"
    mend = "mend default_joint_position, torque_limit and stiffness until robot check passes"
    first["stiffness"] = (guess, f"{remark}; {weak}; {mend}")
    return first


def _toml(value: Any) -> str:
    """Return a value as TOML; equal numbers of a list become one."""
    if isinstance(value, list):
        if len(value) > 3 and len(set(value)) == 1 and not isinstance(value[0], str):
            return _toml(value[0])
        items = [_toml(v) for v in value]
        if sum(map(len, items)) < _LINE:
            return "[" + ", ".join(items) + "]"
        lines = [""]
        for item in items:
            if lines[-1] and len(lines[-1]) + len(item) > _LINE:
                lines.append("")
            lines[-1] += f"{' ' if lines[-1] else '    '}{item},"
        return "\n".join(["[", *lines, "]"])
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
