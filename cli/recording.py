"""Videos and clips of one robot, or of several side by side, from the same pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from .overlay import annotate
from .picture import Picture, Quality
from .play_session import Command, PlaySession
from .scenery import visual_model
from .video import Film

FRAME_TIME = 0.04
"""Time between two pictures [s]."""
CLIP_SIZE, CLIP_TILE = (480, 270), (320, 240)
"""Width and height of the pictures of a GIF or WebP file: of one robot, and of each of several [pixels]."""
_CLIP_EVERY = 2
"""Pictures that are drawn for each one of a clip."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """What is to be filmed."""

    sessions: Sequence[PlaySession]
    """The robots, from left to right."""
    seconds: float
    """Length in simulated time [s]."""
    command: Command | None = None
    """What all of them are told; None: to the target, or a tour."""
    video: Path | None = None
    """An MP4 file."""
    clip: Path | None = None
    """A GIF or WebP file: smaller, with half the pictures."""


def record(wanted: Recording, quality: Quality, progress: Callable[[float], None] = lambda share: None) -> None:
    """Play and film.

    Args:
        wanted: what.
        quality: what ``choose_renderer`` says.
        progress: is told the share that is done.

    Raises:
        UserError: a file cannot be written.
    """
    sessions = wanted.sessions
    several = len(sessions) > 1
    tile = quality.tile if several else quality.size
    frames = max(1, round(wanted.seconds / FRAME_TIME))
    with ExitStack() as stack:
        pictures = [_picture(session, quality, tile) for session in sessions]
        for picture in pictures:
            stack.callback(picture.close)
        width = tile[0] * len(sessions)
        video = wanted.video and stack.enter_context(Film(wanted.video, fps=1.0 / FRAME_TIME, size=(width, tile[1])))
        small = CLIP_TILE if several else CLIP_SIZE
        small = (small[0] * len(sessions), small[1])
        slower = 1.0 / (FRAME_TIME * _CLIP_EVERY)
        clip = wanted.clip and stack.enter_context(Film(wanted.clip, fps=slower, size=small))
        drawn_at = -FRAME_TIME
        for frame in range(frames):
            for session in sessions:
                while session.time < (frame + 1) * FRAME_TIME - 1e-9:  # policies may have periods of their own
                    session.step(wanted.command or session.autopilot())
            in_clip = clip and frame % _CLIP_EVERY == 0
            if video or in_clip:
                since, drawn_at = frame * FRAME_TIME - drawn_at, frame * FRAME_TIME
                tiles = [p.draw(s.position(), since) for p, s in zip(pictures, sessions, strict=True)]
                drawn = np.concatenate(tiles, axis=1)
                readouts = [s.readout() for s in sessions]
                if video:
                    video.add(annotate(drawn, readouts))
                if clip and in_clip:
                    reduced = Image.fromarray(drawn).resize(small, Image.Resampling.BOX)
                    clip.add(annotate(np.asarray(reduced), readouts))
            progress((frame + 1) / frames)


def _picture(session: PlaySession, quality: Quality, tile: tuple[int, int]) -> Picture:
    model = visual_model(session.robot, session.terrain, quality)
    return Picture(model, size=tile, heading=session.terrain.spawns["level_search"].yaw)
