"""How much of a score is chance: the figures of repeated evaluations, and that what was played is not played again."""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import repeatability as bench
import score_cards
from gaitgauge.gauge.result import TerrainScore
from gaitgauge.gauge.store import StoreError
from gaitgauge.gauge.suite import load_suite
from gaitgauge.studies.compare.comparison import load_result
from sample_results import PIPELINES, row, sample

SUITE = load_suite("gaitgauge-1")


def evaluation(scores, steps=100):
    """An evaluation of two terrains, the first with two environments."""
    rows = [
        {"terrain": t, "friction": f, "score": s}
        for t, f, s in zip(("wave", "wave", "flat"), (0.2, 0.6, 0.6), scores, strict=True)
    ]
    wave = (scores[0] + scores[1]) / 2
    score = (wave + scores[2]) / 2
    return {
        "score": score,
        "interval": [score - 0.02, score + 0.02],
        "terrains": {"wave": {"score": wave}, "flat": {"score": scores[2]}},
        "environments": rows,
        "control_steps": steps,
    }


def test_figures_of_two_evaluations_by_hand():
    """Weights 1/4, 1/4 and 1/2; variances of the pairs 2e-4, 8e-4 and 0: σ² = (2e-4 + 8e-4) / 16."""
    pair = [evaluation((0.50, 0.40, 0.7)), evaluation((0.52, 0.36, 0.7), 140)]
    found = bench.judge(pair, {"control_steps": 80}, independent=True)
    assert found["by_environments"]["sigma"] == pytest.approx(np.sqrt(1e-3 / 16))
    assert found["by_environments"]["freedom"] == pytest.approx((2 + 8) ** 2 / (4 + 64))
    scores = 0.575, 0.57
    assert found["mean"] == pytest.approx(np.mean(scores))
    assert found["sigma"] == pytest.approx(abs(scores[0] - scores[1]) / np.sqrt(2))
    # two values of variance s²: 95 % of χ² with one degree of freedom lies between 0.000982 and 5.0239
    assert found["interval"] == pytest.approx(
        [found["sigma"] / np.sqrt(5.0239), found["sigma"] / np.sqrt(0.00098207)], rel=1e-4
    )
    assert found["cost"] == pytest.approx(120 / 80)
    assert found["covered"] == 1.0 and found["half_width"] == pytest.approx(0.02)


def test_environments_that_share_noise_are_not_added_up():
    pair = [evaluation((0.50, 0.40, 0.7)), evaluation((0.52, 0.36, 0.7))]
    found = bench.judge(pair, None, independent=False)
    assert found["by_environments"] is None and found["independent"] is None


def test_both_estimates_find_the_scatter_of_independent_environments():
    """Environments of σ 0.01, 0.02 and 0.03: σ of the score is √(1e-4/16 + 4e-4/16 + 9e-4/4)."""
    draws = np.random.default_rng(0).normal(0.5, (0.01, 0.02, 0.03), (400, 3))
    found = bench.judge([evaluation(row) for row in draws.tolist()], None, independent=True)
    true = np.sqrt(1e-4 / 16 + 4e-4 / 16 + 9e-4 / 4)
    for estimate in (found, found["by_environments"]):
        assert estimate["sigma"] == pytest.approx(true, rel=0.1)
        assert estimate["interval"][0] < true < estimate["interval"][1]
    assert found["independent"] > 0.05


def test_scores_that_move_together_are_seen():
    together = np.random.default_rng(0).normal(0.5, 0.01, (20, 1)) * np.ones(3)
    found = bench.judge([evaluation(row) for row in together.tolist()], None, independent=True)
    assert found["independent"] < 0.01


@pytest.fixture
def played(monkeypatch):
    """Suites that were evaluated."""
    names = []

    def evaluate(request, folder, *, resume):
        assert resume
        names.append(folder.name)
        folder.mkdir()
        (folder / "episodes.csv").write_text("command,control_steps\nall,30\nmax_velocity +x,30\nall,12\n")
        return replace(
            sample("base", **PIPELINES["base"]),
            score=0.5,
            score_interval=(0.4, 0.6),
            level=None,
            terrains={"flat": TerrainScore(score=0.5)},
            environments=(row("flat", level=None, score=0.5),),
        )

    monkeypatch.setattr(bench, "evaluate", evaluate)
    return names


def arguments(folder, **changed):
    given = {"terrain": [], "friction": [], "payload": [], "threads": 1, "policy": "pretrained", "folder": folder}
    return argparse.Namespace(**given | changed)


def test_what_was_played_is_not_played_again(tmp_path, played):
    first = bench.play(SUITE, 3, arguments(tmp_path))
    assert first["control_steps"] == 42
    assert bench.play(SUITE, 3, arguments(tmp_path)) == json.loads(json.dumps(first))
    bench.play(SUITE, 0, arguments(tmp_path))
    assert played == ["repeated-3", "before"]


def test_figures_of_another_part_are_refused(tmp_path, played):
    bench.play(SUITE, 1, arguments(tmp_path))
    with pytest.raises(StoreError, match=r"repeated-1\.json is of another run \(part differ\); give another --folder"):
        bench.play(SUITE, 1, arguments(tmp_path, terrain=["flat"]))


def test_each_evaluation_has_seeds_of_its_own(tmp_path):
    seen = []
    for index in range(4):
        path = tmp_path / f"{index}.toml"
        path.write_text(bench.suite_text(SUITE, index))
        matrix = load_suite(str(path)).matrix
        assert len(matrix.seeds) == len(SUITE.matrix.seeds) and len(matrix.search_seeds) == len(
            SUITE.matrix.search_seeds
        )
        seen += [*matrix.seeds, *matrix.search_seeds]
    assert len(seen) == len(set(seen))


def test_rules_before_are_a_bisection_with_five_seeds_and_no_pushes(tmp_path):
    path = tmp_path / "before.toml"
    path.write_text(bench.suite_text(SUITE, 0, before=True))
    suite = load_suite(str(path))
    assert suite.scoring.level == "bisection" and suite.push is None and len(suite.matrix.search_seeds) == 5


def test_cards_name_the_commit_that_played_where_the_results_do_not_know_it():
    card = sorted(Path(score_cards.__file__).parents[1].glob("docs/data/scorecards/*.json*"))[0]
    result = load_result(card, intervals=False)

    def played(commit):
        return replace(result, provenance=replace(result.provenance, commit=commit))

    made = score_cards.card_of(played(None), "cts", None, "abc")
    assert made["provenance"]["commit"] == "abc" and made["policy"]["path"] == "cts.gauge.pt"
    assert score_cards.card_of(played("def"), "cts", None, "abc")["provenance"]["commit"] == "def"
