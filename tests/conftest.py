"""What all tests share."""

import gc
import os
from collections.abc import Iterator
from functools import cache
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
def commands_are_built_once() -> Iterator[None]:
    """Typer's runner builds all commands anew for every line, which takes longer than most lines do."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("typer.testing._get_command", cache(typer.main.get_command))
        yield
