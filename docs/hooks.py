"""Hooks of the documentation build: the package under its own name, and the command reference."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent


def on_config(config: Any) -> Any:
    """Let mkdocstrings find the package: the repository's root is the package ``gaitgauge``."""
    links = ROOT / "build" / "docs"
    links.mkdir(parents=True, exist_ok=True)
    link = links / "gaitgauge"
    if not link.exists():
        link.symlink_to(ROOT, target_is_directory=True)
    return config


def on_files(files: Files, config: Any) -> Files:
    """Write the command reference out of the commands themselves."""
    with_package = {**os.environ, "PYTHONPATH": str(ROOT / "build" / "docs"), "TERMINAL_WIDTH": "100"}
    command = [sys.executable, "-m", "typer", "gaitgauge.cli.main", "utils", "docs", "--name", "gaitgauge"]
    text = subprocess.run(command, check=True, capture_output=True, text=True, env=with_package, cwd=ROOT).stdout
    files.append(File.generated(config, "cli.md", content=text.replace("# `gaitgauge`", "# Commands", 1)))
    return files
