"""The runner on the real environment, with a scripted engine in place of physics."""

import pytest
import torch
from gaitgauge.policy.loading import load_policy
from gaitgauge.training.algorithms.symmetry import build_mirror
from gaitgauge.training.environment.configuration import ObservationConfiguration, Ramp
from gaitgauge.training.run.checkpoint import reached, read_checkpoint
from gaitgauge.training.run.resuming import resume_run
from gaitgauge.training.run.runner import TrainingRunner
from gaitgauge.training.run.seeding import seed_everything
from small_environment import STAIRS, make
from toy_training import toy_configuration


def build(folder, seed=0, observations=None, **algorithm):
    seed_everything(seed)
    environment = make(num_envs=8, terrain=STAIRS, seed=0, observations=observations or ObservationConfiguration())
    configuration = toy_configuration(steps=6, algorithm=algorithm, run={"random_episode_start": True})
    return TrainingRunner(
        environment,
        configuration,
        contract=environment.contract,
        task="toy",
        log_dir=folder,
        mirror=build_mirror(
            environment.configuration.observations, contract=environment.contract, robot=environment.robot
        ),
    )


@pytest.mark.slow
def test_resumes_exactly_with_the_training_environment(tmp_path):
    whole, first, second = (tmp_path / name for name in ("whole", "first", "second"))
    for folder in (whole, first, second):
        folder.mkdir()
    build(whole).learn(2)
    build(first).learn(1)
    resumed = build(second, seed=5)
    resume_run(resumed, first / "model_1.pt")
    resumed.learn(1)
    a, b = (read_checkpoint(folder / "model_2.pt") for folder in (whole, second))
    for name, value in a["actor_state_dict"].items():
        assert torch.equal(value, b["actor_state_dict"][name]), name
    for name, value in a["training"]["environment"]["memory"].items():
        assert torch.equal(value, b["training"]["environment"]["memory"][name]), name
    assert load_policy(whole / "model_2.pt").contract.hash == resumed.contract.hash


def test_the_algorithm_and_checkpoints_know_where_schedules_are(tmp_path):
    runner = build(tmp_path, entropy_coefficient=Ramp(start=0.5, end=0.1, begin=0.0, until=0.5))
    runner.env.parts.memory.step.fill_(runner.env.configuration.schedule.horizon_steps // 4 - 6)
    runner.learn(1)
    assert float(runner.alg.losses.entropy_coefficient) == pytest.approx(0.3)
    assert reached(read_checkpoint(tmp_path / "model_1.pt")) == pytest.approx(0.25)


@pytest.mark.parametrize(
    "observations",
    [
        ObservationConfiguration(),
        ObservationConfiguration(history_length=3),
        ObservationConfiguration(scan_length=1.0, scan_width=0.6, scan_spacing=0.2),
    ],
)
def test_symmetry_fits_the_training_environment(observations):
    runner = build(None, symmetry="augment", observations=observations)
    runner.learn(1)
    groups = runner.env.get_observations()
    mirror = runner.alg.losses.mirror
    assert [mirror.policy.width, mirror.history.width, mirror.privileged.width] == [
        groups[name].shape[1] for name in ("policy", "history", "privileged")
    ]
