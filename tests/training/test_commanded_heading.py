"""The heading that commands ask for: what progress and the commanded way are measured along."""

from dataclasses import replace

import pytest
import torch
from gaitgauge.terrains.height_scan import heading
from gaitgauge.training.environment.configuration import (
    CommandConfiguration,
    CommandStage,
    Ramp,
    RewardConfiguration,
    TerminationConfiguration,
)
from gaitgauge_fake_engine import FakeScript
from small_environment import FLAT, gliding, idle, make


def commanded(environment, forward, yaw):
    """Command the same to all worlds for good, held where it is straight, and return where they head."""
    memory = environment.parts.memory
    memory.holds_heading.fill_(yaw == 0.0)
    memory.command.copy_(torch.tensor([forward, 0.0, yaw]).expand(environment.num_envs, 3))
    memory.command_steps.fill_(1000)
    return memory, memory.commanded_heading.clone()


def test_who_turns_away_is_still_led_straight_ahead():
    environment = make(4, script=gliding(0.0, 0.0, 4.0))
    memory, ahead = commanded(environment, 1.0, 0.0)
    idle(environment, 39)
    assert torch.allclose(memory.commanded_heading, ahead)
    assert not torch.allclose(heading(environment.backend.state.base_quaternion_w).float(), ahead, atol=1.0)
    assert torch.allclose(memory.commanded_way, 0.78 * ahead, atol=1e-3)
    assert memory.commanded_farthest.tolist() == pytest.approx([0.78] * 4, abs=1e-3)


@pytest.mark.parametrize("turns", [0.0, 4.0])
def test_an_arc_leads_round_whether_the_robot_turns_or_not(turns):
    environment = make(4, script=gliding(0.0, 0.0, turns), rewards=RewardConfiguration(progress_along="command"))
    memory, ahead = commanded(environment, 1.0, 4.0)
    idle(environment, 39)
    # Half a turn at 4 rad/s and 1 m/s: a half circle of radius 0.25 m.
    assert torch.allclose(memory.commanded_heading, -ahead, atol=0.03)
    assert memory.commanded_way.norm(dim=1).tolist() == pytest.approx([0.5] * 4, abs=0.02)
    idle(environment, 39)
    assert memory.commanded_way.norm(dim=1).tolist() == pytest.approx([0.0] * 4, abs=0.03)
    assert memory.commanded_farthest.tolist() == pytest.approx([0.5] * 4, abs=0.02)


def test_a_new_command_sets_out_from_the_robot_s_own_heading():
    environment = make(4, script=gliding(0.0, 0.0, 4.0))
    memory, ahead = commanded(environment, 1.0, 0.0)
    idle(environment, 20)
    memory.command_steps.copy_(torch.tensor([1, 1, 1000, 1000]))
    idle(environment)
    own = heading(environment.backend.state.base_quaternion_w).float()
    assert torch.allclose(memory.commanded_heading[:2], own[:2], atol=1e-5)
    assert torch.allclose(memory.commanded_heading[2:], ahead[2:])


def test_the_way_back_to_a_heading_is_not_turned_round_with_the_command():
    tile = replace(FLAT.tiles[0], reversal_probability=1.0)
    environment = make(
        64,
        script=gliding(0.0, 0.0, 1.0),
        terrain=replace(FLAT, tiles=(tile,)),
        commands=CommandConfiguration(heading_gain=1.0),
    )
    memory, _ = commanded(environment, 0.5, 0.0)
    idle(environment, 10)
    assert (memory.command[:, 2] < -0.1).all(), "it leads back"
    memory.command_steps.fill_(1)
    idle(environment)
    assert memory.command[:, 0].tolist() == pytest.approx([-0.5] * 64)
    assert memory.command[:, 2].abs().max() < 1e-5 and not memory.holds_heading.all()


def test_an_episode_sets_out_from_the_heading_of_its_start():
    fall = torch.tensor([0.1, float("inf")], dtype=torch.float64)
    environment = make(2, script=FakeScript(fall_time=fall))
    memory, ahead = environment.parts.memory, environment.parts.memory.commanded_heading.clone()
    assert torch.allclose(ahead, heading(environment.backend.state.base_quaternion_w).float(), atol=1e-5)
    memory.command.zero_()
    memory.command_steps.fill_(1000)
    while not idle(environment)[2].any():
        pass
    own = heading(environment.backend.state.base_quaternion_w).float()
    assert torch.allclose(memory.commanded_heading, own, atol=1e-5)
    assert not torch.allclose(memory.commanded_heading[0], ahead[0], atol=1e-3)


