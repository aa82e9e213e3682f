"""The product's files and their import statements, parsed once for all tests of this folder."""

import ast
from functools import cache
from pathlib import Path

import gaitgauge

ROOT = Path(gaitgauge.__path__[0])
PACKAGES = ("files", "robots", "terrains", "backends", "policy", "gauge", "studies", "training", "cli")
"""From the lowest to the highest: each imports those before it alone."""


@cache
def import_statements() -> dict[Path, list[ast.Import | ast.ImportFrom]]:
    """Return the import statements of every file, wherever they stand in it."""
    files = [file for package in PACKAGES for file in (ROOT / package).rglob("*.py")]
    return {
        file: [
            node
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
            if isinstance(node, ast.Import | ast.ImportFrom)
        ]
        for file in files
    }
