"""Draw the pictures of a film: in this process on a GPU, in several processes on the CPU, since pictures are independent."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Generator, Iterable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from ..files.choices import cores
from .errors import UserError
from .picture import PLAIN, Picture, Quality, Tile

Note = TypeVar("Note")
Poses = Sequence[tuple[np.ndarray, np.ndarray]]

_MOST = 4
"""Largest number of processes."""
_WORTH = 50
"""Pictures that are worth another process."""
_AHEAD = 3
"""Pictures that are asked for ahead of time, for each process."""


@dataclass(frozen=True, kw_only=True)
class Shot(Generic[Note]):
    """Describe one picture that is to be drawn."""

    poses: Poses
    """Pose (7 + J,) of each robot, and the point (3,) at which its camera looks."""
    note: Note
    """Returned with the picture."""


def processes_for(pictures: int, quality: Quality) -> int:
    """Return the number of processes that draw; 0: this one."""
    wanted = min(_MOST, cores(), pictures // _WORTH)
    return wanted if quality is PLAIN and wanted > 1 else 0


def draw(
    tiles: Sequence[Tile], size: tuple[int, int], shots: Iterable[Shot[Note]], processes: int
) -> Generator[tuple[np.ndarray, Note], None, None]:
    """Draw shots in their order.

    Args:
        tiles: the robots, from left to right.
        size: width and height of each tile [pixels].

    Yields:
        (height, width of all tiles, 3) uint8, and the shot's note.

    Raises:
        UserError: a process that draws was ended from outside.
    """
    if not processes:
        with ExitStack() as stack:
            pictures = [stack.enter_context(closing(Picture(tile, size=size))) for tile in tiles]
            for shot in shots:
                yield _draw_all(pictures, shot.poses), shot.note
        return
    os.environ.setdefault("LP_NUM_THREADS", "0")  # Mesa's threads would only be in the way of the other processes
    pool = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), _begin, (tiles, size))
    waiting: deque[tuple[Future[np.ndarray], Note]] = deque()
    try:
        for shot in shots:
            waiting.append((pool.submit(_draw, shot.poses), shot.note))
            if len(waiting) > _AHEAD * processes:
                future, note = waiting.popleft()
                yield future.result(), note
        for future, note in waiting:
            yield future.result(), note
    except BrokenProcessPool as error:
        raise UserError("a drawing process ended, perhaps for want of memory; ask for a shorter video") from error
    finally:
        pool.shutdown(cancel_futures=True)


def _draw_all(pictures: Sequence[Picture], poses: Poses) -> np.ndarray:
    drawn = [picture.draw(*pose) for picture, pose in zip(pictures, poses, strict=True)]
    return drawn[0] if len(drawn) == 1 else np.concatenate(drawn, axis=1)


_pictures: list[Picture] = []
"""Filled in a process that only draws."""


def _begin(tiles: Sequence[Tile], size: tuple[int, int]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent process handles Ctrl-C
    _pictures[:] = [Picture(tile, size=size) for tile in tiles]


def _draw(poses: Poses) -> np.ndarray:
    return _draw_all(_pictures, poses)
