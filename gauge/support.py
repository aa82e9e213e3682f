"""The support polygon of a robot's soles, and how far inside it the ground presses."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch

from ..robots.anatomy.body_plan import default_pose, sole_geoms
from ..robots.anatomy.limbs import joint_chain
from ..robots.base import Robot
from ..robots.rotation import rotate_inverse


@dataclass(frozen=True, kw_only=True, eq=False)
class _Link:
    """A body on the way from the base to a foot, with its joints."""

    position: torch.Tensor
    """In its parent's frame [m], (3,)."""
    rotation: torch.Tensor
    """(3, 3)."""
    joints: tuple[tuple[int, torch.Tensor, torch.Tensor], ...]
    """Joint of the robot, axis (3,) and anchor [m], (3,)."""


class Soles:
    """Corners of the feet's soles, which follow from the pose of base and joints. F feet of four corners each."""

    def __init__(self, robot: Robot, device: torch.device, dtype: torch.dtype) -> None:
        """Read the way to each foot, and the rectangle around its shapes in the default pose, off the robot's model."""
        import mujoco

        def tensor(values: object) -> torch.Tensor:
            return torch.tensor(np.array(values), device=device, dtype=dtype)

        model, data = default_pose(robot)
        base = model.body(robot.base_body).id
        number = {model.joint(name).id: j for j, name in enumerate(robot.joint_names)}
        self._links: list[list[_Link]] = []
        corners, halves = [], []
        for sole in sole_geoms(model, robot):
            body = foot = int(model.geom_bodyid[sole[0]])
            links: list[_Link] = []
            while body != base:
                turn = np.zeros(9)
                mujoco.mju_quat2Mat(turn, model.body_quat[body])
                own = joint_chain(model, body, int(model.body_parentid[body]))
                joints = tuple((number[j], tensor(model.jnt_axis[j]), tensor(model.jnt_pos[j])) for j in own)
                links.insert(
                    0, _Link(position=tensor(model.body_pos[body]), rotation=tensor(turn.reshape(3, 3)), joints=joints)
                )
                body = int(model.body_parentid[body])
            self._links.append(links)
            low, high = np.full(3, np.inf), np.full(3, -np.inf)
            for geom in sole:
                turn = data.geom_xmat[geom].reshape(3, 3)
                center = data.geom_xpos[geom] + turn @ model.geom_aabb[geom, :3]
                reach = np.abs(turn) @ model.geom_aabb[geom, 3:]
                low, high = np.minimum(low, center - reach), np.maximum(high, center + reach)
            under = [[x, y, low[2]] for x in (low[0], high[0]) for y in (low[1], high[1])]
            corners.append((np.array(under) - data.xpos[foot]) @ data.xmat[foot].reshape(3, 3))
            halves.append(0.5 * min(high[0] - low[0], high[1] - low[1]))
        self._corners = tensor(corners)
        self.half_width = float(np.mean(halves))
        """Half the width of a sole [m]: the distance of its middle from its edge."""
        pairs = list(combinations(range(4 * len(corners)), 2))
        self._pairs = torch.tensor(pairs, device=device).T

    def corners(self, position: torch.Tensor, quaternion: torch.Tensor, joints: torch.Tensor) -> torch.Tensor:
        """Return the corners of all soles, world frame [m], (N, F, 4, 3).

        Args:
            position: of the base, world frame [m], (N, 3).
            quaternion: of the base, wxyz, (N, 4).
            joints: joint positions [rad], (N, J).
        """
        found, at, kind = [], position.device, position.dtype
        for links, corners in zip(self._links, self._corners, strict=True):
            place, turn = position, rotate_inverse(quaternion[:, None], torch.eye(3, device=at, dtype=kind))
            for link in links:
                place = place + turn @ link.position
                turn = turn @ link.rotation
                for joint, axis, anchor in link.joints:
                    place = place + turn @ anchor
                    turn = turn @ _about(axis, joints[:, joint])
                    place = place - turn @ anchor
            found.append(place[:, None] + corners @ turn.transpose(1, 2))
        return torch.stack(found, dim=1)

    def depth(self, points: torch.Tensor, corners: torch.Tensor, carries: torch.Tensor) -> torch.Tensor:
        """Return the distance of points from the nearest edge of the support polygon, negative outside [m], (N,).

        The polygon is the convex hull of the corners of all feet that carry, seen from above. A point's distance is the least,
        over the lines through two corners, of how far the corners reach beyond the point across the line.

        Args:
            points: horizontal places [m], (N, 2).
            corners: as from ``corners``.
            carries: feet that carry, (N, F) bool.
        """
        flat, on = corners[..., :2].flatten(1, 2), carries.repeat_interleave(4, dim=1)
        first, second = self._pairs
        along = flat[:, second] - flat[:, first]
        length = torch.linalg.vector_norm(along, dim=2, keepdim=True)
        across = torch.stack((-along[..., 1], along[..., 0]), dim=2) / length.clamp(min=1e-9)
        usable = on[:, first] & on[:, second] & (length[..., 0] > 1e-6)
        reach = torch.einsum("npk,nck->npc", across, flat - points[:, None])
        out = torch.full_like(reach, torch.inf)
        furthest = torch.where(on[:, None], reach, -out).amax(2)
        nearest = torch.where(on[:, None], reach, out).amin(2)
        depth = torch.minimum(furthest, -nearest)
        return torch.where(usable, depth, torch.full_like(depth, torch.inf)).amin(1)


def _about(axis: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Return the rotations about a unit axis by angles (N,) [rad], (N, 3, 3)."""
    x, y, z = axis.unbind()
    zero = torch.zeros_like(x)
    cross = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero)).view(3, 3)
    sin, cos = torch.sin(angle)[:, None, None], torch.cos(angle)[:, None, None]
    return torch.eye(3, device=axis.device, dtype=axis.dtype) + sin * cross + (1.0 - cos) * (cross @ cross)
