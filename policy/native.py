"""The project's own policy file, and policies with a network built from it.

The file is what ``torch.save`` writes of a dictionary of plain data and tensors; it is only ever read with
``torch.load(weights_only=True)``, which cannot run code.

==============  =====================================================================================================
``format``      ``gaitgauge-policy``
``version``     of the layout, a whole number
``contract``    the policy contract as JSON text
``network``     ``kind``, ``architecture`` and ``arguments`` (JSON text) for a network of ``ARCHITECTURES``;
                ``kind`` (``torchscript`` or ``onnx``) and ``bytes`` (uint8 tensor) for a foreign file carried inside
``state_dict``  tensors of the network; absent for a foreign file
``checksum``    SHA-256 over contract, network and state_dict (``checksum``); files from before it was written lack it
==============  =====================================================================================================

Other keys are left alone: a training checkpoint keeps its optimiser there.
"""

from __future__ import annotations

import copy
import hashlib
import io
import json
import math
import pickle
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ..files.parsing import shown
from ..files.writing import make_folder, replacing
from .base import Policy, PolicyError, PolicySession, check_observation, checked_action
from .comparing import other_width
from .contract import ContractError, PolicyContract
from .foreign.fence.archive import packed, read_archive
from .foreign.fence.pickles import REBUILD_TENSOR, check_tensors, read_pickle
from .networks.architectures import ARCHITECTURES

FORMAT = "gaitgauge-policy"
VERSION = 1
FOREIGN_KINDS = ("torchscript", "onnx")
LARGEST_WIDTH = 65_536
"""Largest number among a network's arguments: of entries, of frames, of neurons in a layer."""
_LONGEST_ARGUMENTS = 65_536

# What a file of tensors and plain data mentions: names that are called, and classes of storages, which are not.
_PLAIN_CALLS = frozenset({REBUILD_TENSOR, "torch._utils _rebuild_parameter", "torch Size", "torch device"})
_PLAIN_CALLS |= {"collections OrderedDict", "builtins set", "__builtin__ set", "_codecs encode"}
_PLAIN_NAMES = re.compile(r"torch (\w+Storage|u?int\d+|float\d+|bfloat16|complex\d+|bool)")

PROGRAM_ERRORS = (RuntimeError, TypeError, ValueError, LookupError, AttributeError, ArithmeticError, MemoryError)
"""Errors inside torch where shapes, types or names do not fit together."""
LOAD_ERRORS = (*PROGRAM_ERRORS, torch.jit.Error, pickle.UnpicklingError, EOFError, OSError, AssertionError)
"""The same for damaged or foreign data, from the archive down to the tensors."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredNetwork:
    """Hold a network of ``architectures.py`` as data."""

    architecture: str
    """A key of ``ARCHITECTURES``."""
    arguments: Mapping[str, Any]
    """Keyword arguments of the architecture, plain JSON data."""
    state_dict: Mapping[str, torch.Tensor]


@dataclass(frozen=True, kw_only=True, eq=False)
class ForeignFile:
    """A policy file of another format, carried unchanged."""

    kind: str
    """``torchscript`` or ``onnx``."""
    data: bytes
    encoder: ForeignFile | None = None
    """The network that runs first, where the contract has an ``encoder``."""

    def entries(self) -> dict[str, Any]:
        """Return what a policy file says of it."""
        data = torch.frombuffer(bytearray(self.data), dtype=torch.uint8)
        return {"kind": self.kind, "bytes": data} | ({"encoder": self.encoder.entries()} if self.encoder else {})


def first_line(error: BaseException) -> str:
    """Return the first line that says anything of an error's message, for messages of one sentence."""
    return said_lines(error)[0].partition(". ")[0].rstrip(".")[:200]


def said_lines(error: BaseException) -> list[str]:
    """Return the lines of an error's message that say anything, or its name."""
    return [line.strip() for line in str(error).splitlines() if line.strip()] or [type(error).__name__]


