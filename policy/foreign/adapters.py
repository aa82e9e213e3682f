"""Makes contracts for policies that come without one, from their files, sidecars and widths.

Every adapter notes in the contract's provenance where it took the facts from and what it had to assume.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ...files.parsing import parse_yaml, read_text
from ...robots.base import Robot
from ..base import PolicyError
from ..contract import (
    ContractError,
    History,
    HistoryOrder,
    ObservationTerm,
    PolicyContract,
    standard_contract,
)
from ..observation_table import ObservationError, foreign_observation
from .described import described_contract

AT_ONCE = 1.0
"""Time after standing within which a fall says that the policy is run wrongly [s]."""
LONGEST_HISTORY = 20
GUESSES = ("ONNX", "TorchScript", "rsl_rl checkpoint")
"""Adapters that take the whole observation for granted."""


def sidecar_contract(path: Path, robot: Robot) -> PolicyContract | None:
    """Return the contract in ``<stem>.contract.toml``, ``contract.toml`` or the same with ``.json`` beside a file, else None.

    Raises:
        PolicyError: it is malformed.
    """
    for written in (path.with_name(f"{path.stem}.contract.toml"), path.with_name("contract.toml")):
        if written.is_file():
            return described_contract(written, robot)
    for sidecar in (path.with_name(f"{path.stem}.contract.json"), path.with_name("contract.json")):
        if sidecar.is_file():
            try:
                return PolicyContract.from_json(read_text(sidecar, "contract", PolicyError))
            except ContractError as error:
                raise PolicyError(f"'{sidecar}' is not a policy contract: {error}") from error
    return None


def contract_for_width(
    width: int, robot: Robot, *, order: HistoryOrder, provenance: Mapping[str, Any], source: str
) -> PolicyContract:
    """Return the standard contract with as many frames, 1 to ``LONGEST_HISTORY``, as an input holds; else raise ``PolicyError``."""
    frame = standard_contract(robot).frame_width
    frames, rest = divmod(width, frame)
    if rest or not 1 <= frames <= LONGEST_HISTORY:
        raise PolicyError(
            f"'{source}' takes {width} values, which is no multiple of the standard observation's {frame}; "
            "give a contract.toml that describes its observation (gaitgauge contract new)"
        )
    history = History(length=frames, order=order if frames > 1 else "frame-major")
    assumed = f"{frames} frame(s) of the standard observation of {frame} entries, {history.order}; gains of the robot"
    return standard_contract(robot, history=history, provenance={**provenance, "assumed": assumed})


def assumptions(contract: PolicyContract) -> str | None:
    """Return the assumptions about a policy that lacks a contract, or parts of one, as one sentence; None where there are none."""
    if "assumed" not in contract.provenance:
        return None
    if contract.provenance["adapter"] not in GUESSES:
        return f"assumed, since '{contract.provenance.get('file', 'its description')}' does not say: {contract.provenance['assumed']}"
    scales = ", ".join(f"{t.name} × {', '.join(f'{s:g}' for s in t.scale)}" for t in contract.observation)
    joints = ", ".join(name.removesuffix("_joint") for name in contract.joint_names)
    gains = " and ".join(
        f"{letter} {min(v):g}" + (f" to {max(v):g}" if min(v) != max(v) else "")
        for letter, v in (("kp", contract.stiffness), ("kd", contract.damping))
    )
    history = contract.history
    frames = (
        "the current frame alone"
        if history.length == 1
        else f"{history.length} frames, {history.order}, starting with {history.start}"
    )
    return (
        f"taken for granted ({contract.provenance['assumed']}): history {frames}; joints {joints}; observation {scales}; "
        f"action scale {min(contract.action_scale):g} rad, gains {gains}; where this is wrong the robot falls: "
        "give a description with --contract, or put a contract.toml or deploy.yaml beside the file"
    )


def doubt(contract: PolicyContract) -> str:
    """Return advice for a robot that falls within ``AT_ONCE`` of standing, with the assumptions about its policy."""
    taken = assumptions(contract)
    return "'gaitgauge doctor POLICY' tries what may be wrong" + (f"; {taken}" if taken else "")


def find_deploy_file(path: Path) -> Path | None:
    """Return the ``deploy.yaml`` that belongs to an ONNX file: beside it, or in ``params/`` next to the folder of exports."""
    candidates = (
        path.with_name(f"{path.stem}.deploy.yaml"),
        path.with_name("deploy.yaml"),
        path.parent / "params" / "deploy.yaml",
        path.parent.parent / "params" / "deploy.yaml",
    )
    return next((c for c in candidates if c.is_file()), None)


def deploy_contract(path: Path, robot: Robot) -> PolicyContract:
    """Read a ``deploy.yaml`` as Unitree's and Isaac Lab's exporters write it.

    In it ``stiffness`` and ``damping`` are in the order of the robot's SDK, everything else is in the policy's; entry i
    of ``joint_ids_map`` is the SDK's number of the policy's joint i. Histories are term-major unless
    ``use_gym_history`` is set, and start with copies of the first observation. Clipping comes before scaling unless
    ``scale_first`` is set; a clip of the action limits the joint target.

    Raises:
        PolicyError: the file is malformed, or asks for something that a contract cannot express.
    """
    data = parse_yaml(read_text(path, "deploy file", PolicyError), f"'{path}'", PolicyError)
    try:
        return _deploy_contract(data, path, robot)
    except ContractError as error:
        raise PolicyError(f"'{path}' does not give a valid policy contract: {error}") from error
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        if isinstance(error, PolicyError):
            raise
        raise PolicyError(f"'{path}' lacks or garbles an entry of a deploy.yaml: {error!r}") from error


def _deploy_contract(data: Mapping[str, Any], path: Path, robot: Robot) -> PolicyContract:
    names = _deploy_joints(data, path, robot)
    sdk = [int(i) for i in data["joint_ids_map"]]
    default = [float(v) for v in data["default_joint_pos"]]
    action = data["actions"]["JointPositionAction"]
    offset = action.get("offset") or default
    if max((abs(o - d) for o, d in zip(offset, default, strict=True)), default=0.0) > 1e-6:
        raise PolicyError(
            f"'{path}' has an action offset other than default_joint_pos, which a policy contract cannot express"
        )
    clip = action.get("clip")
    ranges = ((data.get("commands") or {}).get("base_velocity") or {}).get("ranges") or {}
    limits = [
        max(abs(float(v)) for v in ranges[axis]) if ranges.get(axis) else robot.command_limits[i]
        for i, axis in enumerate(("lin_vel_x", "lin_vel_y", "ang_vel_z"))
    ]
    settings = dict(data["observations"])
    frame_major = bool(settings.pop("use_gym_history", False))
    scale_first = bool(settings.pop("scale_first", False))
    terms, lengths = [], set()
    for name, term in settings.items():
        own, scale = _own_term(name, path), tuple(float(s) for s in _listed(term.get("scale"), 1.0))
        clip_of_term = None
        if (given := term.get("clip")) is not None:
            limit = _limit(float(given[0]), float(given[1]), name, path)
            clip_of_term = (limit,) if scale_first else tuple(limit * abs(s) for s in scale)
        terms.append(ObservationTerm(name=own, scale=scale, clip=clip_of_term))
        lengths.add(int(term.get("history_length") or 1))
    length = _one_length(lengths, path)
    order: HistoryOrder = "frame-major" if frame_major or length == 1 else "term-major"
    return PolicyContract(
        robot=robot.name,
        joint_names=names,
        default_joint_position=tuple(default),
        action_scale=tuple(float(v) for v in _listed(action.get("scale"), 1.0, len(names))),
        target_range=tuple((float(low), float(high)) for low, high in clip) if clip else None,
        stiffness=tuple(float(data["stiffness"][i]) for i in sdk),
        damping=tuple(float(data["damping"][i]) for i in sdk),
        control_period=float(data["step_dt"]),
        observation=tuple(terms),
        history=History(length=length, order=order, start="repeat"),
        command_limits=(limits[0], limits[1], limits[2]),
        provenance={"adapter": "deploy.yaml", "file": path.name},
    )


def _deploy_joints(data: Any, path: Path, robot: Robot) -> tuple[str, ...]:
    if not isinstance(data, Mapping):
        raise PolicyError(f"'{path}' holds no table of settings")
    numbered = robot.sdk_joint_names
    if numbered is None:
        raise PolicyError(
            f"'{path}' numbers joints as the maker's SDK does, which the description of robot '{robot.name}' does not say; "
            "add sdk_joint_names to its robot.toml"
        )
    order = list(data["joint_ids_map"])
    if sorted(order) != list(range(len(numbered))):
        raise PolicyError(
            f"'{path}' has joint_ids_map {order}; every number from 0 to {len(numbered) - 1} is needed once"
        )
    return tuple(numbered[i] for i in order)


def matching_joint(name: str, robot: Robot) -> str:
    """Return the robot's joint of this name, with or without the ending ``_joint``; the name itself if the robot has none."""
    bare = name.removesuffix("_joint")
    return next((j for j in robot.joint_names if j.removesuffix("_joint") == bare), name)


