"""Show a robot in MuJoCo's own viewer, steered with the keyboard or a gamepad."""

from __future__ import annotations

import os
import time
from typing import Any

import mujoco
import mujoco.viewer

from .console import Terminal
from .errors import UserError
from .overlay import summary, table
from .picture import show
from .play_session import Command, PlaySession, Readout, clip
from .scenery import COLLISION_GROUP, visual_model

# GLFW's numbers of keys that the viewer does not use itself.
_UP, _DOWN, _LEFT, _RIGHT, _HOME, _END = 265, 264, 263, 262, 268, 269
_ENTER, _INSERT, _DELETE = 257, 260, 261
KEYS = (
    "up/down: faster forward/backward; left/right: turn; home/end: step to the left/right; enter: stand; "
    "delete: to the target or on tour; insert: back to the start"
)
_STEPS: dict[int, Command] = {
    _UP: (0.1, 0.0, 0.0),
    _DOWN: (-0.1, 0.0, 0.0),
    _LEFT: (0.0, 0.0, 0.25),
    _RIGHT: (0.0, 0.0, -0.25),
    _HOME: (0.0, 0.1, 0.0),
    _END: (0.0, -0.1, 0.0),
}
"""Change of the command by one press of a key [m/s, m/s, rad/s]."""
_STAND: Command = (0.0, 0.0, 0.0)
_REST = 0.12
"""Share of a stick's way about its middle that counts as rest."""
_FULL = 32767.0
"""SDL's value of a stick at its end."""


class Keyboard:
    """Turn keys into commands; ``command`` is None while the robot finds its own way."""

    def __init__(self, limits: Command, command: Command | None) -> None:
        self.command = command
        self.restart = False
        self._limits = limits

    def press(self, key: int) -> None:
        """Take a key by its GLFW number; others than ``KEYS`` mean nothing."""
        if key == _INSERT:
            self.restart = True
        elif key == _DELETE:
            self.command = None
        elif key == _ENTER:
            self.command = _STAND
        elif key in _STEPS:
            now = self.command or _STAND
            forward, lateral, yaw = (round(value + change, 3) for value, change in zip(now, _STEPS[key], strict=True))
            self.command = clip((forward, lateral, yaw), self._limits)


class Gamepad:
    """Turn the sticks of the first gamepad into commands: left stick forward and sideways, right stick turning.

    SDL maps gamepads of any make. Needs the extra ``gamepad``.
    """

    def __init__(self, limits: Command, driver: Any = None) -> None:
        """Open it.

        Args:
            limits: commands with the sticks at their ends.
            driver: stands in for pygame.

        Raises:
            UserError: the extra is not installed, or there is no gamepad.
        """
        self._pygame = driver if driver is not None else _pygame()
        controllers = self._pygame._sdl2.controller
        self._pygame.display.init()  # SDL reports events with a display only, even if it is a dummy
        controllers.init()
        known = [i for i in range(controllers.get_count()) if controllers.is_controller(i)]
        if not known:
            self.close()
            raise UserError("there is no gamepad; connect one, or leave --gamepad out")
        self._pad = controllers.Controller(known[0])
        self._limits = limits
        self._last = _STAND

    def moved(self) -> Command | None:
        """Return the command of the sticks if it has changed since the last call, else None: keys act until a stick moves."""
        sdl = self._pygame
        sdl.event.pump()
        sticks = (sdl.CONTROLLER_AXIS_LEFTY, sdl.CONTROLLER_AXIS_LEFTX, sdl.CONTROLLER_AXIS_RIGHTX)
        # SDL's axes point down and to the right, the robot's forward, to the left and to the left.
        forward, lateral, yaw = (
            -_without_rest(self._pad.get_axis(stick) / _FULL) * limit
            for stick, limit in zip(sticks, self._limits, strict=True)
        )
        last, self._last = self._last, (forward, lateral, yaw)
        return None if self._last == last else self._last

    def close(self) -> None:
        """Give the gamepad back."""
        self._pygame.quit()


def _without_rest(value: float) -> float:
    """Return a stick's place from −1 to 1 with the middle cut out, so that a worn stick stands still; 0 and 1 stay."""
    size = min(abs(value), 1.0)
    if size <= _REST:
        return 0.0
    return (size - _REST) / (1.0 - _REST) * (1.0 if value > 0.0 else -1.0)


def _pygame() -> Any:
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # the window is MuJoCo's
    os.environ.setdefault("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
    try:
        import pygame
        import pygame._sdl2.controller
    except ImportError as error:
        raise UserError("--gamepad needs pygame; install it with: pip install 'gaitgauge[gamepad]'") from error
    return pygame


def texts(readout: Readout) -> tuple[str, str]:
    """Return the texts of the window's corner, names and values; the window's font has no more than ASCII."""
    head, *rows = table(readout)
    lines = [
        (name, "  ".join(f"{value} {of}" for value, of in zip(values, head[1:], strict=True))) for name, *values in rows
    ]
    lines += [(readout.label, readout.place), ("", summary(readout).replace("  ·  ", ", "))]
    return "\n".join(name for name, _ in lines), "\n".join(text for _, text in lines)


def watch(session: PlaySession, command: Command | None, seconds: float | None, gamepad: Gamepad | None = None) -> None:
    """Open the window, and return when it is closed or the time is over. Keys and gamepad steer; the last to act wins.

    Raises:
        UserError: the window cannot be opened.
    """
    keyboard = Keyboard(session.limits, command)
    model = visual_model(session.robot, session.terrain)
    data = mujoco.MjData(model)
    show(model, data, session.position())
    try:
        viewer = mujoco.viewer.launch_passive(
            model, data, key_callback=keyboard.press, show_left_ui=False, show_right_ui=False
        )
    except (RuntimeError, mujoco.FatalError) as error:
        raise UserError(f"the window cannot be opened: {error}; use --viewer viser, or --out FILE.mp4") from error
    Terminal().say(KEYS)
    with viewer:
        viewer.opt.geomgroup[COLLISION_GROUP] = 0
        viewer.cam.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        viewer.cam.trackbodyid = model.body(session.robot.base_body).id
        viewer.cam.distance, viewer.cam.elevation, viewer.cam.azimuth = 2.2, -18.0, 55.0
        due = time.monotonic()
        while viewer.is_running() and (seconds is None or session.time < seconds):
            if keyboard.restart:
                keyboard.restart = False
                session.reset()
            if gamepad is not None and (asked := gamepad.moved()) is not None:
                keyboard.command = asked
            session.step(keyboard.command or session.autopilot())
            with viewer.lock():
                show(model, data, session.position())
            viewer.set_texts((None, mujoco.mjtGridPos.mjGRID_BOTTOMLEFT, *texts(session.readout())))
            viewer.sync()
            due = max(due + session.period, time.monotonic() - session.period)
            time.sleep(max(0.0, due - time.monotonic()))
