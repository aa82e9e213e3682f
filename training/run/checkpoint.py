"""Checkpoints: a policy file that also holds everything a run needs to continue as if it had never stopped.

A checkpoint is a file of ``policy.native``'s format (contract, network, averaged weights of the student), so every command that takes a
policy takes it. Beside these it has rsl_rl's usual entries (``actor_state_dict`` … ``iter``; the weights after the last update),
``average`` (the averaged networks) and ``training``, what only a resumed run reads. It holds tensors and plain data only and is read
without the ability to run code.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import Field

from ...files.parsing import Count, Text, build, edited, one_line, shown
from ...files.writing import replacing
from ...policy import native
from ...policy.base import PolicyError
from ...policy.contract import PolicyContract
from ...policy.foreign.fence.archive import read_limited
from ...policy.loading import file_kind
from ..algorithms.bootstrap import iterations_left

TRAINING_VERSION = 1


class CheckpointError(RuntimeError):
    """A checkpoint cannot be written or does not fit the run; the message says which file, why, and what to do."""


def checkpoint_entries(
    contract: PolicyContract, network: native.StoredNetwork, extra: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the dictionary of a checkpoint: the entries of a policy file, and ``extra``.

    Raises:
        CheckpointError: ``extra`` holds something other than tensors and plain data, or takes a name of the policy
        format.
    """
    entries = native.policy_entries(contract, network)
    if taken := entries.keys() & extra.keys():
        raise CheckpointError(
            f"A checkpoint entry cannot be named {', '.join(sorted(taken))}: the policy format uses these names."
        )
    for name, value in extra.items():
        _require_plain(name, value)
    return entries | dict(extra)


def _require_plain(name: str, value: Any) -> None:
    """Refuse values that could not be read back without running code."""
    if value is None or isinstance(value, bool | int | float | str | torch.Tensor):
        return
    if isinstance(value, Mapping):
        for key, entry in value.items():
            _require_plain(f"{name}.{key}", entry)
    elif isinstance(value, list | tuple):
        for i, entry in enumerate(value):
            _require_plain(f"{name}[{i}]", entry)
    else:
        raise CheckpointError(
            f"A checkpoint can hold tensors, numbers, texts, lists and dictionaries only; {name} is a "
            f"{type(value).__name__}."
        )


def write_checkpoint(path: Path, entries: Mapping[str, Any]) -> None:
    """Write a file that appears whole or not at all; an earlier file survives a failure.

    Raises:
        CheckpointError: the file cannot be written, for example because the disk is full.
    """
    policy = entries.get("format") == native.FORMAT
    buffer = io.BytesIO()
    torch.save({**entries, "checksum": native.checksum(entries)} if policy else dict(entries), buffer)
    with _whole(path) as partial:
        partial.write_bytes(buffer.getbuffer())


def copy_checkpoint(source: Path, target: Path) -> None:
    """Make ``target`` a copy of ``source``, whole or not at all. Raises CheckpointError: it cannot be read or written."""
    with _whole(target) as partial:
        shutil.copyfile(source, partial)


@contextmanager
def _whole(path: Path) -> Iterator[Path]:
    try:
        with replacing(path, CheckpointError) as partial:
            yield partial
    except CheckpointError as error:
        raise CheckpointError(f"{error}; a training goes on with --resume latest") from error


def rank_file(path: Path, rank: int) -> Path:
    """Return the file with the part of process ``rank`` of a checkpoint."""
    return path.with_suffix(f".rank{rank}{path.suffix}")