def _listed(value: Any, missing: float, count: int = 1) -> list[float]:
    if value is None:
        return [missing] * count
    return list(value) if isinstance(value, (list, tuple)) else [value] * count


def _own_term(name: str, source: object) -> str:
    """Return the project's name of an observation."""
    try:
        return foreign_observation(name).name
    except ObservationError as error:
        raise PolicyError(f"'{source}' {error}") from error


def _limit(low: float, high: float, name: str, source: object) -> float:
    """Return the magnitude that an observation is clipped to."""
    if low != -high:
        raise PolicyError(
            f"'{source}' clips the observation '{name}' to [{low}, {high}]; only symmetric limits are supported"
        )
    return high


def _one_length(lengths: set[int], source: object) -> int:
    """Return the length that the histories of all observations have."""
    if len(lengths) > 1:
        raise PolicyError(
            f"'{source}' gives its observations histories of different lengths {sorted(lengths)}; one length is needed"
        )
    return lengths.pop() if lengths else 1


def mjlab_contract(metadata: Mapping[str, str], robot: Robot, *, source: str) -> PolicyContract | None:
    """Read the metadata that mjlab's exporter writes into an ONNX file; None if they are not there.

    Histories are term-major and start with copies of the first observation. The command limits are the robot's and the
    control period is 0.02 s, mjlab's, because the metadata name neither.

    Raises:
        PolicyError: the metadata are incomplete or malformed.
    """
    if "observation_names" not in metadata or "joint_names" not in metadata:
        return None
    try:
        return _mjlab_contract(metadata, robot, source)
    except ContractError as error:
        raise PolicyError(f"the metadata of '{source}' do not give a valid policy contract: {error}") from error
    except (KeyError, IndexError, ValueError, OverflowError) as error:
        if isinstance(error, PolicyError):
            raise
        raise PolicyError(f"the metadata of '{source}' lack or garble an entry: {error!r}") from error


