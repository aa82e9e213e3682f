"""The environment on the physics it trains on: slowly on the CPU, and as CUDA graphs on a GPU."""

from dataclasses import replace

import pytest
import torch
from gaitgauge.training.environment.configuration import EnvironmentConfiguration
from gaitgauge.training.environment.environment import TrainingEnvironment
from gaitgauge.training.environment.step_inputs import AFTER_RESET, AFTER_STEP
from gaitgauge.training.environment.terrain_configuration import ALL_TILES, TerrainConfiguration
from gaitgauge.training.tasks import find_task

torch.set_num_threads(1)

KINDS = ("stairs_up", "slope_down", "flat")
SMALL = EnvironmentConfiguration(
    num_envs=6,
    terrain=TerrainConfiguration(
        tiles=tuple(replace(t, share=1.0) for t in ALL_TILES if t.name in KINDS), levels=2, variants=1
    ),
)


@pytest.fixture(scope="module")
def environment():
    return TrainingEnvironment(SMALL, backend="mujoco-warp", device="cpu")


@pytest.mark.slow
def test_robots_stand_and_see_the_ground(environment):
    for _ in range(40):
        observations, reward, _, extras = environment.step(torch.zeros(6, 12))
        assert all(observations[name].isfinite().all() for name in ("policy", "history", "privileged"))
        assert reward.isfinite().all()
    assert float(environment.parts.memory.diverged_total) == 0
    assert float(extras["log"]["Physics/overflow_worlds"]) == 0
    standing = environment.episode_length_buf >= 35
    assert standing.sum() >= 3, "the standing pose holds"
    force = observations["privileged"][standing, 48:52].sum(dim=1) * 1e3
    assert (force > 60).all() and (force < 400).all(), "about the weight of 150 N"


@pytest.mark.slow
def test_continuing_comes_close_to_never_having_stopped(environment):
    """The solver's warm start is lost, so equality is not to be had."""
    environment.step(torch.zeros(6, 12))
    saved = environment.state_dict()
    expected = environment.step(torch.zeros(6, 12))
    environment.load_state_dict(saved)
    found = environment.step(torch.zeros(6, 12))
    assert torch.equal(found[2], expected[2])
    assert torch.allclose(found[0]["policy"], expected[0]["policy"], atol=2e-2)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["mujoco-warp", "newton"])
def test_the_whole_task_runs(backend):
    """All its ground in one scene, with legs that meet."""
    environment = TrainingEnvironment(
        replace(find_task("go2-moe-cts").environment, num_envs=16), backend=backend, device="cpu"
    )
    for _ in range(3):
        observations, reward, _, _ = environment.step(torch.zeros(16, 12))
        assert all(value.isfinite().all() for value in observations.values()) and reward.isfinite().all()
    assert float(environment.parts.memory.diverged_total) == 0
    environment.close()


@pytest.mark.gpu
def test_captured_and_eager_steps_agree():
    """Both judge the physics of the eager one; random numbers are the same, since the seeds are."""
    configuration = replace(SMALL, num_envs=64)
    eager = TrainingEnvironment(configuration, backend="mujoco-warp", device="cuda:0")
    captured = TrainingEnvironment(configuration, backend="mujoco-warp", device="cuda:0", capture=True)

    def read(names):
        eager._read(names)
        for name in names:
            getattr(captured._inputs, name).copy_(getattr(eager._inputs, name))

    random = torch.Generator().manual_seed(0)
    ended = 0
    for step in range(120):
        action = torch.randn(64, 12, generator=random).cuda() * 1.5
        for environment in (eager, captured):
            environment.parts.action.copy_(action)
            environment.parts.uniform.draw()
        eager.backend.step(eager.parts.targets(), delay=eager.parts.delay())
        read(AFTER_STEP)
        left, right = eager._after_physics(), captured._after_physics()
        assert torch.equal(left.done, right.done), step
        assert torch.allclose(left.reward, right.reward, atol=1e-4)
        assert torch.allclose(left.start.state.base_position, right.start.state.base_position, atol=1e-4)
        eager._reset(left.start)
        read(AFTER_RESET)
        one, two = eager._observe(), captured._observe()
        assert torch.allclose(one.history, two.history, atol=1e-4)
        assert torch.allclose(one.privileged, two.privileged, atol=1e-4)
        ended += int(left.done.sum())
    assert ended > 0


@pytest.mark.gpu
def test_a_captured_environment_runs():
    environment = TrainingEnvironment(
        replace(SMALL, num_envs=256), backend="mujoco-warp", device="cuda:0", capture=True
    )
    with torch.inference_mode():
        for _ in range(100):
            observations, reward, _, _ = environment.step(torch.randn(256, 12, device="cuda:0") * 0.3)
    assert observations["history"].isfinite().all() and reward.isfinite().all()
    assert int(environment.parts.memory.step) == 100