def save_policy(path: str | Path, contract: PolicyContract, network: StoredNetwork | ForeignFile) -> None:
    """Write a policy file. The file appears whole or not at all.

    Args:
        path: conventionally ``model_<iteration>.pt`` for a checkpoint and ``<name>.gauge.pt`` for an import.

    Raises:
        PolicyError: the network does not fit the contract, or the file cannot be written.
    """
    if isinstance(network, StoredNetwork):
        build_network(network, contract, source=str(path))
    entries = policy_entries(contract, network)
    entries["checksum"] = checksum(entries)
    target = Path(path)
    make_folder(target.parent, PolicyError, option="place")
    # Given a path, torch would write its name into the file: equal policies, unequal bytes.
    with replacing(target, PolicyError) as partial, partial.open("wb") as file:
        torch.save(entries, file)


def policy_entries(contract: PolicyContract, network: StoredNetwork | ForeignFile) -> dict[str, Any]:
    """Return the entries of a policy file without its checksum."""
    entries: dict[str, Any] = {"format": FORMAT, "version": VERSION, "contract": contract.to_json()}
    if isinstance(network, StoredNetwork):
        arguments = json.dumps(dict(network.arguments))
        described = {"kind": "native", "architecture": network.architecture, "arguments": arguments}
        state = {name: value.detach().to("cpu") for name, value in network.state_dict.items()}
        return entries | {"network": described, "state_dict": state}
    return entries | {"network": network.entries()}


def checksum(entries: Mapping[str, Any]) -> str:
    """Return the SHA-256 over a policy file's contract, network and weights, hexadecimal.

    A text counts as its UTF-8 bytes, a tensor as its type, shape and content, each after its name.
    """
    digest = hashlib.sha256()

    def add(name: str, value: Any) -> None:
        if isinstance(value, Mapping):
            for key in sorted(value):
                add(f"{name}.{key}", value[key])
        elif isinstance(value, torch.Tensor):
            digest.update(f"{name} {value.dtype} {list(value.shape)}\n".encode())
            digest.update(value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes())
        else:
            digest.update(f"{name} {value}\n".encode(errors="backslashreplace"))

    for part in ("contract", "network", "state_dict"):
        add(part, entries.get(part))
    return digest.hexdigest()


def is_policy(entries: Mapping[str, Any]) -> bool:
    """Return whether a loaded file's dictionary is of the project's own format."""
    name = entries.get("format")
    return isinstance(name, str) and name == FORMAT


def read_policy(entries: Mapping[str, Any], *, source: str) -> tuple[PolicyContract, StoredNetwork | ForeignFile]:
    """Return the contract and network from a loaded file's dictionary.

    Raises:
        PolicyError: the file is of another version, incomplete or malformed.
    """
    version = entries.get("version")
    if type(version) is not int or version != VERSION:
        raise PolicyError(
            f"'{source}' has version {shown(version)} of the policy format; this gaitgauge reads {VERSION}"
        )
    text, spec = entries.get("contract"), entries.get("network")
    if "checksum" in entries and not _intact(entries):
        raise PolicyError(
            f"'{source}' is damaged: its contract, network or weights are not those that were written (checksum)"
        )
    if not isinstance(text, str) or not isinstance(spec, Mapping):
        raise PolicyError(f"'{source}' lacks its contract or network and cannot be used")
    try:
        contract = PolicyContract.from_json(text)
    except ContractError as error:
        raise PolicyError(f"'{source}' has a malformed contract: {error}") from error
    kind = spec.get("kind")
    if isinstance(kind, str) and kind in FOREIGN_KINDS:
        encoder = _carried(inner, source) if isinstance(inner := spec.get("encoder"), Mapping) else None
        return contract, replace(_carried(spec, source), encoder=encoder)
    if not isinstance(kind, str) or kind != "native":
        raise PolicyError(f"'{source}' has a network of unknown kind {shown(kind)}")
    state_dict = entries.get("state_dict")
    if not isinstance(state_dict, Mapping) or not all(isinstance(v, torch.Tensor) for v in state_dict.values()):
        raise PolicyError(f"'{source}' has no state_dict of tensors")
    try:
        arguments_text = spec.get("arguments", "")
        if len(arguments_text) > _LONGEST_ARGUMENTS:
            raise PolicyError(f"'{source}' has network arguments of over {_LONGEST_ARGUMENTS:,} characters")
        arguments = json.loads(arguments_text)
    except (ValueError, TypeError, RecursionError) as error:
        if isinstance(error, PolicyError):
            raise
        raise PolicyError(f"'{source}' has malformed network arguments: {first_line(error)}") from error
    architecture = str(spec.get("architecture"))
    return contract, StoredNetwork(architecture=architecture, arguments=arguments, state_dict=state_dict)


