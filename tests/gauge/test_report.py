"""The report: what it shows for every pipeline, and that hostile text stays text."""

import json
import re
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from gaitgauge.api import ResultsError, load_results
from gaitgauge.gauge.coverage import notes
from gaitgauge.gauge.report.page import CLIP, FELL_AT_LIMIT, metric_matrix, render, sources, warnings, write_report
from gaitgauge.gauge.report.pages import labelled
from gaitgauge.gauge.result import Health, Run, Statistics
from gaitgauge.gauge.store import StoreError
from gaitgauge.studies.compare.comparison import ComparisonError, compare, load_result
from sample_results import HOSTILE, PIPELINES, Page, read, row, sample


@pytest.fixture(scope="module")
def stress():
    return sample()


@pytest.mark.parametrize("pipeline", PIPELINES)
def test_every_pipeline_renders_well_formed_and_shows_its_environments(pipeline):
    result = sample(pipeline, **PIPELINES[pipeline])
    text = render(result)
    page = Page(text)
    assert not page.open
    assert "None" not in page.text
    assert "nan" not in page.text.lower().split()
    rows = text.partition('<table class="all')[2].partition("</table>")[0]
    assert rows.count("<tr>") == len(result.environments) + 1
    shown = f"{result.score:.4f}" if pipeline != "level" else f"{result.level:.2f}"
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
    result = sample(suite=suite)
    assert (result.score_interval, result.chance.note) == (None, "no interval: one seed")
    assert {row.interval for row in result.terrains.values()} == {None}
    assert {row.interval for row in result.metrics.values()} == {None}
    words = Page(render(result)).text
    assert "no interval: one seed" in words and "one seed shows no spread of quality." in words
    assert "Intervals say what" not in words


def test_policy_that_passes_nothing_is_a_result():
    result = sample(terrains=("wave", "obstacle"), frictions=(0.4, 0.6), reach=0)
    page = Page(render(result))
    assert "Not even level 1 passed in 4 of 4 searched environments" in page.text
    assert result.level == 0
    assert "0.00 of 10" in page.text


def test_overflow_and_divergence_stand_at_the_top_and_in_the_table():
    result = sample("base", **PIPELINES["base"])
    health, (row,) = replace(result.health, diverged=1, overflowed=2), result.environments
    row = replace(row, diverged=1, overflowed=2)
    text = Page(render(replace(result, health=health, environments=(row,)))).text
    assert "events" not in Page(render(sample("base", **PIPELINES["base"]))).text
    assert "No falls" not in text
    assert text.index("Physics diverged in 1 of 3") < text.index("Contacts dropped in 2 of 3") < text.index("Terrains")
    assert text.index("Environments") < text.index("1 diverged") < text.index("2 overflowed")


def test_page_asks_for_nothing_from_outside(stress):
    text = render(replace(stress, policy=replace(stress.policy, path=HOSTILE)))
    for _, attributes in Page(text).tags:
        assert not {"src", "href", "srcset", "action", "data", "xlink:href"} & attributes.keys()
    assert not re.search(r"@import|url\(|fetch\(|XMLHttpRequest", text)
    assert "default-src 'none'" in text


def test_film_is_part_of_the_page_and_nothing_else_is_loaded(tmp_path, stress):
    (tmp_path / "results.json").write_text(json.dumps(stress.to_data()))
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


def test_where_a_policy_comes_from_is_told_in_words(stress):
    robot = {"name": "go2", "digest": "5a51"}
    told = {"robot": robot, "task": "go2-flat", "iteration": 1006, "seeds": [1, 2], "note": None}
    found = sources(replace(stress, policy=replace(stress.policy, provenance=told)))
    shown = [found[f"policy: {key}"] for key in told]
    assert shown == ["name go2, digest 5a51", "go2-flat", "1006", "1, 2", "–"]


def test_directions_commands_and_references_are_shown(stress):
    page = Page(render(stress))
    for words in ("turning left", "there and back: forward and right", "0.6739", "go2_moe_cts_137k_0.6739"):
        assert words in page.text
    assert "for comparison: others" in page.text
    assert "for comparison: others" not in Page(render(sample("base", **PIPELINES["base"]))).text


def test_commands_of_a_suite_s_own_have_no_table_of_directions(stress):
    """The page of the suite toy had an empty one."""
    runs = {0: Run(columns={"quality": 0.5}, commands={"ahead 1": 0.8})}
    text = Page(render(replace(stress, environments=tuple(replace(r, runs=runs) for r in stress.environments)))).text
    assert "By command" in text and "By direction" not in text


