"""Comparisons: what is refused, what is paired, corrections, sentences, and files."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from gaitgauge.gauge.request import Request
from gaitgauge.gauge.result import Coverage, Provenance, Run, SuiteName
from gaitgauge.studies.compare.comparison import ComparisonError, compare, holm, load_result
from gaitgauge.studies.compare.contestants import deciding_request
from gaitgauge.studies.compare.report import as_csv, as_latex, as_page, write_comparison
from gaitgauge.studies.interval_charts import common_scale
from sample_results import sample

SCORE_CARDS = Path(__file__).parents[2] / "docs" / "data" / "scorecards"


def results(*, change=0.0, path="a/first.pt", **choices):
    """Return the result of one policy; ``change`` moves the quality of every run."""
    found = sample(**choices)

    def moved(run):
        return replace(run, columns={**run.columns, "quality": run.columns["quality"] + change})

    rows = tuple(replace(r, runs={s: moved(run) for s, run in r.runs.items()}) for r in found.environments)
    policy = replace(found.policy, path=path)
    return replace(found, policy=policy, environments=rows, score=found.score + change * 0.19)


def with_rows(result, change):
    """Return a result with other environments: those that a function gives for each."""
    return replace(result, environments=tuple(change(row) for row in result.environments))


def both(**choices):
    return [results(**choices), results(path="b/second.pt", **choices)]


# ---- Holm -----------------------------------------------------------------------------------------------------------


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.5, 0.9]) == pytest.approx([1.0, 1.0])
    assert holm([]) == []


# ---- what is found --------------------------------------------------------------------------------------------------


def test_a_policy_does_not_differ_from_itself():
    found = compare(both())
    assert found.paired
    assert not any(d.real for d in found.differences)
    assert {d.difference for d in found.differences} == {0.0}
    assert found.sentences[0].startswith("The scores do not tell 'first' and 'second' apart: they differ by 0.0000")
    assert "None of the" in found.sentences[1]


def test_the_same_results_twice_are_refused():
    """They read as two policies that differ by nothing, with a chance of their own."""
    with pytest.raises(ComparisonError, match=r"'first \(1\)' and 'first \(2\)' are one and the same;"):
        compare([results(), results()])


def test_other_rules_of_chance_are_refused_and_named():
    """They ended in a sentence of NumPy's about shapes."""
    first, second = both()
    second = replace(second, chance=replace(second.chance, resamples=20))
    with pytest.raises(
        ComparisonError, match=r"chance\.resamples is 10 in 'first' and 20 in 'second'; it was changed by hand"
    ):
        compare([first, second])


def test_versions_source_and_solver_that_differ_are_said():
    first, second = both(terrains=("flat",))
    assert not any("played alike" in sentence for sentence in compare([first, second]).sentences)
    made = [
        replace(found, provenance=Provenance(versions={"mujoco": version}), solver={"iterations": iterations})
        for found, version, iterations in ((first, "3.16.0", 100), (second, "3.17.0", 5))
    ]
    assert (
        "They were made with other versions or settings, which may be part of a difference: mujoco 3.16.0 and 3.17.0; "
        "solver.iterations 100 and 5."
    ) in compare(made).sentences


def test_everything_that_the_issue_names_is_compared():
    kinds = {d.kind for d in compare(both()).differences}
    assert kinds == {"score", "level", "group", "terrain", "friction", "metric", "metric as measured", "command"}
    swept = compare(both(suite="gaitgauge-1", terrains=("flat", "wave"))).differences
    assert [d.name for d in swept if d.kind == "payload"] == ["-1", "0", "1", "2", "3"]
    assert [d.name for d in swept if d.kind == "friction"] == [f"0.{n}" for n in range(2, 10)] + ["1"]


