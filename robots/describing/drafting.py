"""Write a first ``robot.toml`` for any MuJoCo model of a legged robot: read and mend the model, guess the rest, and say so."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...files.parsing import build, one_line, parse_json
from ..anatomy.roles import WORDS
from ..base import JointParameters
from ..checks.apart import run_apart
from ..checks.checking import compiled
from ..checks.standing import MOST_SAG, Stance, stand_still
from ..loading import RobotError, fits
from .mending import mend
from .motor_guess import Remarked, guess_motors
from .posing import BENDS, standing_pose
from .surveying import GRAVITY, Answers, Survey

if TYPE_CHECKING:
    import mujoco

_CLEARANCE = 0.02
"""Height above the ground at which an episode is to start [m]."""
_GUESSED = "guessed"
_STIFFER = (1.0, 2.0, 4.0, 8.0)
"""Factors of the guessed stiffness that are tried in turn."""
_MOST_TILT = 0.2
"""Largest tilt [rad] of a robot that stands with a guessed stiffness; ``robot check`` allows more."""
_LINE = 100
"""Longest line of a list [characters]."""
_WHEEL_SPEED = 5.0
"""Speed of a wheel for an output of 1 of a policy [rad/s]: the Go2-W's."""


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
    plan: str
    """The body plan and its legs, in words."""
    entries: tuple[Entry, ...]
    mends: tuple[str, ...]
    """Mends of the model's copy, a sentence with the line for each."""
    model: str
    """The model as MJCF, mended, with added names and feet that the description needs; empty where the file itself will do."""

    @property
    def guesses(self) -> list[str]:
        """Return the guesses as sentences."""
        guessed = [entry for entry in self.entries if entry.remark.startswith(_GUESSED)]
        return [f"{each.key} = {' '.join(_toml(each.value).split())} ({each.remark})" for each in guessed]

    def text(self, mjcf: str, *, notes: Mapping[str, Sequence[str]] | None = None) -> str:
        """Return the text of the ``robot.toml``.

        Args:
            mjcf: the model's path relative to it.
            notes: comment lines of its owner above the key of an entry.
        """
        lines = [
            f"# A first description of {self.name}, made from its model: go through what is guessed. SI units and radians.",
            "# A value per joint is one number for all joints, a list in the order of `joint_names`, or a table whose keys",
            "# are joint names or words of them. docs/reference/robot-file.md explains every key. A guess ends in a tag of its",
            "# value: `gaitgauge robot guess` makes those again that nobody has changed.",
            "",
        ]
        tables: dict[str, list[str]] = {}
        for entry in self.entries:
            group, _, key = entry.key.rpartition(".")
            value = mjcf if entry.key == "mjcf" else entry.value
            above = [*(notes or {}).get(entry.key, ())]
            if entry.remark:
                above.append(f"# {one_line(entry.remark)} [{tag_of(entry.value)}]")
            inline = f"{_key(key)} = {_toml(value)}"
            if isinstance(value, dict) and len(inline) > _LINE:
                rows: list[str] = []
                for name, each in value.items():
                    rows += [*(notes or {}).get(f"{entry.key}.{name}", ()), f"{_key(name)} = {_toml(each)}"]
                tables[entry.key] = ["", *above, f"[{_path(entry.key)}]", *rows]
            elif group:
                tables.setdefault(group, ["", f"[{_path(group)}]"]).extend([*above, inline])
            else:
                lines += [*above, inline]
        # a table's own values come before the tables inside it
        for name in sorted(tables, key=lambda name: ("." in name, name.split(".")[:2], name.count("."))):
            lines += tables[name]
        return "\n".join(lines) + "\n"


