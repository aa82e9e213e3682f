"""Scores public policies of other projects on level ground, each at commands within what it was made for, and prints a table.

    python benchmarks/public_policies.py FOLDER [--robots MODELS] [--suite SUITE] [--threads N] [--out results/public] [--only TEXT]

``FOLDER`` has one folder for each policy, with the files that its authors ship beside it. ``MODELS`` has the makers' MuJoCo models of
robots that do not ship with gaitgauge (``b2.xml``, ``g1_12dof.xml``, ``h1.xml``); meshes are left out and
missing trunks and soles become boxes. ``OUT/board.md`` has a table for each robot. ``--suite benchmarks/public_contracts/gentle.toml``
asks for half of each policy's limits and pushes nothing.
"""

from __future__ import annotations

import argparse
import json
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
from gaitgauge.gauge.evaluate import evaluate, prepare
from gaitgauge.gauge.request import Request
from gaitgauge.gauge.result import Result
from gaitgauge.policy.contract import ContractError
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import FilePolicy
from gaitgauge.robots import RobotError, load_robot
from gaitgauge.robots.describing.drafting import draft_robot

HERE = Path(__file__).parent / "public_contracts"
KATARI = "katari16_configs/go2_isaaclab.yaml"
CONTRACTS = {
    "katari16_policy_dc_cfg_comparasion": KATARI,
}
"""Descriptions of policies that have none beside them, by the policy's folder; paths in ``FOLDER`` or of this benchmark."""


@dataclass(frozen=True, kw_only=True)
class Body:
    """A robot that is made of its maker's model."""

    model: str
    pose: Mapping[str, float]
    """Standing pose [rad] by the ending of a joint's name; all others at zero."""
    joints: tuple[str, ...] = ()
    """Beginnings of the joints that move; all others are fixed. Empty: all move."""
    sole: str = ""
    """Ending of bodies that get a box as their sole."""


_LEGS = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
_BENT = {"hip_pitch_joint": -0.1, "knee_joint": 0.3, "ankle_pitch_joint": -0.2}
BODIES = {
    "b2": Body(model="b2", pose={"thigh_joint": 0.8, "calf_joint": -1.5}),
    "g1": Body(model="g1_12dof", pose=_BENT),
    "h1": Body(
        model="h1",
        pose={"hip_pitch_joint": -0.1, "knee_joint": 0.3, "ankle_joint": -0.2},
        joints=_LEGS,
        sole="ankle_link",
    ),
}
ROBOTS = {
    "rl_sar_b2_robot_lab": "b2",
    "unitree_rl_gym_g1_motion": "g1",
    "unitree_rl_gym_h1_motion": "h1",
}
"""Robots of policies by their folder; others are for one that ships."""


@dataclass(kw_only=True)
class Row:
    """One line of the table."""

    file: str
    read: str = ""
    assumed: str = ""
    robot: str = ""
    score: float | None = None
    falls: int | None = None
    seconds: float = 0.0
    problem: str = ""
    limits: tuple[float, ...] = field(default_factory=tuple)


def build_robot(body: Body, models: Path, folder: Path) -> Path:
    """Write a description of a robot from its maker's model without meshes; return its ``robot.toml``."""
    folder.mkdir(parents=True, exist_ok=True)
    tree = ElementTree.parse(models / f"{body.model}.xml")
    root = tree.getroot()
    for parent in list(root.iter()):
        for child in list(parent):
            meshed = child.tag == "geom" and (child.get("mesh") is not None or child.get("class") == "visual")
            fixed = child.tag == "joint" and body.joints and not str(child.get("name")).startswith(body.joints)
            if meshed or child.tag == "mesh" or (fixed and child.get("name") and child.get("type") != "free"):
                parent.remove(child)
    for tag in ("keyframe", "sensor"):
        for element in root.findall(tag):
            root.remove(element)
    for actuators in root.findall("actuator"):
        kept = {j.get("name") for j in root.iter("joint")}
        for motor in list(actuators):
            if motor.get("joint") not in kept:
                actuators.remove(motor)
    world = root.find("worldbody")
    assert world is not None
    base = next(
        b for b in world.findall("body") if b.find("freejoint") is not None or b.find("joint[@type='free']") is not None
    )
    free = base.find("freejoint")
    for joint in base.findall("joint"):
        if joint.get("type") == "free":  # a default class would damp it
            base.remove(joint)
            free = ElementTree.SubElement(base, "freejoint", name=str(joint.get("name") or "floating_base_joint"))
    for other in [b for b in world.findall("body") if b is not base]:
        world.remove(other)
    assert free is not None
    if base.find("geom") is None:
        ElementTree.SubElement(base, "geom", type="box", size="0.06 0.08 0.06", contype="1", conaffinity="1")
    for part in root.iter("body"):
        if body.sole and str(part.get("name")).endswith(body.sole):
            ElementTree.SubElement(part, "geom", type="box", size="0.11 0.03 0.01", pos="0.05 0 -0.055")
    model = folder / f"{body.model}.xml"
    tree.write(model)
    compiled = mujoco.MjModel.from_xml_path(str(model))
    names = [compiled.joint(i).name for i in range(1, compiled.njnt)]
    pose = [next((v for end, v in body.pose.items() if n.endswith(end)), 0.0) for n in names]
    keys = ElementTree.SubElement(root, "keyframe")
    ElementTree.SubElement(keys, "key", name="home", qpos=" ".join(map(str, [0, 0, 1.0, 1, 0, 0, 0, *pose])))
    tree.write(model)
    draft = draft_robot(model, body.model, folder=folder)
    if draft.model:
        (folder / f"{body.model}-named.xml").write_text(draft.model)
    text = draft.text(f"{body.model}-named.xml" if draft.model else model.name)
    description = folder / "robot.toml"
    sdk = f"sdk_joint_names = {json.dumps(names)}\n"
    description.write_text(
        text if "sdk_joint_names" in text else text.replace("default_parameters =", f"{sdk}default_parameters =", 1)
    )
    load_robot(str(description))
    return description