def test_scores_are_those_of_the_results():
    first, second = both()
    by_name = {(d.kind, d.name): d for d in compare([first, second]).differences}
    assert by_name["score", "score"].values[0] == pytest.approx(first.score, abs=1e-6)
    assert by_name["terrain", "wave"].values[0] == first.terrains["wave"].score
    assert by_name["group", "safety"].values[0] == first.groups["safety"]
    assert by_name["level", "mean level"].values[0] == pytest.approx(first.level)


def test_a_score_s_interval_is_that_of_its_runs_whatever_the_file_says():
    first, second = both()
    honest = compare([first, second]).policies
    assert [p.score_interval for p in honest] == [first.score_interval, second.score_interval]
    first = replace(first, score_interval=(first.score, first.score))
    assert compare([first, second]).policies == honest
    # a band of the file's own says nothing of the difference either
    assert compare([first, second]).differences[0].interval == compare(both()).differences[0].interval


def test_the_same_seeds_are_compared_seed_by_seed():
    """Runs that are all better by the same differ for certain, however far the seeds are apart."""
    pair = [results(terrains=("flat",), frictions=(0.6,)) for _ in range(2)]
    for at, qualities in enumerate(((0.5, 0.6, 0.7), (0.52, 0.62, 0.72))):
        (row,) = pair[at].environments
        runs = {seed: Run(columns={**row.runs[seed].columns, "quality": q}) for seed, q in enumerate(qualities)}
        runs = {seed: replace(run, commands=row.runs[seed].commands) for seed, run in runs.items()}
        pair[at] = replace(pair[at], environments=(replace(row, runs=runs),), score=np.mean(qualities))
    first, second = pair
    score = compare([first, second], ["a", "b"]).differences[0]
    assert score.interval == pytest.approx((0.02, 0.02))
    assert score.real
    second = with_rows(second, lambda row: replace(row, runs=dict(zip((5, 6, 7), row.runs.values(), strict=True))))
    second = replace(second, chance=replace(second.chance, seeds=(5, 6, 7)))
    found = compare([first, second], ["a", "b"])
    assert not found.paired
    assert not found.differences[0].real


def test_metrics_are_compared_where_both_reached_one_level():
    first, second = both(frictions=(0.6,))
    second = with_rows(second, lambda row: row if row.flat else replace(row, level=(row.level or 1) - 1))
    flat = first.environments[0]
    found = {(d.kind, d.name): d for d in compare([first, second]).differences}
    runs = [run.columns["dof_power"] for run in flat.runs.values()]
    assert found["metric as measured", "dof_power"].values[0] == pytest.approx(np.mean(runs), abs=1e-6)


def test_metrics_are_compared_at_a_whole_level_that_both_were_measured_at():
    """Expected levels are hardly ever equal: 5.5 and 6.25 have level 6 in common, 5.5 and 7.5 have none."""
    choices = {"suite": "gaitgauge-1", "terrains": ("wave",), "frictions": (0.6,)}
    first, second = results(**choices), results(path="b/second.pt", **choices)

    def measured(result, level, power):
        def at_level(run, at):
            return replace(run, columns={**run.columns, "dof_power": power + at})

        def measured_row(row):
            by_level = {at: {s: at_level(run, at) for s, run in row.runs.items()} for at in (level, level + 1)}
            return replace(row, level=level + 0.5, runs_by_level=by_level)

        return with_rows(result, measured_row)

    first, other = measured(first, 5, 0.0), measured(second, 6, 0.1)
    found = {(d.kind, d.name): d for d in compare([first, other]).differences}
    assert found["metric as measured", "dof_power"].values == pytest.approx((6.0, 6.1))
    assert found["level", "mean level"].difference == pytest.approx(1.0)
    other = measured(second, 7, 0.1)
    assert not [d for d in compare([first, other]).differences if d.kind in ("metric as measured", "command")]