def test_cells_of_stacked_tables_carry_the_heads_of_their_columns():
    """At 390 pixels the page of consistency showed no gap, and of the models' values none."""
    head = '<thead><tr><th>engine</th><th>gap &lt; [m]</th><th class="strip"><svg><text>0.5</text></svg></th><th>end</th></tr></thead>'
    rows = (
        '<tr><td>a</td><td class="x">1</td><td class="strip"></td><td data-label="own">2</td></tr><tr><td>b</td></tr>'
    )
    plain = f"<table>{head}{rows}</table>"
    assert labelled(plain) == plain
    found = labelled(f'<table class="stack one">\n{head}{rows}</table>{plain}')
    assert found == f'<table class="stack one">\n{head}{rows}</table>{plain}'.replace(
        '<td class="x">', '<td data-label="gap &lt; [m]" class="x">', 1
    )


def test_warnings_come_after_the_score_and_in_proportion(stress):
    """The shipped policy's page opened with a fall at its own limit, as loud as a divergence, before the score."""
    rows = [replace(r, falls=0, self_contact=0.0) for r in stress.environments]
    flat, climbs = next(r for r in rows if r.search is None), [r for r in rows if r.search is not None]
    climbs[0] = replace(climbs[0], falls=1)
    health = Health(episodes=3, falls=1, diverged=0, overflowed=0, self_contact=0.004)
    limit, touching = warnings([flat, *climbs], health)
    assert (limit["severity"], limit["meaning"]) == ("note", FELL_AT_LIMIT)
    assert (touching["severity"], touching["headline"]) == (
        "slight",
        "parts of the robot touch each other in 0.4 % of the samples",
    )
    assert warnings([replace(flat, falls=1)], health)[0]["severity"] == "grave", (
        "flat ground has no limit to search for"
    )
    twice = [flat, replace(climbs[0], falls=2), *climbs[1:]]  # both turns on the spot, in one episode
    assert warnings(twice, replace(health, falls=2))[0]["severity"] == "note"
    everywhere = [replace(r, falls=1) for r in climbs]
    assert warnings(everywhere, health)[0]["severity"] == "grave", "more than half of the environments"
    assert warnings([flat], replace(health, falls=0, self_contact=0.02))[0]["severity"] == "note"
    text = render(replace(stress, health=health, environments=(flat, *climbs)))
    assert text.index('class="score"') < text.index("1 fall in 3") < text.index("<h2>Terrains")


def test_the_first_page_that_a_user_sees_has_no_grave_warning():
    shipped = load_result(Path(__file__).parents[2] / "docs" / "data" / "scorecards" / "pretrained-demo.json")
    assert {found["severity"] for found in warnings(shipped.environments, shipped.health)} <= {"note", "slight"}


@pytest.mark.parametrize("place", ["path", "command", "terrain", "host", "provenance", "version", "suite"])
def test_hostile_text_stays_text(place):
    result = sample("base", **PIPELINES["base"])
    match place:
        case "path":
            result = replace(result, policy=replace(result.policy, path=HOSTILE))
        case "command" | "host":
            result = replace(result, provenance=replace(result.provenance, **{place: HOSTILE}))
        case "terrain":
            row = replace(result.environments[0], terrain=HOSTILE, level=3, search={5: False, 3: True})
            terrains = {HOSTILE: result.terrains["flat"]}
            result = replace(result, terrains=terrains, environments=(row, *result.environments[1:]))
        case "provenance":
            result = replace(result, policy=replace(result.policy, provenance={HOSTILE: {"a": HOSTILE}}))
        case "version":
            result = replace(result, provenance=replace(result.provenance, versions={HOSTILE: HOSTILE}))
        case "suite":
            result = replace(result, suite=replace(result.suite, name=HOSTILE, version=HOSTILE, title=HOSTILE))
    page = Page(render(result))
    assert page.count("img") == 0
    assert page.count("script") == 1
    assert "onerror=alert(1)" in page.text
    assert not any(name.startswith("on") for _, attributes in page.tags for name in attributes)


@pytest.mark.parametrize(
    ("suite", "environments"), [pytest.param("robogauge-1.1", 63, marks=pytest.mark.slow), ("gaitgauge-1", 91)]
)
def test_full_run_stays_small(suite, environments):
    result = sample(suite=suite)
    assert len(result.environments) == environments
    assert len(render(result).encode()) < 300_000


def test_report_is_written_beside_the_results(tmp_path, stress):
    (tmp_path / "results.json").write_text(json.dumps(stress.to_data()), encoding="utf-8")
    path = write_report(tmp_path)
    assert path == tmp_path / "report.html"
    assert path.read_text(encoding="utf-8") == render(stress)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["report.html", "results.json"]


