"""What the sprint benchmark makes of a run whose speeds are known."""

import pytest
import sprint
import torch


def test_time_peak_and_error_of_a_robot_that_accelerates_evenly():
    """2 m/s² from rest after 50 steps of standing, up to 4 m/s, which it keeps until it is told to stop."""
    time = torch.arange(400) * 0.02
    first = (2.0 * (time - 1.0)).clamp(0.0, 4.0)
    never = first.clamp(max=3.0)
    running = (time >= 1.0) & (time < 5.0)
    done = sprint.Run(
        period=0.02,
        speed=torch.stack((first, never), dim=1),
        running=running[:, None].expand(-1, 2),
        joint_speed=torch.full((400, 2, 12), 3.0),
        fallen=torch.tensor([False, True]),
    )
    text = "\n".join(sprint.lines(done, speed=4.2, reach=3.9))
    assert "robots                       2, of which fell 1" in text
    assert "came to 3.9 m/s             1" in text
    assert "peak forward speed           3.50 m/s" in text
    # The first step at 3.92 m/s ends 1.98 s after the command.
    assert "time to 3.9 m/s             1.98 s" in text
    assert "error from there on          0.20 m/s" in text
    assert "calves turn at up to         3.0 rad/s" in text


def test_a_robot_runs_stands_and_is_told_to_stop():
    done = sprint.run("pretrained", speed=1.0, runway=0.3, friction=0.6, robots=1, seed=0, suite="robogauge-1.1")
    start, stop = int(done.running[:, 0].int().argmax()), int(done.running[:, 0].sum())
    assert start == 50 and 15 < stop < 100
    assert float(done.speed[:start].abs().max()) < 0.3 < float(done.speed.max()) and not done.fallen.any()
    assert done.joint_speed[start].isfinite().all() and done.joint_speed[0].isnan().all()
    assert done.period == pytest.approx(0.02)