@pytest.mark.parametrize(
    ("along", "held", "free"),
    [("command", 0.78, 0.78), ("straight", 0.78, 0.5), ("base", 0.5, 0.5)],  # 0.5: half a circle
)
def test_progress_may_be_counted_along_whichever_way_the_robot_heads(along, held, free):
    environment = make(4, script=gliding(0.0, 0.0, 4.0), rewards=RewardConfiguration(progress_along=along))
    memory, _ = commanded(environment, 1.0, 0.0)
    memory.holds_heading.copy_(torch.tensor([True, True, False, False]))
    idle(environment, 39)
    assert memory.commanded_way.norm(dim=1).tolist() == pytest.approx([held, held, free, free], abs=0.02)


@pytest.mark.parametrize(
    ("rewards", "stuck"),
    [
        (RewardConfiguration(progress_along="command"), True),
        pytest.param(RewardConfiguration(), False, marks=pytest.mark.slow),
    ],
)
def test_who_walks_an_arc_without_turning_fast_enough_is_not_stuck(rewards, stuck):
    environment = make(
        2,
        script=gliding(1.0, 0.0, 0.6),
        rewards=rewards,
        termination=TerminationConfiguration(stuck=0.5, stuck_from=0.0),
    )
    memory, _ = commanded(environment, 1.0, 2.0)
    memory.holds_heading.fill_(False)
    assert any(bool(idle(environment)[2].any()) for _ in range(150)) == stuck


def test_a_run_from_before_headings_were_remembered_goes_on():
    environment = make(4)
    idle(environment, 5)
    saved = environment.state_dict()
    del saved["memory"]["commanded_heading"], saved["memory"]["holds_heading"]
    environment.load_state_dict(saved)
    own = heading(environment.backend.state.base_quaternion_w).float()
    assert torch.allclose(environment.parts.memory.commanded_heading, own, atol=1e-5)


def straight(gain, share=1.0):
    """Commands that are all 0.5 m/s straight ahead, or arcs."""
    return CommandConfiguration(
        stages=(CommandStage(begin=0.0, forward=(0.5, 0.5), lateral=(0.0, 0.0), yaw=(-0.6, 0.6)),),
        dynamic=False,
        straight_probability=share,
        extreme_probability=0.0,
        stationary_probability=Ramp(start=0.0, end=0.0),
        heading_gain=gain,
    )


@pytest.mark.parametrize(
    ("turns", "steps", "expected"), [(0.5, 40, -0.8), (-0.5, 10, 0.2), (2.0, 40, -1.2), (0.0, 9, 0.0)]
)
def test_straight_commands_lead_back_to_their_heading(turns, steps, expected):
    """Who turned by 0.4 rad is told to turn back at twice that rate, and at no more than the range of 0.6 rad/s allows."""
    environment = make(4, script=gliding(0.0, 0.0, turns), commands=straight(2.0))
    memory = environment.parts.memory
    ahead = memory.commanded_heading.clone()
    idle(environment, steps)
    assert memory.command[:, 2].tolist() == pytest.approx([max(min(expected, 0.6), -0.6)] * 4, abs=0.03)
    assert torch.allclose(memory.commanded_heading, ahead), "what leads back does not turn the heading itself"
    seen = environment.get_observations()["policy"][:, 8]
    assert torch.allclose(seen, 0.25 * memory.command[:, 2], atol=1e-5), "the policy is told"


def test_arcs_and_straight_commands_without_a_gain_are_left_alone():
    environment = make(16, script=gliding(0.0, 0.0, 0.5), commands=straight(2.0, share=0.0))
    before = environment.parts.memory.command.clone()
    idle(environment, 20)
    assert torch.equal(environment.parts.memory.command, before) and before[:, 2].abs().min() > 0
    environment = make(4, script=gliding(0.0, 0.0, 0.5), commands=straight(0.0))
    idle(environment, 20)
    assert environment.parts.memory.command[:, 2].tolist() == [0.0] * 4
