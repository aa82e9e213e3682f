"""Runs what README and guides show: marked blocks as they stand, every other command as far as its parsing.

A block is marked by an HTML comment on the line before it: ``<!-- run -->`` runs it, in the order of the page, in one
folder for the page; ``<!-- run: FOLDER -->`` needs the results of the demo suite there; ``<!-- file: PATH -->`` writes
the block to a file first.
"""

from __future__ import annotations

import os
import pkgutil
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import gaitgauge
import pytest
import typer
from gaitgauge.cli.main import app

ROOT = Path(gaitgauge.__path__[0])
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
_BLOCK = re.compile(
    r"(?:^<!-- (?P<mark>run|file)(?:: (?P<what>\S+))? -->\n)?^```(?P<kind>\w*)[^\n]*\n(?P<text>.*?)^```$", re.M | re.S
)


@dataclass(frozen=True)
class Block:
    """One fenced block of a page."""

    mark: str | None
    what: str | None
    kind: str
    text: str


def blocks(page: Path) -> list[Block]:
    """All fenced blocks of a page."""
    found = _BLOCK.finditer(page.read_text(encoding="utf-8"))
    return [Block(m["mark"], m["what"], m["kind"], m["text"]) for m in found]


def commands(page: Path) -> list[list[str]]:
    """Every ``gaitgauge`` command line of a page's shell blocks, as words."""
    lines: list[list[str]] = []
    for block in blocks(page):
        if block.kind in ("bash", "sh", ""):
            for line in block.text.replace("\\\n", " ").splitlines():
                words = shlex.split(line.split(" || ")[0], comments=True)
                if words[:1] == ["gaitgauge"]:
                    lines.append(words[1:])
    return lines


COMMANDS = typer.main.get_command(app)
SHOWN = [(page.name, words) for page in PAGES for words in commands(page)]


def test_pages_show_commands():
    assert len(SHOWN) > 20


@pytest.mark.parametrize(("page", "words"), SHOWN, ids=[f"{page}: {' '.join(words)}"[:100] for page, words in SHOWN])
def test_every_command_that_is_shown_exists_with_these_options(page, words):
    group = COMMANDS
    context = group.make_context("gaitgauge", [], resilient_parsing=True)
    if words[0].startswith("-"):
        group.make_context("gaitgauge", list(words), resilient_parsing=True)
        return
    for name in list(words):
        command = group.get_command(context, name)
        assert command is not None, f"{page} shows the unknown command '{name}'"
        words = words[1:]
        if not hasattr(command, "commands"):
            break
        group = command
    command.make_context("gaitgauge", list(words))


def test_the_page_of_the_api_names_what_exists_and_every_command():
    text = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    names = re.findall(r"(?:`|^::: )(gaitgauge(?:\.\w+)+)", text, re.M)
    assert len(names) > 15
    for name in names:
        pkgutil.resolve_name(name)  # raises
    assert [c for c in COMMANDS.list_commands(None) if f"`{c}`" not in text] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_pictures_that_pages_show_are_there_and_small(page):
    """README showed a picture that nobody had made."""
    for target in re.findall(r"!\[[^]]*\]\((?!https?:)([^)]+)\)", page.read_text(encoding="utf-8")):
        picture = page.parent / target
        assert picture.is_file(), f"{page.name} shows {target}"
        assert picture.stat().st_size <= 3_000_000


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in PAGES if any(b.mark for b in blocks(p))], ids=lambda p: p.name)
def test_marked_blocks_run(page, tmp_path):
    site = tmp_path / "site"
    site.mkdir()
    (site / "gaitgauge").symlink_to(ROOT, target_is_directory=True)
    folder = tmp_path / "work"
    folder.mkdir()
    paths = [str(site), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    # ``pip install`` of a plug-in writes to ``site``; pip reads PIP_NO_BUILD_ISOLATION=0 as ``--no-build-isolation``.
    pip = {"PIP_TARGET": str(site), "PIP_NO_DEPS": "1", "PIP_NO_BUILD_ISOLATION": "0"}
    environment = os.environ | pip | {"PYTHONPATH": os.pathsep.join(filter(None, paths)), "GAITGAUGE": str(ROOT)}
    programs = {"gaitgauge": "gaitgauge.cli.main", "pip": "pip"}
    shell = "".join(f'{name}() {{ "{sys.executable}" -m {module} "$@"; }}\n' for name, module in programs.items())
    shell += "set -euo pipefail\n"

    def run(command: list[str]) -> None:
        ended = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=900)
        assert ended.returncode == 0, f"{command[-1]}\n{ended.stdout[-3000:]}\n{ended.stderr[-3000:]}"

    for block in blocks(page):
        if block.mark == "file":
            assert block.what
            (folder / block.what).parent.mkdir(parents=True, exist_ok=True)
            (folder / block.what).write_text(block.text)
        elif block.mark == "run":
            if block.what:
                run(
                    [
                        "bash",
                        "-c",
                        f"{shell}gaitgauge evaluate pretrained --suite demo --terrain flat --out {block.what}",
                    ]
                )
            run([sys.executable, "-c", block.text] if block.kind == "python" else ["bash", "-c", shell + block.text])


@pytest.mark.parametrize(
    "page",
    sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("examples/**/*.md")]),
    ids=lambda p: str(p.relative_to(ROOT)),
)
def test_lines_are_at_most_100_columns(page):
    too_long = [f"{i}: {len(line)}" for i, line in enumerate(page.read_text().splitlines(), 1) if len(line) > 100]
    assert not too_long, f"{page.name}, line: columns {too_long[:10]}"
