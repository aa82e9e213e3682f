"""Describe an episode before it runs, and its record afterwards."""

from __future__ import annotations

import json
import zipfile
import zlib
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..files.parsing import Seed, Text, build, one_line, parse_json
from ..files.writing import replacing

Count = Annotated[int, Field(ge=0, lt=2**53)]
_LARGEST = 10**9
"""Bytes that a record unpacks to at most; an episode has some hundred kilobytes."""
QUALITY = "quality"
"""Column of the sample table that holds the quality of each sample."""
MOTION = "motion_done"
"""Metric with the share of the commanded motion that a sample does; the square of its mean multiplies a goal's quality."""


class RecordError(ValueError):
    """An episode's file is damaged."""


@dataclass(frozen=True, kw_only=True, order=True)
class Episode:
    """One uninterrupted run of a policy: a world, a seed and the goals it goes through."""

    terrain: Text
    level: Count
    """1..10; 0 on flat ground."""
    friction: float
    payload: float
    """Mass added to the base [kg]."""
    seed: Seed
    stage: Text
    """``search`` for the level test, ``eval`` for quality."""
    goals: tuple[Text, ...]

    @property
    def key(self) -> str:
        """Name of the episode, unique within a suite; also its file's name."""
        goals = "+".join(g.split("_")[0] for g in self.goals)
        return (
            f"{self.stage}-{self.terrain}-L{self.level}-f{self.friction:.12g}-m{self.payload:.12g}-s{self.seed}-{goals}"
        )


@dataclass(kw_only=True)
class Record:
    """Outcome of an episode."""

    episode: Episode
    success: bool | None = None
    """True where the target was reached; None where there was none."""
    falls: int = 0
    fallen: tuple[tuple[int, int], ...] | None = None
    """Goal, index into ``episode.goals``, and sub-command of each fall; None in files that do not say."""
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
    touching: NDArray[np.bool_] | None = None
    """True where parts of the robot touch each other in a sample, (T,); None in files that do not say."""

    def summary(self) -> dict[str, Any]:
        """One flat row without the samples."""
        row = {k: v for k, v in asdict(self.episode).items() if k != "goals"}
        row["goals"] = "+".join(self.episode.goals)
        for name in ("success", "falls", "diverged", "overflowed", "restarted", "control_steps", "physics_steps"):
            row[name] = getattr(self, name)
        return row

    def save(self, folder: Path) -> None:
        """Write the record as one file, all or nothing. It survives the death of the process at once, and that of the machine soon."""
        head = {k: v for k, v in vars(self).items() if k in _HEAD} | asdict(self.episode)
        arrays: dict[str, Any] = {name: getattr(self, name) for name in _ARRAYS}
        if self.touching is not None:
            arrays["touching"] = self.touching
        with (
            replacing(folder / f"{self.episode.key}.npz", RecordError, durable=False) as partial,
            partial.open("wb") as file,
        ):
            np.savez(file, head=np.frombuffer(json.dumps(head).encode(), dtype=np.uint8), **arrays)

    @classmethod
    def load(cls, path: Path) -> Record:
        """Read a record; raise ``RecordError`` where the file is damaged."""
        try:
            if not path.is_file():  # a pipe never ends, nor does a link to /dev/zero
                raise RecordError("it is no file")
            with zipfile.ZipFile(path) as archive:
                if sum(entry.file_size for entry in archive.infolist()) > _LARGEST:
                    raise RecordError(f"it unpacks to more than {_LARGEST / 1e6:g} MB")
            with np.load(path, allow_pickle=False) as data:
                head = parse_json(data["head"].tobytes(), "its head", RecordError)
                arrays = {k: data[k] for k in _ARRAYS}
                if "touching" in data:
                    arrays["touching"] = data["touching"]
            if not isinstance(head, dict):
                raise RecordError("its head is no table")
            names = [f.name for f in fields(Episode)]
            episode = build(Episode, {n: head[n] for n in names}, "its head", RecordError)
            if episode.key != path.stem:
                raise RecordError(f"it holds episode {one_line(episode.key)}")
            outcome = {"fallen": head.get("fallen")} | {n: head[n] for n in _HEAD if n != "fallen"}
            rest = build(_Outcome, outcome, "its head", RecordError)
            record = cls(episode=episode, **vars(rest), **arrays)
            record.check_samples()
            return record
        except _READ_ERRORS as error:
            said = one_line(error)
            reason = f"it lacks {said}" if isinstance(error, KeyError) else said or type(error).__name__
            raise RecordError(
                f"episode file {one_line(path)} is damaged ({reason}); delete it and run again with --resume"
            ) from error

    def check_samples(self) -> None:
        """Compare the samples' shapes, types and indices with the rest; raise ``RecordError`` where they do not fit."""
        count = len(self.samples)
        expected: dict[str, tuple[NDArray[Any], Any, tuple[int, ...]]] = {
            "samples": (self.samples, np.float32, (count, len(self.columns) if count else self.samples.shape[-1])),
            "goal_index": (self.goal_index, np.int16, (count,)),
            "part_index": (self.part_index, np.int16, (count,)),
        }
        if self.touching is not None:
            expected["touching"] = (self.touching, np.bool_, (count,))
        for name, (array, kind, shape) in expected.items():
            if array.dtype != kind or array.shape != shape:
                raise RecordError(f"{name} is {array.dtype} {list(array.shape)}, not {np.dtype(kind)} {list(shape)}")
        if count and not (self.goal_index.min() >= 0 and self.goal_index.max() < len(self.episode.goals)):
            raise RecordError("goal_index is out of range")
        if count and self.part_index.min() < 0:
            raise RecordError("part_index is out of range")
        if self.fallen is not None and len(self.fallen) != self.falls:
            raise RecordError(f"fallen has {len(self.fallen)} falls, not {self.falls}")


def read_records(folder: Path) -> tuple[dict[Episode, Record], list[Path]]:
    """All records of a folder of episodes, and where its damaged files are now: set aside under the ending ``.damaged``, so that
    their episodes are played again.

    Raises:
        OSError: a damaged file cannot be renamed.
    """
    records: dict[Episode, Record] = {}
    damaged = []
    for path in sorted(folder.glob("*.npz")):
        try:
            record = Record.load(path)
        except RecordError:
            damaged.append(path.rename(path.with_name(path.name[:200] + ".damaged")))
        else:
            records[record.episode] = record
    return records, damaged


@dataclass(kw_only=True)
class _Outcome:
    """What a file says of an episode beside its samples."""

    success: bool | None
    falls: Count
    fallen: tuple[tuple[Count, Count], ...] | None
    diverged: bool
    overflowed: bool
    restarted: bool
    control_steps: Count
    physics_steps: Count
    columns: Annotated[tuple[Text, ...], Field(max_length=1000)]


_HEAD = [f.name for f in fields(_Outcome)]
_ARRAYS = ("samples", "goal_index", "part_index")
_READ_ERRORS = (
    *(OSError, LookupError, ValueError, TypeError, EOFError, MemoryError, ArithmeticError, RuntimeError, SyntaxError),
    *(zipfile.BadZipFile, zlib.error),
)
"""What numpy and zipfile raise on files that are not theirs."""
