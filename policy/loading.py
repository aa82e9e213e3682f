"""Loads a policy from any file that the project understands."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from ..files.parsing import shown
from ..robots import Robot, load_robot
from .base import PolicyError
from .contract import HistoryOrder, PolicyContract, check_robot, standard_contract
from .finding import find_policy
from .foreign.adapters import LONGEST_HISTORY, contract_for_width, described
from .foreign.bodies import DEFAULT_ROBOT
from .foreign.fence.archive import archive_names, read_limited
from .foreign.readers import Facts, contract_beside, find_description, read_description
from .foreign.rsl_rl import checkpoint_network
from .foreign.zoo import known_contract, zoo
from .native import FilePolicy, ForeignFile, NativePolicy, StoredNetwork, is_policy, load_entries, read_policy

if TYPE_CHECKING:
    from .foreign.fenced_policy import Started


def load_policy(
    path_or_name: str | Path,
    robot: Robot | None = None,
    *,
    trust: bool = False,
    contract_file: Path | str | None = None,
) -> FilePolicy:
    """Load a policy and try it on zeros.

    A file's content decides what it is, not its ending: the project's own format, TorchScript, ONNX, or a bare rsl_rl
    checkpoint. Of a TorchScript or ONNX file only operators that compute are run, in a process that can do nothing else
    (``docs/reference/security.md``). A public file that the zoo knows is run as the zoo says, unless a contract is given or
    lies beside it.

    Args:
        path_or_name: a file, or a name (see ``find_policy``).
        robot: the robot it has to fit, and whose data stand in where a foreign file does not say; None: any robot is
            accepted, and the Go2 stands in.
        trust: run a program that a file of the project's own format carries inside; it is fenced in either way.
        contract_file: a description of how a file without a contract of its own is to be run, of this project or of one
            that is understood (``foreign.readers``), or the name of a preset (``foreign.presets``); it goes before all else.

    Raises:
        PolicyError: no such file or name, a damaged or foreign file, or a network that does not fit its contract.
        ContractError: the policy is for another robot or other joints.
    """
    path = find_policy(path_or_name)
    data = read_limited(path)
    given = None if contract_file is None else Path(contract_file)
    sha256 = hashlib.sha256(data).hexdigest()
    known = zoo().get(sha256) if given is None and contract_beside(path) is None else None
    described_by = given if known is None else known_contract(known, robot)
    policy = _load(data, path, str(path_or_name), robot, trust=trust, given=described_by)
    policy.file_sha256 = sha256
    if sentence := described(policy.contract):
        _say(policy.path, sentence)
    if robot is not None:
        check_robot(policy.contract, robot)
    return policy


def own_contract(path_or_name: str | Path, contract_file: str | None) -> str | None:
    """Return the description for one of several policies: None for a file that has its contract inside.

    Raises:
        PolicyError: no such file or name.
    """
    if contract_file is None:
        return None
    path = find_policy(path_or_name)
    data = read_limited(path)
    source = str(path_or_name)
    own = file_kind(data, source) == "torch" and is_policy(load_entries(data, source=source))
    return None if own else contract_file


def restore_policy(
    stored: StoredNetwork | ForeignFile, contract: PolicyContract, path: str, robot: Robot
) -> FilePolicy:
    """Return a policy that another process loaded, from the fields of its ``FilePolicy``; a program in it was trusted there.

    Raises:
        PolicyError: the network does not fit its contract, or a program cannot be run here.
    """
    if isinstance(stored, StoredNetwork):
        return NativePolicy(contract, stored, path=path)
    return _foreign(stored, Path(path), path, robot, contract=contract)


@cache  # once, and not again in each process that is forked from this one
def _say(path: str, sentence: str) -> None:
    logging.getLogger(__name__).warning("'%s' %s", path, sentence)


def _load(
    data: bytes, path: Path, source: str, robot: Robot | None, *, trust: bool, given: Path | PolicyContract | None
) -> FilePolicy:
    """Load a file's content; ``path`` is where its sidecars are, ``source`` what the user called it, ``given`` its description."""
    kind = file_kind(data, source)
    if kind in ("torchscript", "onnx"):
        return _foreign(ForeignFile(kind=kind, data=data), path, source, robot, contract=given)
    entries = load_entries(data, source=source)
    if is_policy(entries):
        if given is not None:
            raise PolicyError(f"'{source}' has its contract inside; leave out --contract, or import its source again")
        inside, network = read_policy(entries, source=source)
        if isinstance(network, StoredNetwork):
            return NativePolicy(inside, network, path=source)
        if not trust:
            raise PolicyError(
                f"'{source}' carries a program of another format inside ({network.kind}); "
                "add --trust (in Python trust=True) to run it, in a process of its own"
            )
        return _foreign(network, path, source, robot, contract=inside)
    if isinstance(given, PolicyContract):
        read: PolicyContract | None = given
    else:
        read = find_description(path, robot, Facts()) if given is None else read_description(given, robot, Facts())
    found = checkpoint_network(entries, robot or load_robot(DEFAULT_ROBOT), path=path, contract=read)
    if found is None:
        raise PolicyError(f"'{source}' is a torch.save file, but neither a gaitgauge policy nor an rsl_rl checkpoint")
    described, network = found
    return NativePolicy(described, network, path=source)


