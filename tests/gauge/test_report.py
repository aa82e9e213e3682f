"""The report: what it shows for every pipeline, where its charts put known data, and that hostile text stays text."""

import json
import math
import re
import zlib
from contextlib import suppress
from copy import deepcopy
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser

import numpy as np
import pytest
from gaitgauge.api import ResultsError, load_results
from gaitgauge.gauge import charts
from gaitgauge.gauge.comparison import ComparisonError, compare, load_result
from gaitgauge.gauge.coverage import coverage
from gaitgauge.gauge.episodes import Record
from gaitgauge.gauge.pipelines import make_environments
from gaitgauge.gauge.plan import PlanRules, environment_result, plan
from gaitgauge.gauge.report import CLIP, STATISTIC_LABELS, metric_matrix, render, report_data, warnings, write_report
from gaitgauge.gauge.results import fold, health
from gaitgauge.gauge.store import StoreError
from gaitgauge.gauge.suite import load_suite

HOSTILE = 'a/<img src="http://evil.example/x.png" onerror=alert(1)></script><script>alert(2)</script>&"\'.pt'
REACH = {"slope_fd": 7, "slope_bd": 6, "stairs_fd": 9, "stairs_bd": 4, "wave": 8, "obstacle": 3}


def ended(suite, episode, generator, reached):
    """A record of random but plausible samples, worse on harder ground and slippery floors; a target met up to a level."""
    if episode.stage == "search":
        return Record(episode=episode, success=episode.level <= reached)
    names = [*suite.metrics.weights, "quality"]
    centre = 0.82 - 0.03 * episode.level - 0.15 * (episode.friction < 0.35)
    by_metric = np.array([0.12 * math.sin(zlib.crc32(n.encode())) for n in names])
    samples = np.clip(centre + by_metric + 0.12 * generator.standard_normal((120, len(names))), 0, 1).astype(np.float32)
    return Record(
        episode=episode,
        falls=int(generator.random() < 0.04),
        columns=tuple(names),
        samples=samples,
        goal_index=np.repeat([0, 1], 60).astype(np.int16),
        part_index=np.tile(np.repeat(np.arange(6), 10), 2).astype(np.int16),
    )


def sample(pipeline="stress", suite="robogauge-1.1", resamples=10, **choices):
    """What ``evaluate`` would write, from synthetic records; a copy for the test to change."""
    return deepcopy(_sample(pipeline, suite, resamples, **choices))


@cache
def _sample(pipeline, suite, resamples, reach=None, **choices):
    suite = load_suite(suite)
    suite = replace(suite, scoring=replace(suite.scoring, bootstrap=resamples))
    generator = np.random.default_rng(0)
    chosen = {"terrains": suite.matrix.terrains, "frictions": None, "payloads": None, "level": None, **choices}
    rules = PlanRules(suite=suite, seeds=suite.matrix.seeds, quality=pipeline != "level")
    environments = []
    for environment in make_environments(suite, **chosen):
        handicap = round(6 * max(0.0, 0.4 - environment.friction) + max(0.0, environment.payload))
        reached = (REACH.get(environment.terrain, 0) if reach is None else reach) - 2 * handicap
        records = {}
        while required := plan(environment, records, rules).required:
            records |= {e: ended(suite, e, generator, reached) for e in required}
        environments.append(environment_result(environment, records, rules))
    results = fold(suite, environments, (*suite.metrics.weights, "quality"))
    policy = {"path": "policies/go2_cts.pt", "contract_hash": "ab" * 32, "file_sha256": "cd" * 32}
    covered = coverage(suite, make_environments(suite, **chosen), suite.matrix.seeds, pipeline=pipeline)
    return results | {
        "coverage": covered,
        "policy": policy | {"provenance": {"adapter": "TorchScript", "steps": 5}},
        "pipeline": pipeline,
        "backend": "mujoco",
        "robot": "go2",
        "health": dict(health(environments)),
        "provenance": {
            "versions": {"python": "3.11.2", "gaitgauge": "0.1.0", "mujoco": "3.17.0", "torch": "2.13.0"},
            "command": "gaitgauge evaluate policies/go2_cts.pt --suite robogauge-1.1",
            "date": "2026-01-02T03:04:05+00:00",
            "host": "lab",
            "machine": "x86_64, 2 CPUs, Linux 6.1",
            "device": "cpu",
            "threads": 2,
            "seconds": 152.5,
            "physics_steps": 1_234_567,
        },
    }


