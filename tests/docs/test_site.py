"""Tests what the build of the site reads."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def hooks() -> ModuleType:
    pytest.importorskip("mkdocs")
    spec = importlib.util.spec_from_file_location("hooks", ROOT / "docs" / "hooks.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_examples_of_commands_are_code(hooks):
    """They were one paragraph, commands behind each other."""
    text = "text\n\nExamples:\n  gaitgauge a\n  gaitgauge b --c\n\n## `gaitgauge d`\n"
    shown = "text\n\nExamples:\n\n```\ngaitgauge a\ngaitgauge b --c\n```\n\n## `gaitgauge d`\n"
    assert hooks.with_examples(text) == shown


def test_the_reference_reads_the_package_and_nothing_else(hooks, tmp_path, monkeypatch):
    """A link to the repository's root held itself and ``.venv``: the build read it 40 times over and did not end."""
    monkeypatch.setattr(hooks, "PATHS", tmp_path)
    hooks.link_package()
    walk = os.walk(tmp_path / "gaitgauge", followlinks=True)
    found = {Path(folder, name).resolve() for folder, _, names in walk for name in names if name.endswith(".py")}
    packages = {path.parent for path in ROOT.glob("*/__init__.py")}
    assert found == {*ROOT.glob("*.py"), *(file for folder in packages for file in folder.rglob("*.py"))}
    assert ROOT / "tests" not in packages
