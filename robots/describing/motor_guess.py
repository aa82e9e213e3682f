"""Guess the constants of a surveyed robot's joints: those of the model's motors, else from weight and leg length."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .surveying import GRAVITY, Survey

if TYPE_CHECKING:
    import mujoco

_STIFFNESS, _TORQUE, _DAMPING, _ARMATURE = 0.3, 0.4, 1.0 / 40.0, 1.5e-4
"""Stiffness [N·m/rad], torque limit [N·m] and armature [kg·m²] over weight times leg length, and damping over stiffness. The Go2
has 0.31, 0.37, 1.6e-4 and 0.025, ANYmal C 0.26, 0.26, and 0.025; the G1's hips 0.44, 0.38, 0.5e-4 and 0.02."""
_SHARES = {"ankle": 0.5, "shoulder": 0.3, "elbow": 0.3, "wrist": 0.1, "hand": 0.05, "head": 0.05}
"""Guesses for a joint over those for a hip, by the beginning of its role; 1 for others."""
_FULL_SPEED, _NO_LOAD_SPEED = 5.8, 12.8
"""Motor speeds times leg length [m/s]: those of the Go2."""

Remarked = tuple[Any, str]
"""A value and its origin."""


def guess_motors(
    survey: Survey, joints: list[int], length: float, actuated: mujoco.MjModel, stiffer: float = 1.0
) -> dict[str, Remarked]:
    """Return constants of the joints, a value or one for each in the given order, by the keys of ``JointParameters``.

    Args:
        length: of the legs [m].
        actuated: the model with all its motors; joints are found by name.
        stiffer: factor of a guessed stiffness.
    """
    model = survey.model
    strength = GRAVITY * float(model.body_mass.sum()) * length
    shares = np.array([_SHARES.get(survey.roles.get(j, "").partition("_")[0], 1.0) for j in joints])
    wheels = np.array([survey.roles.get(j) == "wheel" for j in joints])
    own = [actuated.joint(model.joint(j).name).id for j in joints]
    motor_of = {
        int(actuated.actuator_trnid[a, 0]): a
        for a in range(actuated.nu)
        if actuated.actuator_trntype[a] == survey.mujoco.mjtTrn.mjTRN_JOINT
    }
    dofs = model.jnt_dofadr[joints]
    servos = [motor_of.get(j) for j in own]
    gains = [_gains(actuated, a) for a in servos]
    kp, kd = [k for k, _ in gains], [d for _, d in gains]
    position = all(
        a is not None and k > 0.0 and actuated.actuator_biasprm[a, 1] == -actuated.actuator_gainprm[a, 0]
        for a, k in zip(servos, kp, strict=True)
    )
    sizes, by_length = "guessed from weight and leg length", "guessed from leg length"
    lighter = ", less for joints of arms, ankles and head" if (shares < 1.0).any() else ""
    wheeled = "; wheels have none" if wheels.any() else ""
    stiffness: Remarked = (_rounded(stiffer * _STIFFNESS * strength * shares), f"{sizes}{lighter}{wheeled}")
    if position:
        stiffness = (kp, f"of the model's position actuators{wheeled}")
    damping: Remarked = (_rounded(_DAMPING * np.array(stiffness[0])), "guessed: a fortieth of the stiffness")
    if position and min(kd) > 0.0:
        damping = (kd, "of the model's position actuators")
    stiffness = (np.where(wheels, 0.0, stiffness[0]).tolist(), stiffness[1])
    limits = [_torque_limit(actuated, j, a) for j, a in zip(own, servos, strict=True)]
    guessed = _rounded(_TORQUE * strength * shares)
    torque: Remarked = (guessed, f"{sizes}{lighter}")
    if any(limit is not None for limit in limits):
        known = [g if limit is None else limit for limit, g in zip(limits, guessed, strict=True)]
        torque = (known, "of the model" if None not in limits else f"{sizes} where the model has none")
    inertia = model.dof_armature[dofs]
    armature: Remarked = (inertia.tolist(), "of the model")
    if not inertia.all():
        lacking = "which the model lacks" if not inertia.any() else "where the model has none"
        filled = np.where(inertia > 0.0, inertia, _rounded(_ARMATURE * strength * shares))
        armature = (filled.tolist(), f"{sizes}{lighter}: rotor inertia, {lacking}")
    return {
        "stiffness": stiffness,
        "damping": damping,
        "torque_limit": torque,
        "armature": armature,
        "joint_damping": (model.dof_damping[dofs].tolist(), "of the model"),
        "friction_loss": (model.dof_frictionloss[dofs].tolist(), "of the model"),
        "full_torque_speed": (_round(_FULL_SPEED / length), f"{by_length}: up to here the torque is there"),
        "no_load_speed": (_round(_NO_LOAD_SPEED / length), f"{by_length}: from here the motor drives no more"),
    }


def _gains(model: mujoco.MjModel, actuator: int | None) -> tuple[float, float]:
    """Return stiffness and damping that a position servo gives its joint: the gear multiplies the measured angle and the torque."""
    if actuator is None:
        return 0.0, 0.0
    squared = float(model.actuator_gear[actuator, 0]) ** 2
    kp, kd = model.actuator_gainprm[actuator, 0], -model.actuator_biasprm[actuator, 2]
    return squared * float(kp), squared * float(kd)


def _torque_limit(model: mujoco.MjModel, joint: int, actuator: int | None) -> float | None:
    import mujoco

    if model.jnt_actfrclimited[joint]:
        return float(np.abs(model.jnt_actfrcrange[joint]).max())
    if actuator is None:
        return None
    gear = abs(float(model.actuator_gear[actuator, 0]))
    if model.actuator_forcelimited[actuator]:
        return gear * float(np.abs(model.actuator_forcerange[actuator]).max())
    motor = model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE
    if motor and model.actuator_ctrllimited[actuator]:
        gain = float(model.actuator_gainprm[actuator, 0])
        return gear * gain * float(np.abs(model.actuator_ctrlrange[actuator]).max())
    return None


def _round(value: float) -> float:
    """Round to two digits: a guess has no more."""
    return float(f"{value:.2g}")


def _rounded(values: np.ndarray) -> list[float]:
    return [_round(float(value)) for value in values]