PIPELINES = {
    "base": {"terrains": ("flat",), "frictions": (0.6,), "payloads": (0.0,)},
    "multi": {"terrains": ("slope_fd", "wave"), "frictions": (0.4, 0.6), "payloads": (0.0, 2.0), "level": 5},
    "level": {"terrains": tuple(REACH)},
    "stress": {},
}


@pytest.fixture(scope="module")
def stress():
    return sample()


class Page(HTMLParser):
    """Collects tags with their attributes, and text."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.words, self.open = [], [], []
        self.feed(text)
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in ("meta", "input", "img", "link", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, f"</{tag}> closes nothing"

    def handle_data(self, data):
        if self.open[-1:] not in (["style"], ["script"]):
            self.words.append(data)

    def count(self, tag):
        return sum(t == tag for t, _ in self.tags)


@pytest.mark.parametrize("pipeline", PIPELINES)
def test_every_pipeline_renders_well_formed_and_shows_its_environments(pipeline):
    results = sample(pipeline, **PIPELINES[pipeline])
    text = render(results)
    page = Page(text)
    assert not page.open
    assert "None" not in page.text
    assert "nan" not in page.text.lower().split()
    rows = text.partition('<table class="all')[2].partition("</table>")[0]
    assert rows.count("<tr>") == len(results["environments"]) + 1
    shown = f"{results['score']:.4f}" if pipeline != "level" else f"{results['level']:.2f}"
    assert re.search(rf'class="score">{re.escape(shown)}\b', text)
    assert ("no quality episodes" in page.text) == (pipeline == "level")


def test_a_part_and_a_custom_run_are_never_shown_as_the_suites_score():
    def shown(**choices):
        text = render(sample(**choices))
        heading = re.search(r"<title>(.*?)</title>", text).group(1)
        return heading, re.search(r'class="score-label">(.*?)</span>', text).group(1), Page(text).text

    heading, score, words = shown()
    assert (score, "robogauge-1.1 1.1.0, complete" in words, ": robogauge" in heading) == ("score", True, True)
    heading, score, words = shown(terrains=("flat", "wave"), frictions=(0.6,))
    assert score == "score of a part (2 of 7 terrains, 1 of 9 frictions)"
    assert "a part of robogauge-1.1 1.1.0" in words and "part, robogauge-1.1" in heading
    heading, score, words = shown(terrains=("flat",), frictions=(9.0,))
    assert score == "score of a custom run (friction 9, 1 of 7 terrains)"
    assert "custom, after robogauge-1.1 1.1.0" in words and "custom, robogauge-1.1" in heading


@pytest.mark.parametrize(
    ("suite", "label", "sentence"),
    [
        (
            "robogauge-1.1",
            "mean maximum level",
            "Maximum level The highest of ten levels of difficulty that the level search",
        ),
        (
            "gaitgauge-1",
            "mean expected level",
            "Expected level The level of ten that is reached on average, the area under the",
        ),
    ],
)
def test_levels_are_called_what_they_are(suite, label, sentence):
    words = " ".join(Page(render(sample(suite=suite, terrains=("flat", "wave"), frictions=(0.4, 0.6)))).text.split())
    assert label in words and sentence in words


@pytest.mark.parametrize("suite", ["demo", "mid", "quick"])
def test_suites_with_one_quality_seed_show_no_interval(suite):
    """One seed shows no spread; the intervals that were printed came from sub-commands, which are no sample."""
    results = sample(suite=suite)
    assert (results["score_interval"], results["chance"]["note"]) == (None, "no interval: one seed")
    assert {row["interval"] for row in results["terrains"].values()} == {None}
    assert {row["interval"] for row in results["metrics"].values()} == {None}
    words = Page(render(results)).text
    assert "no interval: one seed" in words and "There are no intervals: one seed shows no spread." in words
    assert "Intervals say what" not in words


def test_policy_that_passes_nothing_is_a_result():
    results = sample(terrains=("wave", "obstacle"), frictions=(0.4, 0.6), reach=0)
    page = Page(render(results))
    assert "Not even level 1 passed in 4 of 4 searched environments" in page.text
    assert results["level"] == 0
    assert "0.00 of 10" in page.text


def test_overflow_and_divergence_stand_at_the_top_and_in_the_table():
    results = sample("base", **PIPELINES["base"])
    results["health"] |= {"diverged": 1, "overflowed": 2}
    results["environments"][0] |= {"diverged": 1, "overflowed": 2}
    text = Page(render(results)).text
    assert "events" not in Page(render(sample("base", **PIPELINES["base"]))).text
    assert "No falls" not in text
    assert text.index("Physics diverged in 1 of 3") < text.index("Contacts dropped in 2 of 3") < text.index("Terrains")
    assert text.index("Environments") < text.index("1 diverged") < text.index("2 overflowed")


def test_page_asks_for_nothing_from_outside(stress):
    text = render(stress | {"policy": stress["policy"] | {"path": HOSTILE}})
    for _, attributes in Page(text).tags:
        assert not {"src", "href", "srcset", "action", "data", "xlink:href"} & attributes.keys()
    assert not re.search(r"@import|url\(|fetch\(|XMLHttpRequest", text)
    assert "default-src 'none'" in text


def test_film_is_part_of_the_page_and_nothing_else_is_loaded(tmp_path, stress):
    (tmp_path / "results.json").write_text(json.dumps(stress))
    (tmp_path / CLIP).write_bytes(b"RIFFfilm")
    text = write_report(tmp_path).read_text()
    assert [a["src"] for t, a in Page(text).tags if "src" in a] == ["data:image/webp;base64,UklGRmZpbG0="]
    assert "img-src data:" in text
    assert "img-src" not in render(stress)
    (tmp_path / CLIP).write_bytes(bytes(5_000_000))
    assert "img-src" not in write_report(tmp_path).read_text()


def test_every_number_has_its_name_where_a_phone_hides_the_tables_heads(stress):
    """At 390 pixels the table of metrics showed no numbers."""
    tables = re.findall(r'<table class="[^"]*stack[^"]*">(.*?)</table>', render(stress), re.S)
    assert len(tables) == 3
    for table in tables:
        for line in re.findall(r"<tr>(.*?)</tr>", table.split("</thead>")[1], re.S):
            _, *cells = re.findall(r"<t[dh]\b[^>]*>", line)
            assert cells and all("data-label=" in cell or 'class="strip"' in cell for cell in cells), line


def test_directions_commands_and_references_are_shown(stress):
    page = Page(render(stress))
    for words in ("turning left", "there and back: forward and right", "0.6739", "arXiv 2602.00678"):
        assert words in page.text
    assert "others, on the same suite" not in Page(render(sample("base", **PIPELINES["base"]))).text


@pytest.mark.parametrize("place", ["path", "command", "terrain", "host", "provenance", "version", "suite"])
def test_hostile_text_stays_text(place):
    results = sample("base", **PIPELINES["base"])
    match place:
        case "path":
            results["policy"]["path"] = HOSTILE
        case "command" | "host":
            results["provenance"][place] = HOSTILE
        case "terrain":
            results["terrains"] = {HOSTILE: results["terrains"]["flat"]}
            results["environments"][0] |= {"terrain": HOSTILE, "level": 3, "search": {"5": False, "3": True}}
        case "provenance":
            results["policy"]["provenance"] = {HOSTILE: {"a": HOSTILE}}
        case "version":
            results["provenance"]["versions"] = {HOSTILE: HOSTILE}
        case "suite":
            results["suite"] = dict.fromkeys(("name", "version", "title"), HOSTILE)
    page = Page(render(results))
    assert page.count("img") == 0
    assert page.count("script") == 1
    assert "onerror=alert(1)" in page.text
    assert not any(name.startswith("on") for _, attributes in page.tags for name in attributes)


@pytest.mark.parametrize(("suite", "environments"), [("robogauge-1.1", 63), ("gaitgauge-1", 91)])
def test_full_run_stays_small(suite, environments):
    results = sample(suite=suite)
    assert len(results["environments"]) == environments
    assert len(render(results).encode()) < 300_000


def test_report_is_written_beside_the_results(tmp_path, stress):
    (tmp_path / "results.json").write_text(json.dumps(stress), encoding="utf-8")
    path = write_report(tmp_path)
    assert path == tmp_path / "report.html"
    assert path.read_text(encoding="utf-8") == render(stress)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["report.html", "results.json"]


@pytest.mark.parametrize("key", ["environments", "terrains", "provenance", "policy", "health", "score", "metrics"])
@pytest.mark.parametrize("value", [None, [1], {"a": 1}, "text", -1, "left out"])
def test_edited_results_are_one_clear_sentence_or_a_page(tmp_path, stress, key, value):
    changed = {**stress, key: value}
    if value == "left out":
        del changed[key]
    (tmp_path / "results.json").write_text(json.dumps(changed))
    try:
        write_report(tmp_path)
    except StoreError as error:
        assert "results.json was edited or is damaged" in str(error) and str(error).isprintable()
    for read in (lambda: compare([load_result(tmp_path)] * 2, ["a", "b"]), lambda: load_results(tmp_path)):
        with suppress(ComparisonError, ResultsError):
            read()


@pytest.mark.parametrize(
    ("content", "words"),
    [(None, "holds no results.json"), ("{", "not valid JSON"), ("[]", "must be a table"), ("[" * 9999, "too deep")],
)
def test_missing_or_damaged_results_are_one_clear_sentence(tmp_path, content, words):
    (tmp_path / "report.html").write_text("earlier")
    if content is not None:
        (tmp_path / "results.json").write_text(content)
    with pytest.raises(StoreError, match=words):
        write_report(tmp_path)
    assert (tmp_path / "report.html").read_text() == "earlier"


def test_radar_puts_values_on_their_spokes():
    terrains = {
        n: {"mean": 1.0, "mean25": 0.0, "mean50": v} for n, v in zip("abcd", (1.0, 0.5, 0.25, 0.0), strict=True)
    }
    radar = charts.radar(terrains, STATISTIC_LABELS)
    (x, y), radius = radar["centre"], radar["centre"][1] - radar["spokes"][0]["y"]
    shapes = {s["statistic"]: s["points"] for s in radar["shapes"]}
    assert shapes["mean50"] == [(x, y - radius), (x + radius / 2, y), (x, y + radius / 4), (x, y)]
    assert shapes["mean25"] == [(x, y)] * 4
    assert shapes["mean"] == [(s["x"], s["y"]) for s in radar["spokes"]]
    assert [s["label"]["anchor"] for s in radar["spokes"]] == ["middle", "start", "middle", "end"]


def test_two_terrains_have_bars_in_place_of_a_radar():
    data = report_data(sample("multi", **PIPELINES["multi"]))
    assert data["radar"] is None
    marks = data["terrains"]["wave"]["strip"]["marks"]
    row = data["terrains"]["wave"]
    assert marks["mean50"] == pytest.approx(5 + 190 * row["mean50"], abs=0.01)
    assert marks["mean25"] < marks["mean50"] < marks["mean"]


def row(terrain="wave", friction=0.6, payload=0.0, level=5, **more):
    return {"terrain": terrain, "friction": friction, "payload": payload, "level": level, **more}


def test_sweep_puts_levels_between_nought_and_ten():
    rows = [
        row(friction=1.0, level=10),
        row(friction=0.2, level=0),
        row(friction=0.6, level=5),
        row("stairs_fd", level=3),
    ]
    (panel,) = charts.sweep(rows, axis="friction", quantity="level")
    left, right, top, bottom = panel["frame"]
    points = panel["points"]
    assert panel["terrain"] == "wave"
    assert [p["y"] for p in points] == [bottom, (top + bottom) / 2, top]
    assert [p["x"] for p in points] == [left + 8, (left + right) / 2, right - 8]
    assert [p["failed"] for p in points] == [True, False, False]


def test_sweep_draws_whiskers_at_the_interval_and_marks_falls():
    rows = [row("flat", f, level=None, score=0.5, interval=[0.25, 0.75], falls=f > 0.5) for f in (0.4, 0.8)]
    (panel,) = charts.sweep(rows, axis="friction", quantity="score")
    _, _, top, bottom = panel["frame"]
    for point in panel["points"]:
        assert point["whisker"] == [bottom - 0.25 * (bottom - top), bottom - 0.75 * (bottom - top)]
    assert [p["failed"] for p in panel["points"]] == [False, True]


def test_payloads_have_their_own_axis_at_the_nominal_friction():
    figures = report_data(sample(suite="gaitgauge-1"))["level_figures"]
    assert [f["title"] for f in figures] == ["over friction at payload 0 kg", "over payload at friction 0.6"]
    assert [len(p["points"]) for p in figures[1]["panels"]] == [5] * 6


def test_crossed_payloads_become_a_map():
    rows = [row(friction=f, payload=p, level=int(10 * f)) for f in (0.2, 0.6, 1.0) for p in (-1.0, 2.0)]
    assert charts.sweep(rows, axis="friction", quantity="level") == []
    assert charts.sweep(rows, axis="payload", quantity="level") == []
    (chart,) = charts.heat(rows, quantity="level")
    cells = {c["title"]: c for c in chart["cells"]}
    low, high = cells["friction 0.2, payload −1 kg: 2"], cells["friction 1, payload 2 kg: 10"]
    assert (low["share"], high["share"]) == (0.2, 1.0)
    assert high["x"] - low["x"] == 2 * chart["cell"][0]
    assert low["y"] - high["y"] == chart["cell"][1]


def test_search_chart_tells_passed_missed_and_untried_levels():
    rows = [row(level=6, search={"5": True, "8": False, "7": False, "6": True}), row("flat", level=None)]
    (chart,) = charts.searches(rows)
    (line,) = chart["lines"]
    column = [round((x - chart["left"]) / chart["cell"]) + 1 for x in line["passed"] + line["failed"] + line["open"]]
    assert column == [5, 6, 7, 8, 1, 2, 3, 4, 9, 10]
    assert line["reached"] == chart["left"] + 5 * chart["cell"]


def test_search_that_passes_nothing_marks_no_level():
    (chart,) = charts.searches([row(level=0, search={"5": False, "2": False, "1": False})])
    assert chart["lines"][0]["reached"] is None


def test_warnings_name_what_failed_and_where():
    rows = [
        row(level=0, search={"1": False}),
        row("stairs_fd", falls=2, diverged=1, overflowed=0, restarted=0),
        row("slope_fd", falls=5, diverged=0, overflowed=0, restarted=3),
    ]
    found = warnings({"environments": rows, "health": {"episodes": 6, "falls": 7, "diverged": 1, "overflowed": 0}})
    assert [w["severity"] for w in found] == ["grave", "grave", "note", "note"]
    assert found[0]["headline"] == "physics diverged in 1 of 6 quality episodes"
    assert found[1]["places"] == ["slope, forward, μ 0.6 (5)", "stairs, forward, μ 0.6 (2)"]
    assert found[2]["headline"] == "not even level 1 passed in 1 of 1 searched environments"
    assert found[3]["places"] == ["slope, forward, μ 0.6 (3)"]


def test_long_lists_of_places_are_cut():
    rows = [row(friction=round(0.1 * i, 1), falls=1) for i in range(1, 10)]
    (warning,) = warnings({"environments": rows, "health": {"episodes": 9, "falls": 9, "diverged": 0, "overflowed": 0}})
    assert len(warning["places"]) == 7
    assert warning["places"][-1] == "and 3 more"


def test_healthy_run_says_so():
    results = sample("base", **PIPELINES["base"])
    results["health"] |= {"falls": 0}
    results["environments"][0]["falls"] = 0
    assert warnings(results) == []
    assert "No falls, no divergence" in render(results)


def test_metric_matrix_is_the_mean_over_played_environments():
    rows = [
        row(level=2, quality={"mean50": 0.2}, metrics={"m": {"mean50": 0.4}}),
        row(level=3, quality={"mean50": 0.4}, metrics={"m": {"mean50": 0.8}}),
        row(level=0, quality=None),
    ]
    assert metric_matrix(rows) == {"wave": {"m": pytest.approx(0.6), "quality": pytest.approx(0.3)}}


def test_unknown_metrics_and_terrains_go_by_their_names(stress):
    results = json.loads(json.dumps(stress).replace("dof_power", "heart_rate").replace("obstacle", "gravel_pit"))
    page = Page(render(results))
    assert "heart rate" in page.text
    assert "gravel pit" in page.text


def test_curves_have_round_ticks_and_leave_out_what_is_not_finite():
    """Of a frame from (46, 8) to (470, 222)."""
    data = charts.curves({"a": [([0.0, 4.0], [-1.0, 3.0])], "b": [([1.0, 2.0, 3.0], [1.0, math.nan, 2.0])]})
    assert data["frame"] == (46.0, 470.0, 8.0, 222.0)
    assert [line["points"] for line in data["lines"]] == [
        [(46.0, 222.0), (470.0, 8.0)],
        [(152.0, 115.0), (364.0, 61.5)],
    ]
    assert [(line["label"], line["turn"]) for line in data["lines"]] == [("a", 0), ("b", 1)]
    assert [t["label"] for t in data["x_ticks"]] == ["0", "1", "2", "3", "4"]
    assert [t["label"] for t in data["y_ticks"]] == ["−1", "0", "1", "2", "3"]
    assert charts.curves({"none": []})["lines"] == []