def _foreign(
    file: ForeignFile,
    path: Path,
    source: str,
    robot: Robot | None,
    *,
    contract: PolicyContract | Path | None = None,
) -> FilePolicy:
    """Load a TorchScript or ONNX file; ``contract`` is the one that was stored with it, a file with it, or None to look for one."""
    from .foreign.fenced_policy import FencedPolicy  # only those who load such a file wait for what it needs

    file, program, metadata = _start(file, source, path.parent)
    if isinstance(contract, Path):
        inputs = program.child.ask("inputs")["names"]
        facts = Facts(inputs=inputs, metadata=metadata, width=partial(_width, program))
        contract = read_description(contract, robot, facts)
    contract = contract or _foreign_contract(program, file.kind, metadata, path, source, robot)
    encoder = None
    if contract.encoder is not None:
        inner = file.encoder or _beside(path, contract.encoder.file, source)
        inner, encoder, _ = _start(inner, contract.encoder.file, path.parent)
        file = replace(file, encoder=inner)
    return FencedPolicy(file, program, contract, path=source, encoder=encoder)


def _beside(path: Path, name: str, source: str) -> ForeignFile:
    """Return the encoder's file, which lies beside the policy's."""
    beside = path.with_name(Path(name).name)
    if Path(name).name != name or not beside.is_file():
        raise PolicyError(f"'{source}' lacks its encoder: there is no file {shown(name)} beside it")
    data = read_limited(beside)
    return ForeignFile(kind=file_kind(data, str(beside)), data=data)


def _start(file: ForeignFile, source: str, folder: Path) -> tuple[ForeignFile, Started, dict[str, str]]:
    """Start a program's process; return the file with all of its weights, the process, and what the file says of itself."""
    from .foreign.fence.child import Child
    from .foreign.fenced_policy import Started

    if file.kind == "torchscript":
        from .foreign.fence.script import check_script
        from .foreign.torchscript_session import ScriptProgram

        script = check_script(file.data, source=source)
        started = Started(child=Child(ScriptProgram, script.data, source=source), attributes=script.attributes)
        return file, started, {"contract": script.contract} if script.contract else {}
    if file.kind != "onnx":
        raise PolicyError(f"'{source}' is neither TorchScript nor ONNX; an encoder has to be one of them")
    from .foreign.fence.graph import check_graph
    from .foreign.onnx_session import GraphProgram  # with onnxruntime, which the forked child may not load any more

    model = check_graph(file.data, source=source, folder=folder)
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    file = replace(file, data=model.SerializeToString())
    return file, Started(child=Child(GraphProgram, file.data, source=source), attributes=()), metadata


def _width(program: Started, candidates: Sequence[int]) -> int | None:
    """Return the width of a program's input, which tries likely ones."""
    width = program.child.ask("width", candidates=list(candidates))["width"]
    return None if width is None else int(width)


def _foreign_contract(
    program: Started, kind: str, metadata: Mapping[str, str], path: Path, source: str, robot: Robot | None
) -> PolicyContract:
    """Return the contract beside a file or in it, that of another project's description, or else the standard one of the input's width."""
    facts = Facts(inputs=program.child.ask("inputs")["names"], metadata=metadata)
    if (found := find_description(path, robot, facts)) is not None:
        return found
    robot = robot or load_robot(DEFAULT_ROBOT)
    frame = standard_contract(robot).frame_width
    order: HistoryOrder = "term-major" if kind == "onnx" else "frame-major"
    width = _width(program, [frame * n for n in range(1, LONGEST_HISTORY + 1)])
    provenance = {"adapter": "ONNX" if kind == "onnx" else "TorchScript", "file": path.name}
    return contract_for_width(width or frame, robot, order=order, provenance=provenance, source=source)


def file_kind(data: bytes, source: str) -> str:
    """Return the kind of a file's content: ``torchscript``, ``onnx`` or ``torch`` (a ``torch.save`` archive).

    Raises:
        PolicyError: anything else; a plain pickle is refused without being opened.
    """
    if data[:4] == b"PK\x03\x04":
        inner = archive_names(data, source=source)
        if "constants.pkl" in inner and any(n.startswith("code/") for n in inner):
            return "torchscript"
        if "data.pkl" in inner:
            return "torch"
        raise PolicyError(f"'{source}' is a zip archive, but neither TorchScript nor a torch.save file")
    if data[:1] == b"\x80":
        raise PolicyError(
            f"'{source}' is a plain pickle, which could run code when opened, and is refused; "
            "save it with torch.save of today's torch"
        )
    # An ONNX file starts with its format version as a one-byte number (protocol buffer field 1).
    if data[:1] == b"\x08" and len(data) > 16:
        return "onnx"
    raise PolicyError(
        f"'{source}' is not a policy: neither a gaitgauge file, TorchScript, ONNX nor an rsl_rl checkpoint"
    )
