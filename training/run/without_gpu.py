"""Say at once that a task needs a GPU that this machine lacks, and what the machine can do instead."""

from __future__ import annotations

from ...backends.base import DeviceError
from ...backends.gpu import gpu_count
from ...backends.registry import made_for_gpu
from ...files.choices import cpu_threads
from ..tasks import TASKS, Task, find_task
from .request import TrainRequest

_TOY, _TOY_TIMES = TASKS["toy"], (113e-6, 68e-6)
"""CPU time of a step of ``toy`` on one core, and of the physics, which all cores share [s] (``benchmarks/toy_training.py``)."""
_TIMES = (0.0, 1380e-6)
"""The same of ``go2-flat``, which made 1,450 steps a second on two cores; torch, too, uses all cores there."""


def check_gpu(request: TrainRequest) -> None:
    """Refuse a new run on an engine made for a GPU where the driver has none; torch is not loaded for it.

    Raises:
        TaskError: unknown task, or a setting that does not fit.
        DeviceError: no GPU; the advice says what trains here and how long it takes.
    """
    if (request.resume, request.init_from, request.device) != (None, None, None):
        return  # a checkpoint is read first
    task = find_task(request.task, request.own_overrides(), robot=request.robot)
    backend = request.backend or task.backend
    if not made_for_gpu(backend) or gpu_count() > 0:
        return
    cores = cpu_threads(None)
    raise DeviceError(
        f"task '{task.name}' trains on {backend}, which wants an NVIDIA GPU, and this machine has none",
        f"'gaitgauge train toy' learns to walk here in {_time(_TOY, _TOY_TIMES, cores)}, the repository's "
        f"docs/start/first_training.ipynb trains go2-flat on a hosted GPU, and --backend mujoco trains this task here in "
        f"{_time(task, _TIMES, cores)}",
    )


def _time(task: Task, times: tuple[float, float], cores: int) -> str:
    """Return about how long a task takes on some idle cores, for people."""
    run = task.training.run
    step = times[0] + times[1] / cores
    minutes = run.iterations * run.steps_per_iteration * task.environment.num_envs * step / 60.0
    if minutes < 90.0:
        return f"about {max(round(minutes), 1)} min"
    return f"about {minutes / 60.0:.0f} h" if minutes < 72 * 60 else f"about {minutes / 1440.0:.0f} days"
