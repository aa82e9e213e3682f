"""Reads the metadata that mjlab's exporter writes into an ONNX file."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from ...robots.base import Robot
from ..base import PolicyError
from ..contract import History, ObservationTerm, PolicyContract
from ..observation_table import HEIGHT_SCAN
from .bodies import fitting_robot, matching_joint
from .terms import checked, clip_before_scaling, own_term, symmetric, usual_scan


def mjlab_contract(metadata: Mapping[str, str], asked: Robot | None, *, source: str) -> PolicyContract | None:
    """Return the contract that the metadata describe; None if they are not there.

    Histories are term-major and start with copies of the first observation. The command limits are the robot's and the
    control period is 0.02 s, mjlab's, because the metadata name neither; nor do they name the grid of a height scan.

    Raises:
        PolicyError: the metadata are incomplete or malformed.
    """
    if "observation_names" not in metadata or "joint_names" not in metadata:
        return None
    with checked(source, "mjlab's metadata"):
        named = _words(metadata, "joint_names")
        fits: Callable[[Robot], bool] = lambda r: {matching_joint(n, r) for n in named} == set(r.joint_names)  # noqa: E731
        robot, chosen = (asked, None) if asked else fitting_robot(fits, "its joints", source)
        return _mjlab_contract(metadata, robot, [chosen] if chosen else [], source)


def _words(metadata: Mapping[str, str], key: str) -> list[str]:
    return [w.strip() for w in metadata.get(key, "").split(",") if w.strip()]


def _mjlab_contract(metadata: Mapping[str, str], robot: Robot, assumed: list[str], source: str) -> PolicyContract:
    words = partial(_words, metadata)
    names = tuple(matching_joint(n, robot) for n in words("joint_names"))
    observations = words("observation_names")
    own = [own_term(name, source) for name in observations]
    if "gait_phase" in own:
        raise PolicyError(
            f"'{source}' observes a gait phase and its metadata do not say the period; give a contract.toml or deploy.yaml (--contract)"
        )
    count = len(observations)
    scales = words("observation_terms_scale") or ["1.0"] * count
    clips = words("observation_terms_clip") or ["-inf;inf"] * count
    lengths = {max(1, int(float(n))) for n in words("observation_terms_history_length")}
    if len(lengths) > 1:
        raise PolicyError(
            f"'{source}' gives its observations histories of different lengths {sorted(lengths)}; one length is needed"
        )
    length = lengths.pop() if lengths else 1
    terms = []
    for name, term, listed, pair in zip(observations, own, scales, clips, strict=True):
        scale = tuple(float(s) for s in listed.split(";"))
        low, high = (float(v) for v in pair.split(";"))
        limit = symmetric(low, high, name, source)
        clip = clip_before_scaling(limit, scale)
        known = None if limit == math.inf else clip if len(clip) > 1 else clip[0]
        terms.append(ObservationTerm(name=term, scale=scale, clip=known))
    assumed += ["control period 0.02 s", f"command limits of robot '{robot.name}'"]
    assumed += [usual_scan(0.0)] if HEIGHT_SCAN in own else []
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
        provenance={
            "adapter": "mjlab metadata",
            "file": Path(source).name,
            "assumed": ", ".join(assumed),
        },
    )
