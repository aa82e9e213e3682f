"""The sprint benchmark: the scenario with settings of its own, and what it prints."""

import sys

import pytest
import sprint
import torch
from gaitgauge.policy.loading import load_policy
from gaitgauge.robots import load_robot
from gaitgauge.studies.trials.running import Trial


def trial(**known: object) -> Trial:
    unknown = {"reached": None, "progress": None, "mean_speed": None, "diverged": False, "pulls": (), "path": ()}
    return Trial(**(unknown | {"seed": 0, "seconds": 5.0, "speed_time": None, "tracking_error": 1.0} | known))


def test_what_is_printed_of_two_robots_of_which_one_fell():
    fast = trial(outcome="success", peak_speed=4.0, speed_time=1.98, tracking_error=0.2)
    slow = trial(outcome="fell", peak_speed=3.0)
    text = "\n".join(sprint.lines([fast, slow], torch.full((400, 12), 3.0), load_robot("go2"), reach=3.9))
    assert "robots                       2, of which fell 1" in text
    assert "came to 3.9 m/s             1" in text
    assert "peak forward speed           3.50 m/s" in text
    assert "time to 3.9 m/s             1.98 s" in text
    assert "error from there on          0.20 m/s" in text
    assert "calves turn at up to         3.0 rad/s" in text


@pytest.mark.parametrize("name", ["go2", "anymal_c"])
def test_joints_are_told_apart_by_what_they_move(name):
    """ANYmal's joints come kind by kind: every third of them is no kind."""
    robot = load_robot(name)
    speed_of = {"hip": 1.0, "thigh": 2.0, "calf": 3.0, "HAA": 1.0, "HFE": 2.0, "KFE": 3.0}
    speeds = [next(v for kind, v in speed_of.items() if kind in joint) for joint in robot.joint_names]
    text = sprint.lines([trial(outcome="fell", peak_speed=3.0)], torch.tensor([speeds] * 400), robot, reach=3.9)
    for what, speed in (("hips", 1.0), ("thighs", 2.0), ("calves", 3.0)):
        (line,) = (line for line in text if line.startswith(what))
        assert f"turn at up to {speed:.1f} rad/s, 99 % below {speed:.1f} rad/s" in " ".join(line.split())


def test_a_robot_runs_stands_and_is_told_to_stop():
    settings = {"speed": 1.0, "reach": 0.5, "runway": 0.3, "friction": 0.6, "suite": "robogauge-1.1"}
    [done], joint_speeds = sprint.run(
        load_policy("pretrained"), load_robot("go2"), sprint.scenario(**settings), robots=1, seed=0
    )
    assert done.outcome == "success" and 0.5 < done.peak_speed < 1.3
    assert 0.1 < done.speed_time < 1.0 and done.path[-1][0] == pytest.approx(0.45, abs=0.2)
    assert joint_speeds.shape[1] == 12 and 15 < len(joint_speeds) < 100


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (["pretrained", "--robots", "0"], "argument --robots: 'value' is '0'; it must be greater than or equal to 1"),
        (["pretrained", "--speed", "0"], "argument --speed: 'value' is '0'; it must be greater than or equal to 0.1"),
        (["pretrained", "--runway", "-1"], "argument --runway: 'value' is '-1'; it must be greater than 0"),
        (["pretrained", "--suite", "nosuch"], "error: there is no suite 'nosuch'"),
        (["nosuch.pt"], "error: there is no policy file 'nosuch.pt'"),
    ],
)
def test_what_cannot_be_run_is_one_sentence(given, sentence, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["sprint.py", *given])
    with pytest.raises(SystemExit) as end:
        sprint.main()
    said = end.value.code if isinstance(end.value.code, str) else capsys.readouterr().err
    assert sentence in said
