"""Prepares the documentation build: links the package under its own name and makes the command reference."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent
PATHS = ROOT / "build" / "package"
"""The folder in which mkdocstrings finds the package (``mkdocs.yml`` names it too)."""


def on_startup(command: str, dirty: bool) -> None:
    """Link the package before mkdocstrings looks for its folder, which must exist by then."""
    link_package()


def link_package() -> None:
    """Let mkdocstrings find the package under its own name, and nothing else.

    The repository's root is the package ``gaitgauge``. mkdocstrings reads every Python file below it, and a link to the
    root would contain the link itself and ``.venv``. The modules and subpackages are therefore linked one by one.
    """
    package = PATHS / "gaitgauge"
    shutil.rmtree(package, ignore_errors=True)
    package.mkdir(parents=True)
    for path in ROOT.iterdir():
        if path.suffix == ".py" or (path / "__init__.py").exists():
            (package / path.name).symlink_to(path)


def on_files(files: Files, config: Any) -> Files:
    """Make the page of the command reference from the commands."""
    with_package = {**os.environ, "PYTHONPATH": str(PATHS), "TERMINAL_WIDTH": "100"}
    command = [sys.executable, "-m", "typer", "gaitgauge.cli.main", "utils", "docs", "--name", "gaitgauge"]
    text = subprocess.run(command, check=True, capture_output=True, text=True, env=with_package, cwd=ROOT).stdout
    content = with_examples(text.replace("# `gaitgauge`", "# Commands", 1))
    files.append(File.generated(config, "reference/cli.md", content=content))
    return files


def with_examples(text: str) -> str:
    """Turn the indented lines below each ``Examples:`` into a code block; Markdown would join them to one paragraph."""

    def code(found: re.Match[str]) -> str:
        return f"Examples:\n\n```\n{textwrap.dedent(found[1])}```\n"

    return re.sub(r"^Examples:\n((?:  .*\n)+)", code, text, flags=re.MULTILINE)
