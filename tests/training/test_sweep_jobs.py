"""Processes of a sweep in their places: what starts, what ends, and what is left behind."""

import fcntl
import os
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from gaitgauge.training.sweep.jobs import Jobs, visible_gpus
from scripted_sweep import SWEEP, Scripted, scripted, work


def test_each_gpu_has_one_training_and_a_failure_stops_nothing(tmp_path):
    runs = [scripted(tmp_path, name) for name in ("broken", "slow", "third")]
    runs.append(scripted(tmp_path, "processor", on_gpu=False))
    outcome, said = work(runs)
    order = (tmp_path / "order").read_text().splitlines()
    assert sorted(line.rpartition(" on ")[2] for line in order) == ["", "3", "3", "5"], "the short ones share a GPU"
    assert list(outcome.failures) == ["broken, seed 0"] and outcome.stopped is None and outcome.unfinished == []
    assert outcome.failures["broken, seed 0"].startswith("the physics has diverged (see '")
    assert all(run.trained and run.gauged(SWEEP) for run in runs[1:])
    assert sum("has been gauged" in sentence for sentence in said) == 3
    # Called again, only what failed is tried again.
    (tmp_path / "order").unlink()
    assert list(work(runs)[0].failures) == ["broken, seed 0"]
    assert (tmp_path / "order").read_text().startswith("broken, seed 0")


def test_a_training_that_was_killed_says_so_and_not_what_it_said_last(tmp_path):
    run = scripted(tmp_path, "killed")
    outcome, _ = work([run])
    assert outcome.failures["killed, seed 0"] == f"ended by SIGKILL (see '{run.log}')"


def test_a_training_that_was_stopped_from_outside_is_gone_on_with(tmp_path):
    """Not in the same call: who stopped it may want the machine."""
    run, early = scripted(tmp_path, "asked"), scripted(tmp_path, "asked-early")
    outcome, said = work([run, early])
    assert outcome.unfinished == ["asked, seed 0"] and list(outcome.failures) == ["asked-early, seed 0"]
    assert (
        "asked, seed 0 was stopped by SIGTERM from outside and has a checkpoint; a later call goes on with it" in said
    )
    assert work([run])[0].unfinished == [] and run.trained


def test_a_gpu_may_have_several_trainings(tmp_path):
    """All GPUs get one before any gets two."""
    runs = [scripted(tmp_path, name) for name in ("slow-1", "slow-2", "slow-3", "slow-4", "last")]
    outcome, said = work(runs, per_gpu=2)
    places = [s.partition(" is trained on ")[2].partition(";")[0] for s in said if " is trained on " in s]
    assert places[:4] == ["GPU 3", "GPU 5", "GPU 3, beside 1", "GPU 5, beside 1"]
    order = dict(line.split(" on ") for line in (tmp_path / "order").read_text().splitlines())
    assert [order[f"slow-{n}, seed 0"] for n in (1, 2, 3, 4)] == ["3", "5", "3", "5"]
    assert outcome.failures == {} and outcome.unfinished == []


def test_what_is_at_work_when_time_is_up_is_gone_on_with(tmp_path):
    runs = [scripted(tmp_path, "slow"), scripted(tmp_path, "late")]
    outcome, _ = work(runs, gpus=("0",), deadline=time.monotonic() + 0.15)
    assert outcome.unfinished == ["slow, seed 0", "late, seed 0"] and outcome.failures == {}
    assert work(runs, gpus=("0",))[0].unfinished == []


def test_a_signal_ends_what_is_at_work(tmp_path):
    runs = [scripted(tmp_path, "slow"), scripted(tmp_path, "late")]
    timer = threading.Timer(0.15, os.kill, (os.getpid(), signal.SIGTERM))
    timer.start()
    outcome, said = work(runs, gpus=("0",))
    timer.join()
    assert outcome.stopped == signal.SIGTERM and len(outcome.unfinished) == 2
    assert "SIGTERM received" in said[-1] and not any("late" in sentence for sentence in said)


def wait_for(path: Path) -> Path:
    until = time.monotonic() + 20.0
    while not path.exists():
        assert time.monotonic() < until, path
        time.sleep(0.02)
    return path


def alive(run: Scripted) -> bool:
    """Whether the training of a run lives, which was started from this process or from one that is gone."""
    try:
        os.kill(int((run.folder / "pid").read_text()), 0)
    except ProcessLookupError:
        return False
    return True


def signals_once(path: Path, *numbers: int) -> threading.Thread:
    """Sends this process signals, 30 ms apart, once a file is there."""

    def send() -> None:
        wait_for(path)
        for number in numbers:
            os.kill(os.getpid(), number)
            time.sleep(0.03)

    thread = threading.Thread(target=send)
    thread.start()
    return thread


