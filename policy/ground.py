"""The ground as a robot's map shows it: heights of a grid of cells about the robot, some time old."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ..backends.base import PhysicsState
from ..terrains.base import Terrain
from ..terrains.height_scan import HeightRasters, heading, place_pattern, scan_pattern
from .contract import ObservationTerm, PolicyContract

_LARGEST = 30.0
"""Largest half size of a map [m]; further out the height of its edge continues."""
_MARGIN = 1.0
"""Of a map around the terrain's shapes [m]."""
MAP_CELL = 0.05
"""Cell of a map where no suite says so [m]; the nearest node counts."""


class Ground:
    """Maps of the terrains of N worlds."""

    def __init__(self, rasters: HeightRasters, terrain_index: torch.Tensor, *, delay: float = 0.0) -> None:
        """Take maps that exist.

        Args:
            rasters: heights of the terrains.
            terrain_index: terrain of every world, (N,) int64; its memory is read anew each time.
            delay: age of a map when the policy sees it [s].
        """
        self.rasters, self.terrain_index, self.delay = rasters, terrain_index, delay

    @classmethod
    def of(
        cls,
        contract: PolicyContract,
        terrains: Sequence[Terrain],
        terrain_index: torch.Tensor,
        *,
        cell: float = MAP_CELL,
        delay: float = 0.0,
    ) -> Ground | None:
        """Make the maps that a policy looks at; None for a policy that looks at none."""
        if not contract.scan_points:
            return None
        half_size = min(max(map(_extent, terrains)) + _MARGIN, _LARGEST)
        rasters = HeightRasters(terrains, half_size=half_size, cell=cell, device=terrain_index.device)
        return cls(rasters, terrain_index, delay=delay)


def _extent(terrain: Terrain) -> float:
    """Return the largest distance of a terrain's shapes from its origin along x or y [m]."""
    # a turned box reaches no further than its diagonal
    reach = [
        abs(c) + sum(each * each for each in box.half_size) ** 0.5 for box in terrain.boxes for c in box.center[:2]
    ]
    if (field := terrain.height_field) is not None:
        reach += [abs(c) + half for c, half in zip(field.center, field.half_size, strict=True)]
    return max(reach, default=0.0)


def scan_points(term: ObservationTerm, device: torch.device | str = "cpu") -> torch.Tensor:
    """Return the points of a ``height_scan`` about the base, x along the heading, in the order of its entries [m], (P, 2)."""
    # the pattern has y as its fast index
    points = scan_pattern(*term.size, term.spacing, device).view(*term.grid, 2)
    return (points.transpose(0, 1) if term.fastest == "x" else points).reshape(-1, 2)


class HeightScan:
    """One ``height_scan`` term of N robots: it reads a map, and gives what it read ``Ground.delay`` ago."""

    def __init__(self, term: ObservationTerm, ground: Ground, count: int, control_period: float) -> None:
        """Prepare the points and the memory."""
        device = ground.terrain_index.device
        self._points = scan_points(term, device)
        self._ground, late = ground, round(ground.delay / control_period)
        self._past = torch.zeros(count, late + 1, len(self._points), device=device)
        self._fresh = torch.ones(count, dtype=torch.bool, device=device)

    def reset(self, episodes: torch.Tensor | None) -> None:
        """Forget the maps of the masked robots, (N,) bool, None for all; the next one stands for older ones."""
        if episodes is None:
            self._fresh.fill_(True)
        else:
            self._fresh.logical_or_(episodes)

    def by_name(self) -> dict[str, torch.Tensor]:
        """Return the memory itself, not copies: past maps, oldest first [m], (N, steps, P), and who has none, (N,) bool."""
        return {"past": self._past, "fresh": self._fresh}

    def __call__(self, state: PhysicsState) -> torch.Tensor:
        """Return the height of the base over each point [m], (N, P), and remember it; call once per control step."""
        position = state.base_position_w.to(torch.float32)
        direction = heading(state.base_quaternion_w.to(torch.float32))
        points = place_pattern(self._points, position[:, :2], direction)
        now = position[:, 2:] - self._ground.rasters.height(self._ground.terrain_index, points)
        if self._past.shape[1] == 1:
            return now
        past = torch.cat((self._past[:, 1:], now[:, None]), dim=1)
        self._past.copy_(torch.where(self._fresh[:, None, None], now[:, None].expand_as(past), past))
        self._fresh.fill_(False)
        return self._past[:, 0].clone()
