"""NVIDIA's MPS, which lets the kernels of several trainings run on a GPU at once; without it they take turns."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

_PROGRAM = "nvidia-cuda-mps-control"
_FOLDERS = ("/usr/local/nvidia/bin", "/usr/local/cuda/bin")
"""Folders of the program besides PATH."""
_DEFAULT_PIPES = Path("/tmp/nvidia-mps")  # NVIDIA's, where CUDA_MPS_PIPE_DIRECTORY is not set
_PATIENCE = 20.0
"""Longest wait for the daemon [s]. It ends once no process uses it any more."""


@contextmanager
def shared_gpus(say: Callable[[str], None]) -> Iterator[Mapping[str, str]]:
    """Start MPS for the processes that get the yielded variables in their environment, and end it afterwards.

    One that runs already is used as it is. Where there is none, ``say`` gets a sentence, and the trainings run without it.
    """
    if Path(os.environ.get("CUDA_MPS_PIPE_DIRECTORY", _DEFAULT_PIPES), "control").exists():
        yield {}
        return
    program = shutil.which(_PROGRAM, path=os.pathsep.join([os.environ.get("PATH", ""), *_FOLDERS]))
    if program is None:
        say(f"NVIDIA's MPS ({_PROGRAM}) is not on this machine: trainings on the same GPU take turns, which is slower")
        yield {}
        return
    with tempfile.TemporaryDirectory(prefix="mps-") as folder:
        variables = {f"CUDA_MPS_{name}_DIRECTORY": str(Path(folder) / name.lower()) for name in ("PIPE", "LOG")}
        for path in variables.values():
            Path(path).mkdir()
        # All GPUs, by their own numbers: a training's CUDA_VISIBLE_DEVICES chooses among those that the daemon sees.
        environment = {k: v for k, v in os.environ.items() if k != "CUDA_VISIBLE_DEVICES"} | variables
        if failure := _call([program, "-d"], environment):
            say(f"NVIDIA's MPS could not be started ({failure}): trainings on the same GPU take turns, which is slower")
            yield {}
            return
        try:
            yield variables
        finally:
            if _call([program], environment, "quit\n"):  # it does not end by itself
                with suppress(OSError, ValueError):
                    note = Path(variables["CUDA_MPS_PIPE_DIRECTORY"], f"{_PROGRAM}.pid")
                    os.kill(int(note.read_text()), signal.SIGKILL)


def _call(command: list[str], environment: Mapping[str, str], text: str = "") -> str:
    """Run the program; why it failed, empty if it did not."""
    try:
        done = subprocess.run(
            command, env=dict(environment), input=text, capture_output=True, text=True, timeout=_PATIENCE, check=False
        )
    except subprocess.TimeoutExpired:
        return f"no answer within {_PATIENCE:.0f} s"
    except OSError as error:
        return error.strerror or "it cannot be run"
    lines = (done.stderr or done.stdout).strip().splitlines()
    return (lines[-1] if lines else f"exit code {done.returncode}") if done.returncode else ""
