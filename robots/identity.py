"""Which robot a policy is for: what every policy remembers of it, and how it is found again.

An installed robot is remembered by its name, one that was given as a file by the file's path and by a copy of the
description and of the model's files, so that a policy can be played where the file is not. Digests say whether what is
found is what was meant.
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
from .checking import check_robot
from .loading import LARGEST_MODEL, RobotError, model_files, robot_digest
from .registry import load_robot, robot_names

LARGEST_COPY = 400_000
"""Largest copy of a robot in a policy [characters]; a model with more than this in its meshes is remembered by its path."""
_LARGEST_UNPACKED = 50_000_000
"""Size of the files of a copy once they are unpacked [bytes]."""
_Digest = Annotated[str, Field(min_length=64, max_length=64)]


@dataclass(frozen=True, kw_only=True)
class RobotIdentity:
    """What a policy remembers of its robot."""

    name: Name
    digest: _Digest
    """``robot_digest`` of the robot."""
    source: Text | None = None
    """Absolute path of its description; None for an installed robot."""
    description: Mapping[Text, Any] | None = None
    """Fields of ``Robot``; ``mjcf`` is a name in ``files``. None where nothing is carried along."""
    files: Mapping[Text, str] | None = None
    """Files of the model by their path among each other, compressed (zlib) in base64."""


def identify(robot: Robot, source: str) -> dict[str, Any]:
    """What a policy is to remember of a robot, as plain data.

    Args:
        source: how it was asked for: a name or a path.

    Raises:
        RobotError: a file of the model cannot be read.
    """
    entry: dict[str, Any] = {"name": robot.name, "digest": robot_digest(robot)}
    if source in robot_names():
        return entry
    entry["source"] = os.path.abspath(os.path.expanduser(source))
    return entry | _copy(robot, LARGEST_COPY)


def packed(robot: Robot) -> RobotIdentity:
    """A robot with all its files, for a machine that may have none of them; ``unpacked`` makes it a robot there.

    Raises:
        RobotError: a file of the model cannot be read.
    """
    copy = _copy(robot, LARGEST_MODEL)
    return RobotIdentity(name=robot.name, digest=robot_digest(robot), **copy)


def _copy(robot: Robot, largest: int) -> dict[str, Any]:
    """Description and files as in ``RobotIdentity``; nothing if they are larger than so many characters."""
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
    """The robot that a policy remembers, checked against its model.

    Args:
        remembered: what ``identify`` returned, as it comes back from a file that anybody may have written.

    Returns:
        The robot, and a sentence where it is not the one that the policy was made for or comes from the policy itself.

    Raises:
        RobotError: it is not there any more, or what is remembered is malformed.
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
    return unpacked(
        known, folder
    ), f"'{one_line(known.source)}' is not there; the robot is the copy that the policy carries"


def changed(robot: Robot, digest: str, what: str) -> str | None:
    """A sentence if a robot is not the one of a digest."""
    found = robot_digest(robot)
    if found == digest:
        return None
    return (
        f"{what} has changed since the policy was made: its digest is {found[:12]}, the policy remembers {digest[:12]}; "
        "results hold for the robot as it is now"
    )


def unpacked(known: RobotIdentity, folder: Path, *, largest: int = _LARGEST_UNPACKED) -> Robot:
    """Write a robot's files into an empty folder, where they have to stay while the robot is read.

    Args:
        known: the robot, perhaps a stranger's.
        largest: their size once they are unpacked, at most [bytes].

    Raises:
        RobotError: they are damaged, lead out of the folder, or are not what the digest says.
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
    model_files(mjcf, within=folder)  # refused before any other file is read
    robot = build(Robot, {**known.description, "mjcf": str(mjcf)}, source, RobotError)
    if robot_digest(robot) != known.digest:
        raise RobotError(f"{source} is damaged: its digest is not the one that the policy remembers; give --robot")
    check_robot(robot, foreign=True)
    return robot
