"""Tests that every test named by ``docs/reference/security.md`` exists."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_every_test_that_the_page_names_exists():
    page = (ROOT / "docs" / "reference" / "security.md").read_text(encoding="utf-8")
    named = re.findall(r"`([\w/]+\.py)`[ |,]+`(test_\w+)`", page)
    assert len(named) > 40
    for file, name in named:
        assert f"def {name}(" in (ROOT / "tests" / file).read_text(), f"{file} has no {name}"
