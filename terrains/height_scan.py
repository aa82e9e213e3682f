"""Ground heights on the device: one small raster per terrain of the palette, read by all worlds at once.

A raster holds ``Terrain.height`` at nodes of a square grid about the terrain's origin. A query takes the nearest node: riser edges stay
vertical, at most half a cell from where they are, and one query is one gather. Beyond the raster the height of its edge continues.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from .base import Terrain
from .height import grid_height


class HeightRasters:
    """Heights of every terrain of a palette."""

    def __init__(
        self, terrains: Sequence[Terrain], *, half_size: float, cell: float, device: torch.device | str
    ) -> None:
        """Sample the terrains of a palette to ``half_size`` from the origin in every direction [m], at nodes ``cell`` apart [m]."""
        steps = round(half_size / cell)
        self.cell = cell
        self.half_size = steps * cell
        self.nodes = 2 * steps + 1
        axis = np.linspace(-self.half_size, self.half_size, self.nodes)
        heights = np.empty((len(terrains), self.nodes, self.nodes), dtype=np.float32)
        for i, terrain in enumerate(terrains):
            heights[i] = grid_height(terrain.boxes, terrain.height_field, axis)
        self._heights = torch.from_numpy(heights).to(device).reshape(-1)

    def height(self, terrain_index: torch.Tensor, points_xy: torch.Tensor) -> torch.Tensor:
        """Return the ground height [m], (N, P), below points of the world frame [m], (N, P, 2), on each world's terrain, (N,) int64. Points
        that are not finite give the height of some node, so that a diverged world does no harm.
        """
        nodes = (points_xy * (1.0 / self.cell) + (self.half_size / self.cell + 0.5)).nan_to_num(0.0, 0.0, 0.0)
        nodes = nodes.clamp(0.0, float(self.nodes - 1)).long()
        row = torch.add(nodes[..., 1], terrain_index[:, None], alpha=self.nodes)
        flat = torch.add(nodes[..., 0], row, alpha=self.nodes)
        return self._heights[flat]


def scan_pattern(length: float, width: float, spacing: float, device: torch.device | str) -> torch.Tensor:
    """Return points of the height scan about the base, (P, 2) [m]: x along the heading is the slow index, both ascending."""
    columns, rows = round(length / spacing) + 1, round(width / spacing) + 1
    x = (torch.arange(columns, dtype=torch.float32) - (columns - 1) / 2) * spacing
    y = (torch.arange(rows, dtype=torch.float32) - (rows - 1) / 2) * spacing
    return torch.cartesian_prod(x, y).to(device)


def heading(quaternion: torch.Tensor) -> torch.Tensor:
    """Return the unit vector of the body's x axis in the world's xy plane, (cos yaw, sin yaw), from quaternions wxyz (N, 4) to (N, 2)."""
    return _heading(quaternion, quaternion[:, 2:].square())


def heading_and_upright(quaternion: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return ``heading``, (N, 2), and the cosine of the angle between the body's z axis and the world's, (N,)."""
    squares = quaternion[:, 1:].square()
    upright = torch.rsub(squares[:, 0] + squares[:, 1], 1.0, alpha=2.0)
    return _heading(quaternion, squares[:, 1:]), upright


def _heading(quaternion: torch.Tensor, squares: torch.Tensor) -> torch.Tensor:
    """Return ``heading`` with the squares of y and z, (N, 2), at hand."""
    mixed = quaternion[:, :2, None] * quaternion[:, None, 2:]  # wy, wz; xy, xz
    forward = torch.rsub(squares[:, 0] + squares[:, 1], 1.0, alpha=2.0)
    direction = torch.stack((forward, 2.0 * (mixed[:, 1, 0] + mixed[:, 0, 1])), dim=-1)
    return direction / direction.norm(dim=-1, keepdim=True).clamp_min(1e-6)


def place_pattern(pattern: torch.Tensor, position_xy: torch.Tensor, heading_xy: torch.Tensor) -> torch.Tensor:
    """Return points about the base, (P, 2) [m], turned to headings, unit vectors (N, 2), and moved to positions in the world frame [m], (N,
    2): (N, P, 2).
    """
    left = torch.stack((-heading_xy[:, 1], heading_xy[:, 0]), dim=-1)
    offset = pattern[None, :, :1] * heading_xy[:, None, :] + pattern[None, :, 1:] * left[:, None, :]
    return position_xy[:, None, :] + offset
