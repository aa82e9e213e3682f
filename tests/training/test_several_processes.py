"""Training in two processes, as ``train`` starts them on one machine and torchrun on two; on the CPU."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from datetime import datetime
from pathlib import Path

import pytest
import torch

SMALL = (
    "training.algorithm.minibatches=1",
    "training.algorithm.epochs=2",
    "training.run.steps_per_iteration=4",
    "training.run.save_interval=2",
    "training.network.actor_hidden=8",
    "training.network.critic_hidden=8",
    "training.network.teacher_hidden=8",
    "training.network.student_hidden=8",
)
MODULE = ("-m", "gaitgauge.cli.main")
TRAIN = (
    *("train", "go2-flat", "--backend", "fake", "--device", "cpu", "--num-envs", "8"),
    *("--no-score", "--no-film", "--seed", "5", *SMALL),
)
SCRIPT = """
import torch
from gaitgauge.training.processes import Processes
from gaitgauge.training.run.runner import TrainingRunner
from toy_training import ToyEnv, toy_configuration, toy_contract
import os
rank = int(os.environ["RANK"])
torch.manual_seed(rank)
runner = TrainingRunner(ToyEnv(seed=rank), toy_configuration(), contract=toy_contract(), task="toy", processes=Processes.join("cpu"))
runner.learn(3)
mine = torch.cat([p.detach().flatten() for p in (*runner.alg.actor.parameters(), *runner.alg.critic.parameters())])
both = [torch.zeros_like(mine) for _ in range(2)]
torch.distributed.all_gather(both, mine)
seen = [torch.zeros_like(runner.env.command) for _ in range(2)]
torch.distributed.all_gather(seen, runner.env.command)
assert not torch.equal(*seen), "both processes saw the same"
assert torch.equal(*both), "the networks drifted apart"
assert runner.alg.learning_rate != 1e-3
runner.close()
runner.processes.leave()
"""


TWO = """
import sys, time
from gaitgauge.training.starting import start_processes
sys.exit(start_processes(2, sys.argv[1:], began=time.monotonic() - 1000.0))
"""
"""Start a command as ``train`` does where there are two GPUs; it began 1000 s ago."""
ONE_MACHINE = ("--standalone", "--nproc-per-node", "2")


def start(folder: Path, *command: str, torchrun: tuple[str, ...] = ()) -> subprocess.Popen[str]:
    with_torchrun = [sys.executable, "-m", "torch.distributed.run", *torchrun, *command]
    launcher = with_torchrun if torchrun else [sys.executable, "-c", TWO, *command]
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join((str(Path(__file__).parent), *sys.path)),
    }
    return subprocess.Popen(
        launcher, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


@pytest.mark.slow
def test_gradients_are_averaged(tmp_path):
    (tmp_path / "learn.py").write_text(SCRIPT)
    process = start(tmp_path, "learn.py", torchrun=ONE_MACHINE)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output


@pytest.mark.slow
def test_one_process_speaks_and_both_are_kept(tmp_path):
    process = start(tmp_path, *TRAIN, "--iterations", "2")
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output
    assert output.count("run directory") == 1
    (run,) = (tmp_path / "logs" / "rsl_rl" / "go2_flat").iterdir()
    assert "16 min" in output, "the shown time does not count from the command"
    description = json.loads((run / "run.json").read_text())
    began, started = (datetime.fromisoformat(description[key]) for key in ("began", "started"))
    assert 1000.0 <= (started - began).total_seconds() < 1200.0
    assert len(list(run.glob("events.out.tfevents.*"))) == 1
    assert sorted(f.name for f in run.glob("model_*.pt")) == ["model_2.pt", "model_2.rank1.pt"]
    first, second = (torch.load(run / f"model_2{end}.pt", weights_only=True) for end in ("", ".rank1"))
    assert first["training"]["log"]["total_steps"] == 2 * 4 * 8 * 2
    mine, other = first["training"]["environment"]["bodies"], second["environment"]["bodies"]
    assert not torch.equal(mine["friction"], other["friction"])
    resumed = start(tmp_path, *TRAIN, "--resume", "latest", "--iterations", "3")
    output, _ = resumed.communicate(timeout=300)
    assert resumed.returncode == 0, output
    assert "episodes start anew" not in output
    assert (run / "model_3.rank1.pt").is_file()


@pytest.mark.slow
def test_a_signal_ends_both_with_a_checkpoint(tmp_path):
    process = start(tmp_path, *TRAIN, "--iterations", "1000000")
    deadline = time.monotonic() + 120.0
    while not list(tmp_path.rglob("model_2.pt")) and time.monotonic() < deadline:
        time.sleep(0.1)
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=60)
    assert "--resume" in output, output
    (run,) = (tmp_path / "logs" / "rsl_rl" / "go2_flat").iterdir()
    description = json.loads((run / "run.json").read_text())
    assert description["outcome"] == "signal"
    last = run / f"model_{description['iteration']}.pt"
    assert last.is_file() and last.with_suffix(".rank1.pt").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("lost", [0, 1])
def test_a_run_that_loses_a_process_ends_with_a_checkpoint_and_a_sentence(tmp_path, lost):
    process = start(tmp_path, *TRAIN, "--iterations", "1000000", "training.run.save_interval=1000000")
    deadline = time.monotonic() + 120.0
    while not (found := list(tmp_path.rglob("events.out.tfevents.*"))) and time.monotonic() < deadline:
        time.sleep(0.1)
    time.sleep(3.0)
    (number,) = [n for n in children(process.pid) if rank(n) == str(lost)]
    os.kill(number, signal.SIGKILL)
    output, _ = process.communicate(timeout=60)
    run = found[0].parent
    description = json.loads((run / "run.json").read_text())
    last = run / f"model_{description['iteration']}.pt"
    assert description["outcome"] == "lost a process" and description["iteration"] > 0
    (sentence,) = [line for line in output.splitlines() if line.startswith("gaitgauge: ")]
    assert "another process has gone: " in sentence
    here = last.relative_to(tmp_path)
    assert f"process {lost} of 2, from 0, was killed (SIGKILL); the last checkpoint is '{here}'" in output
    assert f"iteration {description['iteration']} is in '{here}', go on with --resume {here.parent}" in sentence
    resumed = start(tmp_path, *TRAIN, "--resume", "latest", "--iterations", str(description["iteration"] + 1))
    output, _ = resumed.communicate(timeout=300)
    assert resumed.returncode == 0, output
    assert "what was left of several processes, not 2: episodes start anew, on the levels reached and at " in output
    assert (run / f"model_{description['iteration'] + 1}.rank1.pt").is_file()


HANGING = """
import ctypes, torch.distributed
asked = torch.distributed.all_reduce

