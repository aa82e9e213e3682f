"""The charts of the report: where they put known data."""

import math
import re
from typing import Any

import pytest
from gaitgauge.gauge.report.page import STATISTIC_LABELS, charts, report_data
from gaitgauge.gauge.report.pages import page_template
from gaitgauge.gauge.result import TerrainScore
from gaitgauge.training.sweep import folding
from sample_results import PIPELINES, row, sample


def test_radar_puts_values_on_their_spokes():
    terrains = {
        n: TerrainScore(mean=1.0, mean25=0.0, mean50=v) for n, v in zip("abcd", (1.0, 0.5, 0.25, 0.0), strict=True)
    }
    radar = charts.radar(terrains, STATISTIC_LABELS)
    (x, y), radius = radar["centre"], radar["centre"][1] - radar["spokes"][0]["y"]
    shapes = {s["statistic"]: s["points"] for s in radar["shapes"]}
    assert shapes["mean50"] == [(x, y - radius), (x + radius / 2, y), (x, y + radius / 4), (x, y)]
    assert shapes["mean25"] == [(x, y)] * 4
    assert shapes["mean"] == [(s["x"], s["y"]) for s in radar["spokes"]]
    assert [s["label"]["anchor"] for s in radar["spokes"]] == ["middle", "start", "middle", "end"]


def test_two_terrains_have_bars_in_place_of_a_radar():
    result = sample("multi", **PIPELINES["multi"])
    data = report_data(result)
    assert data["radar"] is None
    marks = data["terrain_strips"]["wave"]["marks"]
    assert marks["mean50"] == pytest.approx(5 + 190 * result.terrains["wave"].mean50, abs=0.01)
    assert marks["mean25"] < marks["mean50"] < marks["mean"]


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
    rows = [row("flat", f, level=None, score=0.5, interval=(0.25, 0.75), falls=f > 0.5) for f in (0.4, 0.8)]
    (panel,) = charts.sweep(rows, axis="friction", quantity="score")
    _, _, top, bottom = panel["frame"]
    for point in panel["points"]:
        assert point["whisker"] == [bottom - 0.25 * (bottom - top), bottom - 0.75 * (bottom - top)]
    assert [p["failed"] for p in panel["points"]] == [False, True]


def test_payloads_have_their_own_axis_at_the_nominal_friction():
    figures = report_data(sample(suite="gaitgauge-1", terrains=("flat", "wave")))["level_figures"]
    assert [f["title"] for f in figures] == ["over friction at payload 0 kg", "over payload at friction 0.6"]
    assert [len(p["points"]) for p in figures[1]["panels"]] == [5]


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
    rows = [row(level=6, search={5: True, 8: False, 7: False, 6: True}), row("flat", level=None)]
    (chart,) = charts.searches(rows)
    (line,) = chart["lines"]
    column = [round((x - chart["left"]) / chart["cell"]) + 1 for x in line["passed"] + line["failed"] + line["open"]]
    assert column == [5, 6, 7, 8, 1, 2, 3, 4, 9, 10]
    assert line["reached"] == chart["left"] + 5 * chart["cell"]


def test_search_that_passes_nothing_marks_no_level():
    (chart,) = charts.searches([row(level=0, search={5: False, 2: False, 1: False})])
    assert chart["lines"][0]["reached"] is None


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


def test_curves_over_little_have_ticks_that_differ():
    data = charts.curves({"a": [([0.000384, 0.000768], [-2e-5, 1e-5])]})
    x, y = (" ".join(t["label"] for t in data[f"{axis}_ticks"]) for axis in "xy")
    assert x == "0 0.0001 0.0002 0.0003 0.0004 0.0005 0.0006 0.0007"
    assert y == "−0.00002 −0.000015 −0.00001 −0.000005 0 0.000005 0.00001"
    assert charts.curves({"a": [([2e7], [1e6])]})["x_ticks"][-1]["label"] == "20000000"


def sweep_page(figures: dict[str, Any], names: list[str]) -> str:
    sweep = {"title": "", "name": "", "suite": "", "entries": [], "sentences": [], "runs": [], "compared": False}
    return page_template(folding.__file__, "sweep.html.j2").render(sweep=sweep, groups=[], names=names, figures=figures)


def test_a_curve_of_one_point_is_a_dot_and_an_entry_without_a_curve_is_in_no_legend():
    nothing = ([], [])
    data = charts.curves({"none": [nothing], "dot": [([1.0], [2.0])], "line": [([0.0, 1.0], [0.0, 1.0]), nothing]})
    page = sweep_page({"level": data}, ["none", "dot", "line"])
    assert re.findall(r'<(polyline|circle) class="curve (c\d)', page) == [("circle", "c1"), ("polyline", "c2")]
    assert re.findall(r'class="curve (c\d)" d="M0 5h26"/></svg>(\w+)', page) == [("c1", "dot"), ("c2", "line")]
    assert "Learning curves" not in sweep_page({"level": charts.curves({"none": [nothing]})}, ["none"])
    assert "Learning curves" not in sweep_page({}, ["none"])


@pytest.mark.parametrize(
    ("seeds", "legend"),
    [
        (1, "a line for each seed."),
        (2, "a line for each seed of an entry: first second."),
        (5, "a line for each seed of an entry: first second third fourth, then the same again."),
    ],
)
def test_seeds_of_a_sweep_s_entry_share_its_colour_and_differ_in_their_dashes(seeds, legend):
    data = charts.curves({name: [([0.0, 1.0], [0.0, 1.0])] * seeds for name in ("CTS", "HIM")})
    page = sweep_page({"level": data}, ["CTS", "HIM"])
    drawn = re.findall(r'<polyline class="curve (c\d d\d)"', page)
    dashes = [f"d{place % 4}" for place in range(seeds)]
    assert drawn == [f"{colour} {dash}" for colour in ("c0", "c1") for dash in dashes]
    (note,) = re.findall(r'<p class="note"><span.*', page)
    assert re.sub(" +", " ", re.sub("<[^>]*>", " ", note)).replace(" ,", ",").replace(" .", ".").strip() == (
        f"CTS HIM ; {legend}"
    )
    assert re.findall(r"curve c3 (d\d)", note) == (dashes[:4] if seeds > 1 else [])


def test_numbers_have_a_true_minus_and_no_negative_zero():
    assert [charts.number(value) for value in (-0.25, -0.0001, 0.0004, 1.5)] == ["−0.25", "0", "0", "1.5"]
