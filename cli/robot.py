"""Describe a robot of one's own, and print every check of it as a sentence (``gaitgauge robot``)."""

from __future__ import annotations

import math
import os
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from rich.text import Text

from ..files.writing import make_folder, same_file, write_atomically
from ..robots import Robot, RobotError, load_robot
from ..robots.checks.examining import Finding, examine
from ..robots.describing.drafting import draft_robot
from ..robots.describing.guessing import guessed_again
from ..robots.describing.surveying import Answers
from ..robots.loading import ROBOT_FILE, load_robot_file
from .console import Terminal, print_json, shell_command
from .errors import UserError
from .picture import Picture, Tile, choose_renderer

if TYPE_CHECKING:
    from .picture import Quality

_EVERYTHING = "everything"
_UNSEEN = ("description", "size", "base", "joints", "feet", "bodies and sites")
"""Checks without which there is no picture; one of a pose that fails is needed most."""
_SIDES = (90.0, 215.0)
"""Directions in which the camera looks in the two views of a standing robot, from its right and from before it [deg]."""


def asked(*, legs: str | None, feet: str | None, keyframe: str | None, pose: str | None) -> Answers:
    """Return the answers that options give; raise ``UserError`` where ``pose`` is none."""
    angles: dict[str, float] = {}
    for each in (pose or "").split(",") if pose else ():
        joint, equals, angle = each.strip().partition("=")
        try:
            angles[joint.strip()] = float(angle)
        except ValueError:
            equals = ""
        if not equals or not math.isfinite(angles[joint.strip()]):
            raise UserError(f"--pose has '{each}'; give angles in radians, such as hip_pitch=-0.3,knee=0.6")
    names = [tuple(n.strip() for n in text.split(",") if n.strip()) if text else () for text in (legs, feet)]
    return Answers(legs=names[0], feet=names[1], keyframe=keyframe, pose=angles)


def new_robot(model: Path, *, out: Path | None, name: str | None, force: bool, answers: Answers | None = None) -> None:
    """Write a first description, and print plan, mends and guesses. An error restores all files.

    Raises:
        UserError: there is a description, or a model with names, already.
        RobotError: the model is no legged robot, or a file cannot be written.
    """
    folder = out or model.parent
    description = folder / ROBOT_FILE
    own = folder / f"{model.stem}-named.xml"
    if same_file(model, description):
        raise UserError(f"'{model}' would be replaced by the description; give the model another name, or --out")
    _refuse_existing(description, force)
    draft = draft_robot(model, name, folder=folder, answers=answers)
    if draft.model:
        _refuse_existing(own, force)
    mjcf = own.name if draft.model else os.path.relpath(model.resolve(), folder.resolve())
    with ExitStack() as undo:
        made = not folder.exists()
        make_folder(folder, RobotError)
        if made:
            undo.callback(folder.rmdir)
        for path, text in ((own, draft.model), (description, draft.text(mjcf))):
            if text:
                earlier = path.read_bytes() if path.is_file() else None
                write_atomically(path, text, RobotError)
                undo.callback(_restore, path, earlier)
        robot = load_robot_file(description)
        undo.pop_all()
    console = Terminal()
    console.say(f"wrote {description}: {robot.title}, {len(robot.foot_names)} legs, {robot.num_joints} joints")
    console.say(f"it is {draft.plan}")
    if draft.model:
        console.say(f"wrote {own}: the model, mended, with names and feet that the description needs")
    if draft.mends:
        console.say("\n  ".join(("mended there:", *draft.mends)))
    console.say("\n  ".join(("guessed, so look at it:", *draft.guesses)))
    console.say(f"next:\n  {shell_command(['robot', 'check', str(description)])}")


def guess_again(path: Path) -> None:
    """Make the guesses of a description again, and print those that changed; raise ``RobotError`` where that fails."""
    text, changes, file = guessed_again(path)
    console = Terminal()
    if changes:
        earlier = file.read_bytes()
        with ExitStack() as undo:
            write_atomically(file, text, RobotError)
            undo.callback(_restore, file, earlier)
            load_robot_file(file)
            undo.pop_all()
        console.say("\n  ".join((f"wrote {file}, comments above keys kept; guessed anew:", *changes)))
    else:
        console.say(f"{file}: every guess stays")
    console.say(f"next:\n  {shell_command(['robot', 'check', str(file)])}")


