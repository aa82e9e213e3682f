"""Describe the model of the MuJoCo engine."""

from __future__ import annotations

import mujoco
import numpy as np

from ...robots.base import Robot
from ..description import ModelFields


def describe_model(model: mujoco.MjModel, robot: Robot) -> dict[str, list[float]]:
    """Return a world's model in the terms of ``PhysicsBackend.describe``."""
    feet, floor = [model.geom(f).id for f in robot.foot_geoms], model.geom("floor").id
    bodies = [model.body(name).id for name in robot.collision_bodies]
    joints = [model.joint(name).id for name in robot.joint_names]
    dofs = model.jnt_dofadr[joints]
    limited = model.actuator_forcelimited.astype(bool)
    return ModelFields(
        total_mass=float(model.body_mass.sum()),
        body_mass=model.body_mass[bodies],
        body_inertia=model.body_inertia[bodies],
        joint_range=np.where(model.jnt_limited[joints, None], model.jnt_range[joints], [-np.inf, np.inf]),
        joint_armature=model.dof_armature[dofs],
        joint_damping=model.dof_damping[dofs],
        joint_friction_loss=model.dof_frictionloss[dofs],
        stiffness=model.actuator_gainprm[:, 0],
        damping=-model.actuator_biasprm[:, 2],
        torque_limit=np.where(limited, model.actuator_forcerange[:, 1], np.inf),
        foot_friction=model.geom_friction[feet, 0],
        floor_friction=float(model.geom_friction[floor, 0]),
        foot_priority=model.geom_priority[feet] - model.geom_priority[floor],
    ).describe()
