"""Turns other projects' words for observations, clips and lists into those of a contract."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from ..base import PolicyError
from ..contract import ContractError
from ..observation_table import ObservationError, foreign_observation

ISAAC_HEIGHT = 0.5
"""Height of the base over the ground that Isaac Lab's height scan calls zero, unless it is told another [m]."""


def usual_scan(height: float) -> str:
    """Return what is assumed of a height scan that a file names without its grid; ``height``: of the base, which it calls zero [m]."""
    return f"the height scan's usual grid, 1.6 by 1 m, 0.1 m apart, x first, less {height:g} m (a contract.toml gives another)"


@contextmanager
def checked(source: object, what: str) -> Iterator[None]:
    """Turn failed lookups on a description's content into one ``PolicyError``; ``what``: its kind, such as ``deploy.yaml``."""
    try:
        yield
    except ContractError as error:
        raise PolicyError(f"'{source}' does not give a valid policy contract: {error}") from error
    except KeyError as error:
        raise PolicyError(f"'{source}' lacks {error} of {what}") from error
    except (TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        if isinstance(error, PolicyError):
            raise
        raise PolicyError(f"'{source}' has a malformed entry of {what}: {error}") from error


def listed(value: Any, missing: Any, count: int = 1) -> list[Any]:
    """Return a list: as it is, or one value for all."""
    if value is None:
        return [missing] * count
    return list(value) if isinstance(value, (list, tuple)) else [value] * count


def own_term(name: str, source: object) -> str:
    """Return the project's name of an observation; raise ``PolicyError`` where it has none."""
    try:
        return foreign_observation(name).name
    except ObservationError as error:
        raise PolicyError(f"'{source}' {error}") from error


def symmetric(low: float, high: float, name: str, source: object) -> float:
    """Return the magnitude that an observation is clipped to."""
    if low != -high:
        raise PolicyError(
            f"'{source}' clips the observation '{name}' to [{low}, {high}]; only symmetric limits are supported"
        )
    return high


def clip_before_scaling(limit: float, scale: Sequence[float]) -> tuple[float, ...]:
    """Return clips after scaling that do the same as one before it; a term scaled by zero is zero, clipped or not."""
    return tuple(limit * (abs(s) or 1.0) for s in scale)
