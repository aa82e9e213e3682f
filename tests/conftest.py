"""What all tests share."""

import gc
import os
import signal
import sys
from collections.abc import Iterator
from copy import copy
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

# Two workers with two threads each wait for each other on two cores; to be said before anything imports torch.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import typer

# Programs that tests start find the scripted engine as pytest does: a folder on the import path is an installation to Python.
_FAKE_ENGINE = str(Path(__file__).parent / "fake_engine")
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (_FAKE_ENGINE, os.environ.get("PYTHONPATH"))))


def pytest_collection_finish() -> None:
    """Leave what the packages made when they were imported out of every later search for garbage."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def nothing_is_found_twice() -> Iterator[None]:
    """Typer's runner builds all commands anew for every line, and Python searches all that is installed for every plug-in.

    Either takes longer than most of what is tested.
    """
    found = cache(lambda group, path: entry_points(group=group))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("typer.testing._get_command", cache(typer.main.get_command))
        patch.setattr("gaitgauge.files.plugins.entry_points", lambda group: found(group, tuple(sys.path)))
        yield


@pytest.fixture(scope="session", autouse=True)
def robots_that_ship_are_read_once() -> Iterator[None]:
    """Nearly every test begins with one of them, and takes longer to read and compile it than for anything else."""
    import mujoco
    from gaitgauge.robots import loading, registry

    own, folder = registry._own(), Path(registry.__file__).resolve().parent
    named, files, compiled = registry._named, loading.model_files, mujoco.MjModel.from_xml_path
    known, listed, model = cache(named), cache(files), cache(compiled)

    def ships(path: str | Path, *others: object) -> bool:
        return not any(others) and Path(path).is_relative_to(folder)

    def model_files(mjcf: Path, *, within: Path | None = None) -> list[Path]:
        return list(listed(mjcf)) if ships(mjcf, within) else files(mjcf, within=within)

    def from_xml_path(path: str, *assets: object) -> mujoco.MjModel:
        return copy(model(path)) if ships(path, *assets) else compiled(path, *assets)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "_named", lambda text: known(text) if text in own else named(text))
        patch.setattr(loading, "model_files", model_files)
        patch.setattr(mujoco.MjModel, "from_xml_path", staticmethod(from_xml_path))
        yield


@pytest.fixture
def hangups() -> Iterator[None]:
    """SIGHUP ends a process, as in a terminal, also where the tests run under nohup, which hands on that it is ignored."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)
