"""Stretches of a run: other settings from a fraction of it on, and the same results after a stop in any of them."""

from dataclasses import replace

import pytest
import torch
from gaitgauge.training.configuration import ConfigurationError
from gaitgauge.training.environment import environment as environment_module
from gaitgauge.training.environment.configuration import EnvironmentConfiguration, ScheduleConfiguration, Stretch
from gaitgauge.training.environment.stretches import settings_in
from gaitgauge.training.run.checkpoint import read_checkpoint
from gaitgauge.training.run.resuming import resume_run
from gaitgauge.training.run.runner import TrainingRunner
from gaitgauge.training.run.seeding import seed_everything
from gaitgauge.training.tasks import find_task
from gaitgauge_fake_engine import FakeBackend, FakeScript
from small_environment import STAIRS, make
from toy_training import toy_configuration

LAST = Stretch(
    name="last",
    begin=0.5,
    settings="environment.rewards.tracking_sigma=0.1 environment.terrain.tiles.flat.share=0.5 environment.randomization.friction=0.5,0.6",
)
STEPS, TOTAL = 6, 4


@pytest.fixture(autouse=True)
def scripted(monkeypatch):
    monkeypatch.setattr(
        environment_module, "make_backend", lambda name, scene, **_: FakeBackend(scene, script=FakeScript())
    )


def build(folder, *, seed=0, keep=True, physics=None, messages=None):
    folder.mkdir(exist_ok=True)
    seed_everything(seed)
    schedule = ScheduleConfiguration(horizon_steps=STEPS * TOTAL, stretches=(LAST,))
    environment = make(num_envs=12, terrain=STAIRS, schedule=schedule)
    return TrainingRunner(
        environment,
        toy_configuration(steps=STEPS, run={"random_episode_start": True, "keep_episodes": keep}),
        contract=environment.contract,
        task="toy",
        log_dir=folder,
        physics=physics,
        message=None if messages is None else messages.append,
    )


def test_a_run_changes_its_settings_at_the_fraction_given_and_keeps_its_levels(tmp_path):
    messages: list[str] = []
    run = build(
        tmp_path / "run", physics=lambda settings: {"trained": [settings.randomization.friction]}, messages=messages
    )
    env = run.env
    run.learn(2)
    assert env.stretch == 0 and env.stretch_ends and env.configuration.rewards.tracking_sigma == 0.25
    levels, kinds = env.parts.memory.level.clone(), env.kind.clone()
    levels[:3] = 2
    env.parts.memory.level.copy_(levels)
    env.next_stretch()
    assert env.stretch == 1 and not env.stretch_ends and env.configuration.rewards.tracking_sigma == 0.1
    assert torch.equal(env.parts.memory.level, levels) and not torch.equal(env.kind, kinds)
    assert float(env.progress) == 0.5 and env.common_step_counter == 2 * STEPS
    friction = env._bodies["friction"]
    assert 0.5 <= float(friction.min()) <= float(friction.max()) <= 0.6


@pytest.mark.parametrize("stop", [1, 2, 3])
def test_a_run_that_stops_in_any_stretch_goes_on_exactly(tmp_path, stop):
    """``stop`` 2 is the boundary: the checkpoint is of the first stretch, and what comes is of the second."""
    messages: list[str] = []
    build(tmp_path / "whole", messages=messages).learn(TOTAL)
    assert [
        text for text in messages if text.startswith("Stretch 'last' begins after iteration 2: environment.rewards.")
    ]
    build(tmp_path / "first").learn(stop)
    resumed = build(tmp_path / "second", seed=5)
    resume_run(resumed, tmp_path / "first" / f"model_{stop}.pt")
    resumed.learn(TOTAL - stop)
    a, b = (read_checkpoint(tmp_path / name / "model_4.pt") for name in ("whole", "second"))
    for name, value in a["actor_state_dict"].items():
        assert torch.equal(value, b["actor_state_dict"][name]), name
    for name, value in a["training"]["environment"]["memory"].items():
        assert torch.equal(value, b["training"]["environment"]["memory"][name]), name
    assert torch.equal(a["training"]["log"]["reward_sum"], b["training"]["log"]["reward_sum"])
    assert a["training"]["environment"]["stretch"] == b["training"]["environment"]["stretch"] == 1


def test_the_boundary_is_a_checkpoint(tmp_path):
    build(tmp_path / "run").learn(TOTAL)
    assert sorted(path.name for path in (tmp_path / "run").glob("model_*.pt")) == ["model_2.pt", "model_4.pt"]


def test_the_physics_of_both_stretches_stand_in_the_policy(tmp_path):
    run = build(tmp_path / "run", physics=lambda settings: {"trained": [list(settings.randomization.friction)]})
    run.contract = replace(run.contract, provenance={**run.contract.provenance, "physics": {"trained": [[0.2, 1.25]]}})
    run.learn(TOTAL)
    assert run.contract.provenance["physics"]["trained"] == [[0.2, 1.25], [0.5, 0.6]]


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("environment.num_envs=3", "'environment.num_envs=3'; it may change environment.… settings of commands, "),
        ("training.run.seed=3", "'training.run.seed=3'; it may change"),
        ("environment.terrain.levels=2", "'odd' of environment.schedule has 2 levels of terrain"),
        ("environment.physics.substeps=5", "'odd' of environment.schedule makes another policy contract"),
        ("environment.rewards.progres=1", "unknown setting 'environment.rewards.progres'"),
        ("environment.randomization.motor_speed=1,2 environment.physics.torque_speed_limit=false", "does nothing"),
    ],
)
def test_a_stretch_that_does_not_fit_is_refused_before_the_run(setting, words):
    odd = ScheduleConfiguration(stretches=(Stretch(name="odd", begin=0.5, settings=setting),))
    with pytest.raises(ValueError, match=words):
        make(num_envs=2, schedule=odd)


def test_stretches_follow_in_order():
    late = ScheduleConfiguration(stretches=(replace(LAST, begin=0.7), LAST))
    with pytest.raises(
        ConfigurationError, match=r"stretches begin at \[0.7, 0.5\] of the run; they must follow in order"
    ):
        settings_in(EnvironmentConfiguration(schedule=late), 1)


def test_a_setting_of_the_command_line_holds_in_every_stretch():
    own = find_task("go2-moe-cts").environment
    given = find_task("go2-moe-cts", ["environment.physics.cone=pyramidal"]).environment
    assert settings_in(own, 1).physics.cone == "elliptic" and settings_in(own, 0).physics.cone == "pyramidal"
    assert settings_in(given, 1).physics == replace(settings_in(own, 1).physics, cone="pyramidal")
