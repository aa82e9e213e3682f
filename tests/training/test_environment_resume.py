"""Saving and continuing: on an engine that remembers nothing else, continuing equals never having stopped."""

import pytest
import torch
from gaitgauge.training.configuration import ConfigurationError
from gaitgauge.training.environment.configuration import (
    CommandConfiguration,
    CommandStage,
    ObservationConfiguration,
    PushConfiguration,
    Ramp,
    ResetConfiguration,
    ScheduleConfiguration,
)
from gaitgauge_fake_engine import FakeScript
from small_environment import STAIRS, make

BUSY = {
    "terrain": STAIRS,
    "push": PushConfiguration(interval=0.1),
    "reset": ResetConfiguration(),
    "schedule": ScheduleConfiguration(horizon_steps=40),
    "commands": CommandConfiguration(
        stages=(
            CommandStage(begin=0.0, forward=(-0.5, 0.5), lateral=(-0.5, 0.5), yaw=(-1.0, 1.0)),
            CommandStage(begin=0.5, forward=(-2.0, 2.0), lateral=(-1.0, 1.0), yaw=(-2.0, 2.0)),
        ),
        interval=0.1,
        stationary_probability=Ramp(start=0.1, end=0.5),
    ),
    "log_interval": 5,
    "episode_length": 0.5,
}


def busy(seed=0, policy=()):
    environment = make(12, seed=seed, script=FakeScript(), observations=ObservationConfiguration(policy=policy), **BUSY)
    environment.episode_length_buf = torch.arange(12) % 20
    return environment


def run(environment, steps, seed):
    random = torch.Generator().manual_seed(seed)
    rows = []
    for _ in range(steps):
        observations, reward, done, extras = environment.step(torch.randn(12, 12, generator=random) * 0.3)
        rows.append({**observations, "reward": reward, "done": done, **extras, **extras.get("log", {})})
        rows[-1].pop("log", None)
    return rows


def same(left, right):
    assert len(left) == len(right)
    for step, (a, b) in enumerate(zip(left, right, strict=True)):
        assert a.keys() == b.keys()
        for name in a:
            assert torch.equal(a[name], b[name]), (step, name)


@pytest.mark.parametrize("policy", [(), ("height_scan", "action_before_last")])
def test_continuing_equals_never_having_stopped(tmp_path, policy):
    straight = busy(policy=policy)
    run(straight, 17, 1)
    torch.save(straight.state_dict(), tmp_path / "state.pt")
    expected = run(straight, 30, 2)
    assert sum(row["done"].sum() for row in expected) > 12

    resumed = busy(seed=99, policy=policy)
    run(resumed, 3, 5)
    resumed.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    same(run(resumed, 30, 2), expected)
    assert resumed.common_step_counter == straight.common_step_counter == 47


def test_a_run_from_before_past_maps_were_kept_goes_on():
    environment = busy(policy=("height_scan",))
    run(environment, 5, 1)
    saved = environment.state_dict()
    del saved["seen_before"]
    environment.load_state_dict(saved)
    run(environment, 1, 2)


def test_observations_come_back():
    environment = busy()
    run(environment, 5, 1)
    saved, before = environment.state_dict(), environment.get_observations()
    run(environment, 5, 2)
    environment.load_state_dict(saved)
    after = environment.get_observations()
    assert all(torch.equal(before[name], after[name]) for name in ("policy", "history", "privileged"))


def test_a_run_from_before_steps_of_rewards_were_counted_goes_on():
    environment = busy()
    run(environment, 5, 1)
    saved = environment.state_dict()
    del saved["memory"]["episode_steps"]
    environment.load_state_dict(saved)
    memory = environment.parts.memory
    assert memory.episode_steps.tolist() == memory.episode_length.tolist()


def test_a_saved_state_does_not_change_with_the_run():
    environment = busy()
    run(environment, 5, 1)
    saved = environment.state_dict()
    step, level = saved["memory"]["step"].clone(), saved["physics"]["base_position_w"].clone()
    run(environment, 5, 1)
    assert torch.equal(saved["memory"]["step"], step) and torch.equal(saved["physics"]["base_position_w"], level)


def test_states_of_other_environments_are_refused():
    environment = busy()
    state = environment.state_dict()
    with pytest.raises(ValueError, match="has version 7, this program reads 1"):
        environment.load_state_dict({**state, "version": 7})
    with pytest.raises(ValueError, match=r"'episode_length' has shape \(12,\), this environment needs \(8,\)"):
        make(8, **BUSY).load_state_dict(state)


def test_progress_without_episodes(tmp_path):
    """Levels, schedules and bodies survive; episodes begin anew on those levels, and move none of them by beginning."""
    reached = busy()
    run(reached, 17, 1)
    level = torch.arange(12) % 3
    reached.parts.memory.level.copy_(level)
    reached.parts.memory.diverged_total.fill_(7)
    torch.save(reached.progress_dict(), tmp_path / "progress.pt")

    resumed = busy(seed=99)
    run(resumed, 3, 5)
    resumed.load_state_dict(torch.load(tmp_path / "progress.pt", weights_only=True))
    memory = resumed.parts.memory
    assert torch.equal(memory.level, level) and resumed.common_step_counter == 17 and int(memory.diverged_total) == 7
    assert torch.equal(resumed.parts.progress(), reached.parts.progress())
    assert int(memory.episode_length.abs().sum()) == 0 and torch.equal(memory.history[:, :-1], memory.history[:, 1:])
    kinds, variants = resumed.palette.index, memory.terrain_index
    assert all(int(variants[i]) in kinds[resumed.kind[i], level[i]].tolist() for i in range(12))
    for name, value in reached.progress_dict()["bodies"].items():
        assert torch.equal(resumed.progress_dict()["bodies"][name], value), name
    run(resumed, 5, 2)


def test_progress_of_other_worlds_is_refused():
    progress = busy().progress_dict()
    with pytest.raises(ValueError, match="12 worlds, this environment 8"):
        make(8, **BUSY).load_state_dict(progress)


def test_a_run_can_begin_in_the_middle_of_its_schedule():
    environment = make(12, **{**BUSY, "schedule": ScheduleConfiguration(horizon_steps=40, begin=0.5)})
    assert float(environment.parts.progress()) == 0.5
    run(environment, 4, 1)
    assert float(environment.parts.progress()) == pytest.approx(0.6)
    with pytest.raises(ConfigurationError, match=r"schedule\.begin is 2"):
        make(12, **{**BUSY, "schedule": ScheduleConfiguration(begin=2.0)})
