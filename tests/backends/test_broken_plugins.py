"""One broken engine breaks nothing but itself."""

import sys
from importlib.metadata import EntryPoint

import pytest
from gaitgauge.backends import BackendError, Scene, backend_class, make_backend
from gaitgauge.backends.registry import find_backend, list_backends
from gaitgauge.files import plugins as plugins_module
from gaitgauge.robots import load_robot
from gaitgauge.terrains.registry import make_terrain
from gaitgauge_fake_engine import FakeBackend

GO2 = load_robot("go2")


class RaisesWhenAsked(FakeBackend):
    @classmethod
    def capabilities(cls):
        raise KeyError("gpu")


class RaisesWhenBuilt(FakeBackend):
    def __init__(self, *arguments, **options):
        sys.exit("no licence")


NUMBER = 3
BROKEN = {
    "gone": ("no_such_module_anywhere:Engine", "failed: ModuleNotFoundError"),
    "nameless": (f"{__name__}:Missing", "failed: AttributeError"),
    "malformed": ("!!", "failed: "),
    "number": (f"{__name__}:NUMBER", "gave 'int'; it must be a subclass of PhysicsBackend"),
    "function": (f"{__name__}:load_robot", "gave 'function'"),
    "asked": (f"{__name__}:RaisesWhenAsked", "failed: KeyError: 'gpu'; mend or uninstall it"),
}


@pytest.fixture(autouse=True)
def installed(monkeypatch):
    values = {name: value for name, (value, _) in BROKEN.items()} | {"built": f"{__name__}:RaisesWhenBuilt"}
    found = [EntryPoint(name=n, value=v, group="gaitgauge.backends") for n, v in values.items()]
    monkeypatch.setitem(sys.modules, __name__, sys.modules[__name__])
    monkeypatch.setattr(plugins_module, "entry_points", lambda group: [e for e in found if e.group == group])


def test_all_can_be_listed_beside_the_broken_ones():
    names = [each.name for each in list_backends()]
    assert {"mujoco", "newton", *BROKEN, "built"} <= set(names)


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_plugin_is_refused_where_it_is_asked_for(name):
    for ask in (backend_class, lambda n: find_backend(n, "cpu")):
        with pytest.raises(BackendError, match=BROKEN[name][1]) as caught:
            ask(name)
        assert f"plug-in '{name}'" in str(caught.value)


def test_a_plugin_that_ends_the_program_does_not():
    scene = Scene(robot=GO2, parameters=GO2.parameters["gauge"], terrains=(make_terrain("flat"),), terrain_index=(0,))
    with pytest.raises(BackendError, match=r"plug-in 'built' .* failed: SystemExit: no licence"):
        make_backend("built", scene)
