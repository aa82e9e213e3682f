"""The folder that a training run leaves behind, laid out as users of rsl_rl and Isaac Lab know it.

``logs/rsl_rl/<experiment>/<YYYY-MM-DD_HH-MM-SS>[_<run_name>]/`` with ``model_<iteration>.pt``, ``best.pt`` (chosen by
the gauge's score), ``params/env.yaml`` and ``params/agent.yaml``, ``run.json`` and TensorBoard's event files.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml

from ..files.parsing import read_results
from ..files.provenance import provenance
from ..files.writing import json_text, make_folder, write_atomically
from ..policy.contract import PolicyContract
from .checkpoint import CheckpointError
from .configuration import to_plain

LOG_ROOT = Path("logs/rsl_rl")


def new_run_directory(root: Path, experiment: str, run_name: str = "", now: datetime | None = None) -> Path:
    """Create ``<root>/<experiment>/<YYYY-MM-DD_HH-MM-SS>[_<run_name>]``; a taken name moves on to the next free second.

    Raises:
        CheckpointError: the folder cannot be created.
    """
    stamp = (now or datetime.now()).replace(microsecond=0)
    suffix = f"_{run_name}" if run_name else ""
    try:
        (root / experiment).mkdir(parents=True, exist_ok=True)
        for second in range(60):
            moment = datetime.fromtimestamp(stamp.timestamp() + second)
            run = root / experiment / f"{moment:%Y-%m-%d_%H-%M-%S}{suffix}"
            if not run.exists():
                run.mkdir()
                return run
    except OSError as error:
        raise CheckpointError(f"Cannot create a run directory in '{root / experiment}': {error.strerror}.") from error
    raise CheckpointError(
        f"Cannot create a run directory in '{root / experiment}': the names of the next minute are all taken."
    )


def latest_checkpoint(run: Path) -> Path | None:
    """The ``model_<iteration>.pt`` of the highest iteration in a run directory, None if there is none."""
    numbered = [
        (int(f.stem.removeprefix("model_")), f)
        for f in run.glob("model_*.pt")
        if f.stem.removeprefix("model_").isdigit()
    ]
    return max(numbered)[1] if numbered else None


def find_checkpoint(choice: str, *, experiment: str, task: str = "", root: Path = LOG_ROOT) -> Path:
    """The checkpoint that ``--resume`` names: ``latest`` (of the experiment), a run directory (its last), or a file.

    Raises:
        CheckpointError: there is none.
    """
    if choice == "latest":
        # A run for another robot than the task's has an experiment of its own.
        runs = [
            r
            for r in root.glob("*/*")
            if r.is_dir() and (r.parent.name == experiment or (task and read_run_json(r).get("task") == task))
        ]
        for run in sorted(runs, key=lambda r: r.name, reverse=True):
            if found := latest_checkpoint(run):
                return found
        raise CheckpointError(
            f"There is nothing to resume: no run in '{root / experiment}' has a model_<iteration>.pt."
        )
    path = Path(choice)
    if path.is_dir():
        if found := latest_checkpoint(path):
            return found
        raise CheckpointError(f"There is nothing to resume: '{choice}' has no model_<iteration>.pt.")
    if not path.is_file():
        raise CheckpointError(
            f"There is no checkpoint '{choice}'; give 'latest', a run directory or a model_<iteration>.pt."
        )
    return path


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


def describe_run(
    *, task: str, backend: str, num_envs: int, seed: int, device: str, contract: PolicyContract
) -> dict[str, Any]:
    """What ``run.json`` says about where and with what a run was made."""
    return {
        "task": task,
        "backend": backend,
        "num_envs": num_envs,
        "seed": seed,
        "started": f"{datetime.now().astimezone():%Y-%m-%dT%H:%M:%S%z}",
        "contract_hash": contract.hash,
    } | provenance(command=sys.argv, device=device)


def read_run_json(run: Path) -> dict[str, Any]:
    """Entries of a run directory's ``run.json``, none if there is no such file.

    Raises:
        CheckpointError: it is damaged.
    """
    path = run / "run.json"
    if not path.exists():
        return {}
    found = read_results(path, "run description", CheckpointError)
    score = (found.get("best_score"), found.get("best_iteration"))
    if not isinstance(found.get("resumed", []), list) or not all(s is None or type(s) in (int, float) for s in score):
        raise CheckpointError(f"'{path}' was edited or is damaged: resumed, best_score or best_iteration")
    return found


def update_run_json(run: Path, changes: Mapping[str, Any]) -> None:
    """Merge entries into ``run.json``, creating it if needed.

    Raises:
        CheckpointError: it is damaged or cannot be written.
    """
    data = read_run_json(run) | to_plain(changes)
    write_atomically(run / "run.json", json_text(data), CheckpointError)
