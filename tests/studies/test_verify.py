"""When a score card holds: pure judgements on hand-made replays."""

from dataclasses import is_dataclass, replace
from pathlib import Path

import pytest
from gaitgauge.gauge.evaluate import Request, identity, prepare
from gaitgauge.gauge.result import Motors
from gaitgauge.gauge.result_figures import check_figures
from gaitgauge.gauge.suite import load_suite
from gaitgauge.studies.cards.agreement import figures_that_are_off
from gaitgauge.studies.cards.verify import CardError, check_card, judge, prepare_replay, with_fresh_seeds
from gaitgauge.studies.compare.comparison import ComparisonError, load_result
from gaitgauge.studies.policies import file_digest
from sample_results import made_of, sample


@pytest.fixture
def card():
    return sample(terrains=("flat", "wave"), frictions=(0.4, 0.6))


def with_row(result, at, **changes):
    """Return a result with other entries in one of its environments."""
    rows = list(result.environments)
    rows[at] = replace(rows[at], **changes)
    return replace(result, environments=tuple(rows))


def test_the_same_outcomes_hold_and_are_equal(card):
    found = judge(card, card)
    assert (found["holds"], found["equal"], found["quick"], found["levels"]) == (True, True, False, [])
    assert found["interval"] == list(card.score_interval)


def shifted(result, by, rows=None):
    """Return a result as another kind of processor would find it: every run differs, its quality by so much more or less."""

    def moved(run, at):
        noise = 2e-4 * (-1) ** at
        tables = (run.columns, run.mean, run.mean25, run.commands)
        columns, mean, mean25, commands = ({k: min(v + noise, 1.0) for k, v in table.items()} for table in tables)
        for table in (columns, mean, mean25):
            table["quality"] += by
        return replace(run, columns=columns, mean=mean, mean25=mean25, commands=commands)

    chosen = range(len(result.environments)) if rows is None else rows
    return made_of(
        result,
        [
            replace(row, runs={seed: moved(run, at) for seed, run in row.runs.items()}) if at in chosen else row
            for at, row in enumerate(result.environments)
        ],
    )


def test_a_score_within_the_band_holds_and_one_outside_does_not(card):
    """Two draws differ by √2 times what one is off: within the interval alone one replay in six of a true card failed."""
    reach = 2**0.5 * (card.score_interval[1] - card.score)
    step = shifted(card, 0.01).score - card.score
    for part, holds in ((0.9, True), (1.1, False), (-1.1, False)):
        replay = shifted(card, 0.01 * part * reach / step)
        assert replay.score == pytest.approx(card.score + part * reach, abs=1e-4)
        found = judge(card, replay)
        assert (found["holds"], found["equal"], found["figures"], found["edited"]) == (holds, False, [], [])
        # a policy that other seeds judge better was not fitted to those of the card
        assert judge(card, replay, fresh=True)["holds"] == (part > -1)


def test_few_runs_that_differ_among_many_that_do_not_were_edited(card):
    """A processor of another kind changes all of them: within its band, a run of one's own making held."""
    found = judge(shifted(card, 0.001, rows=[2]), card)
    assert not found["holds"] and found["edited"] == ["wave, friction 0.4, payload 0 kg"]
    assert found["runs"] == [9, 12]
    assert judge(shifted(card, 0.001), card)["holds"]


@pytest.mark.parametrize("column", ["lin_vel_err", "dof_power"])
def test_a_metric_that_was_raised_in_all_runs_does_not_hold(card, column):
    """All figures follow from the runs, and quality and score stay as they were."""

    def raised(run):
        tables = ({**table, column: min(table[column] + 0.1, 1.0)} for table in (run.columns, run.mean, run.mean25))
        columns, mean, mean25 = tables
        return replace(run, columns=columns, mean=mean, mean25=mean25)

    rows = [replace(row, runs={s: raised(run) for s, run in row.runs.items()}) for row in card.environments]
    found = judge(made_of(card, rows), card)
    assert not found["holds"] and f"{column}.mean50" in found["figures"]