def read_checkpoint(path: str | Path, *, training_state: bool = True, purpose: str = "resume from") -> dict[str, Any]:
    """Read a training checkpoint onto the CPU.

    Args:
        training_state: whether it must hold what training needs to continue; otherwise a policy file will do.
        purpose: of reading it, for the sentences on errors.

    Raises:
        CheckpointError: no such file, damaged, no policy of this project, or a policy without training state.
    """
    cannot = f"Cannot {purpose} '{one_line(path)}': it"
    entries = _load(Path(path), purpose)
    training = entries.get("training")
    policy = native.is_policy(entries)
    if policy:
        _check_policy(entries, str(path), purpose)
    if not training_state and training is None and policy:
        entries = _with_training_part(entries, Path(path), cannot)
        if (training := entries.get("training")) is None:
            return entries
    if not training_state and not policy:
        raise CheckpointError(
            f"{cannot} holds no networks of this project; give a model_<iteration>.pt of a training run or a .gauge.pt."
        )
    if not policy or not isinstance(training, Mapping):
        raise CheckpointError(f"{cannot} holds no training state; give a model_<iteration>.pt of a training run.")
    if training_state and "num_envs" not in training:
        raise CheckpointError(f"{cannot} holds networks only; begin a new run with them: --init-from {path}.")
    version = training.get("version")
    if type(version) is not int or version != TRAINING_VERSION:
        raise CheckpointError(
            f"{cannot}s training state has version {shown(version)}, this gaitgauge reads {TRAINING_VERSION}."
        )
    progress = training.get("progress", 1.0)
    if not isinstance(progress, int | float) or not progress >= 0.0:
        raise CheckpointError(f"{cannot}s progress is {shown(progress)}, no share of a run.")
    return entries


@dataclass(frozen=True, kw_only=True)
class RunNumbers:
    """Numbers and names of a checkpoint's run."""

    task: Text
    iteration: Annotated[int, Field(ge=0, lt=2**53)]
    """Updates done."""
    num_envs: Count
    """Environments of the process that wrote it."""
    world_size: Annotated[int, Field(ge=0, le=1_000_000)]
    """Processes of the run; 0 where some were lost."""
    best_score: float | None
    best_iteration: Annotated[int, Field(ge=0, lt=2**53)] | None


def run_numbers(entries: Mapping[str, Any], path: Path) -> RunNumbers:
    """Return the numbers of a checkpoint that ``read_checkpoint`` read with its training state.

    Raises:
        CheckpointError: one is missing, of the wrong type or out of range.
    """
    training = entries["training"]
    found = {f.name: training[f.name] for f in fields(RunNumbers) if f.name in training}
    if "iter" in entries:
        found["iteration"] = entries["iter"]
    return build(RunNumbers, found, f"Cannot resume from '{path}': its training state", CheckpointError)


def read_rank(path: Path, rank: int, written: Any) -> dict[str, Any] | None:
    """Read the part of process ``rank`` of a checkpoint; None if none was ``written`` with it: the first process may have been the only
    one that came to write, or the checkpoint is a copy.

    Raises:
        CheckpointError: the file is damaged or holds more than tensors and plain data.
    """
    file = rank_file(path, rank)
    entries = _load(file, "resume from") if file.exists() else {}
    return entries if entries and entries.get("written") == written else None


def _load(file: Path, purpose: str) -> dict[str, Any]:
    try:
        data = read_limited(file)
        kind = file_kind(data, str(file))
        entries = dict(native.load_entries(data, source=str(file))) if kind == "torch" else None
    except PolicyError as error:
        raise CheckpointError(f"Cannot {purpose.partition(' ')[0]}: {error}.") from error
    if entries is None:
        raise CheckpointError(
            f"Cannot {purpose} '{one_line(file)}': it is a program ({kind}), and training takes weights of this project: a "
            "model_<iteration>.pt of a run, or a .gauge.pt."
        )
    return entries


def _check_policy(entries: Mapping[str, Any], source: str, purpose: str) -> None:
    """Refuse a checkpoint with a damaged policy, or with a program: training goes on with weights."""
    try:
        _, network = native.read_policy(entries, source=source)
    except PolicyError as error:
        raise CheckpointError(f"Cannot {purpose.partition(' ')[0]}: {error}.") from error
    if isinstance(network, native.ForeignFile):
        raise CheckpointError(
            f"Cannot {purpose} '{one_line(source)}': it carries a program ({network.kind}), not weights, which is all that training "
            "takes; --trust changes nothing in that."
        )


def reached(entries: Mapping[str, Any]) -> float:
    """Return the fraction of its schedules that the run of a file had gone through; 1 where the file does not say: a finished policy goes
    on with the end of its schedules.
    """
    return min(float(entries.get("training", {}).get("progress", 1.0)), 1.0)


