"""``benchmarks/average_policies.py``: the mean of several policies' weights."""

import average_policies
import pytest
import torch
from gaitgauge.policy.contract import go2_contract
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import StoredNetwork, save_policy
from gaitgauge.policy.networks import MlpNetwork
from gaitgauge.robots import load_robot

GO2 = load_robot("go2")


def write(path, iteration, value, hidden=8):
    """A policy whose numbers are all ``value``, with a teacher that shares the first of them."""
    arguments = {"frame_width": 45, "num_actions": 12, "hidden": [hidden]}
    state = {name: torch.full_like(v, value) for name, v in MlpNetwork(**arguments).state_dict().items()}
    first = next(iter(state))
    extra = {
        "actor_state_dict": {"student": state[first], "steps": torch.tensor(7)},
        "critic_state_dict": {"mlp": torch.full((3,), value)},
        "iter": iteration,
    }
    network = StoredNetwork(architecture="mlp", arguments=arguments, state_dict=state)
    save_policy(path, go2_contract(GO2, provenance={"iteration": iteration}), network, extra=extra)
    return path


def test_the_mean_of_three(tmp_path):
    files = [write(tmp_path / f"{n}.pt", n, value) for n, value in ((20, 3.0), (30, 4.0), (10, -1.0))]
    out = tmp_path / "mean.gauge.pt"
    average_policies.main([str(out), *map(str, files)])
    entries = torch.load(out, weights_only=True)
    for key in ("state_dict", "actor_state_dict", "critic_state_dict"):
        for name, tensor in entries[key].items():
            assert (tensor == (7 if name == "steps" else 2)).all(), (key, name)
    assert entries["iter"] == 30
    assert load_policy(out).contract.provenance == {"iteration": 30, "mean_of_iterations": "10, 20, 30"}
    assert out.stat().st_size < 1.05 * files[0].stat().st_size, "what two entries share is stored once"


def test_policies_of_different_networks_have_no_mean(tmp_path):
    files = [write(tmp_path / f"{n}.pt", n, 1.0, hidden=n) for n in (8, 9)]
    with pytest.raises(SystemExit, match="different networks or contracts"):
        average_policies.main([str(tmp_path / "mean.pt"), *map(str, files)])
    assert not (tmp_path / "mean.pt").exists()