def test_levels_that_differ_are_listed(card):
    level = card.environments[3].level
    (found,) = judge(card, with_row(card, 3, level=level - 1))["levels"]
    place = {"terrain": "wave", "friction": 0.6, "payload": 0.0}
    assert found == place | {"card": level, "here": level - 1}


def test_a_search_that_ends_at_the_last_level_is_no_more_exact_than_its_levels(card):
    """All seeds pass level 10 here, and two of four did on the card: chance (Fisher's p is 0.43), and the card was refused."""
    passed = dict.fromkeys(range(4), True)

    def off(level, last):
        old, new = (
            replace(card.environments[3], level=at, trials={5: passed, 8: passed, at: passed} | end, search={at: True})
            for at, end in ((level, last), (10, {}))
        )
        return [name for name in figures_that_are_off([(old, new)], card.chance) if name.startswith("level")]

    assert off(9, {10: {0: False, 1: True, 2: True, 3: False}}) == []
    assert off(6, {7: dict.fromkeys(range(4), False)}) == ["level"]


def test_a_sample_is_held_against_the_same_environments(card):
    """Scores of the two sampled rows by hand; the card's own score, over four rows, does not matter."""
    rows = (card.environments[1], card.environments[3])
    expected = sum(row.score for row in rows) / 2
    replay = replace(card, environments=rows, score=expected)
    found = judge(card, replay)
    assert (found["quick"], found["environments"], found["equal"]) == (True, [2, 4], True)
    assert found["score"] == pytest.approx(expected, abs=1e-6)
    low, high = found["band"]
    assert low < found["interval"][0] < expected < found["interval"][1] < high
    replay = with_row(replay, 0, score=rows[0].score + 0.2)
    assert not judge(card, replace(replay, score=high + 0.01))["holds"]


def test_without_an_interval_only_the_same_outcome_holds(card):
    rules = replace(card.chance, seeds=(0,))  # one seed shows no spread
    card = replace(card, score_interval=None, chance=rules)
    assert judge(card, card)["holds"]
    assert not judge(card, with_row(card, 0, score=card.environments[0].score + 1e-6))["holds"]


def test_the_hash_of_a_policys_file_is_what_other_programs_print(tmp_path):
    path = tmp_path / "policy.pt"
    path.write_bytes(b"abc")  # FIPS 180-2, appendix B.1
    assert file_digest(str(path)) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_results_of_something_else_are_no_card(tmp_path):
    path = tmp_path / "half.json"
    path.write_text('{"schema": 2, "environments": [], "suite": {}}')
    with pytest.raises(ComparisonError, match=r"half\.json': it lacks score, pipeline, backend, robot"):
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
    with pytest.raises(
        CardError, match="the card has no interval, so that nothing can be said of other seeds; leave out --fresh"
    ):
        prepare_replay(replace(card, score_interval=None), fresh=1)


def test_a_card_of_a_policy_that_ships_names_it():
    """Its path is a name, as the user gave it, and no file's."""
    shipped = load_result(
        Path(__file__).parents[2] / "docs/data/scorecards/pretrained-robogauge-1.1.json.gz", intervals=False
    )

    def named(**changes):
        return replace(shipped, policy=replace(shipped.policy, **changes))

    mine = named(file_sha256=file_digest("pretrained"))  # the card may be that of one that shipped before
    assert len(prepare_replay(mine, quick=True).environments) == 7
    with pytest.raises(CardError, match="'pretrained' is another policy than the card's"):
        prepare_replay(named(file_sha256="ab" * 32), quick=True)
    with pytest.raises(CardError, match="the card's policy is not at 'latest' on this machine"):
        prepare_replay(named(path="latest"), quick=True)  # whatever was trained last is nobody's card


def test_a_card_that_holds_less_than_it_says_is_refused():
    """Bad environments left out, and the score worked out anew: a replay of what is left would hold."""
    suite, whole = load_suite("robogauge-1.1"), sample(resamples=2000)
    check_card(whole, suite, "it")
    part = replace(whole, environments=tuple(row for row in whole.environments if row.terrain != "obstacle"))
    with pytest.raises(
        CardError,
        match=r"it calls itself complete, but holds 6 of 7 terrains of robogauge-1\.1; it was changed by hand",
    ):
        check_card(part, suite, "it")


