"""Suites, sweeps, robots and their models, settings, variants, episode files, run folders."""

from __future__ import annotations

import io
import json
import tempfile
from contextlib import suppress
from pathlib import Path

import numpy as np
from fuzzing import register
from gaitgauge.backends.base import PhysicsOptions
from gaitgauge.files.parsing import parse_json, parse_toml, parse_yaml, shown
from gaitgauge.gauge.episodes import Episode, Record, RecordError
from gaitgauge.gauge.store import RunFolder
from gaitgauge.gauge.suite import SUITE_FOLDER, load_suite
from gaitgauge.robots import RobotError, load_robot
from gaitgauge.robots.identity import identify, recall
from gaitgauge.studies.consistency.variants import parse_variant
from gaitgauge.studies.trials.scenario import SCENARIO_FOLDER, load_scenario
from gaitgauge.training.sweep.file import load_sweep
from gaitgauge.training.tasks import find_task

GO2 = load_robot("go2").mjcf.parent
_TOML = (
    b" = ",
    b"[[",
    b"]",
    b"inf",
    b"-1",
    b"1e9",
    b'"',
    b"'''",
    b"\\u001b",
    b"extends = ",
    b"{a = 1}",
    b"true",
    b"[/x]",
)
_XML = (
    b'<replicate count="1000000">',
    b"</replicate>",
    b'<size nkey="1e9"/>',
    b"<",
    b"/>",
    b'"',
    b"<include file='go2.xml'/>",
    b"<weld body1='base_link'/>",
    b"nan",
    b"-1 ",
    b"&a;",
    b"<!--",
)
REQUEST = {"suite": "demo 1.0.0", "seeds": [0, 1], "level": None}


def _suite(content: bytes, folder: Path) -> None:
    path = folder / "mine.toml"
    path.write_bytes(content)
    load_suite(str(path))


def _scenario(content: bytes, folder: Path) -> None:
    path = folder / "mine.toml"
    path.write_bytes(content)
    load_scenario(str(path))


def _sweep(content: bytes, folder: Path) -> None:
    path = folder / "sweep.toml"
    path.write_bytes(content)
    load_sweep(path)


def _robot(content: bytes, folder: Path) -> None:
    (folder / "go2.xml").write_bytes((GO2 / "go2.xml").read_bytes())
    (folder / "robot.toml").write_bytes(content)
    load_robot(folder)


def _model(content: bytes, folder: Path) -> None:
    (folder / "go2.xml").write_bytes(content)
    (folder / "robot.toml").write_bytes((GO2 / "robot.toml").read_bytes())
    load_robot(folder)


def _settings(content: bytes, folder: Path) -> None:
    find_task("go2-moe-cts", content.decode("utf-8", "surrogateescape").splitlines())


def _variant(content: bytes, folder: Path) -> None:
    parse_variant(content.decode("utf-8", "surrogateescape")).physics(PhysicsOptions())


def _carried(content: bytes, folder: Path) -> None:
    """A robot that a policy carries is unpacked into a folder of its own."""
    before, tempfile.tempdir = tempfile.tempdir, str(folder)
    try:
        recall(parse_json(content, "it", RobotError))
    finally:
        tempfile.tempdir = before


EPISODE = Episode(
    terrain="wave",
    level=3,
    friction=0.6,
    payload=0.0,
    seed=0,
    stage="eval",
    goals=("max_velocity", "diagonal_velocity"),
)


def _episode(content: bytes, folder: Path) -> None:
    path = folder / f"{EPISODE.key}.npz"
    path.write_bytes(content)
    record = Record.load(path)
    if record.episode != EPISODE:
        raise RecordError("it is another episode")


def _head(content: bytes, folder: Path) -> None:
    archive = io.BytesIO()
    np.savez(archive, head=np.frombuffer(content, np.uint8), **SAMPLES)
    _episode(archive.getvalue(), folder)


def _request(content: bytes, folder: Path) -> None:
    (folder / "run" / "episodes").mkdir(parents=True)
    (folder / "run" / "request.json").write_bytes(content)
    RunFolder(folder / "run", REQUEST, resume=True)