def _carried(spec: Mapping[str, Any], source: str) -> ForeignFile:
    """Return the foreign file that a policy file carries."""
    kind, data = spec.get("kind"), spec.get("bytes")
    if kind not in FOREIGN_KINDS or not isinstance(data, torch.Tensor) or data.dtype != torch.uint8:
        raise PolicyError(f"'{source}' says that it carries a {shown(kind)} file, but has none")
    return ForeignFile(kind=str(kind), data=data.numpy().tobytes())


def _intact(entries: Mapping[str, Any]) -> bool:
    try:
        return checksum(entries) == entries["checksum"]
    except LOAD_ERRORS:  # tensors of a kind that no policy has, names that cannot be sorted
        return False


def load_entries(data: bytes, *, source: str) -> Mapping[str, Any]:
    """Read a ``torch.save`` archive of data and tensors without running code; raise ``PolicyError`` for damage or anything else."""
    records = read_archive(data, source=source)
    if "data.pkl" not in records:
        raise PolicyError(f"'{source}' is a zip archive, but neither TorchScript nor a torch.save file")
    reading = read_pickle(records["data.pkl"], source=source)
    called = {call.function.name for call in reading.calls}
    # torch itself would allow some more: calls that make what no policy has, of any size
    others = [n for n in reading.names if n not in _PLAIN_CALLS]
    if strange := [n for n in others if n in called or not _PLAIN_NAMES.fullmatch(n)]:
        raise PolicyError(
            f"'{source}' holds more than tensors and plain data ('{strange[0].replace(' ', '.')}'), and was not loaded; "
            "export the policy as TorchScript or ONNX"
        )
    sizes = {name.partition("/")[2]: len(content) for name, content in records.items() if name.startswith("data/")}
    check_tensors((c for c in reading.calls if c.function.name == REBUILD_TENSOR), sizes, source=source)
    try:
        # what was checked is what is loaded: the archive is put together again
        entries = torch.load(io.BytesIO(packed(records)), map_location="cpu", weights_only=True)
    except LOAD_ERRORS as error:
        # torch's message recommends the unsafe way to load it, which is not for the user of a downloaded file to try.
        reason = "its content is no tensors" if isinstance(error, pickle.UnpicklingError) else first_line(error)
        raise PolicyError(f"'{source}' is damaged or truncated: {reason}") from error
    if not isinstance(entries, Mapping):
        raise PolicyError(f"'{source}' holds a {type(entries).__name__}, not a policy")
    return entries


