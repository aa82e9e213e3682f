"""The table in the documentation is what the engines declare."""

import pytest
from capability_table import BEGIN, DOCUMENT, END, ENGINES, capability_table, update_document
from gaitgauge.backends.base import CAPABILITY_NAMES
from gaitgauge.backends.registry import backend_names


def test_every_engine_and_capability_is_there():
    from gaitgauge.backends.newton.solvers import SOLVERS  # takes seconds

    lines = capability_table().splitlines()
    assert [c.strip().strip("`") for c in lines[0].split("|")[2:-1]] == list(ENGINES)
    rows = [line.split("|")[1].strip().strip("`") for line in lines[2:] if line.startswith("|")]
    assert rows == list(CAPABILITY_NAMES)
    own = {n for n in backend_names() if n in ("mujoco", "mujoco-warp", "newton", "drake", "physx")}
    assert own <= set(ENGINES)
    assert {f"newton:{s}" for s in SOLVERS if s != "mujoco"} <= set(ENGINES)


def test_cells_say_what_is_declared():
    rows = {
        line.split("|")[1].strip(): line.split("|")[2:-1] for line in capability_table().splitlines() if "|" in line
    }
    gpu = [c.split()[0] for c in rows["`gpu`"]]
    assert gpu == ["no", "yes", "yes", "yes", "no", "no"]
    assert rows["`foot_condim_6`"][ENGINES.index("newton:steel")].split()[0] == "no"
    assert rows["`latency`"][0].strip() == "yes"


def test_the_document_is_up_to_date(tmp_path):
    copy = tmp_path / "backends.md"
    copy.write_text(DOCUMENT.read_text(encoding="utf-8"), encoding="utf-8")
    assert not update_document(copy), (
        "docs/reference/backends.md is out of date; it says itself how to write its table anew"
    )


def test_an_outdated_table_is_replaced_and_the_rest_stays(tmp_path):
    path = tmp_path / "page.md"
    path.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    assert update_document(path)
    text = path.read_text()
    assert "old" not in text and capability_table() in text
    assert text.startswith("before\n") and text.endswith("\nafter\n")
    assert not update_document(path)
    path.write_text("no place")
    with pytest.raises(ValueError, match="no place for the table"):
        update_document(path)
