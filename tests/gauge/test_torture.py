"""The kill test, with few kills; ``make torture`` has many. And that it notices what it is for."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

spec = importlib.util.spec_from_file_location("torture", Path(__file__).parents[2] / "benchmarks" / "torture.py")
torture = importlib.util.module_from_spec(spec)
spec.loader.exec_module(torture)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
def test_kills_lose_nothing(tmp_path, capsys):
    torture.torture("pretrained", 3, 2, 0, tmp_path)
    assert "lost 0, played twice 0" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ({"a": (1, 1, b"x")}, {}, "is lost"),
        ({"a": (1, 1, b"x")}, {"a": (1, 1, b"y")}, "has changed"),
        ({"a": (1, 1, b"x")}, {"a": (2, 2, b"x")}, "played twice"),
    ],
)
def test_what_is_lost_or_played_twice_is_noticed(before, after, words):
    torture.compare_records(before, before, {"a"})
    torture.compare_records({"speculative": (1, 1, b"x")}, {}, {"a"})
    with pytest.raises(torture.DamageError, match=words):
        torture.compare_records(before, after, {"a"})


def test_other_results_and_partial_files_are_noticed(tmp_path):
    (tmp_path / "episodes").mkdir()
    (tmp_path / "results.json").write_text(json.dumps({"score": 0.5, "provenance": {"date": "today"}}))
    for name in ("episodes.csv", "report.html"):
        (tmp_path / name).write_text("")
    expected = torture.outcome(tmp_path)
    (tmp_path / "results.json").write_text(json.dumps({"score": 0.5, "provenance": {"date": "tomorrow"}}))
    torture.check_end(tmp_path, expected)
    (tmp_path / ".12ab.partial").write_text("")
    with pytest.raises(torture.DamageError, match="partial"):
        torture.check_end(tmp_path, expected)
    with pytest.raises(torture.DamageError, match=r"results\.json"):
        torture.check_end(tmp_path, {"results.json": {"score": 0.6}})
