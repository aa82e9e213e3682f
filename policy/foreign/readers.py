"""Finds and reads the description of a policy: one that is named, one that lies beside it, or one that the file carries."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from ...files.parsing import parse_yaml, read_text
from ...robots.base import Robot
from ..base import PolicyError
from ..contract import ContractError, PolicyContract, reordered
from .adapters import LONGEST_HISTORY
from .bodies import choose_robot
from .deploy_yaml import is_deploy, read_deploy
from .described import described_contract
from .holosoma import holosoma_contract
from .isaac_lab import is_env, read_env
from .legged_gym import is_legged_gym, read_legged_gym
from .mjlab import mjlab_contract
from .presets import find_preset, fitting_presets, preset_contract
from .rl_sar import is_rl_sar, read_rl_sar

_MOST_BESIDE = 40
"""Files beside a policy that are looked at."""
_NEAR = 0.02
"""Share by which numbers of two descriptions may differ: exporters round."""


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Statements of a policy's file on itself."""

    inputs: Sequence[str] = ()
    """Names of the inputs that take observations, where they have names."""
    metadata: Mapping[str, str] = field(default_factory=dict)
    width: Callable[[Sequence[int]], int | None] | None = None
    """Return the width of its input; it is asked with widths that are likely."""


Reader = Callable[[Mapping[str, Any], Path, Robot | None], PolicyContract]


def _reader(data: Mapping[str, Any], facts: Facts) -> Reader | None:
    """Return what reads a YAML table of some project, None where it is none that is known."""
    known: tuple[tuple[Callable[[Mapping[str, Any]], bool], Reader], ...] = (
        (is_deploy, partial(read_deploy, of_mjlab="observation_names" in facts.metadata)),
        (is_rl_sar, partial(read_rl_sar, inputs=facts.inputs)),
        (is_env, read_env),
        (is_legged_gym, read_legged_gym),
    )
    return next((read for recognises, read in known if recognises(data)), None)


def read_description(path: Path, asked: Robot | None, facts: Facts) -> PolicyContract:
    """Return the contract in a file that the user names: of this project, or of one whose descriptions are known; or of a preset.

    Raises:
        PolicyError: no such file, none of the known kinds, malformed, or for another robot.
    """
    if not path.suffix and len(path.parts) == 1 and not path.exists():
        return _named_preset(str(path), asked, facts)
    if path.suffix == ".toml":
        return described_contract(path, asked)
    text = read_text(path, "contract file", PolicyError)
    if path.suffix == ".json":
        try:
            return PolicyContract.from_json(text)
        except ContractError as error:
            raise PolicyError(f"'{path}' is not a policy contract: {error}") from error
    data = parse_yaml(text, f"'{path}'", PolicyError)
    read = _reader(data, facts) if isinstance(data, Mapping) else None
    if read is None:
        raise PolicyError(
            f"'{path}' is no description of a policy that is understood: contract.toml, contract.json, a deploy.yaml of Unitree's "
            "exporters, Isaac Lab's env.yaml, rl_sar's config.yaml, unitree_rl_gym's settings"
        )
    return read(data, path, asked)