def test_a_page_keeps_no_control_character(stress):
    """A page that is printed in a terminal, as by ``cat``, gives it no commands."""
    policy = replace(stress.policy, path="a\x1b]0;owned\x07\x9b31m\u202e.pt", provenance={"made\x1b": "by\x1b[2J"})
    text = render(replace(stress, policy=policy))
    assert "\\x1b]0;owned\\x07\\x9b31m\\u202e.pt" in text
    assert not [c for c in text if not c.isprintable() and c not in "\n\xa0\xad\u2009\u202f"]


@pytest.mark.parametrize("key", ["environments", "terrains", "provenance", "policy", "health", "score", "metrics"])
@pytest.mark.parametrize(
    "value", [{"a": 1}, *(pytest.param(v, marks=pytest.mark.slow) for v in (None, [1], "text", -1)), "left out"]
)
def test_edited_results_are_one_clear_sentence_or_a_page(tmp_path, stress, key, value):
    changed = {**stress.to_data(), key: value}
    if value == "left out":
        del changed[key]
    (tmp_path / "results.json").write_text(json.dumps(changed))
    try:
        write_report(tmp_path)
    except StoreError as error:
        assert "results.json was edited or is damaged" in str(error) and str(error).isprintable()
    for again in (lambda: compare([load_result(tmp_path), stress], ["a", "b"]), lambda: load_results(tmp_path)):
        with suppress(ComparisonError, ResultsError):
            again()


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


HEALTHY = Health(episodes=9)


def test_warnings_name_what_failed_and_where():
    rows = [
        row(level=0, search={1: False}),
        row("stairs_fd", falls=2, diverged=1, overflowed=0, restarted=0),
        row("slope_fd", falls=5, diverged=0, overflowed=0, restarted=3),
    ]
    found = warnings(rows, Health(episodes=6, falls=7, diverged=1))
    assert [w["severity"] for w in found] == ["grave", "grave", "note", "note"]
    assert found[0]["headline"] == "physics diverged in 1 of 6 quality episodes"
    assert found[1]["places"] == ["slope, forward, μ 0.6 (5)", "stairs, forward, μ 0.6 (2)"]
    assert found[2]["headline"] == "not even level 1 passed in 1 of 1 searched environment"
    assert found[3]["places"] == ["slope, forward, μ 0.6 (3)"]


def test_one_episode_is_no_plural():
    rows = [row(falls=1, restarted=1)]
    health = Health(episodes=1, falls=1, diverged=1, overflowed=1)
    assert [w["headline"] for w in warnings(rows, health)] == [
        "physics diverged in 1 of 1 quality episode",
        "contacts dropped in 1 of 1 quality episode",
        "1 fall in 1 quality episode",
        "restarts in 1 of 1 quality episode",
    ]


def test_parts_that_touch_are_told_with_the_worst_places_first():
    rows = [row("wave", self_contact=0.004), row("stairs_fd", self_contact=0.0), row("flat", self_contact=0.118)]
    (warning,) = warnings(rows, replace(HEALTHY, self_contact=0.041))
    assert warning["severity"] == "note"
    assert warning["headline"] == "parts of the robot touch each other in 4.1 % of the samples"
    assert warning["places"] == ["flat, μ 0.6 (11.8 %)", "wave, μ 0.6 (0.4 %)"]


def test_nothing_is_told_of_parts_that_never_touch_or_of_cards_that_do_not_say():
    for said in (HEALTHY, replace(HEALTHY, self_contact=0.0)):
        assert warnings([row("flat")], said) == []


def test_long_lists_of_places_are_cut():
    rows = [row(friction=round(0.1 * i, 1), falls=1) for i in range(1, 10)]
    (warning,) = warnings(rows, replace(HEALTHY, falls=9))
    assert len(warning["places"]) == 7
    assert warning["places"][-1] == "and 3 more"


def test_healthy_run_says_so():
    result = sample("base", **PIPELINES["base"])
    rows = tuple(replace(row, falls=0) for row in result.environments)
    result = replace(result, environments=rows, health=replace(result.health, falls=0))
    assert warnings(result.environments, result.health, notes(result)) == []
    assert "No falls, no divergence" in render(result)


def measured(value):
    return Statistics(mean=value, mean25=value, mean50=value)


def test_metric_matrix_is_the_mean_over_played_environments():
    rows = [
        row(level=2, quality=measured(0.2), metrics={"m": measured(0.4)}),
        row(level=3, quality=measured(0.4), metrics={"m": measured(0.8)}),
        row(level=0, quality=None),
    ]
    assert metric_matrix(rows) == {"wave": {"m": pytest.approx(0.6), "quality": pytest.approx(0.3)}}


def test_unknown_metrics_and_terrains_go_by_their_names(stress):
    text = json.dumps(stress.to_data()).replace("dof_power", "heart_rate").replace("obstacle", "gravel_pit")
    page = Page(render(read(json.loads(text))))
    assert "heart rate" in page.text
    assert "gravel pit" in page.text
