"""``gaitgauge worst`` with robots that fall by a rule."""

import itertools
import json

import pytest
from gaitgauge.studies.worst import study
from gaitgauge.studies.worst.search import Outcome

WORDS = ("--threads", 1, "--minutes", 0.5, "--no-films", "--others", "mujoco@foot_condim=3", "--out", "out")


@pytest.fixture
def late_ones_fall(monkeypatch):
    def play(players, plays, variant):
        falls = [scenario.latency is not None and scenario.latency > 0.02 for scenario, _ in plays]
        return [Outcome(fell=fell, diverged=False, seconds=2.0, lean=0.5) for fell in falls]

    monkeypatch.setattr(study.Players, "play", play)
    monkeypatch.setattr("time.perf_counter", itertools.count(0.0, 0.25).__next__)


def test_table_sentences_and_files(run, refused, policy, late_ones_fall, tmp_path):
    result = run("worst", policy, *WORDS)
    assert result.exit_code == 0, result.output
    text = " ".join(result.output.split())
    assert "latency 2" in text and "6/6" in text and "the probability of a fall is at most" in text
    results = json.loads((tmp_path / "out" / "worst.json").read_text())
    assert [failure["factors"] for failure in results["failures"]] == [["latency"]]
    assert (tmp_path / "out" / "worst.html").is_file()
    assert (tmp_path / "out" / "scenarios" / "worst-01.toml").is_file()
    assert "already holds this search; go on with --resume" in refused("worst", policy, *WORDS)
    again = run("worst", policy, *WORDS, "--resume", "--json")
    assert json.loads(again.stdout)["failures"] == results["failures"]


def test_what_cannot_be_searched_is_refused(refused, policy):
    assert "nobody.pt" in refused("worst", "nobody.pt", *WORDS)
    assert "unknown backend 'bullet'" in refused("worst", policy, "--others", "bullet")
