"""Tests the Python examples of the guides against values worked out by hand."""

from __future__ import annotations

import re
from pathlib import Path

import gaitgauge
import pytest

DOCS = Path(gaitgauge.__path__[0]) / "docs"


def test_a_terrain_of_ones_own():
    code = re.search(r"```python\n(.*?)```", (DOCS / "guides" / "your-terrain.md").read_text(), re.S)
    assert code
    names: dict = {}
    exec(compile(code[1], "your-terrain.md", "exec"), names)
    terrain = names["kerb"](5)
    assert float(terrain.height(2.0, 0.0)) == pytest.approx(0.1)
    assert float(terrain.height(0.0, 0.0)) == 0.0
    assert terrain.target == (4.0, 0.0, 0.0)
