"""When a score card holds: pure judgements on hand-made replays."""

from copy import deepcopy
from pathlib import Path

import pytest
from gaitgauge.gauge.comparison import ComparisonError, load_result
from gaitgauge.gauge.evaluate import Request, identity, prepare
from gaitgauge.gauge.policies import file_digest
from gaitgauge.gauge.suite import load_suite
from gaitgauge.gauge.verify import CardError, check_coverage, judge, prepare_replay, with_fresh_seeds
from sample_results import sample


@pytest.fixture
def card():
    return sample(terrains=("flat", "wave"), frictions=(0.4, 0.6))


def test_the_same_outcomes_hold_and_are_equal(card):
    found = judge(card, deepcopy(card))
    assert (found["holds"], found["equal"], found["quick"], found["levels"]) == (True, True, False, [])
    assert found["interval"] == card["score_interval"]


def test_a_score_within_the_band_holds_and_one_outside_does_not(card):
    """Two draws differ by √2 times what one is off: within the interval alone one replay in six of a true card failed."""
    score = card["score"]
    low, high = (score + 2**0.5 * (end - score) for end in card["score_interval"])
    for value, holds in ((low + 1e-4, True), (high + 1e-4, False), (low - 1e-4, False)):
        replay = deepcopy(card) | {"score": value}
        replay["environments"][0]["score"] += 0.001
        found = judge(card, replay)
        assert (found["holds"], found["equal"], found["replayed"]) == (holds, False, value)
        # a policy that other seeds judge better was not fitted to those of the card
        assert judge(card, replay, fresh=True)["holds"] == (value > low)


def test_levels_that_differ_are_listed(card):
    replay = deepcopy(card)
    row = replay["environments"][3]
    row["level"] -= 1
    (found,) = judge(card, replay)["levels"]
    place = {"terrain": "wave", "friction": 0.6, "payload": 0.0}
    assert found == place | {"card": row["level"] + 1, "here": row["level"]}


def test_a_sample_is_held_against_the_same_environments(card):
    """Scores of the two sampled rows by hand; the card's own score, over four rows, does not matter."""
    replay = deepcopy(card)
    replay["environments"] = [replay["environments"][1], replay["environments"][3]]
    expected = sum(row["score"] for row in replay["environments"]) / 2
    replay["score"] = expected
    found = judge(card, replay)
    assert (found["quick"], found["environments"], found["equal"]) == (True, [2, 4], True)
    assert found["score"] == pytest.approx(expected, abs=1e-6)
    low, high = found["band"]
    assert low < found["interval"][0] < expected < found["interval"][1] < high
    replay["environments"][0]["score"] += 0.2
    assert not judge(card, replay | {"score": high + 0.01})["holds"]


def test_without_an_interval_only_the_same_outcome_holds(card):
    card["score_interval"] = None
    replay = deepcopy(card)
    assert judge(card, replay)["holds"]
    replay["environments"][0]["score"] += 1e-6
    assert not judge(card, replay)["holds"]


def test_the_hash_of_a_policys_file_is_what_other_programs_print(tmp_path):
    path = tmp_path / "policy.pt"
    path.write_bytes(b"abc")  # FIPS 180-2, appendix B.1
    assert file_digest(str(path)) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_results_of_something_else_are_no_card(tmp_path):
    path = tmp_path / "half.json"
    path.write_text('{"schema": 2, "environments": [], "suite": {}}')
    with pytest.raises(ComparisonError, match=r"half\.json': it lacks score, backend, robot, pipeline"):
        load_result(path)


@pytest.mark.parametrize("suite", ["gaitgauge-1", "robogauge-1.1"])
def test_fresh_seeds_are_all_others_and_share_what_the_suites_share(suite):
    """Whoever trained on the seeds that everybody knows, or found out which episode a seed's noise belongs to, has no use of it."""
    known = prepare(Request(policy="pretrained", suite=suite))
    fresh = with_fresh_seeds(known, 7)
    seeds, search = known.suite.matrix.seeds, known.suite.matrix.search_seeds
    assert fresh.rules.seeds == fresh.suite.matrix.seeds == tuple(7_000_000 + s for s in seeds)
    assert not {*fresh.seeds, *fresh.suite.matrix.search_seeds} & {*seeds, *search}
    shared = len({*seeds} & {*search})
    assert len({*fresh.seeds} & {*fresh.suite.matrix.search_seeds}) == shared
    assert fresh.environments == known.environments
    assert identity(fresh) != identity(known)
    other = with_fresh_seeds(known, 8)
    assert not {*fresh.seeds, *fresh.suite.matrix.search_seeds} & {*other.seeds, *other.suite.matrix.search_seeds}
    with pytest.raises(CardError, match="fresh seeds are made from a number of 1 to 1000000, not 0"):
        with_fresh_seeds(known, 0)


def test_a_card_without_an_interval_says_nothing_about_other_seeds(card):
    card["score_interval"] = None
    with pytest.raises(
        CardError, match="the card has no interval, so that nothing can be said of other seeds; leave out --fresh"
    ):
        prepare_replay(card, fresh=1)


def test_a_card_of_a_policy_that_ships_names_it():
    """Its path is a name, as the user gave it, and no file's."""
    shipped = load_result(Path(__file__).parents[2] / "docs/data/scorecards/pretrained-gaitgauge-1.json")
    shipped["policy"]["file_sha256"] = file_digest("pretrained")  # the card may be that of one that shipped before
    assert len(prepare_replay(shipped, quick=True).environments) == 7
    shipped["policy"]["file_sha256"] = "ab" * 32
    with pytest.raises(CardError, match="'pretrained' is another policy than the card's"):
        prepare_replay(shipped, quick=True)
    shipped["policy"]["path"] = "latest"  # whatever was trained last is nobody's card
    with pytest.raises(CardError, match="the card's policy is not at 'latest' on this machine"):
        prepare_replay(shipped, quick=True)


def test_a_card_that_holds_less_than_it_says_is_refused():
    """Bad environments left out, and the score worked out anew: a replay of what is left would hold."""
    whole = sample()
    check_coverage(whole, load_suite("robogauge-1.1"), "it")
    part = whole | {"environments": [row for row in whole["environments"] if row["terrain"] != "obstacle"]}
    with pytest.raises(
        CardError,
        match=r"it calls itself complete, but holds 6 of 7 terrains of robogauge-1\.1; it was changed by hand",
    ):
        check_coverage(part, load_suite("robogauge-1.1"), "it")
    check_coverage(part | {"coverage": None}, load_suite("robogauge-1.1"), "it")  # results from before say nothing
