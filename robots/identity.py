"""Remember the robot that a policy is for, and find it again.

A policy remembers an installed robot by its name; a robot given as a file by the file's path and a copy of the description
and the model's files, so that the policy can be played without the file. Digests tell whether the robot found is the same.
"""

from __future__ import annotations

import atexit
import base64
import os
import shutil
import tempfile
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

from pydantic import Field

from ..files.parsing import Name, Text, build, one_line
from .base import Robot
from .checks.checking import check_robot
from .loading import LARGEST_MODEL, RobotError, model_files, robot_digest
from .registry import load_robot, robot_names

LARGEST_COPY = 400_000
"""Largest copy of a robot in a policy [characters]; a larger model is remembered by its path alone."""
_LARGEST_UNPACKED = 50_000_000
"""Largest size of a copy's unpacked files [bytes]."""
_Digest = Annotated[str, Field(min_length=64, max_length=64)]


@dataclass(frozen=True, kw_only=True)
class RobotIdentity:
    """Data that a policy remembers of its robot."""

    name: Name
    digest: _Digest
    """``robot_digest`` of the robot."""
    source: Text | None = None
    """Absolute path of its description; None for an installed robot."""
    description: Mapping[Text, Any] | None = None
    """Fields of ``Robot``; ``mjcf`` is a name in ``files``. None where the policy carries no copy."""
    files: Mapping[Text, str] | None = None
    """Files of the model by relative path, compressed (zlib) in base64."""


def identify(robot: Robot, source: str) -> dict[str, Any]:
    """Return the data for a policy to remember of a robot, which the user named by ``source``, a name or a path.

    Raises:
        RobotError: a file of the model cannot be read.
    """
    entry: dict[str, Any] = {"name": robot.name, "digest": robot_digest(robot)}
    if source in robot_names():
        return entry
    entry["source"] = os.path.abspath(os.path.expanduser(source))
    return entry | _copy(robot, LARGEST_COPY)


def packed(robot: Robot) -> RobotIdentity:
    """Pack a robot with all its files for another machine's ``unpacked``; raise ``RobotError`` where a file cannot be read."""
    return RobotIdentity(name=robot.name, digest=robot_digest(robot), **_copy(robot, LARGEST_MODEL))


def _copy(robot: Robot, largest: int) -> dict[str, Any]:
    """Return description and files as in ``RobotIdentity``; nothing if they have more than ``largest`` characters."""
    paths = [path.resolve() for path in model_files(robot.mjcf)]
    folder = Path(os.path.commonpath([path.parent for path in paths]))
    files: dict[str, str] = {}
    for path in paths:
        try:
            data = path.read_bytes()
        except OSError as error:
            raise RobotError(f"'{one_line(path)}' cannot be read: {error.strerror}") from error
        files[path.relative_to(folder).as_posix()] = base64.b64encode(zlib.compress(data, 9)).decode()
        if sum(map(len, files.values())) > largest:
            return {}
    return {"description": asdict(robot) | {"mjcf": next(iter(files))}, "files": files}


def recall(remembered: Any) -> tuple[Robot, str | None]:
    """Find the robot that a policy remembers, and check it against its model.

    Args:
        remembered: result of ``identify``, read back from a file that anybody may have written.

    Returns:
        The robot, and a sentence where the robot has changed since or comes from the policy itself.

    Raises:
        RobotError: the robot is gone, or the data are malformed.
    """
    known = build(RobotIdentity, remembered, "the robot that the policy remembers", RobotError)
    if known.source is None:
        robot = load_robot(known.name)
        return robot, changed(robot, known.digest, f"the installed robot '{known.name}'")
    if os.path.exists(known.source):
        robot = load_robot(Path(known.source))
        return robot, changed(robot, known.digest, f"'{one_line(known.source)}'")
    if known.files is None or known.description is None:
        raise RobotError(
            f"the policy is for the robot '{known.name}' of '{one_line(known.source)}', which is not there; say where it is "
            "with --robot"
        )
    folder = Path(tempfile.mkdtemp(prefix="gaitgauge-robot-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    said = f"'{one_line(known.source)}' is not there; the robot is the copy that the policy carries"
    return unpacked(known, folder), said


def changed(robot: Robot, digest: str, what: str) -> str | None:
    """Return a sentence where a robot has another digest, else None."""
    found = robot_digest(robot)
    if found == digest:
        return None
    return (
        f"{what} has changed since the policy was made: its digest is {found[:12]}, the policy remembers {digest[:12]}; "
        "results hold for the robot as it is now"
    )


def unpacked(known: RobotIdentity, folder: Path, *, largest: int = _LARGEST_UNPACKED) -> Robot:
    """Write a robot's files into an empty folder, where they must stay while the robot is in use.

    Args:
        largest: most unpacked size [bytes].

    Raises:
        RobotError: the files are damaged, lead out of the folder, or have another digest.
    """
    assert known.files is not None and known.description is not None
    source = f"the copy of the robot '{known.name}' that the policy carries"
    folder = folder.resolve()
    left = largest
    try:
        for name, text in known.files.items():
            path = PurePosixPath(name)
            if path.is_absolute() or ".." in path.parts or not path.parts:
                raise RobotError(f"{source} has a file '{one_line(name)}' outside its folder")
            unpack = zlib.decompressobj()
            data = unpack.decompress(base64.b64decode(text, validate=True), left + 1)
            left -= len(data)
            if unpack.unconsumed_tail or left < 0:
                raise RobotError(f"{source} unpacks to more than {largest // 10**6} MB")
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_bytes(data)
    except (OSError, ValueError, zlib.error) as error:
        if isinstance(error, RobotError):
            raise
        raise RobotError(f"{source} cannot be unpacked: {one_line(error)}") from error
    mjcf = folder / str(known.description.get("mjcf"))
    model_files(mjcf, within=folder)  # refuse other files before any is read
    robot = build(Robot, {**known.description, "mjcf": str(mjcf)}, source, RobotError)
    if robot_digest(robot) != known.digest:
        raise RobotError(f"{source} is damaged: its digest is not the one that the policy remembers; give --robot")
    check_robot(robot, foreign=True)
    return robot
