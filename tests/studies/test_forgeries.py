"""Forged score cards are refused: the worst ones at once, all kinds in the slow suite."""

import copy
import gzip
import json
import sys
from pathlib import Path

import pytest
from gaitgauge.gauge.result import Result
from gaitgauge.policy.finding import find_policy
from sample_results import sample

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import forgeries

WORST = (
    "all levels 10, trials unchanged",
    "all metrics 1, in rows too",
    "falls changed in rows and totals",
    "quality of 3",
    "motors removed",
    "provenance removed",
    "best environment twice",
    "score is NaN",
    "version of the suite renamed",
    "failed trials turned, level unchanged",
    "quality of runs raised, all but intervals made anew",
)


@pytest.fixture(scope="module", params=["gaitgauge-1", pytest.param("robogauge-1.1", marks=pytest.mark.slow)])
def card(request):
    return sample(suite=request.param, resamples=2000, terrains=("flat", "slope_fd"), frictions=(0.4, 0.6)).to_data()


def test_the_honest_card_is_accepted(card, tmp_path):
    assert forgeries.try_board(card, tmp_path) == forgeries.UNSEEN  # its policy does not ship
    honest = Result.from_data(card, "it", ValueError)
    assert forgeries.try_judge(card, honest, tmp_path) is None


@pytest.mark.parametrize("kind", WORST)
def test_the_worst_forgeries_are_refused_in_one_sentence(card, tmp_path, kind):
    forger = forgeries.forge(card)[kind]
    forged = copy.deepcopy(card)
    forged = forger(forged) or forged
    honest = Result.from_data(card, "it", ValueError)
    for said in (forgeries.try_board(forged, tmp_path), forgeries.try_judge(forged, honest, tmp_path)):
        assert said and said != forgeries.UNSEEN and said.isprintable() and "\n" not in said


def test_kinds_that_change_nothing_are_left_out(card, tmp_path):
    """With one seed and one environment a terrain there is nothing to swap or to copy."""
    few = sample(suite="demo", resamples=2000, terrains=("flat", "slope_fd"), frictions=(0.6,)).to_data()
    few["tolerance"] = [0.1, 0.2]
    kinds = [name for name in forgeries.forge(few) if name.endswith(("swapped", "copy of the best"))]
    assert len(kinds) == 2
    assert [name for kind in kinds for name, *_ in forgeries.tried(few, tmp_path, only=kind)] == []
    assert [name for name, *_ in forgeries.tried(card, tmp_path, only=kinds[0])] == kinds[:1]


@pytest.mark.slow
def test_all_kinds_of_forgeries_are_refused(card, tmp_path):
    found = list(forgeries.tried(card, tmp_path))
    assert len(found) > 120
    assert [name for name, _, judged in found if judged is None] == []
    # the card is of a policy that does not ship, so that the board cannot know its file, motors or training, and says so
    assert [name for name, board, _ in found if board is None] == []
    told = {name for name, board, _ in found if board == forgeries.UNSEEN and not name.startswith(forgeries.REPLAY)}
    of_the_policy = (
        "motors",
        "polic",
        "observations",
        "training",
        "limits",
        "feet",
        "assumptions",
        "provenance",
        "robot",
    )
    assert [name for name in told if not any(word in name for word in of_the_policy)] == []


@pytest.mark.slow
def test_all_kinds_are_refused_by_the_board_where_the_policy_is_here(tmp_path):
    shipped = Path(__file__).parents[2] / "docs/data/scorecards/pretrained-robogauge-1.1.json.gz"
    content = json.loads(gzip.decompress(shipped.read_bytes()))
    content["policy"]["path"] = "mine.gauge.pt"
    (tmp_path / "mine.gauge.pt").write_bytes(find_policy("pretrained").read_bytes())
    assert forgeries.try_board(content, tmp_path) is None
    found = list(forgeries.tried(content, tmp_path))
    assert [name for name, board, _ in found if not board and not name.startswith(forgeries.REPLAY)] == []
    assert [name for name, _, judged in found if judged is None] == []
