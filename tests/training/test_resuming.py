"""What a resumed run takes over where it is not quite the run that wrote the checkpoint."""

import pytest
import torch
from gaitgauge.training.environment_configuration import ScheduleConfiguration
from gaitgauge.training.resuming import resume_run
from gaitgauge.training.runner import TrainingRunner
from gaitgauge.training.seeding import seed_everything
from small_environment import STAIRS, make
from toy_training import toy_configuration

SHARE = 36 / 75
"""Of the schedules after 6 iterations of 6 steps."""


def build(folder=None, seed=0, message=None, processes=None, **run):
    seed_everything(seed)
    environment = make(num_envs=8, terrain=STAIRS, seed=seed, schedule=ScheduleConfiguration(horizon_steps=75))
    return TrainingRunner(
        environment,
        toy_configuration(steps=6, run={"random_episode_start": True, **run}),
        contract=environment.contract,
        task="toy",
        log_dir=folder,
        message=message,
        processes=processes,
    )


def trained(folder, **run):
    """A run of 6 iterations whose worlds are all on the last level, and its checkpoint."""
    runner = build(folder, **run)
    runner.learn(5)
    runner.env.parts.memory.level.fill_(2)
    runner.env.parts.memory.moves_level.zero_()
    runner.learn(1)
    return runner, folder / "model_6.pt"


def edit(path, **training):
    """Replace entries of a checkpoint's training state."""
    entries = torch.load(path, weights_only=True)
    entries["training"] |= training
    torch.save(entries, path)


@pytest.mark.parametrize("keep_episodes", [True, False])
def test_another_number_of_processes_goes_on_with_schedules_and_levels(tmp_path, keep_episodes):
    reached, path = trained(tmp_path, keep_episodes=keep_episodes)
    levels = reached.env.parts.memory.level
    edit(path, world_size=2)
    said = []
    resumed = build(seed=5, message=said.append)
    bodies = resumed.env.progress_dict()["bodies"]
    resume_run(resumed, path)
    assert float(resumed.env.progress) == pytest.approx(SHARE)
    assert torch.equal(resumed.env.parts.memory.level, levels) and float(levels.float().mean()) > 1.5
    assert resumed.env.common_step_counter == 36
    for name, value in resumed.env.progress_dict()["bodies"].items():
        assert torch.equal(value, bodies[name]), "every process draws its own"
    assert "by 2 processes, not 1: episodes start anew, on the levels reached and at 48 % of the schedules" in said[0]
    resumed.learn(1)
    assert float(resumed.env.progress) == pytest.approx(42 / 75)


def test_a_checkpoint_without_an_environment_goes_on_with_its_schedules(tmp_path):
    _, path = trained(tmp_path)
    entries = torch.load(path, weights_only=True)
    del entries["training"]["environment"], entries["training"]["random"]
    torch.save(entries, path)
    edit(path, world_size=0)
    said = []
    resumed = build(seed=5, message=said.append)
    start = resumed.env.parts.memory.level.clone()
    resume_run(resumed, path)
    assert float(resumed.env.progress) == pytest.approx(SHARE)
    assert torch.equal(resumed.env.parts.memory.level, start)
    assert resumed.env.common_step_counter == 36
    assert "what was left of several processes, not 1: episodes start anew, at 48 % of the schedules" in said[0]


def test_running_episodes_of_a_whole_checkpoint_keep_their_ages(tmp_path):
    """Whatever the setting of the resumed run, which only says what its own checkpoints hold."""
    reached, path = trained(tmp_path)
    ages = reached.env.episode_length_buf.clone()
    resumed = build(seed=5, keep_episodes=False)
    resume_run(resumed, path)
    resumed.learn(0)
    assert torch.equal(resumed.env.episode_length_buf, ages)


def test_episodes_that_begin_anew_from_a_slim_checkpoint_have_random_ages(tmp_path):
    """Without them all worlds would time out at once, again and again."""
    _, path = trained(tmp_path, keep_episodes=False)
    resumed = build(seed=5, keep_episodes=True)
    resume_run(resumed, path)
    resumed.learn(0)
    assert len(set(resumed.env.episode_length_buf.tolist())) > 4


@pytest.mark.parametrize("kept", ["whole", "slim", "of two processes"])
def test_the_log_takes_over_running_episodes_where_they_run_on(tmp_path, kept):
    reached, path = trained(tmp_path, keep_episodes=kept != "slim")
    length = reached.logger.episode_length
    assert bool((length > 0).any())
    if kept == "of two processes":
        edit(path, world_size=2)
    resumed = build(seed=5)
    resume_run(resumed, path)
    going = kept == "whole"
    assert torch.equal(resumed.logger.episode_length, length if going else torch.zeros(8))
    assert torch.equal(resumed.logger.reward_sum, reached.logger.reward_sum if going else torch.zeros(8))
    assert resumed.logger.total_steps == reached.logger.total_steps
