"""Finding terrains by name: order, errors, plug-ins."""

import subprocess
import sys

import pytest
from gaitgauge.files import plugins as plugins_module
from gaitgauge.terrains import Terrain, TerrainError, gauge_terrain_names, make_terrain, terrain_names


class FakeEntryPoint:
    def __init__(self, name, loaded):
        self.name, self.value, self.dist, self._loaded = name, f"somewhere:{name}", None, loaded

    def load(self):
        if isinstance(self._loaded, Exception):
            raise self._loaded
        return self._loaded


@pytest.fixture
def plugins(monkeypatch):
    found = []
    monkeypatch.setattr(plugins_module, "entry_points", lambda group: found if group == "gaitgauge.terrains" else [])
    return found


def test_official_order():
    assert gauge_terrain_names() == ["flat", "slope_fd", "slope_bd", "stairs_fd", "stairs_bd", "wave", "obstacle"]
    assert terrain_names()[:7] == gauge_terrain_names()


@pytest.mark.parametrize("level", [0, 11, -1, 100])
@pytest.mark.parametrize("name", ["slope_fd", "stairs_bd", "wave", "obstacle"])
def test_level_out_of_range(name, level):
    with pytest.raises(TerrainError, match=f"'{name}' has levels 1 to 10, not {level}"):
        make_terrain(name, level)


def test_level_missing_or_no_whole_number():
    with pytest.raises(TerrainError, match="'wave' needs a level from 1 to 10"):
        make_terrain("wave")
    for level in (2.5, "3", True):
        with pytest.raises(TerrainError, match="whole number"):
            make_terrain("wave", level)


def test_flat_has_no_levels():
    assert make_terrain("flat", 0).name == "flat"
    with pytest.raises(TerrainError, match="'flat' has no levels"):
        make_terrain("flat", 1)


def test_unknown_name_offers_what_is_near_or_all_there_is():
    with pytest.raises(TerrainError, match=r"unknown terrain 'stair_fd'; did you mean 'stairs_fd'"):
        make_terrain("stair_fd", 1)
    with pytest.raises(TerrainError, match="choose one of: flat, slope_fd"):
        make_terrain("xyzzy", 1)
    assert issubclass(TerrainError, ValueError)


def test_plugin_terrain(plugins):
    plugins.append(FakeEntryPoint("gravel", lambda level: Terrain(name="gravel", family="gravel", level=level)))
    plugins.append(FakeEntryPoint("wave", lambda level: Terrain(name="not this one", family="x")))
    assert terrain_names() == [*gauge_terrain_names(), "gravel"]
    assert make_terrain("gravel", 17).level == 17
    assert make_terrain("gravel").level == 0
    assert make_terrain("wave", 1).name == "wave"


def test_broken_plugins_are_reported(plugins):
    def raises(level):
        raise KeyError("level")

    plugins += [
        FakeEntryPoint("missing", ImportError("no module 'gone'")),
        FakeEntryPoint("wrong", lambda level: level),
        FakeEntryPoint("raises", raises),
        FakeEntryPoint("exits", sys.exit),
        FakeEntryPoint("number", 3),
    ]
    assert terrain_names()[-1] == "wrong"
    for name, message in (
        ("missing", r"plug-in 'missing' \(somewhere:missing\) failed: ImportError: no module 'gone'"),
        ("wrong", "must return a Terrain, not int"),
        ("raises", "failed: KeyError: 'level'; mend or uninstall it"),
        ("exits", "failed: SystemExit: 1"),
        ("number", "failed: TypeError"),
    ):
        with pytest.raises(TerrainError, match=message):
            make_terrain(name, 1)


def test_the_room_needs_no_engine():
    code = (
        "import sys, gaitgauge.terrains as t; t.make_terrain('wave', 3).height(1, 1);"
        "print({'torch', 'mujoco', 'warp'} & set(sys.modules))"
    )
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
        == "set()"
    )
