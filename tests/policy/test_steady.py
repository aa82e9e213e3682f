"""The action of an episode does not depend on the row it sits in."""

import pytest
import torch
from gaitgauge.policy.base import RowwiseSession
from gaitgauge.policy.contract import go2_contract
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import StoredNetwork, save_policy
from gaitgauge.policy.networks import MlpNetwork
from gaitgauge.policy.steady import steady_session
from gaitgauge.robots import load_robot

ROBOT = load_robot("go2")


@pytest.fixture
def tiny(tmp_path):
    """A network so small that its products take other paths in other rows."""
    torch.manual_seed(0)
    arguments = {"frame_width": 45, "num_actions": 12, "hidden": [8], "history_length": 3}
    stored = StoredNetwork(architecture="mlp", arguments=arguments, state_dict=MlpNetwork(**arguments).state_dict())
    save_policy(tmp_path / "tiny.gauge.pt", go2_contract(ROBOT), stored)
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
    session, fewer = steady_session(load_policy("pretrained", ROBOT), 24)
    assert session.batched and fewer and not isinstance(session, RowwiseSession)


def test_alone_is_what_a_batch_of_one_gives(tiny):
    observations = torch.randn(6, 4, 45)
    rowwise, single = RowwiseSession(tiny.session, 4), tiny.session(1)
    for observation in observations:
        assert torch.equal(rowwise.act(observation)[2:3], single.act(observation[2:3]))
