"""Processes of a training and of a sweep that are killed by SIGKILL: they end by themselves."""

import fcntl
import json
import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from gaitgauge.training.run.side_process import CHILD_PROGRAM, PROGRAM

SLEEPER = """
import signal, sys, time
from pathlib import Path

def stop(number, frame):
    Path("stopped").write_text(signal.Signals(number).name)
    sys.exit()

signal.signal(signal.SIGTERM, stop)
Path("said").write_text(" ".join([__name__, Path(sys.argv[0]).name, *sys.argv[1:]]))
time.sleep(60)
"""
SIDE = f"""
import time
from pathlib import Path
from gaitgauge.training.run.side_process import Job, SideProcess
command = [*{CHILD_PROGRAM[:-1]}, "sleeper", "--of", "two"]
SideProcess().submit(Job(command=command, checkpoint=Path("model_1.pt"), iteration=1, output=Path("side/1.txt")))
time.sleep(60)
"""
SCORER = """
import sys, time
from pathlib import Path
from gaitgauge.policy.finding import PRETRAINED
from gaitgauge.training.run.scoring import Scorer
scorer = Scorer(Path("run"), suite="quick", threads=2)
scorer.submit(PRETRAINED, 1)
Path("group").write_text(str(scorer._side._running[1].pid))
time.sleep(600)
"""
SWEEP = """
name = "toy"
title = "A toy"
backend = "fake"
training_suite = "none"
settings = ["environment.num_envs=8", "training.run.iterations=100000", "training.run.save_interval=2",
    "training.run.steps_per_iteration=4", "training.algorithm.minibatches=1"]
[[entry]]
name = "one"
task = "go2-cts"
"""


def until(what, seconds: float = 60.0):
    """What a function returns once it is true."""
    end = time.monotonic() + seconds
    while not (found := what()):
        assert time.monotonic() < end
        time.sleep(0.05)
    return found


def killed(process: subprocess.Popen) -> None:
    process.kill()
    process.wait()


def program(folder: Path, *arguments: str) -> subprocess.Popen:
    """A Python program that stands in a folder."""
    return subprocess.Popen([sys.executable, *arguments], cwd=folder)


def test_what_runs_beside_is_asked_to_stop_when_its_parent_is_killed(tmp_path):
    (tmp_path / "sleeper.py").write_text(SLEEPER)
    parent = program(tmp_path, "-c", SIDE)
    said = until(lambda: (tmp_path / "said").exists() and (tmp_path / "said").read_text())
    assert said == "__main__ sleeper.py --of two"
    time.sleep(0.2)
    assert not (tmp_path / "stopped").exists(), "its parent lives"
    killed(parent)
    assert until(lambda: (tmp_path / "stopped").exists() and (tmp_path / "stopped").read_text(), 10.0) == "SIGTERM"


def lives(group: int) -> bool:
    """Whether there is a process in a group."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
def test_a_training_that_is_killed_leaves_no_gauge_behind(tmp_path):
    parent = program(tmp_path, "-c", SCORER)
    until(lambda: list(tmp_path.glob("run/gauge/quick/*/episodes")))
    group = int((tmp_path / "group").read_text())
    time.sleep(2.0)  # its workers play
    assert lives(group)
    killed(parent)
    until(lambda: not lives(group), 10.0)


def free(lock: Path) -> bool:
    """Whether the training that had a lock has ended."""
    with lock.open() as file, suppress(BlockingIOError):
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return True
    return False


@pytest.mark.slow
def test_trainings_of_a_sweep_that_is_killed_write_a_checkpoint_and_end(tmp_path):
    (tmp_path / "toy.toml").write_text(SWEEP)
    sweep = program(tmp_path, *PROGRAM[1:], "sweep", "toy.toml", "--out", "out")
    until(lambda: list(tmp_path.rglob("model_2.pt")))
    killed(sweep)
    (lock,) = tmp_path.rglob("train.lock")
    until(lambda: free(lock))
    (noted,) = tmp_path.rglob("run.json")
    said = json.loads(noted.read_text())
    assert said["outcome"] == "signal" and (noted.parent / f"model_{said['iteration']}.pt").exists()