@pytest.mark.parametrize("suite", ["robogauge-1.1", "gaitgauge-1"])
def test_one_that_passes_no_level_of_an_environment_compares_with_one_that_does(suite):
    first, second = both(suite=suite, terrains=("flat", "wave"))
    failed = next(r for r in second.environments if r.terrain == "wave")
    trials = {level: dict.fromkeys(outcomes, False) for level, outcomes in failed.trials.items()}
    none = replace(failed, trials=trials, level=0, score=0.0, runs={})
    second = with_rows(second, lambda row: none if row is failed else row)
    found = next(d for d in compare([first, second]).differences if d.kind == "terrain" and d.name == "wave")
    assert found.interval is not None and found.interval[0] < found.difference < found.interval[1]


def test_one_seed_says_so():
    one = [results(suite="demo", path=f"{n}.pt", terrains=("flat", "slope_fd", "stairs_fd")) for n in "ab"]
    found = compare(one)
    assert found.differences[0].interval is None
    assert not any(d.real for d in found.differences)
    assert "no interval: one seed; evaluate with two seeds or more" in found.sentences[0]


def test_scores_of_three_are_corrected_for_three_pairs():
    found = compare([*both(), results(path="c/third.pt", change=0.05)])
    scores = [d for d in found.differences if d.kind == "score"]
    assert len(scores) == 3
    assert all(d.corrected >= d.p_value for d in scores)
    assert "after correction for 3 comparisons" in found.sentences[0]


def test_files_of_one_name_are_told_apart_by_their_folder():
    pair = [results(path=p) for p in ("runs/a/model_10.pt", "runs\\b\\model_10.pt")]
    assert [p.label for p in compare(pair).policies] == ["a model_10", "b model_10"]
    same = [results(path="x/model.pt", change=change) for change in (0.0, 0.1)]
    assert [p.label for p in compare(same).policies] == ["x (1)", "x (2)"]


def test_parts_of_one_shape_compare_and_say_that_they_are_no_benchmark():
    whole = compare(both())
    assert whole.complete
    assert not any("score of robogauge-1.1" in s for s in whole.sentences)
    parts = compare(both(terrains=("flat", "wave"), frictions=(0.6,)))
    assert not parts.complete
    assert parts.sentences[-1] == (
        "None of these is a score of robogauge-1.1 1.1.0; all hold the same, part: 2 of 7 terrains, 1 of 9 frictions."
    )
    assert parts.plain()["policies"][0]["coverage"] == {"kind": "part", "text": "2 of 7 terrains, 1 of 9 frictions"}
    first, second = both()
    second = replace(second, coverage=Coverage(kind="custom", text="seed 9"))
    assert compare([first, second]).sentences[-1] == (
        "Not all of these are scores of robogauge-1.1 1.1.0: 'first' complete; 'second' custom: seed 9."
    )


def test_runs_at_different_given_levels_are_refused():
    pair = [results(terrains=("wave",), frictions=(0.6,), level=level, path=f"{level}.pt") for level in (5, 6)]
    with pytest.raises(ComparisonError, match=r"'5' was given level \[5\] and '6' level \[6\]; .* the same --level"):
        compare(pair)


# ---- what is refused ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"suite": SuiteName(name="mid", version="1.0.0", digest="")},
            "'second' has mid 1.0.0; evaluate both on one suite",
        ),
        (
            {"backend": "newton"},
            "results with different engines do not compare: 'first' has mujoco, 'second' has newton",
        ),
        ({"robot": "a1"}, "different robots"),
        ({"score": None}, "the results of 'second' have levels and no scores"),
    ],
)
def test_other_conditions_are_one_sentence(change, words):
    first, second = both()
    with pytest.raises(ComparisonError, match=words):
        compare([first, replace(second, **change)])


def test_a_suite_whose_rules_were_changed_is_another_one():
    first, second = both()
    second = replace(second, suite=replace(second.suite, digest="00"))
    with pytest.raises(ComparisonError, match=r"name the suite robogauge-1.1 1.1.0, but its rules were changed"):
        compare([first, second])