def build_network(stored: StoredNetwork, contract: PolicyContract, *, source: str) -> nn.Module:
    """Build a network with its weights and try it on zeros.

    Raises:
        PolicyError: unknown architecture, wrong arguments, weights that do not fit, or widths other than the
            contract's.
    """
    make = ARCHITECTURES.get(stored.architecture)
    if make is None:
        raise PolicyError(
            f"'{source}' names the unknown network '{stored.architecture}'; known are: {', '.join(ARCHITECTURES)}"
        )
    _check_arguments(stored.arguments, source=source)
    try:
        # first without memory: widths that the weights do not have are found before they are allocated
        with torch.device("meta"):
            make(**stored.arguments).load_state_dict(dict(stored.state_dict), assign=True)
        network = make(**stored.arguments)
        network.load_state_dict(dict(stored.state_dict))
    except LOAD_ERRORS as error:
        message = " ".join(str(error).split())
        raise PolicyError(
            f"'{source}': the weights or arguments do not fit the network '{stored.architecture}': {message}"
        ) from error
    network = network.float().eval().requires_grad_(False)
    width: int = network.frame_width  # type: ignore[assignment]
    if width != contract.observation_width:
        raise PolicyError(f"'{source}': the network takes {width} values, {other_width(contract, width)}")
    session = NativeSession(network, 1, contract, torch.device("cpu"), source)
    session.act(torch.zeros(1, contract.observation_width))
    return network


def _check_arguments(arguments: Any, *, source: str) -> None:
    """Refuse arguments of a network that would take endless time or memory to build."""
    if not isinstance(arguments, Mapping):
        raise PolicyError(f"'{source}' has malformed network arguments: a table is needed")
    pending = list(arguments.values())
    while pending:
        value = pending.pop()
        if isinstance(value, (list, tuple)):
            pending.extend(value)
        elif isinstance(value, Mapping):
            pending.extend(value.values())
        elif isinstance(value, (int, float)) and not abs(value) <= LARGEST_WIDTH:
            raise PolicyError(
                f"'{source}' has {value:.6g} among its network's arguments; at most {LARGEST_WIDTH:,} is allowed"
            )


class FilePolicy(Policy):
    """A policy that came out of a file and can be stored in one again."""

    stored: StoredNetwork | ForeignFile
    """Its network, for ``save_policy``."""
    row_by_row: bool = False
    """A foreign file's program takes one robot at a time, which is slow; the user was told when it was loaded."""
    file_sha256: str = ""
    """SHA-256 of the file's bytes as they were loaded, hexadecimal, as ``sha256sum`` prints it; empty where it came out of none."""

    @property
    def digest(self) -> str:
        """Return the SHA-256, hexadecimal, over the contract and the whole network.

        A file's own digest would not do: weights may lie beside an ONNX file, gains in a ``deploy.yaml``, and the activation of a
        checkpoint in an ``agent.yaml``.
        """
        total, stored = hashlib.sha256(self.contract.hash.encode()), self.stored
        if isinstance(stored, ForeignFile):
            for file in (stored, stored.encoder):
                if file is not None:
                    total.update(file.kind.encode())
                    total.update(file.data)
            return total.hexdigest()
        total.update(json.dumps([stored.architecture, dict(stored.arguments)], sort_keys=True).encode())
        for name, tensor in sorted(stored.state_dict.items()):
            total.update(f"{name} {tensor.dtype} {list(tensor.shape)}".encode())
            total.update(tensor.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes())
        return total.hexdigest()


class NativePolicy(FilePolicy):
    """Play a policy with a network of ``architectures.py``."""

    def __init__(self, contract: PolicyContract, stored: StoredNetwork, *, path: str) -> None:
        """Build the network; raise ``PolicyError`` where it does not fit the contract."""
        self.contract, self.path, self.stored = contract, path, stored
        self.network = build_network(stored, contract, source=path)
        self._recorded: dict[int, FrozenNetwork] = {}

    def session(self, num_episodes: int, *, device: str = "cpu") -> PolicySession:
        """Start work on ``num_episodes`` episodes, with a copy of the network as it is in the first session of so many on the CPU."""
        network: Any = self._recorded.get(num_episodes) if device == "cpu" else None
        if network is None:
            network = copy.deepcopy(self.network).to(device)
            if device == "cpu":
                network = frozen(network, num_episodes)
            if isinstance(network, FrozenNetwork):
                self._recorded[num_episodes] = network  # it remembers nothing, and recording takes a while
        return NativeSession(network, num_episodes, self.contract, torch.device(device), self.path)


