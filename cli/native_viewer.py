"""MuJoCo's own viewer, steered with the keyboard."""

from __future__ import annotations

import time

import mujoco
import mujoco.viewer

from .console import Terminal
from .errors import UserError
from .gamepad import Gamepad
from .overlay import summary, table
from .picture import show
from .play_session import Command, PlaySession, Readout, clip
from .scenery import COLLISION_GROUP, visual_model

# GLFW's numbers of keys that the viewer does not use itself.
_UP, _DOWN, _LEFT, _RIGHT = 265, 264, 263, 262
_HOME, _END, _ENTER, _INSERT, _DELETE = 268, 269, 257, 260, 261
KEYS = (
    "up/down: faster forward/backward; left/right: turn; home/end: step to the left/right; enter: stand; "
    "delete: to the target or on tour; insert: back to the start"
)
_FORWARD_STEP, _LATERAL_STEP, _YAW_STEP = 0.1, 0.1, 0.25
"""What one press adds to a command [m/s, m/s, rad/s]."""


class Keyboard:
    """What the keys have asked for: None while the robot finds its own way."""

    def __init__(self, limits: Command, command: Command | None) -> None:
        self.command = command
        self.restart = False
        self._limits = limits

    def press(self, key: int) -> None:
        """Take a key by its GLFW number; others than ``KEYS`` mean nothing."""
        steps = {
            _UP: (_FORWARD_STEP, 0.0, 0.0),
            _DOWN: (-_FORWARD_STEP, 0.0, 0.0),
            _LEFT: (0.0, 0.0, _YAW_STEP),
            _RIGHT: (0.0, 0.0, -_YAW_STEP),
            _HOME: (0.0, _LATERAL_STEP, 0.0),
            _END: (0.0, -_LATERAL_STEP, 0.0),
        }
        if key == _INSERT:
            self.restart = True
        elif key == _DELETE:
            self.command = None
        elif key == _ENTER:
            self.command = (0.0, 0.0, 0.0)
        elif key in steps:
            now = self.command or (0.0, 0.0, 0.0)
            forward, lateral, yaw = (round(value + change, 3) for value, change in zip(now, steps[key], strict=True))
            self.command = clip((forward, lateral, yaw), self._limits)


def texts(readout: Readout) -> tuple[str, str]:
    """What stands in the window's corner, names and values; the window's font has no more than ASCII."""
    head, *rows = table(readout)
    lines = [
        (name, "  ".join(f"{value} {of}" for value, of in zip(values, head[1:], strict=True))) for name, *values in rows
    ]
    lines += [(readout.label, readout.place), ("", summary(readout).replace("  ·  ", ", "))]
    return "\n".join(name for name, _ in lines), "\n".join(text for _, text in lines)


def watch(session: PlaySession, command: Command | None, seconds: float | None, gamepad: Gamepad | None = None) -> None:
    """Open the window; returns when it is closed or the time is over. Keys and gamepad steer, the last to act wins.

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
