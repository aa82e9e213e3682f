"""Compare Newton's import of a robot with MuJoCo's compilation."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray


def import_differences(found: mujoco.MjModel, expected: mujoco.MjModel, order: NDArray) -> list[str]:
    """Return a sentence for each field in which Newton's MuJoCo model differs from the model of MuJoCo's own compiler.

    Args:
        found: the model made by Newton.
        expected: the robot as MuJoCo compiles it.
        order: geom of ``found`` for each geom of ``expected``.
    """
    wrong: list[str] = []
    for name in BODY_AND_JOINT_FIELDS:
        _compare(name, getattr(found, name), getattr(expected, name), wrong)
    _compare("body_inertia", _inertia(found), _inertia(expected), wrong)
    for name in GEOM_FIELDS:
        _compare(name, getattr(found, name)[order], getattr(expected, name), wrong)
    # round shapes leave some sizes unused, with different values
    used = np.arange(3) < np.array([_USED_SIZES.get(int(t), 3) for t in expected.geom_type])[:, None]
    _compare("geom_size", np.where(used, found.geom_size[order], 0.0), np.where(used, expected.geom_size, 0.0), wrong)
    pairs = [_colliding(found, order), _colliding(expected, np.arange(expected.ngeom))]
    for a, b in sorted(pairs[0] ^ pairs[1]):
        names = f"'{expected.geom(a).name}' and '{expected.geom(b).name}'"
        wrong.append(f"geoms {names} {'collide' if (a, b) in pairs[0] else 'do not collide'}, unlike in MuJoCo")
    return wrong


BODY_AND_JOINT_FIELDS = (
    "body_mass", "body_ipos", "body_pos", "jnt_pos", "jnt_axis", "jnt_limited", "jnt_range", "jnt_stiffness",
    "jnt_solref", "jnt_solimp", "jnt_margin", "dof_armature", "dof_damping", "dof_frictionloss", "dof_solref",
    "dof_solimp", "qpos0",
)  # fmt: skip
"""Model fields that must agree, bodies and joints in the same order in both models."""
GEOM_FIELDS = (
    "geom_type", "geom_pos", "geom_bodyid", "geom_condim", "geom_priority", "geom_friction",
    "geom_solref", "geom_solimp", "geom_solmix",
)  # fmt: skip
"""Model fields of geoms that must agree."""
_USED_SIZES = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): 1,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): 2,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): 2,
}


def _inertia(model: mujoco.MjModel) -> NDArray[np.float64]:
    """Return every body's inertia about its centre of mass, along the body's axes [kg·m²], (B, 3, 3); principal axes have no order."""
    turn = np.zeros((model.nbody, 9))
    for row, quaternion in zip(turn, model.body_iquat, strict=True):
        mujoco.mju_quat2Mat(row, quaternion)
    axes = turn.reshape(-1, 3, 3)
    return axes @ (model.body_inertia[:, :, None] * axes.transpose(0, 2, 1))


def _compare(name: str, found: NDArray, expected: NDArray, wrong: list[str]) -> None:
    """Note a field with differences beyond single precision."""
    a, b = np.asarray(found, dtype=np.float64), np.asarray(expected, dtype=np.float64)
    if a.shape != b.shape:
        wrong.append(f"{name} has shape {a.shape} instead of {b.shape}")
    elif not np.allclose(a, b, rtol=2e-5, atol=2e-6):
        wrong.append(f"{name} is off by {np.abs(a - b).max():.3g}")


def _colliding(model: mujoco.MjModel, order: NDArray) -> set[tuple[int, int]]:
    """Return the pairs of robot geoms, numbered as in ``order``, that can collide."""
    excluded = {int(s) for s in model.exclude_signature}
    found = set()
    for i in range(len(order)):
        for j in range(i + 1, len(order)):
            a, b = int(order[i]), int(order[j])
            body = sorted((int(model.geom_bodyid[a]), int(model.geom_bodyid[b])))
            related = body[0] == body[1] or (body[0] != 0 and int(model.body_parentid[body[1]]) == body[0])
            contype, conaffinity = model.geom_contype, model.geom_conaffinity
            masks = contype[a] & conaffinity[b] or contype[b] & conaffinity[a]
            if masks and not related and (body[0] << 16) + body[1] not in excluded:
                found.add((i, j))
    return found