def test_a_robot_whose_files_were_changed_is_another_one():
    first, second = both()
    first, second = (
        replace(found, provenance=Provenance(digests={"robot": digest}))
        for found, digest in ((first, "ab" * 32), (second, "cd" * 32))
    )
    with pytest.raises(
        ComparisonError, match=r"name the robot go2, but its files differ \(abababababab and cdcdcdcdcdcd\)"
    ):
        compare([first, second])
    assert compare([first, replace(second, provenance=Provenance())])  # results of before do not say


def test_other_environments_are_refused():
    first, second = results(frictions=(0.6,)), results(frictions=(0.6, 0.9), path="second.pt")
    with pytest.raises(ComparisonError, match=r"only 'second' has flat at friction 0.9"):
        compare([first, second])


def test_given_levels_do_not_compare_with_searched_ones():
    first = results(frictions=(0.6,), terrains=("wave",))
    second = results(frictions=(0.6,), terrains=("wave",), path="second.pt")
    second = with_rows(second, lambda row: replace(row, trials={}))
    with pytest.raises(ComparisonError, match="'second' was given its level and that of 'first' was searched for"):
        compare([first, second])


def test_one_result_is_no_comparison():
    with pytest.raises(ComparisonError, match="at least two"):
        compare([results()])


@pytest.mark.parametrize("content", ["{", "[]", '{"schema": 1}'])
def test_damaged_and_old_results_are_one_sentence(tmp_path, content):
    path = tmp_path / "results.json"
    path.write_text(content)
    with pytest.raises(ComparisonError, match=r"not valid JSON|must be a table|has schema|UTF-8|lacks"):
        load_result(path)
    with pytest.raises(ComparisonError, match="there are no results"):
        load_result(tmp_path / "none")


# ---- files ----------------------------------------------------------------------------------------------------------


def test_every_file_holds_every_difference(tmp_path):
    found = compare(both(frictions=(0.6, 0.9)))
    paths = write_comparison(tmp_path / "out", found)
    plain = json.loads(paths["json"].read_text())
    rows = list(csv.DictReader(io.StringIO(paths["csv"].read_text())))
    assert len(rows) == len(plain["differences"]) == len(found.differences)
    assert float(rows[0]["difference"]) == plain["differences"][0]["difference"]
    assert plain["sentences"] == found.sentences
    page = paths["html"].read_text()
    assert page.count("<tr") >= len(found.differences)
    assert "http" not in page.replace("http-equiv", "")


def test_latex_escapes_names_and_has_as_many_cells_as_columns():
    found = compare([results(path="a_b&c.pt"), results(path="50%_{x}.pt")])
    lines = [line for line in as_latex(found).splitlines() if line.endswith(r"\\")]
    assert all(line.replace(r"\&", "").count("&") == 6 for line in lines)
    assert r"a\_b\&c" in lines[0] and r"50\%\_\{x\}" in lines[0]


def test_the_page_is_well_formed_and_names_stay_text():
    found = compare([results(path="<b>bold</b>.pt"), results(path="other.pt")])
    page = as_page(found)
    assert "<b>bold" not in page
    for table in page.split("<table>")[1:]:
        ElementTree.fromstring("<table>" + table.partition("</table>")[0].replace("&nbsp;", " ") + "</table>")


def test_csv_of_one_seed_has_empty_ends():
    one = [results(suite="demo", path=f"{n}.pt", terrains=("flat", "slope_fd", "stairs_fd")) for n in "ab"]
    found = compare(one)
    row = next(csv.DictReader(io.StringIO(as_csv(found))))
    assert (row["low"], row["high"], row["real"]) == ("", "", "False")
    assert replace(found.differences[0], corrected=0.01).real