def test_a_card_of_a_suite_that_names_another_or_has_other_rules_is_refused():
    suite, card = load_suite("robogauge-1.1"), sample(resamples=2000)
    for key, value in (("version", "9.9.9"), ("name", "zz")):
        with pytest.raises(
            CardError, match=r"it names its suite .*, but its digest a43a.* is that of robogauge-1\.1 1\.1\.0"
        ):
            check_card(replace(card, suite=replace(card.suite, **{key: value})), suite, "it")
    with pytest.raises(CardError, match=r"it: chance.resamples is 1000, but that of robogauge-1.1 is 2000"):
        check_card(replace(card, chance=replace(card.chance, resamples=1000)), suite, "it")


@pytest.mark.parametrize("interval", [(0.0, 1.0), (0.9, 0.95), None])
def test_an_interval_that_the_runs_do_not_give_is_refused(card, interval):
    """It was taken as it is printed, and a card with a wide one held whatever its score."""
    check_figures(card, "it", CardError)
    with pytest.raises(CardError, match=r"it: score_interval is .*, but what it is made of gives \["):
        check_figures(replace(card, score_interval=interval), "it", CardError)


def test_the_band_is_as_wide_as_the_replay_s_interval(card):
    """Runs that were spread by hand widen the card's interval, and no band."""
    true = judge(card, card)["band"]
    forged = replace(card, score_interval=(0.0, 1.0))
    for place, row in enumerate(card.environments):
        spread = {
            seed: replace(run, columns={**run.columns, "quality": run.columns["quality"] + 0.3 * (at - 1)})
            for at, (seed, run) in enumerate(row.runs.items())
        }
        forged = with_row(forged, place, runs=spread)
    found = judge(forged, card)
    assert found["band"] == true and not found["equal"]


def off(value, steps, by):
    """Return a result, or a part of it, in which the figure at a path is off."""
    if not steps:
        return value + by
    step, *rest = steps
    if is_dataclass(value):
        return replace(value, **{step: off(getattr(value, step), rest, by)})
    changed = dict(value) if isinstance(value, dict) else list(value)
    changed[step] = off(value[step], rest, by)
    return changed if isinstance(value, dict) else tuple(changed)


@pytest.mark.parametrize(
    ("key", "inside"),
    [
        ("level", ()),
        ("level_interval", (0,)),
        ("terrains", ("wave", "interval", 1)),
        ("metrics", ("lin_vel_err", "mean25")),
        ("groups", ("safety",)),
        ("groups_interval", ("safety", 0)),
        ("health", ("episodes",)),
    ],
)
def test_a_figure_that_is_off_where_no_outcome_is_is_named(card, key, inside):
    """The last digits of an interval may be another machine's, and an older card may say less."""
    for by, figures in ((1e-6, []), (0.1, [key])):
        found = judge(off(card, (key, *inside), by), card)
        assert (found["holds"], found["equal"], found["figures"]) == (not figures, False, figures)
    older = replace(card, lacking=frozenset({"health", "groups_interval"}))
    assert judge(older, card)["equal"]


def test_another_solver_or_motors_than_the_replay_s_do_not_hold_and_other_versions_are_said(card):
    card = replace(card, solver={"iterations": 100}, motors=Motors(stiffness=(20.0,), damping=(0.5,)))
    assert judge(card, card)["holds"]
    for key, value in (("solver", {"iterations": 5}), ("motors", Motors(stiffness=(40.0,), damping=(0.5,)))):
        found = judge(replace(card, **{key: value}), card)
        assert not found["holds"] and [item["name"].partition(".")[0] for item in found["settings"]] == [key]
    versions = {"mujoco": "3.16.0", "numpy": "1.0"}
    older = replace(card, provenance=replace(card.provenance, versions=versions, digests={"source": "ab" * 32}))
    found = judge(older, replace(card, provenance=replace(card.provenance, digests={"source": "cd" * 32})))
    assert found["holds"] and found["unlike"] == [
        "mujoco 3.16.0 and 3.17.0",
        "source of gaitgauge abababababab and cdcdcdcdcdcd",
    ]