class FrozenNetwork:
    """A network without a memory of its own as one recorded sequence of operations: layers cost little more than their work."""

    def __init__(self, recorded: Any, network: Any) -> None:
        """Keep ``recorded``, which acts as ``network`` does."""
        self.history_length, self.frame_width = network.history_length, network.frame_width
        self._recorded = recorded

    def __call__(self, history: torch.Tensor) -> torch.Tensor:
        """Return actions (N, J) for ``history`` (N, H, F)."""
        action: torch.Tensor = self._recorded(history)
        return action


def frozen(network: Any, num_episodes: int) -> Any:
    """Return the network as a ``FrozenNetwork`` where that gives the same actions to the last bit, else the network itself."""
    if hasattr(network, "initial_state"):
        return network
    network.eval()
    with torch.inference_mode(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what a recording would not follow; the comparison below sees it
        generator = torch.Generator().manual_seed(0)
        shape, counts = (network.history_length, network.frame_width), (num_episodes, 8, num_episodes + 1)
        inputs = [torch.randn(rows, *shape, generator=generator) for rows in counts]
        try:
            recorded = torch.jit.freeze(torch.jit.trace(network, inputs[0], check_trace=False))
            # twice: the second call is the one that its executor has optimized
            same = all(torch.equal(recorded(x), network(x)) for x in inputs + inputs)
        except RuntimeError:
            return network
    return FrozenNetwork(recorded, network) if same else network


class NativeSession(PolicySession):
    """Run a network of ``architectures.py`` and keep its history and state."""

    def __init__(
        self, network: Any, num_episodes: int, contract: PolicyContract, device: torch.device, source: str
    ) -> None:
        """Take over a network of ``ARCHITECTURES`` on ``device``; ``source`` is its name for messages."""
        self._network, self._num_episodes, self._contract, self._source = network, num_episodes, contract, source
        frames, width = network.history_length, network.frame_width
        # A frame that has not been seen is NaN where the first one takes its place.
        self._unseen = math.nan if contract.history.start == "repeat" else 0.0
        self._history = torch.full((num_episodes, frames, width), self._unseen, device=device)
        self._initial: torch.Tensor | None = None
        if hasattr(network, "initial_state"):
            self._initial = network.initial_state(num_episodes).to(device)
            self._state = self._initial.clone()

    def reset(self, episodes: torch.Tensor | None = None) -> None:
        """See ``PolicySession``: the history becomes unseen, the state initial."""
        if episodes is None:
            episodes = torch.ones(self._num_episodes, dtype=torch.bool, device=self._history.device)
        self._history = self._history.masked_fill(episodes[:, None, None], self._unseen)
        if self._initial is not None:
            self._state = torch.where(episodes[:, None], self._initial, self._state)

    def act(self, observation: torch.Tensor, rows: torch.Tensor | None = None) -> torch.Tensor:
        """See ``PolicySession``."""
        check_observation(observation, self._num_episodes, self._contract, self._source)
        newest = observation[:, None]
        self._history = torch.cat((self._history[:, 1:], newest), dim=1)
        if self._unseen != 0.0:
            self._history = torch.where(self._history.isnan(), newest, self._history)
        with torch.no_grad():
            try:
                if self._initial is None and rows is not None:
                    some = self._network(self._history.index_select(0, rows))
                    some = checked_action(some, len(rows), self._contract, self._source)
                    return some.new_zeros(self._num_episodes, some.shape[1]).index_copy_(0, rows, some)
                if self._initial is None:
                    action = self._network(self._history)
                else:
                    action, self._state = self._network(self._history, self._state)
            except RuntimeError as error:
                raise PolicyError(f"'{self._source}' failed: {first_line(error)}") from error
        return checked_action(action, self._num_episodes, self._contract, self._source)
