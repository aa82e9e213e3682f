import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from gaitgauge.policy.base import PolicySession
from gaitgauge.policy.contract import PolicyContract, standard_contract
from gaitgauge.policy.native import StoredNetwork, save_policy
from gaitgauge.policy.networks.architectures import CtsNetwork
from gaitgauge.robots import Robot, load_robot

# The foreign programs are shared by several test files.
sys.path.insert(0, str(Path(__file__).parent))

SMALL_CTS = {"latent_width": 8, "encoder_hidden": [32, 16], "actor_hidden": [32, 16]}


@pytest.fixture(scope="session")
def go2() -> Robot:
    return load_robot("go2")


@pytest.fixture(scope="session")
def contract(go2: Robot) -> PolicyContract:
    return standard_contract(go2)


@pytest.fixture(scope="session")
def cts_network() -> CtsNetwork:
    """A small random CTS network."""
    torch.manual_seed(0)
    return CtsNetwork(**SMALL_CTS).eval().requires_grad_(False)


@pytest.fixture(scope="session")
def cts_stored(cts_network: CtsNetwork) -> StoredNetwork:
    return StoredNetwork(architecture="cts", arguments=SMALL_CTS, state_dict=cts_network.state_dict())


@pytest.fixture
def cts_file(tmp_path: Path, contract: PolicyContract, cts_stored: StoredNetwork) -> Path:
    path = tmp_path / "cts.gauge.pt"
    save_policy(path, contract, cts_stored)
    return path


@pytest.fixture(scope="session")
def run() -> Callable[[PolicySession, torch.Tensor], torch.Tensor]:
    """Gives the actions of a session over all steps from a reset; row 2 is reset once more before step 6."""

    def run_session(session: PolicySession, observations: torch.Tensor) -> torch.Tensor:
        session.reset()
        actions = []
        for step, observation in enumerate(observations):
            if step == 6:
                session.reset(torch.arange(observation.shape[0]) == 2)
            actions.append(session.act(observation))
        return torch.stack(actions)

    return run_session


@pytest.fixture(scope="session")
def observations() -> torch.Tensor:
    """Random observations of 4 episodes over 10 steps, (10, 4, 45)."""
    return torch.randn(10, 4, 45, generator=torch.Generator().manual_seed(1))
