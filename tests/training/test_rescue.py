"""What is left when one of several processes is lost or diverges, as one process can show it."""

import json
import os
import signal
import threading

import pytest
import torch
from gaitgauge.training.processes import Processes, ProcessLostError
from gaitgauge.training.run.checkpoint import read_checkpoint
from gaitgauge.training.run.resuming import TrainingDivergedError
from gaitgauge.training.run.run_directory import update_run_json
from gaitgauge.training.run.runner import TrainingRunner
from gaitgauge.training.run.seeding import seed_everything
from toy_training import ToyEnv, toy_configuration, toy_contract


def make(log_dir, env=None):
    seed_everything(0)
    return TrainingRunner(
        env or ToyEnv(),
        toy_configuration(),
        contract=toy_contract(),
        task="toy",
        log_dir=log_dir,
        processes=LostProcesses(rank=1, count=2),
    )


class LostProcesses(Processes):
    """Two processes, of which the other one is lost when ``lost`` says so."""

    lost = False

    def average(self, values):
        pass

    def copy_first(self, tensors):
        pass

    def firsts(self, value):
        return value

    def largest(self, number):
        if LostProcesses.lost:
            raise ProcessLostError("another process has gone: connection closed")
        return number


def lose(tmp_path, monkeypatch, *, outcome, broken):
    """What the second process raises when the first one is lost after its second iteration, having said an outcome."""
    runner = make(tmp_path)
    update_run_json(tmp_path, {"outcome": "running"})
    monkeypatch.setattr(LostProcesses, "lost", False)
    monkeypatch.setattr("gaitgauge.training.run.rescue.time.sleep", lambda _: None)
    runner.learn(1)
    if broken:
        with torch.no_grad():
            runner.alg.actor.student.actor[0].weight[0, 0] = float("nan")
        keep = runner.rescue.keepsake.keep
        monkeypatch.setattr(runner, "_iterate", lambda obs: keep({"learned": runner.learned()}, 2, "cpu") or obs)
    update_run_json(tmp_path, {"outcome": outcome})
    monkeypatch.setattr(LostProcesses, "lost", True)
    with pytest.raises((ProcessLostError, SystemExit)) as caught:
        runner.learn(1)
    return caught.value


def noted(folder):
    return json.loads((folder / "run.json").read_text())["outcome"]


def test_a_rescued_checkpoint_is_of_the_last_iteration(tmp_path, monkeypatch):
    error = lose(tmp_path, monkeypatch, outcome="running", broken=False)
    assert "iteration 2 is in" in str(error) and read_checkpoint(tmp_path / "model_2.pt")["iter"] == 2
    assert noted(tmp_path) == "lost a process"


def test_broken_weights_are_not_rescued(tmp_path, monkeypatch):
    error = lose(tmp_path, monkeypatch, outcome="running", broken=True)
    assert isinstance(error, ProcessLostError) and "not finite" in str(error) and "--resume" not in str(error)
    assert not (tmp_path / "model_2.pt").exists() and noted(tmp_path) == "diverged"


@pytest.mark.parametrize("broken", [True, False])
def test_a_run_in_which_another_process_diverged_has_diverged(tmp_path, monkeypatch, broken):
    """The one that diverged has said so; what is finite is kept all the same."""
    assert isinstance(lose(tmp_path, monkeypatch, outcome="diverged", broken=broken), SystemExit)
    assert (tmp_path / "model_2.pt").exists() == (not broken) and noted(tmp_path) == "diverged"


def test_a_run_in_which_another_process_failed_has_lost_it(tmp_path, monkeypatch):
    """It noted that, since nobody might have been left to; those that are left have a checkpoint to tell of."""
    error = lose(tmp_path, monkeypatch, outcome="failed", broken=False)
    assert "iteration 2 is in" in str(error) and (tmp_path / "model_2.pt").exists()
    assert noted(tmp_path) == "lost a process"


