"""Tests that an episode and a training step pass the functions of ``docs/reference/architecture.md``, in that order."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import CodeType, FrameType

import pytest
from gaitgauge.cli.main import app
from typer.testing import CliRunner

ROOT = Path(__file__).parents[2]
SMALL = (
    "training.algorithm.minibatches=1",
    "training.algorithm.epochs=1",
    "training.run.steps_per_iteration=4",
)


TITLES = ("One episode, from the command to the result", "One training step")


def hops(title: str) -> list[str]:
    """Return the functions of a section's table, as ``file:name``; the first is the command."""
    page = (ROOT / "docs" / "reference" / "architecture.md").read_text(encoding="utf-8")
    section = page.split(f"## {title}")[1].split("\n## ")[0]
    return re.findall(r"^\| \d+ \| `([\w/]+\.py:[\w.]+)` \|", section, re.MULTILINE)


def passed(command: list[str], wanted: list[str]) -> list[str]:
    """Return the wanted functions in the order in which a command called them."""
    names: dict[CodeType, str | None] = {}
    calls: list[str] = []

    def note(frame: FrameType, event: str, _: object) -> None:
        if event != "call":
            return
        code = frame.f_code
        if code not in names:
            path = Path(code.co_filename).resolve()
            name = f"{path.relative_to(ROOT)}:{code.co_qualname}" if path.is_relative_to(ROOT) else ""
            names[code] = name if name in wanted else None
        if (name := names[code]) is not None:
            calls.append(name)

    sys.setprofile(note)
    try:
        ended = CliRunner().invoke(app, command)
    finally:
        sys.setprofile(None)
    assert ended.exit_code == 0, ended.output
    return calls


def assert_in_order(wanted: list[str], calls: list[str]) -> None:
    """Check that the calls contain the wanted functions in their order."""
    rest = iter(calls)
    for hop in wanted:
        assert hop in rest, f"{hop} is not called after the hops above it"


@pytest.mark.parametrize("title", TITLES)
def test_a_command_calls_what_it_imports(title):
    (commands, _, command), (file, _, function) = (hop.partition(":") for hop in hops(title)[:2])
    body = (ROOT / commands).read_text(encoding="utf-8").split(f"\ndef {command}(")[1].split("\n@command")[0]
    assert f" from ..{Path(file).stem} import {function}\n" in body
    assert f" {function}(" in body


@pytest.mark.parametrize("title", TITLES)
def test_every_function_exists(title):
    for hop in hops(title):
        file, _, name = hop.partition(":")
        *classes, function = name.split(".")
        source = (ROOT / file).read_text(encoding="utf-8")
        assert all(f"\nclass {c}" in source for c in classes), hop
        assert re.search(rf"^{'    ' if classes else ''}def {function}\(", source, re.MULTILINE), hop


@pytest.mark.slow
def test_an_episode(tmp_path):
    wanted = hops(TITLES[0])[1:]
    assert len(wanted) > 12
    command = ["evaluate", "pretrained", "--suite", "demo", "--pipeline", "base", "--terrain", "flat", "--threads", "1"]
    assert_in_order(wanted, passed([*command, "--no-clip", "--out", str(tmp_path)], wanted))


@pytest.mark.slow
def test_a_training_step(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wanted = [hop for hop in hops(TITLES[1])[1:] if not hop.startswith("backends/")]  # the engine is another
    assert len(wanted) > 12
    command = [
        "train",
        "go2-flat",
        *SMALL,
        "--backend",
        "fake",
        "--device",
        "cpu",
        "--num-envs",
        "8",
        "--no-score",
        "--no-film",
    ]
    assert_in_order(wanted, passed([*command, "--iterations", "1"], wanted))