@pytest.mark.parametrize(
    ("suite", "names"),
    [
        ("robogauge-1.1", ("pretrained", "standing")),
        ("gaitgauge-1", ("shipped-on-2026-11-28", "cts")),
        pytest.param("robogauge-1.1", "*", marks=pytest.mark.slow),
        pytest.param("gaitgauge-1", "*", marks=pytest.mark.slow),
    ],
)
def test_score_cards_that_ship_can_be_compared(suite, names):
    """Two of a suite, and all."""
    paths = [path for name in names for path in sorted(SCORE_CARDS.glob(f"{name}-{suite}.json*"))]
    cards = [load_result(path, intervals=False) for path in paths]
    cards = [replace(card, chance=replace(card.chance, resamples=200)) for card in cards]  # of 2000, which take seconds
    found = compare([card for card in cards if card.robot == "go2"])
    assert len(found.policies) >= 2
    assert next(d for d in found.differences if d.kind == "score").real


def test_a_metric_is_the_figure_that_evaluate_shows():
    """The page had a mean of the same name and another weighting."""
    pair = both(frictions=(0.6, 0.9))
    found = compare(pair)
    weighted = {d.name: d.values for d in found.differences if d.kind == "metric"}
    assert weighted == {name: tuple(round(r.metrics[name].mean50, 6) for r in pair) for name in pair[0].metrics}
    measured = {d.name: d.values for d in found.differences if d.kind == "metric as measured"}
    assert measured.keys() == weighted.keys() and measured != weighted  # without the weight of the level
    assert "<th>metric as measured</th>" in as_page(found)


def test_axes_have_a_size_and_heads_have_room():
    """Axes of equal policies went from -1e-06 to 1e-06, and a head was cut off."""
    page = as_page(compare(both()))
    assert "e−0" not in page and ">−0.001<" in page and ">0.001<" in page
    assert page.count('<th class="odds">corrected p</th>') == page.count("<th>p</th>")
    assert common_scale([{"value": 1e-9, "interval": (0.0, 2e-9)}], signed=False) == (0.0, 1e-3)
    assert common_scale([{"value": 0.03, "interval": (0.0, 0.04)}], signed=True) == (-0.05, 0.05)


@pytest.mark.parametrize(
    ("choices", "outcome"),
    [
        ({"suite": "demo"}, (0, 1, 2)),
        ({"suite": "demo", "seeds": (4, 5)}, (4, 5)),
        ({"suite": "gaitgauge-1"}, ()),  # its own three
        ({"suite": "demo", "seeds": (4,)}, "seed 4 is the only one"),
        ({"suite": "gaitgauge-1", "pipeline": "base"}, "pipeline 'base' plays one seed"),
    ],
)
def test_seeds_that_decide_nothing_are_not_played(choices, outcome):
    said = []
    request = Request(policy="a.pt", **choices)
    if isinstance(outcome, str):
        with pytest.raises(ComparisonError, match=f"{outcome}.*, which tells no difference from chance; "):
            deciding_request(request, said.append)
        return
    assert deciding_request(request, said.append).seeds == outcome
    added = (
        "suite 'demo' has one seed, which tells no difference from chance: every policy is played with seeds 0, 1 and 2"
    )
    assert said == ([added] if outcome == (0, 1, 2) else [])


def test_a_comparison_never_gets_the_folder_of_another_one(tmp_path):
    whole, other = compare(both()), compare(both(frictions=(0.6,)))
    usual = tmp_path / "compare-a-b"
    homes = [write_comparison(usual, found, overwrite=False)["json"].parent for found in (whole, other, whole)]
    assert homes == [usual, tmp_path / "compare-a-b-2", usual]
    assert write_comparison(usual, other)["json"].parent == usual  # asked for


def test_details_are_named_once():
    """They read 'level mean level'."""
    found = compare(both())
    real = [replace(d, corrected=0.01, difference=0.5) for d in found.differences if d.kind in ("level", "group")]
    (sentence,) = [s for s in replace(found, differences=tuple(real)).sentences if "in detail" in s]
    assert "correction: mean level +0.5000, group " in sentence