def test_a_process_that_diverges_says_so_for_all(tmp_path):
    env = ToyEnv()
    env.poison = 2
    with pytest.raises(TrainingDivergedError):
        make(tmp_path, env=env).learn(1)
    assert noted(tmp_path) == "diverged"


@pytest.mark.parametrize("begun_at", [0, 3])
def test_a_run_that_loses_a_process_before_its_first_iteration_says_so(tmp_path, monkeypatch, begun_at):
    runner = make(tmp_path)
    runner.iteration = begun_at
    update_run_json(tmp_path, {"outcome": "running"})
    monkeypatch.setattr("gaitgauge.training.run.rescue.time.sleep", lambda _: None)
    monkeypatch.setattr(LostProcesses, "lost", True)
    monkeypatch.setattr(runner, "_iterate", lambda *_: runner.processes.largest(0))
    with pytest.raises(ProcessLostError, match=r"no iteration was complete, so there is no new checkpoint$"):
        runner.learn(1)
    said = json.loads((tmp_path / "run.json").read_text())
    assert (said["outcome"], said["iteration"]) == ("lost a process", begun_at)


@pytest.mark.parametrize("complete", [0, 1])
def test_a_process_that_fails_says_so_for_all(tmp_path, monkeypatch, complete):
    """A reward that raises does so in every process, whether or not an iteration was complete: none is left to say it."""
    runner = make(tmp_path)
    runner.learn(complete)
    update_run_json(tmp_path, {"outcome": "running"})
    monkeypatch.setattr(runner.env, "step", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        runner.learn(1)
    assert noted(tmp_path) == "failed"


@pytest.mark.parametrize("complete", [0, 2])
def test_a_process_that_hangs_in_a_message_ends_with_a_checkpoint_when_asked_to_stop(
    tmp_path, monkeypatch, capfd, complete
):
    """As in NCCL: the call to a lost process never comes back, whatever signal arrives."""
    runner = make(tmp_path)
    update_run_json(tmp_path, {"outcome": "running"})
    monkeypatch.setattr("gaitgauge.training.run.rescue.PATIENCE", 0.6)
    monkeypatch.setattr("gaitgauge.training.run.rescue.PATIENCE_AFTER_SIGNAL", 0.3)
    monkeypatch.setattr(LostProcesses, "lost", False)
    ended, codes = threading.Event(), []

    def end(code):
        codes.append(code)
        ended.set()

    def hang(_):
        if runner.iteration == complete:
            os.kill(os.getpid(), signal.SIGTERM)
            assert ended.wait(20.0), "nobody ended the process"
            raise KeyboardInterrupt  # it would be gone by now

    monkeypatch.setattr("gaitgauge.training.run.rescue.os._exit", end)
    monkeypatch.setattr("gaitgauge.training.run.rescue.time.sleep", lambda _: None)
    monkeypatch.setattr(runner.processes.__class__, "average", lambda _, values: hang(values))
    before = {name: value.clone() for name, value in runner.alg.actor.state_dict().items()}
    keep = runner.rescue.keep

    def remember():
        keep()
        before.update({name: value.clone() for name, value in runner.alg.actor.state_dict().items()})

    monkeypatch.setattr(runner.rescue, "keep", remember)
    with pytest.raises(KeyboardInterrupt):
        runner.learn(5)
    assert codes == [2]
    (sentence,) = [line for line in capfd.readouterr().err.splitlines() if line.startswith("gaitgauge: ")]
    path = tmp_path / f"model_{complete}.pt"
    if not complete:
        assert sentence.endswith("did not answer for 0.6 s; no iteration was complete, so there is no new checkpoint")
        assert not path.exists()
        return
    assert sentence.endswith(f"for 0.3 s; iteration 2 is in '{path}', go on with --resume {tmp_path}")
    written = read_checkpoint(path)
    assert written["iter"] == 2
    assert all(torch.equal(value, before[name]) for name, value in written["actor_state_dict"].items())
