"""``results.json`` and score cards that somebody edited: each is one sentence for every reader."""

import copy
import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gaitgauge.api import ArgumentError, ResultsError, evaluate, load_policy, load_results, train
from gaitgauge.api import compare as compare_results
from gaitgauge.backends.base import BackendError
from gaitgauge.gauge.result import MOST_ROWS, read_result
from gaitgauge.gauge.store import StoreError
from gaitgauge.gauge.suite import SuiteError
from gaitgauge.policy.base import PolicyError
from gaitgauge.studies.cards.board import write_board
from gaitgauge.studies.compare.comparison import ComparisonError, compare, load_result
from gaitgauge.studies.compare.report import write_comparison
from gaitgauge.studies.validate.validation import Measurements, ValidationError, validate
from gaitgauge.training.configuration import ConfigurationError

SEED = Path(__file__).parents[1] / "fuzz" / "seeds" / "results" / "results.json"
TRUE = json.loads(SEED.read_text())


@pytest.fixture
def edited(tmp_path):
    """Writes results with one value replaced."""

    def write(*path: str | int, value: object) -> Path:
        table = found = copy.deepcopy(TRUE)
        for key in path[:-1]:
            table = table[key]
        table[path[-1]] = value
        file = tmp_path / "results.json"
        file.write_text(json.dumps(found))
        return file

    return write


def test_an_expected_level_is_no_edited_one():
    """A card of gaitgauge-1 was refused for levels that are no whole numbers."""
    card = load_result(
        Path(__file__).parents[2] / "docs/data/scorecards/shipped-on-2026-11-28-gaitgauge-1.json.gz", intervals=False
    )
    assert any(row.reached % 1 for row in card.environments)


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        (("suite", "name"), "../../x", "suite: name is"),
        (("suite", "digest"), [1], "suite: digest is"),
        (("policy", "path"), 3, "policy: path is 3"),
        (("policy", "observations"), 3, "policy: observations is 3"),
        (("backend",), ["x"], "backend is"),
        (("robot",), "../robot.toml", "robot is"),
        (("score",), "high", "score is 'high'"),
        (("score_interval",), [0.1], "score_interval"),
        (("coverage",), 3, "coverage is 3"),
        (("coverage", "kind"), "best", "coverage: kind is 'best'"),
        (("environments",), [{}] * (MOST_ROWS + 1), "environments is"),
        (("environments", 0), 3, r"environments\[0\] is 3"),
        (("environments", 0, "friction"), -1, "friction is -1"),
        (("environments", 1, "level"), 10**9, "level is 1000000000"),
        (("provenance", "digests"), 3, "provenance: digests is 3"),
        (("score",), 1e308, "score is 1e"),
        (("score",), -0.5, "score is -0.5"),
        (("score",), 0.9, "score is 0.9, but what it is made of gives 0.134166"),
        (("score_interval",), [0.9, 0.1], "its ends must rise"),
        (("groups",), {"tracking": "good"}, "groups.tracking is 'good'"),
        (("metrics",), {"zmp_margin": 1.0}, "metrics.zmp_margin is 1.0"),
        (("terrains", "flat"), 3, "terrains.flat is 3"),
        (("chance",), None, "chance is None"),
        (("chance", "note"), 3, "chance: note is 3"),
        (("environments",), TRUE["environments"] * 2, "is there twice"),
        (
            ("environments", 0, "score"),
            None,
            r"environments\[0\].score is nothing, but what it is made of gives 0.17750",
        ),
        (("environments", 0, "runs"), 5, "runs is 5"),
        (("environments", 0, "runs"), {"x": {}}, "'x'; it must be a whole number"),
        (("environments", 0, "runs"), {"0": {"quality": "high"}}, "runs.0.quality is 'high'"),
        (("environments", 0, "runs"), {"0": {"quality": 1e300}}, r"runs.0.quality is 1e\+300; it must be less than"),
        (("groups",), {"tracking": -1e300}, r"groups.tracking is -1e\+300; it must be greater than"),
        (("environments", 0, "metrics"), {"zmp_margin": 3}, "metrics.zmp_margin is 3"),
        (("environments", 1, "trials"), {"1": {"2": "no"}}, "trials.1.2 is 'no'"),
    ],
)
def test_every_reader_of_cards_names_the_value(edited, tmp_path, path, value, named):
    file = edited(*path, value=value)
    for read in (load_result, lambda card: write_board(card.parent, tmp_path / "board.html")):
        with pytest.raises(ComparisonError, match=named) as caught:
            read(file)
        assert str(caught.value).isprintable() and "results.json" in str(caught.value)
    assert not (tmp_path / "board.html").exists()