def convert_motor(
    file: Path,
    *,
    robot: str,
    out: Path,
    error: str | None,
    activation: str | None,
    name: str,
    passive: bool,
    force: bool,
) -> None:
    """Write an actuator network as ``NAME.npz`` and a parameter set that uses it as ``NAME.toml``.

    Raises:
        MotorNetworkError, PolicyError: the file cannot be used.
        RobotError: no such robot.
        UserError: an option does not fit, or a file is there and is not to be replaced.
    """
    from ..policy.foreign.motor_files import Description, read_motor_file
    from ..robots.motor_network import save_motor_network
    from ..robots.sets import find_set, network_text

    if not name.isidentifier():
        raise UserError(f"--name is '{name}'; use letters, digits and _")
    if error not in (None, *(signs := {"target-position": 1, "position-target": -1})):
        raise UserError(f"--error is '{error}'; it must be target-position or position-target")
    for end in ("npz", "toml"):
        _refuse_existing(out / f"{name}.{end}", force)
    described = None
    if error is not None:
        described = Description(error_sign=signs[error], activation=activation or "softsign")  # type: ignore[arg-type]
    machine = load_robot(robot)
    network = read_motor_file(file, described)
    make_folder(out, RobotError)
    save_motor_network(network, out / f"{name}.npz")
    text = network_text(machine, name, find_set(machine, None)[1], network, passive=passive)
    write_atomically(out / f"{name}.toml", text, RobotError)
    console = Terminal()
    inputs = f"{network.history} call{'s' if network.history > 1 else ''} of error and velocity"
    console.say(f"wrote {out / name}.npz: {network.kind}, {inputs}, called every {1e3 * network.period:g} ms")
    console.say(f"wrote {out / name}.toml: use it with --parameters {out / name}.toml --suite gaitgauge-1-network")


def _restore(path: Path, earlier: bytes | None) -> None:
    if earlier is None:
        path.unlink(missing_ok=True)
    else:
        write_atomically(path, earlier, RobotError)


def _refuse_existing(path: Path, force: bool) -> None:
    if path.exists() and not force:
        raise UserError(f"'{path}' already exists; give another folder (--out), or replace it with --force")


def check_robot_files(asked: str, *, picture: Path | None, json_output: bool) -> bool:
    """Print every check, and draw the standing pose if asked; return False where a check failed that everything needs.

    Raises:
        UserError: the picture's name does not end in .png, or it cannot be drawn.
    """
    if picture is not None and picture.suffix.lower() != ".png":
        raise UserError(f"--picture is '{picture}'; give a file that ends in .png")
    quality = None if picture is None else choose_renderer()  # before MuJoCo is imported
    robot: Robot | None = None
    try:
        robot = load_robot(Path(asked) if os.path.isdir(asked) else asked, check=False)
        described = f"{robot.title}: the description is complete and its values are possible"
        complete = Finding(check="description", passed=True, sentence=described, needed_for=_EVERYTHING)
        findings = [complete, *examine(robot)]
    except RobotError as error:
        findings = [Finding(check="description", passed=False, sentence=str(error), needed_for=_EVERYTHING)]
    sound = all(f.passed for f in findings if f.needed_for == _EVERYTHING)
    drawn = None
    unseen = any(f.check in _UNSEEN and not f.passed for f in findings)
    if robot is not None and not unseen and quality is not None and picture is not None:
        drawn = picture
        _draw(robot, quality, picture)
    if json_output:
        rows = [asdict(f) for f in findings]
        print_json({"robot": asked, "sound": sound, "checks": rows, "picture": drawn and str(drawn)})
        return sound
    console = Terminal()
    for finding in findings:
        needed = finding.needed_for == _EVERYTHING
        word, style = ("pass", "green") if finding.passed else ("FAIL", "bold red") if needed else ("note", "yellow")
        more = "" if finding.passed or needed else f" ({finding.needed_for} needs it)"
        console.say(Text.assemble((word, style), f"  {finding.check}: {finding.sentence}{more}"))
    if drawn is not None:
        console.say(f"picture {drawn}")
    console.say("the robot is sound" if sound else "the robot cannot be used yet")
    return sound


def _draw(robot: Robot, quality: Quality, path: Path) -> None:
    """Write a picture of the standing pose from two sides, or raise ``UserError``."""
    import imageio.v3
    import numpy as np

    from ..robots.anatomy.body_plan import body_plan, default_pose
    from ..terrains.registry import make_terrain
    from .scenery import visual_model

    _, data = default_pose(robot)
    position = data.qpos[: 7 + robot.num_joints].copy()
    plan = body_plan(robot)
    position[2] = plan.standing_height
    model = visual_model(robot, make_terrain("flat"), quality)
    views = []
    for azimuth in _SIDES:
        tile = Tile(model=model, heading=math.radians(azimuth - Picture.AZIMUTH), leg_length=plan.leg_length)
        picture = Picture(tile, size=quality.tile)
        try:
            views.append(picture.draw(position, position[:3]))
        finally:
            picture.close()
    try:
        imageio.v3.imwrite(path, np.ascontiguousarray(np.concatenate(views, axis=1)))
    except OSError as error:
        reason = error.strerror or error
        raise UserError(f"the picture '{path}' cannot be written: {reason}; choose another --picture") from error
