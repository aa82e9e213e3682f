"""The methods by name: one algorithm in each file."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from .ac_moe import AcMoe
from .cts import CTS
from .dreamwaq import Dreamwaq
from .him import Him
from .mcp import Mcp
from .ppo import PPO

METHODS: Mapping[str, type[PPO]] = MappingProxyType(
    {"cts": CTS, "ac_moe": AcMoe, "mcp": Mcp, "him": Him, "dreamwaq": Dreamwaq}
)
"""By the names that ``training.algorithm.method`` takes."""
