"""Find the end of a leg that has a whole shank for a foot: the centre of such a shape is no place to stand on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import mujoco

_LONG = 2.0
"""Smallest length over width of a shape that counts as a shank."""
_ALONG = 0.7
"""Smallest cosine between a shank's shape and the line from the knee to its end."""
_UPRIGHT = 0.3
"""Smallest cosine between a shank's shape and the vertical."""
_WIDER = 1.25
"""Radius of a sphere at the end of a shape over that of what it covers: the sphere alone meets the ground."""
_TIP = 0.1
"""Share of a mesh's length that counts as its end."""


_CONTACT = (
    *("contype", "conaffinity", "condim", "priority", "friction", "solmix", "solref", "solimp"),
    *("margin", "gap", "group", "rgba"),
)
"""Properties of a shape that say how it meets others, and how it looks."""


@dataclass(frozen=True, kw_only=True)
class ShankEnd:
    """The end of a shank, and a sphere there that would be a foot."""

    length: float
    """Of the shape [m]."""
    center: NDArray[np.float64]
    """Of the sphere, in the frame of the shape's body [m]."""
    radius: float
    """Of the sphere [m]."""


def shank_end(model: mujoco.MjModel, data: mujoco.MjData, geom: int, knee: NDArray[np.float64]) -> ShankEnd | None:
    """Return the end of a foot's shape, a geom, that is a whole shank; None for a foot.

    Args:
        data: the robot's kinematics.
        knee: place of the last joint above the foot, world frame [m].
    """
    import mujoco

    kinds = mujoco.mjtGeom
    kind = kinds(int(model.geom_type[geom]))
    middle, half = model.geom_aabb[geom, :3].copy(), model.geom_aabb[geom, 3:]
    long = int(half.argmax())
    across = [i for i in range(3) if i != long]
    if half[long] < _LONG * half[across].max():
        return None
    # in the shape's own frame; the end is the side further from the knee
    turn, place = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
    if abs(turn[2, long]) < _UPRIGHT:
        return None  # a sole
    from_knee = turn.T @ (knee - place)
    outwards = 1.0 if from_knee[long] < middle[long] else -1.0
    end = middle.copy()
    end[long] += outwards * half[long]
    if abs(end[long] - from_knee[long]) < _ALONG * np.linalg.norm(end - from_knee):
        return None
    if kind == kinds.mjGEOM_MESH:
        first, count = model.mesh_vertadr[model.geom_dataid[geom]], model.mesh_vertnum[model.geom_dataid[geom]]
        points = model.mesh_vert[first : first + count].astype(float)
        points = points[outwards * (points[:, long] - end[long]) > -_TIP * 2.0 * half[long]]
        low, high = points[:, across].min(axis=0), points[:, across].max(axis=0)
        end[across] = 0.5 * (low + high)
        width = float(np.linalg.norm(points[:, across] - end[across], axis=1).max())
    elif kind == kinds.mjGEOM_BOX:
        width = float(np.linalg.norm(half[across]))
    else:
        width = float(half[across].max())
    # the sphere's centre: that of a capsule's round end, which encloses an ellipsoid's; half a width behind a flat end
    end[long] -= outwards * width * (1.0 if kind in (kinds.mjGEOM_CAPSULE, kinds.mjGEOM_ELLIPSOID) else 0.5)
    body = model.geom_bodyid[geom]
    center = data.xmat[body].reshape(3, 3).T @ (place + turn @ end - data.xpos[body])
    return ShankEnd(length=2.0 * float(half[long]), center=center, radius=_WIDER * width)


def add_foot(body: mujoco.MjsBody, name: str, end: ShankEnd, shank: mujoco.MjsGeom) -> None:
    """Add a massless sphere to the end of a shank, with the shank's contact properties."""
    import mujoco

    foot = body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[round(end.radius, 5), 0.0, 0.0],
        pos=[round(float(x), 5) for x in end.center],
        mass=0.0,
    )
    for key in _CONTACT:
        setattr(foot, key, getattr(shank, key))


def copy_geom(body: mujoco.MjsBody, geom: mujoco.MjsGeom) -> None:
    """Add a copy of a primitive shape to a body."""
    copy = body.add_geom(name=geom.name)
    for key in ("type", "size", "pos", "quat", "mass", *_CONTACT):
        setattr(copy, key, getattr(geom, key))
