"""Find terrains by name: the gauge's own, and plug-ins of the entry-point group ``gaitgauge.terrains``.

Such an entry point is a callable that takes the level (0 for none) and returns a ``Terrain``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from ..files.parsing import did_you_mean, one_line
from ..files.plugins import guarded, load_plugin, origin, plugins
from .base import Terrain
from .gauge_terrains import LEVELS, flat, obstacle, slope, stairs, wave
from .shapes import TerrainError

GROUP = "gaitgauge.terrains"

# The order in which the published benchmark lists its terrains; tables and averages follow it.
_LEVELLED: dict[str, Callable[[int], Terrain]] = {
    "slope_fd": slope,
    "slope_bd": partial(slope, backward=True),
    "stairs_fd": stairs,
    "stairs_bd": partial(stairs, backward=True),
    "wave": wave,
    "obstacle": obstacle,
}


def gauge_terrain_names() -> list[str]:
    """Return the seven terrains of the published benchmark in its order; only ``flat``, the first, has no levels."""
    return ["flat", *_LEVELLED]


def terrain_names() -> list[str]:
    """Return the names of all terrains: the gauge's own first, then installed plug-ins."""
    own = gauge_terrain_names()
    return own + sorted(set(plugins(GROUP)) - set(own))


def make_terrain(name: str, level: int | None = None) -> Terrain:
    """Build a terrain.

    Args:
        name: one of ``terrain_names()``.
        level: 1..10; None or 0 for ``flat``. A plug-in gets any level unchanged, 0 for None.

    Raises:
        TerrainError: unknown name, a level that the terrain does not have, or a plug-in that cannot be loaded or gives
            no terrain.
    """
    if level is not None and (isinstance(level, bool) or not isinstance(level, int)):
        raise TerrainError(f"the level of terrain '{name}' must be a whole number, not {level!r}")
    if name == "flat":
        if level not in (None, 0):
            raise TerrainError(f"terrain 'flat' has no levels, but level {level} was asked for; leave the level out")
        return flat()
    if name in _LEVELLED:
        if level is None:
            raise TerrainError(f"terrain '{name}' needs a level from {LEVELS[0]} to {LEVELS[-1]}")
        if level not in LEVELS:
            raise TerrainError(f"terrain '{name}' has levels {LEVELS[0]} to {LEVELS[-1]}, not {level}")
        return _LEVELLED[name](level)
    plugin = plugins(GROUP).get(name)
    if plugin is None:
        hint = did_you_mean(name, terrain_names()) or f"; choose one of: {', '.join(terrain_names())}"
        raise TerrainError(f"unknown terrain '{one_line(name, 80)}'{hint}")
    terrain = guarded(plugin, TerrainError, load_plugin(plugin, TerrainError), level or 0)
    if not isinstance(terrain, Terrain):
        raise TerrainError(f"{origin(plugin)} must return a Terrain, not {type(terrain).__name__}")
    return terrain
