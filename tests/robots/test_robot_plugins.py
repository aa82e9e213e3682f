"""Robots that other packages bring."""

import sys
from dataclasses import replace
from importlib.metadata import EntryPoint

import pytest
from gaitgauge.files import plugins as plugins_module
from gaitgauge.robots import Robot, RobotError, load_robot, robot_names

GO2 = load_robot("go2")
OWN = robot_names()


PLUGIN_PATH = ""


def plugin_robot() -> Robot:
    return replace(GO2, name="plugged")


def plugin_nonsense() -> int:
    return 3


def plugin_that_exits() -> Robot:
    raise SystemExit(3)


def plugin_that_raises() -> Robot:
    raise KeyError("x")


def plugin_out_of_range() -> Robot:
    return replace(GO2, name="plugged", stand_height=-1)


@pytest.fixture
def install_plugin(monkeypatch):
    """Pretends that a package with one entry point is installed."""

    def install(name: str, value: str) -> None:
        monkeypatch.setitem(sys.modules, "robot_plugin", sys.modules[__name__])
        found = [EntryPoint(name=name, value=value, group="gaitgauge.robots")]
        monkeypatch.setattr(plugins_module, "entry_points", lambda group: [e for e in found if e.group == group])

    return install


def test_plugin_callable(install_plugin):
    install_plugin("plugged", "robot_plugin:plugin_robot")
    assert robot_names() == [*OWN, "plugged"]
    assert load_robot("plugged") == plugin_robot()


def test_plugin_path(install_plugin, write_hopper, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "PLUGIN_PATH", str(write_hopper()))
    install_plugin("hopper", "robot_plugin:PLUGIN_PATH")
    assert load_robot("hopper").title == "One leg"


def test_plugin_does_not_replace_an_own_robot(install_plugin):
    install_plugin("go2", "robot_plugin:plugin_robot")
    assert robot_names() == OWN
    assert load_robot("go2") == GO2


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        (
            "plugged",
            "no_such_module_anywhere:robot",
            "failed: ModuleNotFoundError: No module named 'no_such_module_anywhere'",
        ),
        ("plugged", "robot_plugin:no_such_attribute", "failed: AttributeError"),
        ("plugged", "robot_plugin:plugin_that_exits", "failed: SystemExit: 3; mend or uninstall it"),
        ("plugged", "robot_plugin:plugin_that_raises", "failed: KeyError: 'x'"),
        ("plugged", "robot_plugin:plugin_out_of_range", "stand_height is -1; it must be greater than 0"),
        ("plugged", "not an entry point", "failed: AttributeError"),
        ("plugged", "robot_plugin:plugin_nonsense", "gave int; it must be a path or a callable"),
        (
            "other",
            "robot_plugin:plugin_robot",
            "a robot named 'plugged'; entry point and robot must share a name",
        ),
    ],
)
def test_broken_plugin(install_plugin, name, value, message):
    install_plugin(name, value)
    with pytest.raises(RobotError) as caught:
        load_robot(name)
    assert message in str(caught.value)
