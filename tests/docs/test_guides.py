"""Tests that README and pages are right: commands, pictures, links, lengths.

Marked blocks are run as they stand; every other command is parsed.

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

ROOT = Path(gaitgauge.__path__[0]).resolve()
DOCS = ROOT / "docs"
SITE = sorted(DOCS.rglob("*.md"))
GUIDES = sorted((DOCS / "guides").glob("*.md"))
PAGES = [ROOT / "README.md", *SITE]
EVERYTHING = [*sorted(ROOT.glob("*.md")), *SITE, *sorted(ROOT.glob("examples/**/*.md"))]
GENERATED = {DOCS / "reference" / "cli.md"}
"""Pages that only the build of the site writes."""
_BLOCK = re.compile(
    r"(?:^<!-- (?P<mark>run|file)(?:: (?P<what>\S+))? -->\n)?^```(?P<kind>\w*)[^\n]*\n(?P<text>.*?)^```$", re.M | re.S
)


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    mark: str | None
    what: str | None
    kind: str
    text: str


def blocks(page: Path) -> list[Block]:
    """Return all fenced blocks of a page."""
    found = _BLOCK.finditer(page.read_text(encoding="utf-8"))
    return [Block(m["mark"], m["what"], m["kind"], m["text"]) for m in found]


def commands(page: Path) -> list[list[str]]:
    """Return every ``gaitgauge`` command line of a page's shell blocks, as words."""
    lines: list[list[str]] = []
    for block in blocks(page):
        if block.kind in ("bash", "sh", ""):
            for line in block.text.replace("\\\n", " ").splitlines():
                words = shlex.split(line.split(" || ")[0], comments=True)
                if words[:1] == ["gaitgauge"]:
                    lines.append(words[1:])
    return lines


def title(page: Path) -> str:
    """Return the path of a page below the repository's root."""
    return str(page.relative_to(ROOT))


def words_in(page: Path) -> int:
    """Count the words of a page as ``wc -w`` does."""
    return len(page.read_text(encoding="utf-8").split())


def pictures(page: Path) -> list[Path]:
    """Return the files of the pictures that a page shows."""
    shown = re.findall(r"!\[[^]]*\]\((?!https?:)([^)\s]+)\)", page.read_text(encoding="utf-8"))
    return [(page.parent / target).resolve() for target in shown]


COMMANDS = typer.main.get_command(app)
SHOWN = [(title(page), words) for page in PAGES for words in commands(page)]


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


def test_the_pages_of_the_api_name_what_exists_and_every_command():
    text = "".join(page.read_text(encoding="utf-8") for page in sorted((DOCS / "reference" / "api").glob("*.md")))
    names = re.findall(r"(?:`|^::: )(gaitgauge(?:\.\w+)+)", text, re.M)
    assert len(names) > 15
    for name in names:
        pkgutil.resolve_name(name)  # raises
    assert [c for c in COMMANDS.list_commands(None) if f"`{c}`" not in text] == []


@pytest.mark.parametrize("page", PAGES, ids=title)
def test_pictures_that_pages_show_are_there_and_small(page):
    """README showed a picture that nobody had made."""
    for picture in pictures(page):
        assert picture.is_file(), f"{page.name} shows {picture}"
        assert picture.stat().st_size <= 1_200_000


def test_the_pages_show_at_least_15_pictures_and_each_picture_of_the_folder():
    shown = {picture for page in PAGES for picture in pictures(page)}
    assert len(shown) >= 15
    assert sorted(p.name for p in (DOCS / "media").iterdir() if p not in shown) == []


@pytest.mark.parametrize("page", GUIDES, ids=title)
def test_a_guide_has_at_most_900_words(page):
    assert words_in(page) <= 900


def test_start_and_guides_have_at_most_20_000_words():
    assert sum(map(words_in, [DOCS / "index.md", *(DOCS / "start").glob("*.md"), *GUIDES])) <= 20_000


def test_the_glossary_has_at_most_30_words():
    terms = re.findall(r"^\| \*\*", (DOCS / "reference" / "glossary.md").read_text(encoding="utf-8"), re.M)
    assert 10 < len(terms) <= 30


def test_readme_and_changelog_are_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 90
    assert len((ROOT / "CHANGELOG.md").read_text(encoding="utf-8").splitlines()) <= 120


@pytest.mark.parametrize("page", EVERYTHING, ids=title)
def test_links_lead_to_files(page):
    prose = _BLOCK.sub("", page.read_text(encoding="utf-8"))
    targets = re.findall(r"\]\((?!https?:|mailto:|#)([^)\s#]+)[^)]*\)", prose)
    paths = [(page.parent / target).resolve() for target in targets]
    assert [os.path.relpath(path, ROOT) for path in paths if not path.exists() and path not in GENERATED] == []


NIGHTLY = {
    "docs/guides/board.md": "tests/cli/test_verify_command.py",
    "docs/guides/compare.md": "tests/cli/test_compare_command.py",
    "docs/guides/consistency.md": "tests/cli/test_consistency_command.py",
    "docs/start/first-training.md": "tests/cli/test_train.py",
}
"""Pages with commands that take a minute or more, and the fast tests that run these commands on less."""
RUN = [
    pytest.param(page, marks=pytest.mark.nightly if title(page) in NIGHTLY else ())
    for page in PAGES
    if any(block.mark for block in blocks(page))
]


def test_what_is_run_at_night_alone_has_a_fast_test():
    for page, test in NIGHTLY.items():
        names = {words[0] for words in commands(ROOT / page)}
        assert any(f'"{name}"' in (ROOT / test).read_text() for name in names), page


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN, ids=title)
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
    programs = {"gaitgauge": "-m gaitgauge.cli.main", "pip": "-m pip", "python": ""}
    shell = "".join(f'{name}() {{ "{sys.executable}" {module} "$@"; }}\n' for name, module in programs.items())
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
                        f"{shell}gaitgauge evaluate pretrained --suite demo --terrain flat --no-clip --out {block.what}",
                    ]
                )
            run([sys.executable, "-c", block.text] if block.kind == "python" else ["bash", "-c", shell + block.text])


def prose_lines(text: str) -> list[tuple[int, str]]:
    """Return the numbered lines of a page that are neither code, nor rows of a table, nor a picture alone."""
    lines: list[tuple[int, str]] = []
    in_code = False
    for number, line in enumerate(text.splitlines(), 1):
        if line.lstrip().startswith("```"):
            in_code = not in_code
        elif not in_code and not re.match(r"\s*(\||!\[[^]]*\]\([^)]*\)$)", line):
            lines.append((number, line))
    return lines


@pytest.mark.parametrize("page", EVERYTHING, ids=title)
def test_lines_of_prose_are_at_most_100_columns(page):
    lines = prose_lines(page.read_text(encoding="utf-8"))
    too_long = [f"{number}: {len(line)}" for number, line in lines if len(line) > 100]
    assert not too_long, f"{page.name}, line: columns {too_long[:10]}"