@pytest.mark.parametrize(
    ("key", "value", "named"),
    [
        ("resamples", 10**9, "resamples is"),
        ("levels", 10**9, "levels is"),
        ("seeds", "all", "seeds is"),
        ("seeds", [], r"results\.json': chance: seeds is \[\]"),
    ],
)
def test_rules_of_chance_that_are_none_or_would_take_all_memory(edited, key, value, named):
    with pytest.raises(ComparisonError, match=named):
        load_result(edited("chance", key, value=value))


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        (("level",), 9.9, "level is 9.9, but what it is made of gives"),
        (("groups", "tracking"), 0.99, "groups.tracking is 0.99, but what it is made of gives"),
        (
            ("metrics", "lin_vel_err", "mean50"),
            0.99,
            "metrics.lin_vel_err.mean50 is 0.99, but what it is made of gives",
        ),
        (("terrains", "flat", "score"), 0.99, "terrains.flat.score is 0.99, but what it is made of gives"),
        (("terrains", "flat", "level"), 3, "terrains.flat.level is 3, but what it is made of gives nothing"),
        (("health", "falls"), 77, "health.falls is 77, but what it is made of gives"),
        (
            ("environments", 0, "quality", "mean50"),
            0.9,
            r"environments\[0\].quality.mean50 is 0.9, but what it is made of gives",
        ),
        (
            ("environments", 0, "runs", "0", "quality"),
            0.9,
            r"environments\[0\].quality.mean50 is .*, but what it is made of gives",
        ),
        (
            ("environments", 0, "runs"),
            {},
            r"environments\[0\].quality is there, but what it is made of gives nothing",
        ),
        (("environments", 1, "trials"), {}, r"environments\[1\].trials lacks .* its search has: level 2, seed 100"),
        (("chance", "seeds"), [0, 1, 2], r"environments\[0\].runs has the seeds '.*', but chance.seeds has '0, 1, 2'"),
    ],
)
def test_a_figure_that_its_runs_do_not_give_is_named(edited, path, value, named):
    """Whoever shows a better one has to invent the runs that give it, and these a replay finds."""
    with pytest.raises(ComparisonError, match=named) as caught:
        load_result(edited(*path, value=value))
    assert "results.json'" in str(caught.value)


def test_a_score_that_does_not_follow_from_level_and_quality_is_named(edited):
    """All that is made of it was changed along."""
    found = json.loads(edited("environments", 0, "score", value=0.9).read_text())
    rows = found["environments"]
    for terrain, item in found["terrains"].items():
        item["score"] = float(np.mean([row["score"] for row in rows if row["terrain"] == terrain]))
    found["score"] = float(np.mean([item["score"] for item in found["terrains"].values()]))
    file = edited("environments", value=rows)
    file.write_text(json.dumps(found))
    with pytest.raises(ComparisonError, match=r"environments\[0\].score is 0.9, but what it is made of gives"):
        load_result(file)


def test_many_rows_with_many_replicates_are_too_many(edited):
    rows = [TRUE["environments"][0] | {"payload": 0.01 * at} for at in range(1000)]
    file = edited("environments", value=rows)
    summary = {
        "score": rows[0]["score"],
        "level": None,
        "terrains": {},
        "metrics": {},
        "groups": {},
        "group_metrics": {},
    }
    summary |= {"health": None, "score_interval": None, "groups_interval": {}}
    file.write_text(json.dumps(json.loads(file.read_text()) | summary))
    many = read_result(file, ComparisonError)
    many = replace(many, chance=replace(many.chance, resamples=100_000))
    with pytest.raises(ComparisonError, match="1000 environments with 100,000 replicates"):
        compare([many, replace(many, policy=replace(many.policy, path="other.pt"))], ["one", "two"])


def test_scores_that_no_evaluation_writes_are_not_compared(edited):
    file = edited("environments", 0, "runs", value={"0": {"quality": float("inf")}})
    with pytest.raises(ComparisonError):
        compare([load_result(file), load_result(SEED)], ["one", "two"])


def test_the_library_reads_coverage_with_care(edited):
    with pytest.raises(ResultsError, match="was edited or is damaged"):
        load_results(edited("coverage", value=["complete"]))


