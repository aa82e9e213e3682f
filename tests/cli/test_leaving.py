"""The end of a command that failed on a GPU: after its sentence nothing is waited for."""

import subprocess
import sys

import pytest
import torch
from gaitgauge.cli import main as program

FAILS = """
import sys, tempfile, threading, time, torch
from gaitgauge.backends.base import BackendError
from gaitgauge.cli import main as program
from gaitgauge.training.run import launch

folder = tempfile.TemporaryDirectory()
def train(*_, **__):
    torch.cuda.is_initialized = lambda: True
    threading.Thread(target=time.sleep, args=(1000,)).start()
    print(folder.name)
    raise BackendError("1000000 worlds do not fit into the memory of cuda:0: about 479209 would")

launch.train = train
sys.argv = ["gaitgauge", "train", "go2-flat", "--backend", "mujoco", "--device", "cpu", "--num-envs", "4", "--no-score", "--no-film"]
program.main()
"""


@pytest.mark.parametrize(
    ("code", "on_gpu", "left"), [(2, True, [2]), (0, True, []), (None, True, []), (2, False, []), ("text", True, [])]
)
def test_only_a_failure_on_a_gpu_leaves_at_once(monkeypatch, code, on_gpu, left):
    def ends(**_):
        raise SystemExit(code)

    exits: list[int] = []
    monkeypatch.setattr(program, "app", ends)
    monkeypatch.setattr(program.atexit, "_run_exitfuncs", lambda: None)
    monkeypatch.setattr(program.os, "_exit", exits.append)
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: on_gpu)
    with pytest.raises(SystemExit) as end:
        program.main()
    assert exits == left and end.value.code == code


@pytest.mark.slow
def test_a_training_without_enough_memory_ends_after_its_sentence(tmp_path):
    ended = subprocess.run([sys.executable, "-c", FAILS], cwd=tmp_path, capture_output=True, text=True, timeout=500)
    assert ended.returncode == 2
    assert ended.stderr.strip().splitlines()[-1].startswith("gaitgauge: 1000000 worlds do not fit into the memory")
    folder = next(line for line in ended.stdout.splitlines() if "/" in line)
    assert not (tmp_path / folder).exists(), "a temporary folder was left"
