"""Choose each world's tile, and change its level (paper, game-inspired curriculum).

All tiles of all kinds and levels are one palette of terrains; a new level is another terrain index at the next reset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from ...files.parsing import shown
from ...terrains.base import Terrain
from ...terrains.training_tiles import TILE_KINDS, make_tile
from ..configuration import ConfigurationError
from .memory import EnvironmentMemory
from .own_terms import resolve
from .randomness import UniformColumns
from .step_inputs import StepInputs
from .terrain_configuration import TerrainConfiguration, TileConfiguration


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingPalette:
    """All tiles of the kinds in use, and where each kind, level and variant is among them."""

    terrains: tuple[Terrain, ...]
    tiles: tuple[TileConfiguration, ...]
    """Kinds in use; a kind's number is its place here."""
    index: torch.Tensor
    """Terrain index of every kind, level and variant, (K, L, V) int64; tiles repeat where a kind has no levels or no chance."""

    @property
    def num_levels(self) -> int:
        """Return the levels per kind, L."""
        return self.index.shape[1]


def build_palette(configuration: TerrainConfiguration) -> TrainingPalette:
    """Build the tiles of every kind with a share above zero. Raises TerrainError: unknown kind, or more levels than tiles have."""
    tiles = tuple(t for t in configuration.tiles if t.share > 0)
    terrains: list[Terrain] = []
    index = torch.zeros(len(tiles), configuration.levels, configuration.variants, dtype=torch.int64)
    for number, tile in enumerate(tiles):
        kind = TILE_KINDS.get(tile.name)  # make_tile says what is wrong with an unknown one
        for level in range(configuration.levels):
            for variant in range(configuration.variants):
                if kind and not kind.levelled and level > 0:
                    index[number, level] = index[number, 0]
                elif kind and not kind.random and variant > 0:
                    index[number, level, variant] = index[number, level, 0]
                else:
                    index[number, level, variant] = len(terrains)
                    terrains.append(
                        make_tile(tile.name, level, configuration.seed + variant, shape=configuration.shape)
                    )
    return TrainingPalette(terrains=tuple(terrains), tiles=tiles, index=index)


def assign_kinds(shares: Sequence[float], num_envs: int) -> torch.Tensor:
    """Return the kind of every world, (N,) int64: contiguous blocks in proportion to the shares, so that teacher and student share every
    kind.

    Raises:
        ConfigurationError: shares that are negative or all zero.
    """
    if min(shares, default=-1.0) < 0 or sum(shares) <= 0:
        raise ConfigurationError(
            "environment.terrain.tiles.<kind>.share is 0 for every kind, or negative for one; give at least one kind a share above 0"
        )
    bounds = torch.tensor([sum(shares[: i + 1]) / sum(shares) for i in range(len(shares))], dtype=torch.float64)
    middle = (torch.arange(num_envs, dtype=torch.float64) + 0.5) / num_envs
    return torch.searchsorted(bounds[:-1].contiguous(), middle, right=True)


class Levels:
    """Level and tile of each world."""

    def __init__(self, configuration: TerrainConfiguration, palette: TrainingPalette, kind: torch.Tensor) -> None:
        """Put the tiles' indices on the device of ``kind``, each world's, (N,) int64. Raises ConfigurationError: the level rule is not
        there.
        """
        self._settings, self._kind, self._num_levels = configuration, kind, palette.num_levels
        self._index = palette.index.to(kind.device)
        self._rule = resolve(configuration.level_rule, "environment.terrain.level_rule")

    def follow(self, memory: EnvironmentMemory, inputs: StepInputs) -> None:
        """Remember how far the robots came, and how far they should have come."""
        memory.farthest.copy_(torch.maximum(memory.farthest, inputs.distance))
        forward, lateral = memory.command[:, :1], memory.command[:, 1:2]
        heading_xy = inputs.commanded_heading_xy
        left_xy = torch.stack((-heading_xy[:, 1], heading_xy[:, 0]), dim=1)
        memory.commanded_way.add_(forward * heading_xy + lateral * left_xy, alpha=inputs.period)
        memory.commanded_farthest.copy_(torch.maximum(memory.commanded_farthest, memory.commanded_way.norm(dim=1)))

    def move(
        self, memory: EnvironmentMemory, uniform: UniformColumns, worlds: torch.Tensor, failed: torch.Tensor
    ) -> None:
        """Move the masked worlds to the level and tile of their next episode; ``failed`` marks those with a failure; both (N,) bool."""
        level = self._rule(
            self._settings,
            level=memory.level,
            num_levels=self._num_levels,
            farthest=memory.farthest,
            commanded=memory.commanded_farthest,
            fallen=failed,
            uniform=uniform["level"][:, 0],
        )
        if not isinstance(level, torch.Tensor) or level.shape != memory.level.shape or level.dtype is not torch.int64:
            raise ConfigurationError(
                f"environment.terrain.level_rule is {shown(self._settings.level_rule)}, which gave {shown(level)}; it must be a "
                "level from 0 for each world, (N,) int64"
            )
        torch.where(worlds & memory.moves_level, level, memory.level, out=memory.level)
        variants = self._index.shape[2]
        variant = (uniform["variant"][:, 0] * variants).long().clamp(max=variants - 1)
        tile = self._index[self._kind, memory.level, variant]
        torch.where(worlds, tile, memory.terrain_index, out=memory.terrain_index)


def next_level(
    configuration: TerrainConfiguration,
    *,
    level: torch.Tensor,
    num_levels: int,
    farthest: torch.Tensor,
    commanded: torch.Tensor,
    fallen: torch.Tensor,
    uniform: torch.Tensor,
) -> torch.Tensor:
    """Return the level of the next episode, were this one over.

    Up after leaving the middle of the tile far enough; down after a fall, or with too little of the commanded way made. A robot that
    masters the last level starts anywhere again, so that easy tiles are not forgotten.

    Args:
        level: present level from 0, (N,) int64.
        num_levels: L.
        farthest: largest distance from the tile's middle in the episode [m], (N,).
        commanded: largest distance that the commands would have led to, at the commanded headings [m], (N,).
        fallen: whether the episode ended by a fall, (N,) bool.
        uniform: numbers in [0, 1), (N,).

    Returns:
        (N,) int64 in [0, L).
    """
    anywhere = (uniform * num_levels).long().clamp(max=num_levels - 1)
    if not configuration.curriculum:
        return anywhere
    up = farthest > configuration.promotion_distance
    slow = farthest < configuration.demotion_share * commanded
    down = ~up & (slow | fallen if configuration.demote_falls else slow)
    moved = torch.add(level + up, down, alpha=-1)
    return torch.where(moved >= num_levels, anywhere, moved.clamp_min(0))