def learned_networks(entries: Mapping[str, Any], *, raw: bool = False) -> Mapping[str, Any]:
    """Return ``actor_state_dict`` and ``critic_state_dict`` of a checkpoint: the averages where it has any, unless ``raw``."""
    return entries if raw else entries.get("average", entries)


def student_state(actor: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the deployed network's part of an actor's state dictionary."""
    return {n.removeprefix("student."): value for n, value in actor.items() if n.startswith("student.")}


def training_part(policy: Path) -> Path:
    """Return where the networks that only training needs lie beside a policy file: ``go2.training.pt`` of ``go2.gauge.pt``."""
    return policy.with_name(f"{policy.name.removesuffix('.pt').removesuffix('.gauge')}.training.pt")


def write_apart(source: str | Path, destination: Path) -> None:
    """Write a file of ``trim_checkpoint`` in two: a policy file with what plays, and what only training reads beside it.

    Raises:
        CheckpointError: ``source`` is no such file, or one of the two cannot be written.
    """
    entries = read_checkpoint(source, training_state=False, purpose="use")
    if "training" not in entries or "average" in entries:
        raise CheckpointError(
            f"Cannot use '{source}': it is no policy with teacher and critic; write one with import --trainable."
        )
    whole = {name: entries[name] for name in ("format", "version", "contract", "network", "state_dict")}
    actor = entries["actor_state_dict"]
    more = {n: value for n, value in actor.items() if not n.startswith("student.")}
    rest: dict[str, Any] = {
        name: entries[name] for name in ("critic_state_dict", "iter", "bootstrap", "training") if name in entries
    }
    write_checkpoint(destination, whole)
    write_checkpoint(training_part(destination), {"policy": native.checksum(entries), "actor_state_dict": more, **rest})


def _with_training_part(entries: dict[str, Any], path: Path, cannot: str) -> dict[str, Any]:
    """Return a policy file's entries with what ``write_apart`` put beside it, where there is such a file.

    Raises:
        CheckpointError: the file beside it is damaged, or belongs to another policy.
    """
    part = training_part(path)
    if part == path or not part.is_file():
        return entries
    beside = _load(part, "start from")
    if beside.get("policy") != native.checksum(entries):
        raise CheckpointError(f"{cannot} is not the policy that '{one_line(part)}' belongs to; move that file away.")
    with edited(f"Cannot start from '{path}': '{one_line(part)}' beside it", CheckpointError, RuntimeError):
        student = {f"student.{name}": value for name, value in entries["state_dict"].items()}
        return {**entries, **beside, "actor_state_dict": {**beside["actor_state_dict"], **student}}


def trim_checkpoint(source: str | Path, destination: Path, *, raw: bool = False) -> None:
    """Write a checkpoint's averaged networks, or ``raw`` ones after the last update, without the state for resuming: a policy file from
    which training can begin anew (``--init-from``), with its teacher and its critic. Raises CheckpointError: ``source`` is no training
    checkpoint, or the destination cannot be written.
    """
    entries = read_checkpoint(source, purpose="use")
    with edited(f"Cannot use '{source}': it", CheckpointError, RuntimeError):
        networks = learned_networks(entries, raw=raw)
        actor, critic = networks["actor_state_dict"], networks["critic_state_dict"]
        kept = {name: entries[name] for name in ("format", "version", "contract", "network")}
        if raw:
            contract = PolicyContract.from_json(entries["contract"])
            kept["contract"] = replace(contract, provenance={**contract.provenance, "weights": "last update"}).to_json()
        training = {
            name: entries["training"][name] for name in ("version", "task", "progress") if name in entries["training"]
        }
        bare = {"bootstrap": {"left": iterations_left(entries["bootstrap"])}} if "bootstrap" in entries else {}
        write_checkpoint(
            Path(destination),
            kept
            # The student is in there twice; tensors that are the same object are stored once.
            | {"state_dict": student_state(actor), "actor_state_dict": actor, "critic_state_dict": critic}
            | {"iter": entries["iter"]}
            | bare
            | {"training": training},
        )
