"""``gaitgauge play``: watch a policy walk, in a window, in a browser or in a video file."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from .console import Terminal
from .errors import UserError
from .progress import ProgressDisplay
from .video import check_video_path, choose_renderer

if TYPE_CHECKING:
    from .play_session import PlaySession

VIEWERS = ("native", "viser", "video")
_WIDTH, _HEIGHT = 1280, 720
_SHORTEST, _LONGEST = 0.1, 3600.0
_FRAME_TIME = 0.04
"""Time between two pictures of a video [s]; drawing without a GPU takes about half a second each."""
_VIDEO_SECONDS = 10.0
"""Length of a video where none is asked for [s]."""


def run_play(
    choice: str,
    *,
    terrain: str,
    level: int | None,
    backend: str,
    device: str | None,
    viewer: str | None,
    out: Path | None,
    seconds: float | None,
    command: tuple[float, float, float] | None,
    friction: float,
    seed: int,
    port: int,
    host: str = "127.0.0.1",
    gamepad: bool = False,
    trust: bool = False,
) -> None:
    """Load, build, and hand over to the viewer.

    Raises:
        UserError: an option that makes no sense, or a viewer that this machine has no display for.
        PolicyError, ContractError, TerrainError, BackendError: one sentence on what is wrong.
    """
    chosen = _viewer(viewer, out)
    if seconds is not None and not _SHORTEST <= seconds <= _LONGEST:
        raise UserError(f"--seconds is {seconds:g}; give {_SHORTEST:g} to {_LONGEST:g} seconds")
    if gamepad and chosen != "native":
        raise UserError(
            f"--gamepad steers the window and the viewer is '{chosen}'; add --viewer native, or leave it out"
        )
    if not 0.0 < friction <= 10.0:
        raise UserError(f"--friction is {friction:g}; give a coefficient above 0 and at most 10")
    video = out or Path("play.mp4")
    if chosen == "video":
        check_video_path(video)
        choose_renderer()  # before MuJoCo is imported
    from ..backends.registry import choose_device
    from ..gauge.suite import load_suite
    from ..policy.loading import load_policy
    from ..robots import load_robot
    from ..terrains.gauge_terrains import LEVELS
    from ..terrains.registry import gauge_terrain_names, make_terrain
    from .play_session import PlaySession, PlaySettings
    from .policies import policy_file

    if level is None and terrain != "flat" and terrain in gauge_terrain_names():
        level = LEVELS[len(LEVELS) // 2 - 1]
    ground = make_terrain(terrain, level)
    path = policy_file(choice)
    policy = load_policy(path, trust=trust)
    robot = load_robot(policy.contract.robot)
    settings = PlaySettings(
        backend=backend,
        device=choose_device(backend, device),
        friction=friction,
        seed=seed,
        suite=load_suite("gaitgauge-1"),
    )
    session = PlaySession(policy, robot, ground, settings)
    where = terrain if not ground.level else f"{terrain} level {ground.level}"
    Terminal().say(f"{path} on {where}, {backend}, friction {friction:g}")
    try:
        if chosen == "video":
            _record(session, video, seconds or _VIDEO_SECONDS, command)
        elif chosen == "native":
            from .gamepad import Gamepad
            from .native_viewer import watch

            pad = Gamepad(session.limits) if gamepad else None
            try:
                watch(session, command, seconds, pad)
            finally:
                if pad is not None:
                    pad.close()
        else:
            from .browser_viewer import serve

            serve(session, command, seconds, port, host)
    finally:
        session.close()


def _viewer(asked: str | None, out: Path | None) -> str:
    """The viewer that is asked for, or the best that this machine has."""
    if asked is not None and asked not in VIEWERS:
        raise UserError(f"there is no viewer '{asked}'; choose one of: {', '.join(VIEWERS)} (--viewer)")
    if out is not None:
        if asked not in (None, "video"):
            raise UserError(f"--out writes a video and --viewer {asked} opens a viewer; give one of them")
        return "video"
    display = sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if asked == "native" and not display:
        raise UserError("there is no display for a window; use --viewer viser for a browser, or --out FILE.mp4")
    return asked or ("native" if display else "viser")


def _record(session: PlaySession, out: Path, seconds: float, command: tuple[float, float, float] | None) -> None:
    """Write a video of so much simulated time."""
    from .scenery import visual_model
    from .video import Picture, Video

    model = visual_model(session.robot, session.terrain, width=_WIDTH, height=_HEIGHT)
    heading = session.terrain.spawns["level_search"].yaw
    picture = Picture(model, width=_WIDTH, height=_HEIGHT, heading=heading)
    steps = max(1, round(_FRAME_TIME / session.period))
    between = steps * session.period
    frames = max(1, round(seconds / between))
    console = Terminal()
    try:
        with (
            Video(out, fps=1.0 / between, width=_WIDTH, height=_HEIGHT) as video,
            ProgressDisplay(console, "recording") as display,
        ):
            for frame in range(frames):
                for _ in range(steps):
                    session.step(command or session.autopilot())
                video.add(picture.draw(session.position(), between))
                display.update((frame + 1) / frames, f"{(frame + 1) * between:.1f} of {seconds:g} s")
    finally:
        picture.close()
    told = [f"{n} {what}" for n, what in ((session.falls, "falls"), (session.arrivals, "times at the target")) if n]
    console.say(f"wrote {out}, {seconds:g} s" + (f", {', '.join(told)}" if told else ""))
