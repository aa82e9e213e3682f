"""Start the processes of a training on this machine, one for each GPU."""

from __future__ import annotations

import logging
import os
import signal
import sys
import tempfile
import uuid
from collections.abc import Sequence
from pathlib import Path

import torch
from torch.distributed.elastic.multiprocessing import DefaultLogsSpecs, SignalException, Std
from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
from torch.distributed.launcher.api import LaunchConfig, elastic_launch

from ..policy.finding import latest_checkpoint
from .configuration import ConfigurationError
from .processes import RUN_BEGAN, RUN_TOLD


def processes_to_start(gpus: int | None, asked: str | None, device: str) -> int:
    """Return how many processes a training is to start, one for each GPU; 1 if this process trains itself.

    Args:
        gpus: how many GPUs the user asks for, None for all that are visible.
        asked: the device that the user asks for; one GPU by number (``cuda:1``) is that GPU alone.
        device: what ``own_device`` made of it.

    Raises:
        ConfigurationError: there are not so many.
    """
    if "WORLD_SIZE" in os.environ:  # torchrun or this function's caller started this process
        return 1
    one = not device.startswith("cuda") or asked not in (None, "cuda")
    here = 1 if one else torch.cuda.device_count()
    if gpus is not None and gpus > here:
        has = f"trains on '{device}' alone" if one else f"has {here} GPU{'s' * (here > 1)}"
        raise ConfigurationError(f"--gpus is {gpus}, but this command {has}; give --gpus {here} or leave it out")
    return gpus or here


def start_processes(count: int, arguments: Sequence[str], *, began: float) -> int:
    """Run this program in several processes that know of each other, and wait for their end.

    The first process writes to the terminal. What others printed is shown where they failed first or the first one was killed.
    ``began`` is ``time.monotonic()`` of the command's start, from which all of them count.

    Returns:
        The exit code of the first process that failed, otherwise 0.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    logging.getLogger("torch.distributed.elastic").setLevel(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as folder:
        told = Path(folder) / "run"
        os.environ |= {RUN_TOLD: str(told), RUN_BEGAN: repr(began)}
        logs = DefaultLogsSpecs(log_dir=folder, redirects=dict.fromkeys(range(1, count), Std.ALL))
        config = LaunchConfig(
            min_nodes=1,
            max_nodes=1,
            nproc_per_node=count,
            run_id=uuid.uuid4().hex,
            rdzv_backend="c10d",
            rdzv_endpoint="localhost:0",
            max_restarts=0,
            logs_specs=logs,
        )
        try:
            elastic_launch(config, sys.executable)("-m", "gaitgauge.cli.main", *arguments)
        except ChildFailedError as error:
            rank, failure = error.get_first_failure()
            killed = failure.exitcode < 0
            tellers = [rank] if rank else range(1, count) if killed else []
            texts = [p.read_text(errors="replace") for r in tellers for p in Path(folder).rglob(f"{r}/stderr.log")]
            sys.stderr.write("".join(dict.fromkeys(texts)))
            if killed:
                name = signal.Signals(-failure.exitcode).name
                sys.stderr.write(f"process {rank} of {count}, from 0, was killed ({name}); {_left(told)}\n")
            return 128 - failure.exitcode if killed else failure.exitcode
        except SignalException as error:
            return 128 + error.sigval
    return 0


def _left(told: Path) -> str:
    """Return what there is to go on with after a process was killed, from the file that names the run directory."""
    run = Path(told.read_text()) if told.is_file() else None
    if run is None or (last := latest_checkpoint(run)) is None:
        return "there is no checkpoint: start again"
    return f"the last checkpoint is '{last}', go on with --resume {run}"
