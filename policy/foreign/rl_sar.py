"""Reads rl_sar's ``config.yaml``, with the ``base.yaml`` of its robot beside it or one folder above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from ...files.parsing import parse_yaml, read_text, shown
from ...robots.base import Robot
from ..base import PolicyError
from ..contract import History, HistoryOrder, ObservationTerm, Part, PolicyContract, without_wheels
from .bodies import choose_robot, matching_joint, wheels_of
from .terms import checked, listed

_TERMS = {
    "lin_vel": ("base_linear_velocity_b", "lin_vel_scale"),
    "ang_vel": ("base_angular_velocity_b", "ang_vel_scale"),
    "ang_vel_body": ("base_angular_velocity_b", "ang_vel_scale"),
    "gravity_vec": ("projected_gravity_b", None),
    "commands": ("command", "commands_scale"),
    "dof_pos": ("joint_position", "dof_pos_scale"),
    "dof_vel": ("joint_velocity", "dof_vel_scale"),
    "actions": ("last_action", None),
}
"""rl_sar's observations: the project's, and the setting with its scale."""


def is_rl_sar(data: Mapping[str, Any]) -> bool:
    """Return whether a table is one: settings below one key, the robot's name and the policy's."""
    inner = next(iter(data.values())) if len(data) == 1 else None
    return isinstance(inner, Mapping) and "rl_kp" in inner and "observations" in inner


def read_rl_sar(data: Mapping[str, Any], path: Path, asked: Robot | None, inputs: Sequence[str] = ()) -> PolicyContract:
    """Return the contract that a ``config.yaml`` describes; settings of the ``base.yaml`` hold where it says nothing.

    Entry i of ``joint_mapping`` is the place in ``joint_names`` of the policy's joint i; everything else is in the policy's
    order. Frame 0 of a history is the present one. A history begins with zeros. Targets of ``wheel_indices`` are velocities, and
    the network sees their angles as zero.

    Args:
        inputs: names of the network's inputs, for a policy that takes the present frame and a history apart.

    Raises:
        PolicyError: the file is malformed, is for another robot, or asks for something that a contract cannot express.
    """
    with checked(path, "rl_sar's config.yaml"):
        key = str(next(iter(data)))
        settings = {**_base(path), **data[key]}
        robot = choose_robot(asked, key.partition("/")[0], path)
        return _read(settings, path, robot, inputs)


def _base(path: Path) -> Mapping[str, Any]:
    """Return the settings of the robot's ``base.yaml``."""
    for folder in (path.parent, path.parent.parent):
        base = folder / "base.yaml"
        if base.is_file():
            data = parse_yaml(read_text(base, "base.yaml", PolicyError), f"'{base}'", PolicyError)
            inner = next(iter(data.values())) if isinstance(data, Mapping) and len(data) == 1 else None
            if isinstance(inner, Mapping):
                return inner
            raise PolicyError(
                f"'{base}' is not a base.yaml of rl_sar: one key, the robot's name, with settings is needed"
            )
    raise PolicyError(
        f"'{path}' needs rl_sar's base.yaml, with joint_names, dt and decimation, beside it or one folder above; put it there"
    )


def _read(settings: Mapping[str, Any], path: Path, robot: Robot, inputs: Sequence[str]) -> PolicyContract:
    numbered = [matching_joint(str(name), robot) for name in settings["joint_names"]]
    names = tuple(numbered[int(i)] for i in settings["joint_mapping"])
    joints = len(names)
    wheels = wheels_of([names[int(i)] for i in settings.get("wheel_indices") or ()], robot, path)
    clip = float(settings["clip_obs"]) if settings.get("clip_obs") is not None else None
    terms = []
    for name in settings["observations"]:
        if name not in _TERMS:
            raise PolicyError(f"'{path}' asks for the observation {shown(name)}; supported are: {', '.join(_TERMS)}")
        own, key = _TERMS[name]
        scale = tuple(float(v) for v in listed(settings[key] if key else 1.0, 1.0))
        if own == "joint_position" and wheels:
            scale = without_wheels(scale, [joint in wheels for joint in names])
        terms.append(ObservationTerm(name=own, scale=scale, clip=clip))
    frames = [int(i) for i in settings.get("observations_history") or [0]]
    steps = {b - a for a, b in pairwise(frames)}
    if sorted(frames) != list(range(len(frames))) or len(steps) > 1:
        raise PolicyError(
            f"'{path}' has observations_history {frames}; all frames from 0, in order or reversed, are supported"
        )
    major = "term" if settings.get("observations_history_priority") == "term" else "frame"
    order: HistoryOrder = f"{major}-major{'-newest-first' if steps == {1} else ''}"  # type: ignore[assignment]
    limits = [float(v) for key in ("clip_actions_lower", "clip_actions_upper") for v in listed(settings.get(key), 0.0)]
    magnitudes = {abs(v) for v in limits}
    if len(magnitudes) > 1:
        raise PolicyError(
            f"'{path}' clips actions to {sorted(magnitudes)}; one symmetric limit for all joints is supported"
        )
    assumed = [f"command limits of robot '{robot.name}'"]
    if len(frames) > 1:
        assumed.append("the history begins with zeros")
    layout: tuple[Part, ...] = ()
    if settings.get("dreamwaq_two_inputs"):
        if len(inputs) != 2:
            raise PolicyError(f"'{path}' is for a network of two inputs; this one has {len(inputs) or 'one'}")
        layout = (Part(input=inputs[0], length=1), Part(input=inputs[1]))
    return PolicyContract(
        robot=robot.name,
        joint_names=names,
        default_joint_position=tuple(float(v) for v in settings["default_dof_pos"]),
        action_scale=tuple(float(v) for v in listed(settings["action_scale"], 1.0, joints)),
        action_clip=(magnitudes.pop() or None) if magnitudes else None,
        stiffness=tuple(float(v) for v in settings["rl_kp"]),
        damping=tuple(float(v) for v in settings["rl_kd"]),
        control_period=round(float(settings["dt"]) * int(settings["decimation"]), 9),
        observation=tuple(terms),
        history=History(length=len(frames), order=order if len(frames) > 1 else "frame-major"),
        layout=layout,
        command_limits=robot.command_limits,
        velocity_joints=wheels,
        provenance={"adapter": "rl_sar config.yaml", "file": path.name, "assumed": ", ".join(assumed)},
    )
