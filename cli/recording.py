"""Film one robot, or several side by side: video and clip are made from the same pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from ..robots.anatomy.body_plan import body_plan
from .drawing import Shot, draw, processes_for
from .overlay import annotate
from .picture import Follower, Quality, Tile
from .play_session import Command, PlaySession, Readout
from .scenery import visual_model
from .video import film

FRAME_TIME = 0.04
"""Time between two pictures [s]."""
CLIP_SIZE, CLIP_TILE = (480, 270), (320, 240)
"""Width and height of pictures in a GIF or WebP file, of one robot and of each of several [pixels]."""
_CLIP_EVERY = 2
"""Frames of a video for each frame of a clip."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Describe a film."""

    sessions: Sequence[PlaySession]
    """The robots, from left to right."""
    seconds: float
    """Length in simulated time [s]."""
    command: Command | None = None
    """Command of all robots; None: to the target, or a tour."""
    video: Path | None = None
    """An MP4 file."""
    clip: Path | None = None
    """A GIF or WebP file: smaller, with half the pictures."""


def record(wanted: Recording, quality: Quality, progress: Callable[[float], None] = lambda share: None) -> None:
    """Play and film.

    Raises:
        UserError: a file cannot be written.
    """
    sessions = wanted.sessions
    several = len(sessions) > 1
    tile = quality.tile if several else quality.size
    small = CLIP_TILE if several else CLIP_SIZE
    size, small = (tile[0] * len(sessions), tile[1]), (small[0] * len(sessions), small[1])
    frames = max(1, round(wanted.seconds / FRAME_TIME))
    every = 1 if wanted.video else _CLIP_EVERY
    tiles = [
        Tile(
            model=visual_model(session.robot, session.terrain, quality),
            heading=session.terrain.spawns["level_search"].yaw,
            leg_length=body_plan(session.robot).leg_length,
            ground_shadows=quality.ground_shadows,
        )
        for session in sessions
    ]
    with ExitStack() as stack:
        video = wanted.video and stack.enter_context(film(wanted.video, fps=1.0 / FRAME_TIME, size=size))
        slower = 1.0 / (FRAME_TIME * _CLIP_EVERY)
        clip = wanted.clip and stack.enter_context(film(wanted.clip, fps=slower, size=small))
        processes = processes_for(frames // every * len(sessions), quality)
        drawn = draw(tiles, tile, _shots(sessions, frames, every, wanted.command), processes)
        for picture, (frame, readouts) in stack.enter_context(closing(drawn)):
            if video:
                video(annotate(picture, readouts))
            if clip and frame % _CLIP_EVERY == 0:
                reduced = Image.fromarray(picture).resize(small, Image.Resampling.BOX)
                clip(annotate(np.asarray(reduced), readouts))
            progress((frame + 1) / frames)


def _shots(
    sessions: Sequence[PlaySession], frames: int, every: int, command: Command | None
) -> Iterator[Shot[tuple[int, list[Readout]]]]:
    """Play, and yield what is to be drawn, every so many frames."""
    followers = [Follower() for _ in sessions]
    for frame in range(frames):
        for session in sessions:
            while session.time < (frame + 1) * FRAME_TIME - 1e-9:  # policies may have periods of their own
                session.step(command or session.autopilot())
        if frame % every == 0:
            positions = [session.position() for session in sessions]
            poses = [(p, each.follow(p, FRAME_TIME * every)) for p, each in zip(positions, followers, strict=True)]
            yield Shot(poses=poses, note=(frame, [session.readout() for session in sessions]))