def tag_of(value: Any) -> str:
    """Return four digits that tell a value of the description from most others."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:4]


def _path(dotted: str) -> str:
    return ".".join(_key(part) for part in dotted.split("."))


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name, ensure_ascii=False)


def draft_robot(
    model: Path, name: str | None = None, *, folder: Path | None = None, answers: Answers | None = None
) -> Draft:
    """Read a model in a process of its own, mend a copy, and guess the values that it lacks.

    Args:
        folder: for the description and a model with names; None for the model's folder.

    Raises:
        RobotError: MuJoCo cannot compile the model, it is no legged robot on a free base, or it cannot be told which limbs are legs.
    """
    if not model.is_file():
        raise RobotError(f"there is no model '{one_line(model)}'; give the MJCF file of the robot")
    text = run_apart(partial(_draft, model, name, folder or model.parent, answers or Answers()), model)
    return build(Draft, parse_json(text, "the draft", RobotError), "the draft", RobotError)


def _draft(path: Path, name: str | None, home: Path, answers: Answers) -> str:
    spec, actuated = compiled(path)
    mends = mend(path, spec, actuated)
    model = spec.compile() if mends else actuated
    survey = Survey(path, spec, model, answers)
    mends += survey.mends
    model = survey.model
    title = name or (spec.modelname if spec.modelname not in ("", "MuJoCo Model") else path.stem)
    joints = list(dict.fromkeys([j for leg in survey.legs for j in leg.joints] + survey.hinges))
    names = [model.joint(j).name for j in joints]
    length = float(np.mean([survey.leg_length(leg) for leg in survey.legs]))
    two = len(survey.legs) == 2
    bends = BENDS[survey.plan in ("biped", "humanoid")]
    pose, how = standing_pose(survey, bends[0])
    motors = _standing_motors(survey, pose, joints, length, actuated)
    if _GUESSED in how and not motors["stiffness"][1].startswith(_GUESSED):
        for bend in bends[1:]:
            if _stands(_stance(survey, pose, joints, motors), survey, length):
                break
            pose, how = standing_pose(survey, bend)
            how += "; straighter than usual, since the model's gains hold no more"
    survey.place(pose)
    fast = round(min(1.0, 0.4 * math.sqrt(GRAVITY * length)) if two else min(2.0, math.sqrt(GRAVITY * length)), 1)
    height = math.ceil(1000 * (survey.depth() + _CLEARANCE)) / 1000
    sites = [model.site(s).name for s in range(model.nsite) if model.site_bodyid[s] == survey.base]
    imu = next((site for site in sites if "imu" in site.lower()), None)
    order = f"{_GUESSED} order: leg by leg, the front left one first, from the base outwards"
    trunk = f"{_GUESSED}: the largest shape of the base; others count as head and sensors"
    above = f"{_GUESSED}: {_CLEARANCE:g} m above where the feet touch the ground in the default pose"
    commands = f"{_GUESSED} from legs of {length:.3f} m: forward, sideways [m/s], turning [rad/s]"
    wheels = [survey.roles.get(j) == "wheel" for j in joints]
    outputs = [_WHEEL_SPEED if wheel else 0.25 for wheel in wheels]
    moved = (
        f"{_GUESSED}: how far an output of 1 moves a joint's target [rad{'; rad/s of a wheel' if any(wheels) else ''}]"
    )
    entries = [
        Entry("name", re.sub(r"[^a-z0-9_-]+", "-", title.lower()).strip("-_") or "robot"),
        Entry("title", title),
        Entry("mjcf", path.name),
        Entry("joint_names", names, order),
        Entry("default_joint_position", joint_table(names, [pose[j] for j in joints]), how),
        Entry("base_body", survey.body_name(survey.base)),
        *_feet(survey),
        Entry("collision_bodies", survey.colliding_bodies()),
        Entry("trunk_shapes", [survey.geom_name(survey.trunk(), "trunk")], trunk),
        *([Entry("imu_site", imu)] if imu else []),
        Entry("stand_height", height, above),
        Entry("command_limits", [fast, round(fast / 2, 2), fast], commands),
        Entry("action_scale", joint_table(names, outputs), moved),
        *(
            [Entry("velocity_joints", [n for n, w in zip(names, wheels, strict=True) if w], "wheels")]
            if any(wheels)
            else []
        ),
        Entry("default_parameters", "gauge"),
    ]
    legs = [n for leg in survey.legs for n in (model.joint(j).name for j in leg.joints)]
    if set(legs) != set(names):
        entries.append(
            Entry("variants.legs.driven_joints", legs, "for policies that drive the legs alone and hold the rest")
        )
    for key, (value, remark) in motors.items():
        table = joint_table(names, value) if isinstance(value, list) else value
        entries.append(Entry(f"parameters.gauge.{key}", table, remark))
    text, left_out = _model_text(path, survey, actuated, home)
    mends += left_out
    if not (survey.renamed or mends):
        text = ""  # the file itself will do
    ends = ", ".join(survey.body_name(int(model.geom_bodyid[leg.feet[0]])) for leg in survey.legs)
    plan = f"{WORDS[survey.plan]}, with legs that end in {ends}"
    draft = Draft(name=entries[0].value, plan=plan, entries=tuple(entries), mends=tuple(mends), model=text)
    return json.dumps(asdict(draft))


def _model_text(path: Path, survey: Survey, actuated: mujoco.MjModel, home: Path) -> tuple[str, list[str]]:
    """Return the mended model as MJCF, and a sentence where its visual meshes had to be left out."""
    import mujoco

    full = mujoco.MjSpec.from_file(str(path))
    left_out: list[str] = []
    mend(path, full, actuated)
    survey.repeat(full)
    try:
        full.compile()
    except (ValueError, RuntimeError, MemoryError, mujoco.FatalError) as error:
        reason = one_line(re.sub(r"'[^']*/", "'", str(error)).removeprefix("Error: "), 120)
        if "unknown exception" in reason or "allocate memory" in reason:
            reason = "they need more memory than a robot may take"
        full = survey.spec
        left_out = [f"{path.name}: visual meshes, which MuJoCo cannot compile ({reason}): left out of the copy"]
    for kind in ("meshdir", "texturedir"):
        setattr(full, kind, str(path.parent.resolve() / getattr(full, kind)))
    text = full.to_xml()
    for assets in {full.meshdir, full.texturedir}:  # absolute for this process, relative to the folder in the draft
        text = text.replace(f'dir="{assets}', f'dir="{os.path.relpath(assets, home.resolve())}')
    return text, left_out


def _feet(survey: Survey) -> list[Entry]:
    """Return the entries of the feet, which bear the names of their shapes, or those of their bodies where these are several."""
    feet = f"{_GUESSED}: the shape at the end of each leg, legs in the same order"
    if survey.answers.feet:
        feet = "as said"
    if survey.added_feet:
        spheres = f"{survey.added_feet} are small spheres added at the ends of shapes that are a whole shank"
        feet += f"; {spheres}, since a foot's position is the centre of its shape"
    shapes = [[survey.geom_name(foot, "foot") for foot in leg.feet] for leg in survey.legs]
    if all(len(sole) == 1 for sole in shapes):
        return [Entry("foot_names", [sole[0] for sole in shapes], feet)]
    bodies = [survey.body_name(int(survey.model.geom_bodyid[leg.feet[0]])) for leg in survey.legs]
    soles = "the shapes at the underside of each foot" if not survey.answers.feet else "as said"
    return [
        Entry("foot_names", bodies, f"{_GUESSED}: the body at the end of each leg, legs in the same order"),
        Entry("foot_shapes", shapes, soles if survey.answers.feet else f"{_GUESSED}: {soles}"),
    ]


def joint_table(names: Sequence[str], values: Sequence[Any]) -> Any:
    """Return values per joint as one number where all agree, else as a table by words of names that share a value."""
    if len(set(values)) == 1:
        return values[0]
    of = dict(zip(names, values, strict=True))
    words: dict[str, list[str]] = {}
    for name in names:
        parts = name.removesuffix("_joint").split("_")
        for begin in range(len(parts)):
            for end in range(begin + 1, len(parts) + 1):
                key = "_".join(parts[begin:end])
                if key not in words:
                    words[key] = [other for other in names if fits(key, other)]
    alike = {key: found for key, found in words.items() if len({of[name] for name in found}) == 1}
    table: dict[str, Any] = {}
    left = dict.fromkeys(names)
    for key in sorted(alike, key=lambda key: (-len(alike[key]), key.count("_"))):
        if any(name in left for name in alike[key]):
            table[key] = of[alike[key][0]]
            for name in alike[key]:
                left.pop(name, None)
    return {**table, **{name: of[name] for name in left}}


def _standing_motors(
    survey: Survey, pose: Mapping[int, float], joints: list[int], length: float, actuated: mujoco.MjModel
) -> dict[str, Remarked]:
    """Return constants of the joints; a guessed stiffness is doubled until the placed robot stands."""
    first = guess_motors(survey, joints, length, actuated)
    guess, remark = first["stiffness"]
    if not remark.startswith(_GUESSED):
        return first
    stances, most = [], max(guess)
    for stiffer in _STIFFER:
        motors = first if stiffer == 1.0 else guess_motors(survey, joints, length, actuated, stiffer)
        stances.append(_stance(survey, pose, joints, motors))
        if _stands(stances[-1], survey, length):
            if stiffer > 1.0:
                raised = f"{remark}, and raised from {most:g}, with which it does not stand well"
                motors["stiffness"] = (motors["stiffness"][0], raised)
            return motors
        if stances[-1].apart_after is not None:
            break
    how = "it flies apart" if stances[0].apart_after is not None else str(stances[0])
    weak = f"it does not stand well with it, nor with up to {max(motors['stiffness'][0]):g}: {how}"
    mended = "mend default_joint_position, torque_limit and stiffness until robot check passes"
    first["stiffness"] = (guess, f"{remark}; {weak}; {mended}")
    return first


def _stance(survey: Survey, pose: Mapping[int, float], joints: list[int], motors: Mapping[str, Remarked]) -> Stance:
    """Return how the robot stands in a pose; two legs are held upright, since they fall over whatever their stiffness."""
    angles = {survey.model.joint(j).name: pose[j] for j in joints}
    constants: dict[str, Any] = {
        key: tuple(np.broadcast_to(value, len(joints)).tolist()) for key, (value, _) in motors.items()
    }
    survey.place(dict(pose))
    height, held = survey.feet_depth(), len(survey.legs) == 2
    return stand_still(survey.spec.copy(), angles, JointParameters(**constants), height, upright=held)


def _stands(stance: Stance, survey: Survey, length: float) -> bool:
    """Return whether the robot as it was placed last stands well enough for ``robot check``."""
    return stance.stands(lowest=1.0 - MOST_SAG * length / survey.feet_depth(), most_tilt=_MOST_TILT)


def _toml(value: Any) -> str:
    """Return a value as TOML."""
    if isinstance(value, list):
        items = [_toml(v) for v in value]
        if sum(map(len, items)) < _LINE:
            return "[" + ", ".join(items) + "]"
        if isinstance(value[0], list):
            return "[\n" + "".join(f"    {item},\n".replace("\n    ", "\n        ") for item in items) + "]"
        lines = [""]
        for item in items:
            if lines[-1] and len(lines[-1]) + len(item) > _LINE:
                lines.append("")
            lines[-1] += f"{' ' if lines[-1] else '    '}{item},"
        return "\n".join(["[", *lines, "]"])
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(name)} = {_toml(each)}" for name, each in value.items()) + " }"
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
