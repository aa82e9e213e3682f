"""``docs/reference/security.md`` names a test for each hole that was found; each of them is there."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_every_test_that_the_page_names_exists():
    named = re.findall(r"`([\w/]+\.py)` `(test_\w+)`", (ROOT / "docs" / "reference" / "security.md").read_text())
    assert len(named) > 40
    for file, name in named:
        assert f"def {name}(" in (ROOT / "tests" / file).read_text(), f"{file} has no {name}"
