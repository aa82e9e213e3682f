"""The action of an episode does not depend on the row it sits in."""

import pytest
import torch
from gaitgauge.policy.base import Policy, PolicySession, RowwiseSession
from gaitgauge.policy.batch_invariance import steady_session
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.export.files import export_onnx, export_torchscript
from gaitgauge.policy.foreign.fenced_policy import FencedPolicy
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import NativePolicy, StoredNetwork, save_policy
from gaitgauge.policy.networks.architectures import ARCHITECTURES, MlpNetwork
from gaitgauge.robots import load_robot

pytestmark = pytest.mark.usefixtures("programs_run_here")

ROBOT = load_robot("go2")


@pytest.fixture
def tiny(tmp_path):
    """A network so small that its products take other paths in other rows."""
    torch.manual_seed(0)
    arguments = {"frame_width": 45, "num_actions": 12, "hidden": [8], "history_length": 3}
    stored = StoredNetwork(architecture="mlp", arguments=arguments, state_dict=MlpNetwork(**arguments).state_dict())
    save_policy(tmp_path / "tiny.gauge.pt", standard_contract(ROBOT), stored)
    return load_policy(str(tmp_path / "tiny.gauge.pt"), ROBOT)


def play(session, observations, order):
    rows = []
    for step, observation in enumerate(observations):
        if step == 3:
            mask = torch.arange(len(order)) < 5
            session.reset(mask[order])
        rows.append(session.act(observation[order])[order.argsort()])
    return torch.stack(rows)


@pytest.mark.parametrize("count", [5, 24])
def test_rows_do_not_matter(tiny, count):
    observations = torch.randn(8, count, 45, generator=torch.Generator().manual_seed(1))
    orders = [torch.arange(count), torch.arange(count).flip(0), torch.arange(count).roll(3)]
    results = [play(steady_session(tiny, count)[0], observations, order) for order in orders]
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])
    assert torch.allclose(results[0], play(tiny.session(count), observations, orders[0]), atol=1e-6)


def test_the_shipped_policy_runs_batched():
    session, _ = steady_session(load_policy("pretrained", ROBOT), 24)
    assert not isinstance(session, RowwiseSession)


@pytest.mark.parametrize("architecture", ["ac_moe", "mcp", "him", "dreamwaq"])
def test_rows_of_the_other_methods_networks_do_not_matter(architecture):
    torch.manual_seed(0)
    arguments = {"primitives_blind_to": [6, 7, 8]} if architecture == "mcp" else {}
    state = ARCHITECTURES[architecture](**arguments).state_dict()
    stored = StoredNetwork(architecture=architecture, arguments=arguments, state_dict=state)
    session, _ = steady_session(NativePolicy(standard_contract(ROBOT), stored, path=architecture), 24)
    assert not isinstance(session, RowwiseSession)


@pytest.fixture(
    scope="module", params=["own", "torchscript", "onnx", pytest.param("row by row", marks=pytest.mark.slow)]
)
def policy(request, tmp_path_factory):
    """The shipped policy and its exports, and a network that needs each row alone."""
    own = load_policy("pretrained", ROBOT)
    if request.param == "own":
        return own
    path = tmp_path_factory.mktemp("exported") / "policy"
    if request.param == "row by row":
        return OverRows(own)
    export = export_torchscript if request.param == "torchscript" else export_onnx
    export(own, path)
    made = load_policy(path, ROBOT)
    assert isinstance(made, FencedPolicy)
    return made


class OverRows(Policy):
    """A policy whose rows influence each other, as one would whose file normalizes over the batch."""

    def __init__(self, inner: Policy) -> None:
        self._inner, self.contract, self.path = inner, inner.contract, inner.path

    def session(self, num_episodes: int, *, device: str = "cpu") -> PolicySession:
        session = self._inner.session(num_episodes, device=device)
        alone = session.act
        session.act = lambda observation, rows=None: alone(observation - observation.mean(), rows)
        return session


def test_the_number_of_episodes_does_not_matter(policy):
    """To the last bit: in runs of 1 to 30 episodes, wholly or in part at work, with resets on the way."""
    steps, most = 5, 30
    width = policy.contract.observation_width
    observations = torch.randn(steps, most, width, generator=torch.Generator().manual_seed(1))
    results = {}
    with torch.inference_mode():
        for count in (1, 5, 24, 30):
            session, fewer = steady_session(policy, count)
            actions = []
            for step, observation in enumerate(observations[:, :count]):
                if step == 3:
                    session.reset(torch.arange(count) % 3 == 0)
                rows = torch.arange(8) if fewer and count > 8 and step % 2 else None
                actions.append(session.act(observation, rows)[:8])
            results[count] = torch.stack(actions)
    for count, result in results.items():
        assert torch.equal(result, results[30][:, :count])


def test_alone_is_what_a_batch_of_one_gives(tiny):
    observations = torch.randn(6, 4, 45)
    rowwise, single = RowwiseSession(tiny.session, 4), tiny.session(1)
    for observation in observations:
        assert torch.equal(rowwise.act(observation)[2:3], single.act(observation[2:3]))
