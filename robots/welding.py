"""Make joints of a robot rigid: a model with fewer degrees of freedom steps faster."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .anatomy.body_plan import default_pose
from .base import JointParameters, Robot
from .loading import PER_JOINT, RobotError


def welded(robot: Robot, folder: Path, held: Sequence[str] = ()) -> Robot:
    """Return the robot with the joints that no policy drives rigid in its standing pose; the model is written into a folder.

    Masses, shapes and bodies stay. The joints that remain are in the order of ``joint_names``. Those of ``held`` remain too, and motors
    hold them.

    Raises:
        RobotError: such a joint and a driven one move the same body, or an equality ties them.
    """
    import mujoco

    driven = robot.driven_joints or robot.joint_names
    kept = [i for i, name in enumerate(robot.joint_names) if name in driven or name in held]
    if len(kept) == robot.num_joints:
        return robot
    model, data = default_pose(robot)
    spec = mujoco.MjSpec.from_file(str(robot.mjcf))
    for element in [*spec.actuators, *spec.sensors, *spec.keys]:
        spec.delete(element)  # they may name the joints
    rigid = set(robot.joint_names) - set(driven) - set(held)
    for tie in [each for each in spec.equalities if each.type == mujoco.mjtEq.mjEQ_JOINT]:
        tied = {name for name in (tie.name1, tie.name2) if name}
        if tied.isdisjoint(rigid):
            continue
        if loose := tied - rigid:
            raise RobotError(
                f"robot '{robot.name}': the joint '{min(tied & rigid)}' cannot be made rigid, since an equality ties it to "
                f"'{min(loose)}'; drive both, or hold both"
            )
        spec.delete(tie)
    for name in rigid:
        body = spec.joint(name).parent
        if any(joint.name in driven for joint in body.joints):
            raise RobotError(
                f"robot '{robot.name}': the joint '{name}' cannot be made rigid, since a driven joint moves the same body '{body.name}'; "
                "drive both, or hold both"
            )
        number, parent = model.body(body.name).id, model.body(body.parent.name).id
        inverse, turn, place = np.zeros(4), np.zeros(4), np.zeros(3)
        mujoco.mju_negQuat(inverse, data.xquat[parent])
        mujoco.mju_mulQuat(turn, inverse, data.xquat[number])
        mujoco.mju_rotVecQuat(place, data.xpos[number] - data.xpos[parent], inverse)
        body.quat, body.pos = turn, place
        body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        spec.delete(spec.joint(name))
    for name in ("meshdir", "texturedir"):
        setattr(spec, name, str((robot.mjcf.parent / getattr(spec, name)).resolve()))
    file = folder / robot.mjcf.name
    file.write_text(spec.to_xml(), encoding="utf-8")

    def of_kept(values: Sequence[Any] | None) -> Any:
        return None if values is None else tuple(values[i] for i in kept)

    def constants(every: JointParameters) -> JointParameters:
        changes: dict[str, Any] = {name: of_kept(getattr(every, name)) for name in PER_JOINT}
        return replace(every, **changes)

    return replace(
        robot,
        mjcf=file,
        joint_names=of_kept(robot.joint_names),
        default_joint_position=of_kept(robot.default_joint_position),
        action_scale=of_kept(robot.action_scale),
        parameters={name: constants(each) for name, each in robot.parameters.items()},
        velocity_joints=tuple(n for n in robot.velocity_joints or () if n in driven) or None,
        sdk_joint_names=None,
        driven_joints=robot.driven_joints if held else None,
        variants=None,
    )