def test_a_second_interrupt_shortens_the_wait_and_leaves_no_training(tmp_path, monkeypatch):
    monkeypatch.setattr("gaitgauge.training.sweep.jobs._LAST_PATIENCE", 0.3)
    run, began = scripted(tmp_path, "deaf"), time.monotonic()
    sender = signals_once(run.folder / "is-deaf", signal.SIGINT, signal.SIGINT)
    outcome, _ = work([run])
    sender.join()
    assert outcome.stopped == signal.SIGINT and outcome.unfinished == ["deaf, seed 0"]
    assert not alive(run) and time.monotonic() - began < 30.0


@pytest.mark.usefixtures("hangups")
def test_a_terminal_that_is_closed_stops_a_sweep_like_a_signal(tmp_path):
    run = scripted(tmp_path, "long")
    sender = signals_once(run.folder / "pid", signal.SIGHUP)
    outcome, said = work([run])
    sender.join()
    assert outcome.stopped == signal.SIGHUP and not alive(run) and "SIGHUP received" in said[-1]


def test_a_mistake_of_the_sweep_itself_leaves_no_training(tmp_path, monkeypatch):
    run = scripted(tmp_path, "long")

    def broken(self):
        wait_for(run.folder / "pid")
        raise ZeroDivisionError

    monkeypatch.setattr(Jobs, "_collect", broken)
    with pytest.raises(ZeroDivisionError):
        work([run])
    assert not alive(run)


@pytest.mark.parametrize("place", ["train.log", "gauge.log"])
def test_a_log_that_cannot_be_written_is_the_failure_of_its_run(tmp_path, place):
    runs = [scripted(tmp_path, name) for name in ("first", "second")]
    (runs[0].folder / place).mkdir(parents=True)
    outcome, _ = work(runs)
    log = runs[0].folder / place
    assert outcome.failures == {"first, seed 0": f"'{log}': is a directory; mend that and call again"}
    assert runs[1].gauged(SWEEP)


def test_a_description_that_is_damaged_is_the_failure_of_its_run(tmp_path):
    """Also where it comes about while the run is trained."""
    runs = [scripted(tmp_path, name) for name in ("damaged", "second")]
    outcome, _ = work(runs)
    assert list(outcome.failures) == ["damaged, seed 0"] and outcome.unfinished == []
    assert "run.json' is not valid JSON" in outcome.failures["damaged, seed 0"] and runs[1].gauged(SWEEP)


def test_a_training_that_a_killed_sweep_left_is_not_started_again(tmp_path):
    runs = [scripted(tmp_path, name) for name in ("long", "second")]
    if not (sweep := os.fork()):
        work(runs[:1])
    number = int(wait_for(runs[0].folder / "pid").read_text())
    os.kill(sweep, signal.SIGKILL)
    os.waitpid(sweep, 0)
    outcome, _ = work(runs)
    assert list(outcome.failures) == ["long, seed 0"] and runs[1].gauged(SWEEP) and alive(runs[0])
    assert outcome.failures["long, seed 0"] == (
        f"it is still being trained on GPU 3 by process {number} of an earlier call; wait until that has ended, or stop it "
        f"with 'kill {number}', and call again"
    )
    os.kill(number, signal.SIGTERM)


@pytest.mark.parametrize("noted", ["", "1; rm -rf ~", "5", "\x1b[31m on \x1b"])
def test_what_a_lock_file_says_is_no_command(tmp_path, noted):
    """A full disk leaves it empty, versions before this one wrote a number alone; who wrote anything else is not known."""
    run = scripted(tmp_path, "one")
    run.folder.mkdir(parents=True)
    lock = run.folder / "train.lock"
    lock.write_text(noted)
    with lock.open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        sentence = work([run])[0].failures["one, seed 0"]
    assert ("kill 5'" in sentence) == (noted == "5") and "rm" not in sentence and sentence.isprintable()
    assert sentence.startswith("it is still being trained by ") and sentence.endswith("and call again")


@pytest.mark.parametrize("name", ["train.lock", "train.log", "gauge.lock", "gauge.log"])
def test_a_link_in_a_run_s_folder_is_not_written_through(tmp_path, name):
    """The folder may come from elsewhere."""
    run = scripted(tmp_path, "one")
    run.folder.mkdir(parents=True)
    (tmp_path / "precious").write_text("mine")
    (run.folder / name).symlink_to(tmp_path / "precious")
    sentence = work([run])[0].failures["one, seed 0"]
    assert (
        sentence
        == f"'{run.folder / name}' is a link, and a sweep writes to its own files alone; remove it and call again"
    )
    assert (tmp_path / "precious").read_text() == "mine"


def test_gpus_are_those_that_may_be_seen(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,GPU-1a")
    assert visible_gpus() == ["4", "GPU-1a"]
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    assert visible_gpus() == ["0", "1"]


def test_a_suite_that_changes_during_a_gauging_is_not_played_for_ever(tmp_path):
    run = replace(scripted(tmp_path, "one"), suite_digest="another")
    assert "was changed while it was gauged; call again" in work([run])[0].failures["one, seed 0"]
