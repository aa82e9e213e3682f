"""A metric from outside: found through an entry point, weighed by a suite, played to the score, and shown in the report."""

import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import torch
from gaitgauge.files import plugins as plugins_module
from gaitgauge.gauge.metrics import Metric, MetricError, find_metric, metric_groups, metric_label, metric_names
from gaitgauge.gauge.report.page import write_report
from gaitgauge.gauge.suite import SuiteError, load_suite
from tiny_runs import evaluate, tiny_request

FEET = Metric(
    function=lambda at: 1.0 - at.state.foot_position_w[:, :, 2].std(1),
    state=("foot_position_w",),
    label="level feet <of all legs>",
    short_label="feet",
    group="quality",
)
"""Reads a column that no metric of the project needs, of shape (N, feet, 3)."""
NUMBER = 3
UNKNOWN_COLUMN = Metric(function=lambda at: at.friction, state=("mood",), label="mood")
UNDECLARED = Metric(function=lambda at: at.state.joint_velocity[:, 0], state=("joint_position",), label="undeclared")
RAISES = Metric(function=lambda at: 1 / 0, state=(), label="raises")
SHAPELESS = Metric(function=lambda at: at.command, state=(), label="shapeless")
REFUSES = Metric(function=lambda at: at.friction, state=(), label="refuses", prepare=lambda constants: {}["arm"])
PLUGINS = {
    "level_feet": "FEET",
    "gone": "MISSING",
    "number": "NUMBER",
    "mood": "UNKNOWN_COLUMN",
    "undeclared": "UNDECLARED",
    "raises": "RAISES",
    "shapeless": "SHAPELESS",
    "refuses": "REFUSES",
}


@pytest.fixture(autouse=True)
def installed(monkeypatch):
    found = [EntryPoint(name=n, value=f"{__name__}:{v}", group="gaitgauge.metrics") for n, v in PLUGINS.items()]
    engines = list(plugins_module.entry_points("gaitgauge.backends"))
    monkeypatch.setitem(sys.modules, __name__, sys.modules[__name__])
    monkeypatch.setattr(
        plugins_module, "entry_points", lambda group: [e for e in (*found, *engines) if e.group == group]
    )


def request_with(folder: Path, metric: str):
    """A request for the tiny suite with one more metric."""
    request = tiny_request(folder, terrains=("flat",))
    groups = f'groups = {{ tracking = ["lin_vel_err"], quality = ["{metric}"] }}\n'
    weights = f"[metrics.weights]\nlin_vel_err = 1.0\n{metric} = 2.0\n"
    Path(request.suite).write_text(Path(request.suite).read_text() + groups + weights)
    return request


def test_a_metric_from_outside_counts_in_the_score(tmp_path):
    request = request_with(tmp_path, "level_feet")
    results = evaluate(request, tmp_path / "run")
    assert results.score is not None
    assert 0.0 < results.metrics["level_feet"].mean <= 1.0
    assert results.groups.keys() == {"tracking", "quality"}
    write_report(tmp_path / "run")
    page = (tmp_path / "run" / "report.html").read_text()
    assert "level feet &lt;of all legs&gt;" in page


def test_labels_groups_and_names_come_from_the_table():
    assert metric_names()[:2] == ["lin_vel_err", "ang_vel_err"] and "level_feet" in metric_names()
    assert metric_label("level_feet", short=True) == "feet" and metric_label("zmp_margin", short=True) == "ZMP margin"
    assert metric_label("not_installed") == "not installed" and metric_label("number") == "number"
    assert metric_groups(["level_feet", "lin_vel_err", "other"]) == {
        "tracking": ["lin_vel_err"],
        "quality": ["level_feet"],
    }


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("gone", "plug-in 'gone' .* failed: AttributeError"),
        ("number", "plug-in 'number' .* gave 'int'; it must be a Metric"),
        ("mood", "plug-in 'mood' .* reads the state 'mood'; choose from time, base_position_w"),
    ],
)
def test_a_broken_metric_is_refused_with_the_suite(name, message, tmp_path):
    with pytest.raises(MetricError, match=message):
        find_metric(name)
    with pytest.raises(SuiteError, match=message):
        load_suite(request_with(tmp_path, name).suite)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("undeclared", "a metric reads 'joint_velocity' of the state; name it in the metric's 'state'"),
        ("raises", "plug-in 'raises' .* failed: ZeroDivisionError: division by zero; mend or uninstall it"),
        ("shapeless", r"metric 'shapeless' gave \[\d+, 3\]; it must give a tensor of shape \[\d+\]"),
        ("refuses", "plug-in 'refuses' .* failed: KeyError: 'arm'"),
    ],
)
def test_a_metric_that_fails_while_it_is_measured_is_named(name, message, tmp_path):
    with pytest.raises(MetricError, match=message):
        evaluate(request_with(tmp_path, name), tmp_path / "run")


def test_the_function_of_a_plugin_gets_what_it_declares():
    values = find_metric("level_feet").function
    state = type("State", (), {"foot_position_w": torch.zeros(2, 4, 3)})
    assert values(type("At", (), {"state": state})).tolist() == [1.0, 1.0]