def _mjlab_contract(metadata: Mapping[str, str], robot: Robot, source: str) -> PolicyContract:
    def words(key: str, default: str = "") -> list[str]:
        return [w.strip() for w in metadata.get(key, default).split(",") if w.strip()]

    names = tuple(matching_joint(n, robot) for n in words("joint_names"))
    observations = words("observation_names")
    own = [_own_term(name, source) for name in observations]
    count = len(observations)
    scales = words("observation_terms_scale") or ["1.0"] * count
    clips = words("observation_terms_clip") or ["-inf;inf"] * count
    length = _one_length({max(1, int(float(n))) for n in words("observation_terms_history_length")}, source)
    terms = []
    for name, term, listed, pair in zip(observations, own, scales, clips, strict=True):
        scale = tuple(float(s) for s in listed.split(";"))
        low, high = (float(v) for v in pair.split(";"))
        limit = _limit(low, high, name, source)
        clip = tuple(limit * (abs(s) or 1.0) for s in scale)  # a term scaled by zero is zero, clipped or not
        known = None if limit == math.inf else clip if len(clip) > 1 else clip[0]
        terms.append(ObservationTerm(name=term, scale=scale, clip=known))
    action_scale = [float(v) for v in words("action_scale")]
    return PolicyContract(
        robot=robot.name,
        joint_names=names,
        default_joint_position=tuple(float(v) for v in words("default_joint_pos")),
        action_scale=tuple(action_scale * len(names) if len(action_scale) == 1 else action_scale),
        stiffness=tuple(float(v) for v in words("joint_stiffness")),
        damping=tuple(float(v) for v in words("joint_damping")),
        control_period=0.02,
        observation=tuple(terms),
        history=History(length=length, order="frame-major" if length == 1 else "term-major", start="repeat"),
        command_limits=robot.command_limits,
        provenance={"adapter": "mjlab metadata", "assumed": "control period 0.02 s, command limits of the robot"},
    )
