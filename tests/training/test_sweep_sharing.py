"""MPS for trainings that share a GPU: started, handed on, ended; a shell script stands for NVIDIA's program."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from gaitgauge.training.sweep import sharing
from gaitgauge.training.sweep.jobs import Jobs
from gaitgauge.training.sweep.sharing import shared_gpus
from scripted_sweep import SWEEP, scripted

PROGRAM = "nvidia-cuda-mps-control"
DAEMON = """#!/bin/sh
if [ "$1" = -d ]; then
  echo "start ${CUDA_VISIBLE_DEVICES-all}" >> "$NOTES"
  START
else
  read order; echo "$order" >> "$NOTES"
  QUIT
fi
"""


@pytest.fixture
def notes(tmp_path, monkeypatch):
    """What the program was asked; none is installed yet, and none runs."""
    path = tmp_path / "notes"
    monkeypatch.setenv("NOTES", str(path))
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}/bin{os.pathsep}/usr/bin")
    monkeypatch.setattr(sharing, "_FOLDERS", ())
    monkeypatch.setattr(sharing, "_DEFAULT_PIPES", tmp_path / "pipes")
    monkeypatch.delenv("CUDA_MPS_PIPE_DIRECTORY", raising=False)
    return path


def install(folder: Path, *, start="", end=""):
    program = folder / PROGRAM
    program.write_text(DAEMON.replace("START", start or "true").replace("QUIT", end or "true"))
    program.chmod(0o755)


def test_it_is_started_for_all_gpus_and_ended(tmp_path, notes, monkeypatch):
    install(tmp_path)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    said = []
    with shared_gpus(said.append) as variables:
        assert notes.read_text() == "start all\n"
        assert set(variables) == {"CUDA_MPS_PIPE_DIRECTORY", "CUDA_MPS_LOG_DIRECTORY"}
        folders = [Path(path) for path in variables.values()]
        assert all(folder.is_dir() for folder in folders)
    assert notes.read_text() == "start all\nquit\n"
    assert not any(folder.exists() for folder in folders)
    assert said == []


def test_it_is_ended_after_an_error(tmp_path, notes):
    install(tmp_path)
    with pytest.raises(KeyboardInterrupt), shared_gpus(print):
        raise KeyboardInterrupt
    assert notes.read_text().endswith("quit\n")


def test_a_machine_without_it_is_told_of(notes):
    said = []
    with shared_gpus(said.append) as variables:
        assert variables == {}
    (sentence,) = said
    assert PROGRAM in sentence and "take turns" in sentence


def test_one_that_does_not_start_is_told_of(tmp_path, notes):
    install(tmp_path, start="echo 'no permission for the GPU' >&2; exit 1")
    said = []
    with shared_gpus(said.append) as variables:
        assert variables == {}
    assert "no permission for the GPU" in said[0]
    assert notes.read_text() == "start all\n", "what did not start is not ended"


def test_one_that_runs_already_is_left_alone(tmp_path, notes, monkeypatch):
    install(tmp_path)
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "control").touch()
    monkeypatch.setenv("CUDA_MPS_PIPE_DIRECTORY", str(tmp_path / "own"))
    with shared_gpus(print) as variables:
        assert variables == {}
    assert not notes.exists()


def test_one_that_does_not_end_is_killed(tmp_path, notes, monkeypatch):
    monkeypatch.setattr(sharing, "_PATIENCE", 0.5)
    daemon = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    install(tmp_path, start=f'echo {daemon.pid} > "$CUDA_MPS_PIPE_DIRECTORY/{PROGRAM}.pid"', end="exec sleep 60")
    began = time.monotonic()
    with shared_gpus(print):
        pass
    assert daemon.wait(5.0) == -9
    assert time.monotonic() - began < 10.0


def test_trainings_on_gpus_get_its_variables_and_others_do_not(tmp_path, monkeypatch):
    seen = {}
    popen = subprocess.Popen

    def noted(command, **options):
        seen[options["env"]["CUDA_VISIBLE_DEVICES"]] = options["env"].get("CUDA_MPS_PIPE_DIRECTORY")
        return popen(command, **options)

    monkeypatch.setattr("gaitgauge.training.sweep.jobs.subprocess.Popen", noted)
    runs = [scripted(tmp_path, "short"), scripted(tmp_path, "processor", on_gpu=False)]
    Jobs(SWEEP, threads=1, deadline=None, say=print, gpus=("5",), sharing={"CUDA_MPS_PIPE_DIRECTORY": "pipes"}).work(
        runs
    )
    assert seen == {"5": "pipes", "": None}
