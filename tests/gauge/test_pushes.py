"""Sudden lateral pushes: when, how hard, to which side, and on whom."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from gaitgauge.backends.base import BackendError, Capability, Support
from gaitgauge.gauge.play.pushes import push_force, push_steps, sideways
from gaitgauge.gauge.play.segments import Segment
from gaitgauge.gauge.suite import Push, load_suite
from gaitgauge.robots.rotation import from_yaw
from scripted_gauge import DIAGONAL, MAXIMUM, PERIOD, Puppet, episode, run, scene, short_suite

PUSH = Push(goal=MAXIMUM, after=(0.06, 0.06), duration=0.04, force=(80.0, 100.0))


class Pushed(Puppet):
    """Writes down the force that acts in each control step after each reset."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.force = torch.zeros(self.num_worlds, 3, dtype=torch.float64)
        self.log: list[tuple[float, list[float]]] = []

    def apply_force(self, force_w):
        self.force = force_w.clone()

    def step(self, joint_targets, **options):
        if joint_targets is not None:
            self.log += [(float(t), f.tolist()) for t, f in zip(self.state.time, self.force, strict=True)]
        super().step(joint_targets, **options)


def pushed(*goals, suite=None, **options):
    suite = suite or replace(short_suite("gaitgauge-1"), push=PUSH)
    backend = Pushed(scene(suite, 1, None))
    run(suite, backend, [episode(*goals)], **options)
    return backend.log


def test_every_sub_command_of_the_goal_is_pushed_once_to_one_side():
    log = pushed(MAXIMUM)
    acting = [(t, f) for t, f in log if any(f)]
    assert len(acting) == 6 * 2  # six sub-commands, 0.04 s of 0.02 s each
    for (first, one), (second, other) in zip(acting[::2], acting[1::2], strict=True):
        assert second - first == pytest.approx(PERIOD)
        # two steps of settling, then 0.06 s of the command; the robot is reset with one physics step of 0.01 s
        assert first == pytest.approx(0.01 + 2 * PERIOD + 0.06)
        assert one == pytest.approx(other)
        assert one[0] == pytest.approx(0.0, abs=1e-9) and one[2] == 0.0
        assert 80.0 <= abs(one[1]) <= 100.0
    assert len({f[1] for _, f in acting}) == 6


def test_other_goals_and_other_suites_are_not_pushed():
    assert not any(any(f) for _, f in pushed(DIAGONAL))
    assert not any(any(f) for _, f in pushed(MAXIMUM, suite=short_suite("robogauge-1.1")))


def test_a_captured_loop_pushes_alike():
    """Without early outs, as on a GPU."""
    one, other = ([f for _, f in pushed(MAXIMUM, **options) if any(f)] for options in ({}, {"poll_interval": 2}))
    assert one == other


def test_pushes_go_to_both_sides_and_have_all_strengths():
    segments = [
        Segment(episode=episode(MAXIMUM, seed=seed), goal=MAXIMUM, goal_index=0, sub_command=part)
        for seed in range(200)
        for part in range(6)
    ]
    force = np.array([push_force(PUSH, s) for s in segments])
    assert (force > 0).mean() == pytest.approx(0.5, abs=0.06)
    assert abs(force).min() < 80.5 and abs(force).max() > 99.5
    assert abs(force).mean() == pytest.approx(90.0, abs=1.0)
    assert push_force(PUSH, segments[7]) == force[7]


def test_nobody_can_know_when_a_push_comes():
    """A push at one time would be none for a policy that counts: it comes at any control step from 1.5 to 3.5 s, for 0.2 s."""
    suite = load_suite("gaitgauge-1")
    segments = [
        Segment(episode=episode(MAXIMUM, seed=seed), goal=MAXIMUM, goal_index=0, sub_command=part)
        for seed in range(300)
        for part in range(6)
    ]
    steps = np.array([push_steps(suite, s) for s in segments])
    assert set(steps[:, 1] - steps[:, 0]) == {10}
    # control steps are counted from 1: the first after 1.5 s is the 76th
    assert steps[:, 0].min() == 76 and steps[:, 0].max() == 176
    assert np.histogram(steps[:, 0], bins=4, range=(76, 177))[0] == pytest.approx(450, abs=75)
    forces = np.abs([push_force(suite.push, s) for s in segments])
    assert abs(np.corrcoef(steps[:, 0], forces)[0, 1]) < 0.08
    assert push_steps(suite, segments[7]) == tuple(steps[7])


def test_a_push_is_sideways_of_the_heading():
    force = sideways(from_yaw(torch.tensor([0.0, torch.pi / 2, torch.pi])), torch.tensor([90.0, 90.0, -90.0]))
    assert force.flatten().tolist() == pytest.approx([0, 90, 0, -90, 0, 0, 0, 90, 0], abs=1e-4)


def test_the_own_suite_pushes_as_the_papers_trials_did():
    push = load_suite("gaitgauge-1").push
    assert push.force == (80.0, 100.0)
    assert push.after == (1.5, 3.5) and push.duration == 0.2
    assert load_suite("robogauge-1.1").push is None


def test_an_engine_that_cannot_push_is_refused_in_one_sentence(monkeypatch):
    able = Pushed.capabilities()
    unable = {**able, "external_force": Capability(support=Support.NONE)}
    monkeypatch.setattr(Pushed, "capabilities", classmethod(lambda cls: unable))
    with pytest.raises(BackendError, match="suite 'gaitgauge-1' pushes robots, and engine 'fake' knows no external"):
        pushed(MAXIMUM)
    assert pushed(MAXIMUM, suite=replace(short_suite("gaitgauge-1"), push=None))


def test_a_push_does_not_depend_on_the_row_of_its_robot():
    """One unit in the last place of a push is another episode: results would depend on the number of workers."""
    generator = torch.Generator().manual_seed(0)
    quaternions = torch.nn.functional.normalize(torch.randn(3000, 4, generator=generator, dtype=torch.float64))
    forces = torch.rand(3000, generator=generator, dtype=torch.float64)
    together = sideways(quaternions, forces)
    apart = [sideways(q, f) for q, f in zip(quaternions.split(3), forces.split(3), strict=True)]
    assert torch.equal(together, torch.cat(apart))