@pytest.mark.parametrize("path", ["a\n^^5cinput{b}.pt", "=1+1\r\n^^5cwrite18{c}.pt", "@SUM(1)\u2028\x1b[31m.pt"])
def test_a_policy_s_name_is_neither_latex_nor_a_formula(edited, tmp_path, path):
    """The name stands in a comment of the table for LaTeX, which a line's end ends; ``^^5c`` is a backslash there."""
    found = compare([load_result(edited("policy", "path", value=path)), load_result(SEED)])
    files = write_comparison(tmp_path, found)
    tex = files["tex"].read_text()
    assert tex.isascii() and all(c.isprintable() or c == "\n" for c in tex)
    assert tex.splitlines()[1] == "" and tex.splitlines()[2].startswith(r"\begin{tabular}")
    assert not re.search(r"(?m)^[^%]*\^\^", tex)
    assert all(d.first.isprintable() for d in found.differences)
    cells = {cell for row in csv.reader(files["csv"].open(newline="")) for cell in row}
    assert not [c for c in cells if c.startswith(("=", "@"))]


def test_policies_measured_in_other_motions_do_not_compare():
    table = Measurements(name="real\x1b", values={"a": {"x": {"m": 1.0}}, "b": {"y\x1b": {"m": 1.0}}})
    with pytest.raises(ValidationError, match="every policy needs the same motions") as caught:
        validate(table, [table])
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: load_results(None), "path is None; it must be a path"),
        (lambda: compare_results([SEED, SEED]), r"result is \[.*; it must be a path, or what evaluate returned"),
        (lambda: evaluate(5), "policy is 5; it must be a path"),
        (lambda: evaluate("pretrained", device=2.5), "device is 2.5; it must be a text"),
        (
            lambda: evaluate("pretrained", terrains="flat"),
            "terrains is 'flat'; it must be a list",
        ),
        (lambda: evaluate("pretrained", frictions=0.5), "frictions is 0.5; it must be a list"),
        (lambda: evaluate("pretrained", seeds=["a"]), r"seeds\[0\] is 'a'; it must be a whole number"),
        (lambda: evaluate("pretrained", level=2.5), "level is 2.5; it must be a whole number"),
        (lambda: load_policy(["a"]), r"policy is \['a'\]; it must be a path"),
    ],
)
def test_an_argument_of_another_type_is_named(call, named):
    with pytest.raises(ArgumentError, match=named):
        call()


def test_a_name_that_no_system_takes_is_one_sentence():
    with pytest.raises(ResultsError, match="cannot be read: File name too long"):
        load_results("x" * 5000)


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: train(None), "task is None; it must be a text"),
        (lambda: train(["go2-flat"]), r"task is \['go2-flat'\]; it must be a text"),
        (lambda: train("go2-flat", 3), r"settings is \(3,\); it must be several texts"),
        (lambda: train("go2-flat", treads=3), "there is no option treads; choose from backend, device, gpus, num_envs"),
        (lambda: train("go2-flat", threads=0), "threads is 0; it must be greater than or equal to 1"),
        (lambda: train("go2-flat", threads=10**9), "threads is 1000000000; it must be less than or equal to 1024"),
        (lambda: train("go2-flat", seconds=float("nan")), "seconds is nan; it must be a finite number"),
        (lambda: train("go2-flat", iterations="many"), "iterations is 'many'; it must be a whole number"),
        (lambda: compare_results("x" * 300, "y"), "File name too long"),
        (lambda: evaluate("pretrained", threads=0), "threads is 0; it must be greater than or equal to 1"),
        (lambda: evaluate("pretrained", threads=10**300), "threads is 10+…?.*; it must be less than or equal to 1024"),
        (lambda: evaluate("pretrained", device="\x1b[31m"), "there is no device"),
        (lambda: evaluate("pretrained", pipeline="\x1b[31m"), "there is no pipeline"),
    ],
)
def test_what_cannot_be_trained_or_compared_is_one_sentence(call, named):
    with pytest.raises(
        (ArgumentError, BackendError, ConfigurationError, ComparisonError, SuiteError), match=named
    ) as caught:
        call()
    assert str(caught.value).isprintable()


def test_numpy_s_numbers_are_numbers(tmp_path):
    """They were a traceback where the request was written down."""
    with pytest.raises(PolicyError, match="nowhere"):
        evaluate(
            "nowhere.pt", suite="demo", level=np.int64(3), seeds=np.arange(2), threads=np.int64(1), out=tmp_path / "r"
        )
    request = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gaitgauge.gauge.evaluate.evaluate", lambda asked, *_, **__: request.append(asked))
        with pytest.raises(StoreError):
            evaluate("pretrained", level=np.int64(3), seeds=np.arange(2), frictions=np.ones(1), out=tmp_path / "r")
    asked = request[0].request
    assert json.dumps([asked.level, *asked.seeds, *asked.frictions]) == "[3, 0, 1, 1.0]"
