"""What a resumed run takes over where it is not quite the run that wrote the checkpoint."""

import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from gaitgauge.gauge.described import training_physics
from gaitgauge.policy.loading import load_policy
from gaitgauge.training.environment.configuration import ScheduleConfiguration
from gaitgauge.training.processes import Processes
from gaitgauge.training.run.checkpoint import copy_checkpoint, rank_file
from gaitgauge.training.run.resuming import begin_with, resume_run
from gaitgauge.training.run.runner import TrainingRunner
from gaitgauge.training.run.seeding import seed_everything
from small_environment import STAIRS, make
from toy_training import ToyEnv, toy_configuration, toy_contract

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


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of 6 iterations whose worlds are all on the last level, and a copy of its checkpoint."""

    @cache
    def run(keep_episodes):
        runner = build(tmp_path_factory.mktemp("run"), keep_episodes=keep_episodes)
        runner.learn(5)
        runner.env.parts.memory.level.fill_(2)
        runner.env.parts.memory.moves_level.zero_()
        runner.learn(1)
        return runner

    def copied(folder, keep_episodes=True):
        runner = run(keep_episodes)
        return runner, Path(shutil.copy(runner.log_dir / "model_6.pt", folder))

    return copied


def edit(path, **training):
    """Replace entries of a checkpoint's training state."""
    entries = torch.load(path, weights_only=True)
    entries["training"] |= training
    torch.save(entries, path)


@pytest.mark.parametrize("keep_episodes", [True, False])
def test_another_number_of_processes_goes_on_with_schedules_and_levels(trained, tmp_path, keep_episodes):
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


def test_a_checkpoint_without_an_environment_goes_on_with_its_schedules(trained, tmp_path):
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


def test_running_episodes_of_a_whole_checkpoint_keep_their_ages(trained, tmp_path):
    """Whatever the setting of the resumed run, which only says what its own checkpoints hold."""
    reached, path = trained(tmp_path)
    ages = reached.env.episode_length_buf.clone()
    resumed = build(seed=5, keep_episodes=False)
    resume_run(resumed, path)
    resumed.learn(0)
    assert torch.equal(resumed.env.episode_length_buf, ages)


def test_episodes_that_begin_anew_from_a_slim_checkpoint_have_random_ages(trained, tmp_path):
    """Without them all worlds would time out at once, again and again."""
    _, path = trained(tmp_path, keep_episodes=False)
    resumed = build(seed=5, keep_episodes=True)
    resume_run(resumed, path)
    resumed.learn(0)
    assert len(set(resumed.env.episode_length_buf.tolist())) > 4


@pytest.mark.parametrize("kept", ["whole", "slim", "of two processes"])
def test_the_log_takes_over_running_episodes_where_they_run_on(trained, tmp_path, kept):
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


class Both(Processes):
    """One of two processes that agree on all that the first one says; what they ask each other is remembered."""

    said = "one learning"
    asked = ()

    def average(self, values):
        pass

    def copy_first(self, tensors):
        pass

    def firsts(self, value):
        return Both.said

    def largest(self, number):
        Both.asked = (*Both.asked, number)
        return max(Both.asked[-2:])


@pytest.fixture(scope="module")
def learned_by_two(tmp_path_factory):
    """The folder of two processes after one iteration, by what they agree on, and the second one's ages."""

    @cache
    def learned(said):
        folder = tmp_path_factory.mktemp("two")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Both, "said", said)
            patch.setattr(Both, "asked", ())
            build(folder, processes=Both(rank=0, count=2)).learn(1)
            second = build(folder, seed=1, processes=Both(rank=1, count=2))
            second.learn(1)
        return folder, second.env.episode_length_buf.clone()

    return learned


@pytest.fixture
def of_two(learned_by_two, tmp_path):
    """Makes a checkpoint of two processes after one iteration; returns its path and the second one's ages."""

    def make_checkpoint(said="one learning"):
        folder, ages = learned_by_two(said)
        shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
        return tmp_path / "model_1.pt", ages

    return make_checkpoint