def _named_preset(name: str, asked: Robot | None, facts: Facts) -> PolicyContract:
    """Return the contract of a preset, with as many frames as the policy's input holds."""
    try:
        preset = find_preset(name)
    except PolicyError as error:
        raise PolicyError(f"--contract '{name}' is no file, and {error}") from error
    robot = choose_robot(asked, None, name)
    one = preset_contract(preset, robot)
    if facts.width is None:
        return one
    frame = one.frame_width
    width = facts.width([frame * n for n in range(1, LONGEST_HISTORY + 1)]) or frame
    if width % frame:
        fitting = ", ".join(fitting_presets(robot, width)) or "none"
        raise PolicyError(
            f"preset '{name}' gives {frame} values a frame, but the policy takes {width}; presets that fit: {fitting}"
        )
    return preset_contract(preset, robot, frames=width // frame)


def contract_beside(path: Path) -> Path | None:
    """Return the contract of this project's kind that lies beside a policy, None where there is none."""
    names = (f"{path.stem}.contract.toml", "contract.toml", f"{path.stem}.contract.json", "contract.json")
    # unlike a path, ``isfile`` is False for a name that is too long for the file system
    return next((path.with_name(name) for name in names if os.path.isfile(path.with_name(name))), None)


def find_description(path: Path, asked: Robot | None, facts: Facts) -> PolicyContract | None:
    """Return the contract that lies beside a policy or in it, None where there is none.

    ``contract.toml`` and ``contract.json`` go before all else, then the contract that an export of this project carries; other
    descriptions must not disagree.

    Raises:
        PolicyError: a description is malformed or for another robot, or two of them disagree.
    """
    if (own := contract_beside(path)) is not None:
        return _noting_others(read_description(own, asked, facts), own, path, asked, facts)
    if "contract" in facts.metadata:
        try:
            return PolicyContract.from_json(facts.metadata["contract"])
        except ContractError as error:
            raise PolicyError(f"'{path}' carries a malformed contract: {error}") from error
    found: list[tuple[str, PolicyContract]] = []
    problem: PolicyError | None = None
    for source, read in _candidates(path, asked, facts):
        try:
            contract = read()
        except PolicyError as error:
            problem = problem or error
            continue
        if contract is None:
            continue
        if found and (difference := _disagreement(found[0][1], contract)):
            raise PolicyError(
                f"'{path}' has two descriptions, '{found[0][0]}' and '{source}', that disagree on {difference}; say which is right "
                "with --contract FILE"
            )
        found.append((source, contract))
    if not found and problem:
        raise problem
    return found[0][1] if found else None


def _noting_others(
    contract: PolicyContract, own: Path, path: Path, asked: Robot | None, facts: Facts
) -> PolicyContract:
    """Return the contract of ``own`` with a remark on the first other description of a policy that says otherwise: it is not used."""
    others: list[tuple[str, Callable[[], PolicyContract | None]]] = []
    with suppress(PolicyError):  # what is not used need not be sound
        others = _candidates(path, asked, facts)
    for source, read in others:
        with suppress(PolicyError):
            if (other := read()) is not None and (difference := _disagreement(contract, other)):
                remark = f"{own.name} is used, and not {source}, which differs in {difference}"
                told = "; ".join(filter(None, (contract.provenance.get("assumed"), remark)))
                return replace(contract, provenance={**contract.provenance, "assumed": told})
    return contract


def _candidates(path: Path, asked: Robot | None, facts: Facts) -> list[tuple[str, Callable[[], PolicyContract | None]]]:
    """Return descriptions beside a policy and in it, those that are most explicit first."""
    run = (path.parent / "params", path.parent.parent / "params")
    files = [path.with_name(f"{path.stem}.deploy.yaml"), path.with_name("deploy.yaml")]
    files += [folder / name for name in ("deploy.yaml", "env.yaml") for folder in run]
    files = [each for each in files if each.is_file()]
    beside = sorted(path.parent.glob("*.y*ml"))[:_MOST_BESIDE]
    candidates: list[tuple[str, Callable[[], PolicyContract | None]]] = []
    for file in [*files, *(each for each in beside if each not in files)]:
        try:
            data = parse_yaml(read_text(file, "description", PolicyError), f"'{file}'", PolicyError)
        except PolicyError:
            if file in files:  # a sidecar by its name
                raise
            continue
        if file in files and not isinstance(data, Mapping):
            raise PolicyError(f"'{file}' holds no table of settings")
        read = _reader(data, facts) if isinstance(data, Mapping) else None
        if read is None and file in files:
            read = read_env if file.name == "env.yaml" else read_deploy
        if read is not None:
            candidates.append((str(file), partial(read, data, file, asked)))
    kinds = (mjlab_contract, holosoma_contract)
    inside = [("its metadata", partial(kind, facts.metadata, asked, source=str(path))) for kind in kinds]
    return candidates + inside


def _disagreement(a: PolicyContract, b: PolicyContract) -> str | None:
    """Return the first thing that two descriptions say otherwise, in words; None where they agree."""
    if sorted(a.joint_names) != sorted(b.joint_names):
        return "the joints"
    if "breadth" not in str(b.provenance) and a.joint_names != b.joint_names and "Isaac" not in b.provenance["adapter"]:
        return f"the order of the joints ({', '.join(a.joint_names[:3])} … and {', '.join(b.joint_names[:3])} …)"
    b = reordered(b, a.joint_names)
    for name in ("default_joint_position", "action_scale", "stiffness", "damping"):
        for joint, mine, other in zip(a.joint_names, getattr(a, name), getattr(b, name), strict=True):
            if abs(mine - other) > _NEAR * max(abs(mine), abs(other)) + 0.002:
                return f"{name} of {joint} ({mine:g} and {other:g})"
    if [t.name for t in a.observation] != [t.name for t in b.observation]:
        names = [", ".join(t.name for t in c.observation) for c in (a, b)]
        return f"the observation ({names[0]} and {names[1]})"
    for mine_term, other_term in zip(a.observation, b.observation, strict=True):
        if set(mine_term.scale) != set(other_term.scale):
            return f"the scale of {mine_term.name} ({mine_term.scale[0]:g} and {other_term.scale[0]:g})"
    for name, one, two in (
        ("control_period", a.control_period, b.control_period),
        ("the length of the history", a.frames, b.frames),
    ):
        if one != two:
            return f"{name} ({one:g} and {two:g})"
    return None
