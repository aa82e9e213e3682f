"""The task that prices turns on the spot, and its worlds at both ends of the feet's torsion."""

from types import SimpleNamespace

import pytest
import torch
import turns


def test_only_turns_on_the_spot_cost_and_both_sides_cost_the_same():
    command = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.5, 0.0, 1.0], [0.0, 0.0, 0.1]])
    rate = torch.tensor([0.6, 1.4, 3.0, 0.0, 0.0])
    velocity = torch.stack((torch.zeros(5), torch.zeros(5), rate), dim=1)
    cost = turns.turn_error(SimpleNamespace(command=command, base_angular_velocity_b=velocity))
    assert cost.tolist() == pytest.approx([0.4, 0.4, 1.0, 0.0, 0.0])


def test_worlds_get_their_feet_once_and_most_are_at_an_end():
    class Environment:
        cfg = SimpleNamespace(seed=0)
        backend = SimpleNamespace(randomize=lambda drawn: found.append(drawn.foot_torsion))

    found, environment = [], Environment()
    for _ in range(2):
        turns.feet_at_both_ends(environment, torch.zeros(2000, dtype=torch.bool))
    (torsion,) = found
    free, whole = (torsion == 0.0).float().mean().item(), (torsion == 1.0).float().mean().item()
    assert (free, whole) == pytest.approx((0.4, 0.4), abs=0.04)
    assert ((torsion > 0.0) & (torsion < 1.0)).float().mean().item() == pytest.approx(0.2, abs=0.04)
