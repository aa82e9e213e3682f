"""The folder that a training run leaves behind, laid out as users of rsl_rl and Isaac Lab know it.

``logs/rsl_rl/<experiment>/<YYYY-MM-DD_HH-MM-SS>[_<run_name>]/`` with ``model_<iteration>.pt``, ``best.pt`` (chosen by the gauge's score),
``params/env.yaml`` and ``params/agent.yaml``, ``run.json`` and TensorBoard's event files.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import Field

from ...files.parsing import NotNegative, Text, one_line, read_results, take
from ...files.writing import json_text, make_folder, write_atomically
from ...policy.finding import LOG_ROOT, latest_checkpoint
from ..configuration import to_plain
from .checkpoint import CheckpointError

_Number = Annotated[int, Field(ge=0, lt=2**53)]


def new_run_directory(root: Path, experiment: str, run_name: str = "", now: datetime | None = None) -> Path:
    """Create ``<root>/<experiment>/<YYYY-MM-DD_HH-MM-SS>[_<run_name>]``; a taken name moves on to the next free second.

    Raises:
        CheckpointError: the folder cannot be created.
    """
    stamp = (now or datetime.now()).replace(microsecond=0)
    suffix = f"_{run_name}" if run_name else ""
    try:
        str(root).encode()
        (root / experiment).mkdir(parents=True, exist_ok=True)
        for second in range(60):
            moment = datetime.fromtimestamp(stamp.timestamp() + second)
            run = root / experiment / f"{moment:%Y-%m-%d_%H-%M-%S}{suffix}"
            with suppress(FileExistsError):  # another run's, perhaps made just now
                run.mkdir()
                return run
    except OSError as error:
        raise CheckpointError(f"Cannot create a run directory in '{root / experiment}': {error.strerror}.") from error
    except UnicodeEncodeError as error:
        raise CheckpointError(
            f"Cannot create a run directory in '{one_line(root)}': TensorBoard takes no path that is no UTF-8; choose "
            "another --log-root."
        ) from error
    raise CheckpointError(
        f"Cannot create a run directory in '{root / experiment}': the names of the next minute are all taken."
    )


def find_checkpoint(
    choice: str, *, experiment: str, task: str = "", root: Path = LOG_ROOT, others: Sequence[str] = ()
) -> Path:
    """Return the checkpoint that ``--resume`` or ``--init-from`` names: ``latest`` (of the experiment), a run directory (its last), or a
    file; ``others`` are the names that the option takes besides.

    Raises:
        CheckpointError: there is none.
    """
    if choice == "latest":
        runs = [r for r in root.glob("*/*") if r.is_dir()]
        for run in sorted(runs, key=lambda r: r.name, reverse=True):
            # A run for another robot than the task's has an experiment of its own; a task made of another one has that one's.
            mine, found = run.parent.name == experiment, latest_checkpoint(run)
            if task and found:
                mine = _task_of(run, task if mine else None) == task
            if mine and found:
                return found
        raise CheckpointError(f"There is no checkpoint: no run in '{root / experiment}' has a model_<iteration>.pt.")
    path = Path(choice)
    if path.is_dir():
        if found := latest_checkpoint(path):
            return found
        ended = "; the run ended before its first one (training.run.save_interval): start it again"
        raise CheckpointError(
            f"There is no checkpoint: '{one_line(choice)}' has no model_<iteration>.pt"
            f"{ended if (path / 'run.json').is_file() else ''}."
        )
    if not path.is_file():
        known = ", ".join(["latest", *others, "a run directory"])
        raise CheckpointError(f"There is no checkpoint '{one_line(choice)}'; give {known} or a model_<iteration>.pt.")
    return path


def _task_of(run: Path, otherwise: str | None) -> str | None:
    """Return the task of a run, or something else where it does not say; None for a run of other experiments with a damaged file."""
    try:
        return read_run_json(run).get("task", otherwise)
    except CheckpointError:
        if otherwise is not None:
            raise
        return None


def write_parameters(run: Path, *, environment: Any, agent: Any) -> None:
    """Write ``params/env.yaml`` and ``params/agent.yaml``, which ``yaml.safe_load`` reads back.

    Raises:
        CheckpointError: the files cannot be written.
    """
    folder = run / "params"
    make_folder(folder, CheckpointError, option="--log-root")
    for name, configuration in (("env", environment), ("agent", agent)):
        text = yaml.safe_dump(to_plain(configuration), sort_keys=False, allow_unicode=True)
        write_atomically(folder / f"{name}.yaml", text, CheckpointError)


@dataclass(frozen=True, kw_only=True)
class _Noted:
    """Entries that readers of a ``run.json`` rely on."""

    task: Text = ""
    outcome: Text = ""
    iteration: _Number = 0
    environment_steps: _Number | None = None
    training_seconds: NotNegative | None = None
    best_score: float | None = None
    best_iteration: _Number | None = None
    resumed: tuple[Any, ...] = ()


def read_run_json(run: Path) -> dict[str, Any]:
    """Return the entries of a run directory's ``run.json``, none if there is no such file. Raises CheckpointError: it is damaged."""
    path = run / "run.json"
    if not path.exists():
        return {}
    found = read_results(path, "run description", CheckpointError)
    take(_Noted, found, f"run description '{one_line(path)}'", CheckpointError)
    return found


def refuse_links(run: Path) -> None:
    """Refuse to go on in a run directory that leads elsewhere: training writes to its folders.

    Raises:
        CheckpointError: there is a link to a folder, or a link in one of its folders.
    """
    for place, folders, files in os.walk(run):
        below = [*folders] if Path(place) == run else [*folders, *files]
        for path in (Path(place, name) for name in below):
            if path.is_symlink():
                raise CheckpointError(
                    f"Cannot resume in '{one_line(run)}': '{one_line(path.relative_to(run))}' is a link, and a run "
                    "writes to its own folder alone; put there what it leads to."
                )


def update_run_json(run: Path, changes: Mapping[str, Any]) -> None:
    """Merge entries into ``run.json``, creating it if needed. Raises CheckpointError: it is damaged or cannot be written."""
    data = read_run_json(run) | to_plain(changes)
    write_atomically(run / "run.json", json_text(data), CheckpointError)
