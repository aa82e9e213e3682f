import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from gaitgauge.cli.main import app
from gaitgauge.cli.play_session import PlaySession
from gaitgauge.cli.requests import PlayRequest
from gaitgauge.cli.worlds import WorldMaker
from gaitgauge.policy.contract import PolicyContract, standard_contract
from gaitgauge.policy.native import StoredNetwork, save_policy
from gaitgauge.policy.networks.architectures import MlpNetwork
from gaitgauge.robots import load_robot
from typer.testing import CliRunner, Result

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(autouse=True)
def no_films(monkeypatch: pytest.MonkeyPatch) -> None:
    """Evaluations film nobody: it takes seconds, and not every machine can draw."""
    monkeypatch.setattr("gaitgauge.cli.clip.make_clip", lambda folder, results, options: None)
    monkeypatch.setattr("gaitgauge.cli.clip.FilmTime._find", lambda self: None)


@pytest.fixture(autouse=True)
def no_remembered_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Times of command lines stay out of the user's cache."""
    monkeypatch.setattr("gaitgauge.cli.progress.folder_of_times", lambda: tmp_path / "times")


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Result]:
    """Runs a command line in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def invoke(*arguments: object) -> Result:
        return CliRunner().invoke(app, [str(a) for a in arguments])

    return invoke


@pytest.fixture
def refused(run: Callable[..., Result]) -> Callable[..., str]:
    """Runs a command line that must end with one clear sentence, and returns it."""

    def invoke(*arguments: object) -> str:
        result = run(*arguments)
        assert result.exit_code not in (0, None)
        assert result.exception is None or isinstance(result.exception, SystemExit), repr(result.exception)
        lines = result.stderr.splitlines()
        assert len(lines) == 1, result.stderr
        assert lines[0].startswith("gaitgauge: ")
        assert "Traceback" not in result.output
        return lines[0].removeprefix("gaitgauge: ")

    return invoke


@pytest.fixture(scope="session")
def contract() -> PolicyContract:
    return standard_contract(load_robot("go2"))


@pytest.fixture(scope="session")
def stored() -> StoredNetwork:
    """A network that holds the standing pose."""
    arguments = {"frame_width": 45, "num_actions": 12, "hidden": [8]}
    network = MlpNetwork(**arguments)
    zeros = {name: torch.zeros_like(value) for name, value in network.state_dict().items()}
    return StoredNetwork(architecture="mlp", arguments=arguments, state_dict=zeros)


@pytest.fixture
def policy(tmp_path: Path, contract: PolicyContract, stored: StoredNetwork) -> Path:
    """A policy that stands still, beside the folder of the command line."""
    path = tmp_path / "standing.gauge.pt"
    save_policy(path, contract, stored)
    return path


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run directory of two iterations of go2-flat."""
    from small_run import FAKE, SMALL

    root = tmp_path_factory.mktemp("logs")
    arguments = ["train", "go2-flat", *FAKE, "--iterations", 2, "--seed", 5, "--log-root", root, *SMALL]
    result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    (run,) = (root / "go2_flat").iterdir()
    assert str(run) in result.output.replace("\n", "")
    return run


@pytest.fixture
def session(policy: Path) -> Iterator[Callable[..., PlaySession]]:
    """Makes worlds in which that policy stands."""
    made = []

    def make(
        terrain: str = "flat", level: int | None = None, friction: float = 0.8, policy: Path = policy, **options: str
    ) -> PlaySession:
        maker = WorldMaker(PlayRequest(policies=(), device="cpu", **options))
        made.append(maker.make(str(policy), terrain, level, friction, "standing"))
        return made[-1]

    yield make
    for played in made:
        played.close()
