import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from gaitgauge.gauge.evaluate import Request
from gaitgauge.gauge.play import progress
from tiny_runs import evaluate, tiny_request


@pytest.fixture
def request_for(tmp_path, monkeypatch) -> Callable[..., Request]:
    """Makes requests for a tiny suite on an engine without physics; progress is told at every turn."""
    monkeypatch.setattr(progress, "_WATCH_INTERVAL", 0.0)
    return lambda *base, **choices: tiny_request(tmp_path, *base, **choices)


@pytest.fixture(scope="session")
def whole_run(tmp_path_factory) -> tuple[Request, Path]:
    """A request and the folder of its run, which stays as it is."""
    folder = tmp_path_factory.mktemp("whole")
    request = tiny_request(folder)
    evaluate(request, folder / "run")
    return request, folder / "run"


@pytest.fixture
def finished(whole_run, tmp_path) -> tuple[Request, Path]:
    """The same with a copy of the folder, to be changed."""
    request, folder = whole_run
    return request, Path(shutil.copytree(folder, tmp_path / "run"))
