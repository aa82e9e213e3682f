"""Watch policies walk in a window, in a browser or in a video file (``gaitgauge play``)."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from .console import Terminal
from .errors import UserError
from .picture import WITH_MJPYTHON, choose_renderer, window_possible
from .progress import ProgressDisplay
from .requests import VIEWERS, PlayRequest
from .video import CLIP_ENDINGS, VIDEO_ENDINGS, check_film_path

if TYPE_CHECKING:
    from .play_session import PlaySession

MOST = 4
"""Policies side by side."""
_FASTEST = 100.0
"""Largest speed of ``--command`` [m/s, rad/s]."""
_SHORTEST, _LONGEST = 0.1, 3600.0
_LONGEST_CLIP = 60.0
"""The encoder of a GIF keeps all its pictures in memory [s]."""
_VIDEO_SECONDS = 10.0
"""Length of a video by default [s]."""


def run_play(asked: PlayRequest) -> None:
    """Load, build, and hand over to the viewer.

    Raises:
        UserError: an option that makes no sense, or a viewer that this machine has no display for.
        PolicyError, ContractError, TerrainError, BackendError: one sentence on what is wrong.
    """
    viewer = _check(asked)
    quality = choose_renderer() if viewer == "video" else None  # before MuJoCo is imported
    from ..policy.finding import shipped_policies
    from .play_session import beyond
    from .worlds import WorldMaker

    console, maker = Terminal(), WorldMaker(asked)
    level = maker.default_level(asked.terrain) if asked.level is None else asked.level
    sessions = maker.make_all(asked.policies, asked.terrain, level, asked.friction)
    for named, session in zip(asked.policies, sessions, strict=True):
        shown = named if named in shipped_policies() else session.policy.path
        console.say(f"{shown} on {session.readout().place}, {asked.backend}, friction {asked.friction:g}")
        if asked.command and (sentence := beyond(asked.command, session.limits)):
            console.say(f"{session.label}: {sentence}" if len(sessions) > 1 else sentence)
    if viewer == "viser":
        from .browser_viewer import Choice, serve

        serve(sessions, maker, Choice(terrain=asked.terrain, level=level, policies=asked.policies), asked)
        return
    with ExitStack() as stack:
        for session in sessions:
            stack.callback(session.close)
        if quality is not None:
            from .recording import Recording, record

            seconds = asked.seconds or _VIDEO_SECONDS
            video = asked.out or (None if asked.gif else Path("play.mp4"))
            wanted = Recording(sessions=sessions, seconds=seconds, command=asked.command, video=video, clip=asked.gif)
            with ProgressDisplay(console, "recording") as display:
                record(wanted, quality, lambda share: display.update(share, f"{share * seconds:.1f} of {seconds:g} s"))
            for path in filter(None, (video, asked.gif)):
                console.say(f"wrote {path}, {seconds:g} s{_events(sessions)}")
        else:
            from .native_viewer import Gamepad, watch

            pad = Gamepad(sessions[0].limits) if asked.gamepad else None
            if pad is not None:
                stack.callback(pad.close)
            watch(sessions[0], asked.command, asked.seconds, pad)


def _events(sessions: Sequence[PlaySession]) -> str:
    """Return how often robots fell and arrived, where any did."""
    counts = ((sum(s.falls for s in sessions), "falls"), (sum(s.arrivals for s in sessions), "times at the target"))
    return "".join(f", {count} {event}" for count, event in counts if count)


def _check(asked: PlayRequest) -> str:
    """Return the viewer that is asked for, or the best that this machine has. Raises UserError: options that make no sense."""
    from ..gauge.pipelines import check_friction

    films = {"--out": (asked.out, VIDEO_ENDINGS), "--gif": (asked.gif, CLIP_ENDINGS)}
    named = [option for option, (path, _) in films.items() if path is not None]
    viewer = _viewer(asked.viewer, named, several=len(asked.policies) > 1)
    longest = _LONGEST_CLIP if asked.gif else _LONGEST
    if asked.seconds is not None and not _SHORTEST <= asked.seconds <= longest:
        raise UserError(f"--seconds is {asked.seconds:g}; give {_SHORTEST:g} to {longest:g} seconds")
    if asked.gamepad and viewer != "native":
        hint = "add --viewer native, or leave it out"
        raise UserError(f"--gamepad steers the window and the viewer is '{viewer}'; {hint}")
    check_friction(asked.friction)
    if asked.command and not all(abs(speed) <= _FASTEST for speed in asked.command):
        given = " ".join(f"{speed:g}" for speed in asked.command)
        raise UserError(f"--command is {given}; give speeds from -{_FASTEST:g} to {_FASTEST:g}")
    if len(asked.policies) > MOST:
        raise UserError(f"{len(asked.policies)} policies are given; at most {MOST} are shown side by side")
    for option, (path, endings) in films.items():
        if path is not None:
            check_film_path(path, option, endings)
    return viewer


def _viewer(asked: str | None, films: Sequence[str], *, several: bool) -> str:
    if asked is not None and asked not in VIEWERS:
        raise UserError(f"there is no viewer '{asked}'; choose one of: {', '.join(VIEWERS)} (--viewer)")
    if films:
        if asked not in (None, "video"):
            raise UserError(f"{films[0]} writes a video and --viewer {asked} opens a viewer; give one of them")
        return "video"
    if asked == "native" and several:
        raise UserError("the window shows one policy; for several use --viewer viser for a browser, or --out FILE.mp4")
    if asked == "native" and not window_possible():
        raise UserError(f"on macOS the window needs mjpython; {WITH_MJPYTHON}, or use --viewer viser for a browser")
    display = sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if asked == "native" and not display:
        raise UserError("there is no display for a window; use --viewer viser for a browser, or --out FILE.mp4")
    return asked or ("native" if display and window_possible() and not several else "viser")