def resume_both(path):
    """Resume in both processes, the second one first; returns it and what the first one says."""
    said, second = [], build(seed=6, processes=Both(rank=1, count=2))
    resume_run(second, path)
    resume_run(build(seed=5, message=said.append, processes=Both(rank=0, count=2)), path)
    return second, " ".join(said)


def test_both_parts_of_a_checkpoint_are_resumed(of_two):
    path, ages = of_two()
    second, said = resume_both(path)
    assert torch.equal(second.env.episode_length_buf, ages) and not second.fresh and not said


def test_parts_from_before_they_were_told_apart_are_resumed(of_two):
    path, ages = of_two()
    for file in (path, rank_file(path, 1)):
        entries = torch.load(file, weights_only=True)
        del (entries["training"] if file is path else entries)["written"]
        torch.save(entries, file)
    second, said = resume_both(path)
    assert torch.equal(second.env.episode_length_buf, ages) and not said


def test_the_best_checkpoint_is_resumed_by_several_processes(tmp_path, of_two):
    """It is a copy of the first process's part alone."""
    path, _ = of_two()
    copy_checkpoint(path, tmp_path / "best.pt")
    second, said = resume_both(tmp_path / "best.pt")
    first = torch.load(path, weights_only=True)["training"]["environment"]["memory"]
    assert second.fresh and float(second.env.progress) == pytest.approx(6 / 75)
    assert torch.equal(second.env.parts.memory.level, first["level"])
    assert "best.pt' has no part of process 1" in said and "start anew, on the levels of the first" in said


@pytest.mark.parametrize("change", [pytest.param("another learning", marks=pytest.mark.slow), "another iteration"])
def test_a_part_that_was_not_written_with_the_checkpoint_is_not_taken(tmp_path, of_two, change):
    """An earlier branch left it, and the run was killed before this one's second process had written."""
    path, _ = of_two()
    old = rank_file(path, 1).read_bytes()
    if change == "another learning":
        path, _ = of_two(said=change)
    else:
        path = path.rename(tmp_path / "model_7.pt")
        entries = torch.load(path, weights_only=True)
        entries["training"]["written"] = entries["training"]["written"].replace("1", "7")
        torch.save(entries, path)
    rank_file(path, 1).write_bytes(old)
    second, said = resume_both(path)
    assert second.fresh and "has no part of process 1" in said


def engine(name):
    return {"engine": name, "version": "1", "settings": {"timestep": 0.005}}


def learned_in(folder, *names, tuned=()):
    """A run that says in which engines it trains and which score it."""
    runner = TrainingRunner(ToyEnv(), toy_configuration(), contract=toy_contract(), task="toy", log_dir=folder)
    physics = {"trained": [*map(engine, names)], "tuned": [*map(engine, tuned)]}
    runner.contract = replace(runner.contract, provenance={**runner.contract.provenance, "physics": physics})
    return runner


def test_a_policy_remembers_the_physics_of_all_its_trainings(tmp_path):
    for folder in ("one", "two", "three"):
        (tmp_path / folder).mkdir()
    learned_in(tmp_path / "one", "warp", tuned=["mujoco"]).learn(1)
    second = learned_in(tmp_path / "two", "newton")
    begin_with(second, tmp_path / "one" / "model_1.pt")
    second.learn(1)
    resumed = learned_in(tmp_path / "three", "newton", tuned=["mujoco"])
    resume_run(resumed, tmp_path / "two" / "model_1.pt")
    resumed.learn(1)
    physics = training_physics(load_policy(tmp_path / "three" / "model_2.pt").contract)
    assert [e.engine for e in physics.trained] == ["warp", "newton"] and physics.note is None
    assert [e.engine for e in physics.tuned] == ["mujoco"]


def test_a_policy_that_began_with_one_of_unknown_physics_says_so(tmp_path):
    TrainingRunner(ToyEnv(), toy_configuration(), contract=toy_contract(), task="toy", log_dir=tmp_path).learn(1)
    second = learned_in(None, "newton")
    begin_with(second, tmp_path / "model_1.pt")
    physics = training_physics(second.contract)
    assert [e.engine for e in physics.trained] == ["newton"] and "began with does not say" in physics.note
