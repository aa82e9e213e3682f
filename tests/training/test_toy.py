"""The task ``toy``: it learns to walk on a CPU, in minutes."""

from __future__ import annotations

import gaitgauge
import pytest
from gaitgauge.training.run.launch import _straight
from gaitgauge.training.run.plan import prepare
from gaitgauge.training.run.request import TrainRequest


def test_it_trains_on_the_cpu_in_one_rollout_a_step():
    plan = prepare(TrainRequest(task="toy"))
    assert (plan.backend, plan.device, plan.suite) == ("mujoco", "cpu", "toy")
    # a limit of torque over speed makes MuJoCo stop at each substep
    assert not plan.task.environment.physics.torque_speed_limit
    assert plan.task.training.run.torch_threads == 1


@pytest.mark.parametrize(("limits", "command"), [((1.0, 0.0, 0.0), (0.75, 0.0, 0.0)), ((2.0, 1.0, 2.0), None)])
def test_its_film_shows_the_walk_that_it_learned(limits, command):
    class Contract:
        command_limits = limits

    assert _straight(Contract()) == command


@pytest.mark.slow
def test_it_walks_where_it_stood(tmp_path):
    outcome, _ = gaitgauge.train("toy", iterations=120, score=False, film=False, log_root=tmp_path)
    result = gaitgauge.evaluate(outcome.checkpoint, suite="toy", seeds=(4000,), out=tmp_path / "judged")
    assert result.metrics["motion_done"].mean > 0.5  # 0.01 where it stands
