"""What an episode is before it runs, and what is known of it afterwards."""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..files.writing import replacing

QUALITY = "quality"
"""Column of the sample table that holds the quality of each sample."""


class RecordError(ValueError):
    """An episode's file is damaged, or cannot be written."""


@dataclass(frozen=True, kw_only=True, order=True)
class Episode:
    """One uninterrupted run of a policy: a world, a seed and the goals it goes through."""

    terrain: str
    level: int
    """1..10; 0 on flat ground."""
    friction: float
    payload: float
    """Mass added to the base [kg]."""
    seed: int
    stage: str
    """``search`` for the level test, ``eval`` for quality."""
    goals: tuple[str, ...]

    @property
    def key(self) -> str:
        """Name of the episode, unique within a suite; also its file's name."""
        goals = "+".join(g.split("_")[0] for g in self.goals)
        return (
            f"{self.stage}-{self.terrain}-L{self.level}-f{self.friction:.12g}-m{self.payload:.12g}-s{self.seed}-{goals}"
        )


@dataclass(kw_only=True)
class Record:
    """What came of an episode."""

    episode: Episode
    success: bool | None = None
    """Whether the target was reached; None where there was none."""
    falls: int = 0
    diverged: bool = False
    """The physics became invalid; counts as a fall."""
    overflowed: bool = False
    """The engine dropped contacts or constraints."""
    restarted: bool = False
    """A penetration made the goal start again."""
    control_steps: int = 0
    physics_steps: int = 0
    columns: tuple[str, ...] = ()
    """Metrics, then ``quality``."""
    samples: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    """Value of every sample, (T, columns), not clamped; NaN where a metric is not defined."""
    goal_index: NDArray[np.int16] = field(default_factory=lambda: np.zeros(0, np.int16))
    """Goal of each sample, index into ``episode.goals``, (T,)."""
    part_index: NDArray[np.int16] = field(default_factory=lambda: np.zeros(0, np.int16))
    """Sub-command of each sample, (T,)."""

    def summary(self) -> dict[str, Any]:
        """One flat row without the samples."""
        row = {k: v for k, v in asdict(self.episode).items() if k != "goals"}
        row["goals"] = "+".join(self.episode.goals)
        for name in ("success", "falls", "diverged", "overflowed", "restarted", "control_steps", "physics_steps"):
            row[name] = getattr(self, name)
        return row

    def save(self, folder: Path) -> None:
        """Write the record as one file, all or nothing. It survives the death of the process at once, and that of the machine soon."""
        head = {**self.summary(), "goals": list(self.episode.goals), "columns": list(self.columns)}
        with replacing(folder / f"{self.episode.key}.npz", RecordError, durable=False, ending=".npz") as partial:
            np.savez(
                partial,
                head=np.frombuffer(json.dumps(head).encode(), dtype=np.uint8),
                samples=self.samples,
                goal_index=self.goal_index,
                part_index=self.part_index,
            )

    @classmethod
    def load(cls, path: Path) -> Record:
        """Read a record.

        Raises:
            RecordError: the file is damaged.
        """
        try:
            with np.load(path, allow_pickle=False) as data:
                head: Mapping[str, Any] = json.loads(data["head"].tobytes())
                arrays = {k: data[k] for k in ("samples", "goal_index", "part_index")}
            names = ("terrain", "level", "friction", "payload", "seed", "stage")
            episode = Episode(goals=tuple(head["goals"]), **{n: head[n] for n in names})
            if episode.key != path.stem:
                raise ValueError(f"it holds episode {episode.key}")
            rest = ("success", "falls", "diverged", "overflowed", "restarted", "control_steps", "physics_steps")
            return cls(episode=episode, columns=tuple(head["columns"]), **arrays, **{n: head[n] for n in rest})
        except (OSError, KeyError, ValueError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise RecordError(
                f"episode file {path} is damaged ({reason}); delete it and run again with --resume"
            ) from error