def score(file: Path, folder: Path, options: argparse.Namespace) -> Row:
    """Load and score one policy."""
    name, began = file.parent.name, time.perf_counter()
    row = Row(file=f"{name}/{file.name}")
    given = CONTRACTS.get(name)
    contract = None if given is None else str(folder / given)
    try:
        robot = None
        if (needed := ROBOTS.get(name)) is not None:
            if options.robots is None:
                raise RobotError(f"robot '{needed}' needs the maker's model; give its folder as --robots")
            robot = str(build_robot(BODIES[needed], options.robots, options.out / "robots" / needed))
        asked = None if robot is None else load_robot(robot)
        policy: FilePolicy = load_policy(file, asked, contract_file=contract)
        provenance = policy.contract.provenance
        row.read = str(provenance.get("adapter", "its contract"))
        row.assumed, row.robot = str(provenance.get("assumed", "")), policy.contract.robot
        row.limits = policy.contract.command_limits
        request = Request(
            policy=str(file), robot=robot, contract=contract, suite=str(options.suite), threads=options.threads
        )
        result: Result = evaluate(prepare(request), options.out / name, resume=True)
        row.score, row.falls = result.terrains["flat"].score, result.health.falls
    except (ValueError, RuntimeError, ContractError, OSError) as error:
        row.problem = " ".join(str(error).split())
    row.seconds = time.perf_counter() - began
    return row


def cell(value: Any) -> str:
    """Return a value as a cell of the table."""
    return "" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value).replace("|", "/")


def boards(rows: list[Row]) -> str:
    """Return a table for each robot, best policies first, those without a score last."""
    lines = []
    for robot in sorted({row.robot for row in rows if row.robot}):
        lines += [f"## {robot}", "", "| policy | score | falls | limits | assumed |", "| --- | --- | --- | --- | --- |"]
        for row in sorted((r for r in rows if r.robot == robot), key=lambda r: -1.0 if r.score is None else -r.score):
            limits = ", ".join(f"{v:g}" for v in row.limits)
            columns = (row.file.partition("/")[0], row.score, row.falls, limits, row.problem or row.assumed)
            lines.append("| " + " | ".join(cell(v) for v in columns) + " |")
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    """Score the policies and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--robots", type=Path)
    parser.add_argument("--suite", default=HERE / "suite.toml", help="a suite with one terrain, flat")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results/public"))
    parser.add_argument("--only", default="", help="part of the names of the policies' folders")
    options = parser.parse_args()
    files = sorted(
        f for ending in ("*.pt", "*.onnx") for f in options.folder.glob(f"*/{ending}") if options.only in f.parent.name
    )
    print(
        "| file | read | robot | limits | score | falls | assumed |\n| --- | --- | --- | --- | --- | --- | --- |",
        flush=True,
    )
    rows = []
    for file in files:
        row = score(file, options.folder, options)
        rows.append(row)
        limits = ", ".join(f"{v:g}" for v in row.limits)
        columns = (row.file, row.read, row.robot, limits, row.score, row.falls, row.problem or row.assumed)
        print("| " + " | ".join(cell(v) for v in columns) + " |", flush=True)
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "board.md").write_text(boards(rows))
        (options.out / "board.json").write_text(json.dumps([vars(r) for r in rows], indent=2))


if __name__ == "__main__":
    main()
