"""Scores public policies of other projects on level ground, each at commands within what it was made for, and prints a table.

    python benchmarks/public_policies.py FOLDER [--robots MODELS] [--gentle] [--threads N] [--out results/public] [--only TEXT]

``FOLDER`` has one folder for each policy, with the files that its authors ship beside it. ``MODELS`` has the makers' MuJoCo models of
robots that do not ship with gaitgauge (``b2.xml``, ``g1_12dof.xml``, ``h1.xml``); meshes are left out and missing trunks and soles
become boxes. Four legs are judged by ``public_contracts/suite.toml``, two by ``biped.toml``, all in the robot's own measure.
``OUT/board.md`` has a table for each robot. ``--gentle`` asks for half of each policy's limits and pushes nothing.
"""

from __future__ import annotations

import argparse
import json
import time
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from pathlib import Path

import humanoid_models
import mujoco
from gaitgauge.gauge.evaluate import evaluate, prepare
from gaitgauge.gauge.request import Request
from gaitgauge.gauge.result import Result
from gaitgauge.policy.contract import ContractError
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import FilePolicy
from gaitgauge.policy.robot_of import robot_for
from gaitgauge.robots import RobotError, load_robot
from gaitgauge.robots.describing.drafting import draft_robot

HERE = Path(__file__).parent / "public_contracts"
ROBOTS = {
    "rl_sar_b2_robot_lab": "b2",
    "unitree_rl_gym_g1_motion": "g1_12dof",
    "unitree_rl_gym_h1_motion": "h1",
}
"""Robots of policies by their folder; others are for one that ships."""
HEAD = """| policy | score | motion done | falls of sub-commands | limits | read | assumed |
| --- | --- | --- | --- | --- | --- | --- |"""


@dataclass(kw_only=True)
class Row:
    """One line of the table."""

    file: str
    read: str = ""
    assumed: str = ""
    robot: str = ""
    score: float | None = None
    interval: tuple[float, float] | None = None
    done: float | None = None
    """Mean share of the commanded motion."""
    falls: int | None = None
    sub_commands: int | None = None
    seconds: float = 0.0
    problem: str = ""
    limits: tuple[float, ...] = field(default_factory=tuple)


def build_b2(models: Path, folder: Path) -> Path:
    """Write a description of the B2 from its maker's model without meshes; return its ``robot.toml``."""
    folder.mkdir(parents=True, exist_ok=True)
    tree = ElementTree.parse(models / "b2.xml")
    root = tree.getroot()
    for parent in list(root.iter()):
        for child in list(parent):
            meshed = child.tag == "geom" and (child.get("mesh") is not None or child.get("class") == "visual")
            if meshed or child.tag in ("mesh", "keyframe", "sensor"):
                parent.remove(child)
    base = root.find("worldbody/body")
    assert base is not None
    if base.find("geom") is None:
        ElementTree.SubElement(base, "geom", type="box", size="0.06 0.08 0.06", contype="1", conaffinity="1")
    model = folder / "b2.xml"
    tree.write(model)
    compiled = mujoco.MjModel.from_xml_path(str(model))
    names = [compiled.joint(i).name for i in range(1, compiled.njnt)]
    pose = [
        next((v for end, v in {"thigh_joint": 0.8, "calf_joint": -1.5}.items() if n.endswith(end)), 0.0) for n in names
    ]
    keys = ElementTree.SubElement(root, "keyframe")
    ElementTree.SubElement(keys, "key", name="home", qpos=" ".join(map(str, [0, 0, 1.0, 1, 0, 0, 0, *pose])))
    tree.write(model)
    draft = draft_robot(model, "b2", folder=folder)
    if draft.model:
        (folder / "b2-named.xml").write_text(draft.model)
    text = draft.text("b2-named.xml" if draft.model else model.name)
    sdk = f"sdk_joint_names = {json.dumps(names)}\n"
    description = folder / "robot.toml"
    description.write_text(
        text if "sdk_joint_names" in text else text.replace("default_parameters =", f"{sdk}default_parameters =", 1)
    )
    load_robot(str(description))
    return description


def score(file: Path, options: argparse.Namespace) -> Row:
    """Load and score one policy."""
    name, began = file.parent.name, time.perf_counter()
    row = Row(file=f"{name}/{file.name}")
    try:
        robot = None
        if (needed := ROBOTS.get(name)) is not None:
            if options.robots is None:
                raise RobotError(f"robot '{needed}' needs the maker's model; give its folder as --robots")
            build = build_b2 if needed == "b2" else humanoid_models.write
            robot = str(build(options.robots, options.out / "robots" / needed))
        policy: FilePolicy = load_policy(file, None if robot is None else load_robot(robot))
        provenance = policy.contract.provenance
        row.read = str(provenance.get("adapter", "its contract"))
        row.assumed, row.robot = str(provenance.get("assumed", "")), policy.contract.robot
        row.limits = policy.contract.command_limits
        biped = len(robot_for(policy.contract, robot).foot_names) == 2
        kinds = ("biped", "biped-gentle") if biped else ("suite", "gentle")
        suite = str(HERE / f"{kinds[options.gentle]}.toml")
        request = Request(policy=str(file), robot=robot, suite=suite, threads=options.threads)
        result: Result = evaluate(prepare(request), options.out / name, resume=True)
        row.score, row.interval = result.score, result.score_interval
        row.falls, row.done = result.health.falls, result.metrics["motion_done"].mean
        row.sub_commands = sum(len(run.commands) for each in result.environments for run in each.runs.values())
    except (ValueError, RuntimeError, ContractError, OSError) as error:
        row.problem = " ".join(str(error).split())
    row.seconds = time.perf_counter() - began
    return row


def line(row: Row) -> str:
    """Return a row of a table."""
    interval = "" if row.interval is None else " ({:.3f} to {:.3f})".format(*row.interval)
    score = "" if row.score is None else f"{row.score:.3f}{interval}"
    done = "" if row.done is None else f"{row.done:.2f}"
    falls = "" if row.falls is None else f"{row.falls} of {row.sub_commands}"
    limits = ", ".join(f"{v:g}" for v in row.limits)
    cells = (row.file.partition("/")[0], score, done, falls, limits, row.read, row.problem or row.assumed)
    return "| " + " | ".join(each.replace("|", "/") for each in cells) + " |"


def boards(rows: list[Row]) -> str:
    """Return a table for each robot, best policies first, those without a score last."""
    lines = []
    for robot in sorted({row.robot for row in rows}):
        own = sorted((r for r in rows if r.robot == robot), key=lambda r: -1.0 if r.score is None else -r.score)
        lines += [f"## {robot or 'not loaded'}", "", HEAD, *map(line, own), ""]
    return "\n".join(lines)


def main() -> None:
    """Score the policies and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--robots", type=Path)
    parser.add_argument("--gentle", action="store_true", help="half of each policy's limits, no pushes")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results/public"))
    parser.add_argument("--only", default="", help="part of the names of the policies' folders")
    options = parser.parse_args()
    files = sorted(
        f for ending in ("*.pt", "*.onnx") for f in options.folder.glob(f"*/{ending}") if options.only in f.parent.name
    )
    print(HEAD, flush=True)
    rows = []
    for file in files:
        rows.append(score(file, options))
        print(line(rows[-1]), flush=True)
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "board.md").write_text(boards(rows))
        (options.out / "board.json").write_text(json.dumps([vars(r) for r in rows], indent=2))


if __name__ == "__main__":
    main()
