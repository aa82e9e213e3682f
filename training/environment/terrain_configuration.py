"""Settings of the ground to train on: which tiles, and how they get harder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from ...files.parsing import NotNegative, Positive, Seed, Share
from ...terrains.training_tiles import DEFAULT_SHAPE, NUM_TILE_LEVELS, TileShape

_Distance = Annotated[float, Field(gt=0.0, le=100.0)]
_Spread = Annotated[float, Field(ge=0.0, le=100.0)]


SCENARIOS = "scenarios"
"""Kind of ground of the worlds that play ``EnvironmentConfiguration.scenarios``, which has no level."""


@dataclass(frozen=True, kw_only=True)
class TileConfiguration:
    """One kind of training tile: its share, the commands on it, and factors on the settings of the same names in ``rewards`` and
    ``commands``.
    """

    name: str
    """A kind out of ``terrains.training_tiles.TILE_KINDS``."""
    share: NotNegative
    """Share of the environments, relative to the other kinds'; 0 leaves the kind out."""
    command_limits: tuple[float, float, float]
    """Largest forward, lateral [m/s] and yaw [rad/s] command on this kind."""
    sigma: Positive
    """Largest tracking sigma on this kind (``RewardConfiguration.dynamic_sigma``)."""
    ends: bool = True
    """True if the kind has an edge, at which ``TerrainConfiguration.leave_distance`` acts and to which crossings lead."""
    linear_tracking: NotNegative = 1.0
    """Factor on the weight ``rewards.linear_tracking``."""
    yaw_tracking: NotNegative = 1.0
    """Factor on the weight ``rewards.yaw_tracking``."""
    progress: NotNegative = 1.0
    """Factor on the weight ``rewards.progress``."""
    vertical_velocity: NotNegative = 1.0
    """Factor on the weight ``rewards.vertical_velocity``."""
    roll_pitch_rate: NotNegative = 1.0
    """Factor on the weight ``rewards.roll_pitch_rate``."""
    stationary_probability: NotNegative = 1.0
    """Factor on the share of stationary commands."""
    stationary_yaw_probability: NotNegative = 1.0
    """Factor on the share of those that turn on the spot."""
    interval: Positive | None = None
    """Time between two draws of commands [s]; None for ``commands.interval``."""
    reversal_probability: Share = 0.0
    """Chance that the opposite of a command follows it; in half of the cases without its yaw rate, at the heading of that moment."""
    stuck: bool = True
    """True if ``termination.stuck`` ends episodes."""


_MODERATE, _SLOW, _STRAIGHT = (1.5, 1.0, 1.5), (1.0, 1.0, 1.5), (1.0, 0.5, 1.5)

FLAT_TILE = TileConfiguration(name="flat", share=0.09, command_limits=(2.0, 1.0, 2.0), sigma=0.25, ends=False)
"""Level ground without end."""
ALL_TILES = (
    TileConfiguration(name="wave", share=0.15, command_limits=_MODERATE, sigma=5.0 / 12.0),
    TileConfiguration(name="slope_up", share=0.06, command_limits=_MODERATE, sigma=0.25),
    TileConfiguration(name="slope_down", share=0.06, command_limits=_MODERATE, sigma=0.25),
    TileConfiguration(name="rough_slope", share=0.04, command_limits=_MODERATE, sigma=0.25),
    TileConfiguration(name="stairs_up", share=0.25, command_limits=_STRAIGHT, sigma=0.5),
    TileConfiguration(name="stairs_down", share=0.1, command_limits=_SLOW, sigma=0.5),
    TileConfiguration(name="bars", share=0.12, command_limits=_STRAIGHT, sigma=0.75),
    TileConfiguration(name="obstacles", share=0.13, command_limits=_STRAIGHT, sigma=0.75),
    FLAT_TILE,
)
"""Every kind. Sigmas are the published ones (bars have that of obstacles), limits too but for slower sideways commands on stairs upwards,
bars and obstacles; waves and all that is to be climbed have more than their published share, slopes and flat less."""


@dataclass(frozen=True, kw_only=True)
class TerrainConfiguration:
    """Kinds of ground, and their levels."""

    tiles: tuple[TileConfiguration, ...] = ALL_TILES
    """Kinds of training tile."""
    shape: TileShape = DEFAULT_SHAPE
    """Dimensions of the tiles."""
    levels: Annotated[int, Field(ge=1, le=NUM_TILE_LEVELS)] = NUM_TILE_LEVELS
    """Number of levels, from the easiest."""
    variants: Annotated[int, Field(ge=1, le=1000)] = 16
    """Different tiles per kind and level, where a kind has chance in it. With four, chance makes a level harder than the next."""
    seed: Seed = 0
    """Seed of the tiles' chance."""
    curriculum: bool = True
    """Let levels follow success; otherwise every episode draws its level."""
    highest_start_level: Annotated[int, Field(ge=0, lt=NUM_TILE_LEVELS)] = 5
    """Levels at the start are uniform from 0 to this, or to the last of ``levels``."""
    promotion_distance: _Distance = 4.0
    """Distance from the tile's middle (larger of |x|, |y|) beyond which the level rises [m]; 4 is the tile's edge."""
    demotion_share: Share = 0.5
    """Share of the commanded way below which the level falls."""
    demote_falls: bool = True
    """Lower the level after a fall before promotion, at any distance."""
    leave_distance: _Distance | None = 4.75
    """Distance from the tile's middle at which an episode is cut short as a time-out [m]; None for never. Beyond the edge there is only
    level ground, on which the published robots had the next tile."""
    spawn_jitter: _Spread = 1.0
    """Episodes start up to this far from the tile's middle, in x and in y [m]."""
    spread_probability: Share = 0.1
    """Share of the episodes that start anywhere on the tile instead, as the gauge's evaluation does; no success of theirs moves a level."""
    spread_distance: _Spread = 3.0
    """Those episodes start up to this far from the tile's middle, in x and in y [m]."""
    level_rule: str = "gaitgauge.training.environment.curriculum:next_level"
    """``module:function`` that says on which level the next episode is, with the arguments of this one."""


TRAINING_TERRAIN = TerrainConfiguration()
"""Every kind of tile, with a curriculum."""