def all_reduce(*arguments, **settings):
    try:
        return asked(*arguments, **settings)
    except RuntimeError:
        mutex = ctypes.create_string_buffer(64)
        for _ in range(2):  # the second time for ever, in C, deaf to signals
            ctypes.CDLL(None).pthread_mutex_lock(mutex)

torch.distributed.all_reduce = all_reduce
"""


@pytest.mark.slow
@pytest.mark.parametrize("lost", [0, 1])
def test_a_process_that_hangs_because_another_one_was_killed_leaves_a_checkpoint(tmp_path, monkeypatch, lost):
    """NCCL waits for a lost process, where gloo raises."""
    (tmp_path / "sitecustomize.py").write_text(HANGING)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    process = start(tmp_path, *TRAIN, "--iterations", "1000000", "training.run.save_interval=1000000")
    deadline = time.monotonic() + 120.0
    while not list(tmp_path.rglob("events.out.tfevents.*")) and time.monotonic() < deadline:
        time.sleep(0.1)
    time.sleep(3.0)
    (number,) = [n for n in children(process.pid) if rank(n) == str(lost)]
    os.kill(number, signal.SIGKILL)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGKILL, output
    (run,) = (tmp_path / "logs" / "rsl_rl" / "go2_flat").iterdir()
    description = json.loads((run / "run.json").read_text())
    last = run / f"model_{description['iteration']}.pt"
    assert description["outcome"] == "lost a process" and description["iteration"] > 0 and last.is_file()
    here = last.relative_to(tmp_path)
    assert f"process {lost} of 2, from 0, was killed (SIGKILL); the last checkpoint is '{here}'" in output
    (tmp_path / "sitecustomize.py").unlink()
    resumed = start(tmp_path, *TRAIN, "--resume", "latest", "--iterations", str(description["iteration"] + 1))
    output, _ = resumed.communicate(timeout=300)
    assert resumed.returncode == 0, output


def start_nodes(folder: Path, *command: str) -> list[subprocess.Popen[str]]:
    """Two agents of torchrun with one process each, as on two machines that share a folder."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    meeting = ("--nnodes", "2", "--nproc-per-node", "1", "--rdzv-backend", "c10d", "--rdzv-id", "walk")
    meeting += ("--rdzv-endpoint", f"127.0.0.1:{port}")
    return [start(folder, *command, torchrun=meeting) for _ in range(2)]


@pytest.mark.slow
def test_gradients_are_averaged_over_two_nodes(tmp_path):
    (tmp_path / "learn.py").write_text(SCRIPT)
    for node in start_nodes(tmp_path, "learn.py"):
        output, _ = node.communicate(timeout=300)
        assert node.returncode == 0, output


@pytest.mark.slow
def test_a_run_on_two_nodes_is_one_run_and_goes_on_without_one_of_them(tmp_path):
    nodes = start_nodes(tmp_path, *MODULE, *TRAIN, "--iterations", "1000000")
    deadline = time.monotonic() + 200.0
    while not list(tmp_path.rglob("model_2.rank1.pt")) and time.monotonic() < deadline:
        time.sleep(0.1)
    (run,) = (tmp_path / "logs" / "rsl_rl" / "go2_flat").iterdir()
    (second,) = [node for node in nodes if "1" in [rank(n) for n in children(node.pid)]]
    for number in [second.pid, *children(second.pid)]:
        os.kill(number, signal.SIGKILL)
    (first,) = [node for node in nodes if node is not second]
    output, _ = first.communicate(timeout=120)
    second.wait()
    description = json.loads((run / "run.json").read_text())
    assert description["outcome"] in ("lost a process", "signal"), output
    last = description["iteration"]
    assert last >= 2 and (run / f"model_{last}.pt").is_file()
    assert "--resume" in output
    alone = [sys.executable, *MODULE, *TRAIN, "--resume", "latest", "--iterations", str(last + 1)]
    done = subprocess.run(alone, cwd=tmp_path, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}, timeout=300)
    assert done.returncode == 0
    assert (run / f"model_{last + 1}.pt").is_file()


def children(parent: int) -> list[int]:
    """Processes that a process has started."""
    return [int(n) for n in Path(f"/proc/{parent}/task/{parent}/children").read_text().split()]


def rank(number: int) -> str:
    """Rank of a process of a run."""
    entries = dict(e.partition("=")[::2] for e in Path(f"/proc/{number}/environ").read_text().split("\0"))
    return entries.get("RANK", "")