class ScalarError(ValueError):
    """A scalar that no parser takes; of the project's own, as the errors of its readers are."""

    __module__ = "gaitgauge.files.parsing"


def _scalars(content: bytes, folder: Path) -> None:
    """Every value alone, with a tag and as a key, through each parser of texts."""
    taken, text = 0, content.decode("utf-8", "surrogateescape").replace("\n", " ")
    tags = ("", "!!bool ", "!!int ", "!!timestamp ")
    texts = [(parse_yaml, f"x: {tag}{text}") for tag in tags] + [
        (parse_yaml, f"{text}: 1"),
        (parse_toml, f"x = {text}"),
    ]
    for parse, line in [*texts, (parse_json, text)]:
        with suppress(ScalarError):
            assert shown(parse(line, "it", ScalarError)).isprintable()
            taken += 1
    if not taken:
        raise ScalarError("none takes it")


SAMPLES = {
    "samples": np.zeros((3, 2), np.float32),
    "goal_index": np.array([0, 0, 1], np.int16),
    "part_index": np.array([0, 7, 2], np.int16),
}
HEAD = json.dumps(
    {**vars(EPISODE), "columns": ["dof_power", "quality"], "success": None, "falls": 0, "diverged": False}
    | {"overflowed": False, "restarted": False, "control_steps": 3, "physics_steps": 30}
).encode()


def _archive() -> bytes:
    archive = io.BytesIO()
    np.savez(archive, head=np.frombuffer(HEAD, np.uint8), **SAMPLES)
    return archive.getvalue()


SCENARIOS = [
    (SCENARIO_FOLDER / f"{name}.toml").read_bytes().replace(b'name = "', b'name = "my-', 1)
    for name in ("drop-60cm", "sprint")
]
_GONE = identify(load_robot("go2"), "/nowhere/robot.toml")
CARRIED = json.dumps(_GONE, default=str).encode()
_SUITE = (SUITE_FOLDER / "robogauge-1.1.toml").read_bytes().replace(b'"robogauge-1.1"', b'"mine"')
_SHORT = b'extends = "gaitgauge-1"\nname = "mine"\n[matrix]\nfrictions = [0.6]\n[metrics]\ninterval = 50\n'
_SETTINGS = b"environment.push.linear=0.6\ntraining.run.iterations=50\nenvironment.terrain.tiles.flat.share=0.3\n"
register("suite", _suite, seeds=[_SUITE, _SHORT], words=_TOML, text=True)
_SWEEP = b"""name = "a"\ntitle = "b"\nseeds = [0, 1]\nsettings = ["training.run.iterations=5"]\ncheckpoint = "best"
[[entry]]\nname = "c"\ntask = "go2-him"\nseeds = [7]\nbackend = "mujoco"\ndevice = "cpu"\n"""
register("sweep", _sweep, seeds=[_SWEEP], words=_TOML, text=True)
register("robot", _robot, seeds=[(GO2 / "robot.toml").read_bytes()], words=_TOML, text=True)
register("robot-model", _model, seeds=[(GO2 / "go2.xml").read_bytes()], words=_XML, text=True)
register("settings", _settings, seeds=[_SETTINGS], words=(b"=", b".", b"none", b"inf", b"1,2", b"\n"), text=True)
register(
    "variant",
    _variant,
    seeds=[b"newton:steel@timestep=0.005@cone=pyramidal", b"mujoco@iterations=50@self_collision=false"],
    words=(b"@", b"=", b"none", b"nan", b"0"),
    text=True,
)
register("episode", _episode, seeds=[_archive()])
register("episode-head", _head, seeds=[HEAD], json=True)
register("run-request", _request, seeds=[json.dumps(REQUEST).encode()], json=True)
register("robot-carried", _carried, seeds=[CARRIED], json=True)
_DIGITS = (
    b"0x",
    b"f" * 5000,
    b"9" * 5000,
    b"0b",
    b"1" * 20_000,
    b"maybe",
    b"1:99:99",
    b"2020-99-99",
    b"1e999",
    b".inf",
    b"!!bool ",
)
register("scalars", _scalars, seeds=[b"0x1f", b"true", b"1.5"], words=_DIGITS, text=True)
register("scenario", _scenario, seeds=SCENARIOS, words=_TOML, text=True)
