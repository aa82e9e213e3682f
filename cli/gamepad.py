"""A gamepad as the source of commands: left stick forward and sideways, right stick turning. Needs the extra ``gamepad``."""

from __future__ import annotations

import os
from typing import Any

from .errors import UserError
from .play_session import Command

_REST = 0.12
"""Share of a stick's way about its middle that counts as rest."""
_FULL = 32767.0
"""What SDL gives for a stick at its end."""


class Gamepad:
    """The first gamepad, as SDL maps it whatever its make."""

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
        self._last: Command = (0.0, 0.0, 0.0)

    def moved(self) -> Command | None:
        """The command of the sticks if it is another than at the last call, else None: keys act until a stick moves."""
        self._pygame.event.pump()
        sticks = (
            self._pygame.CONTROLLER_AXIS_LEFTY,
            self._pygame.CONTROLLER_AXIS_LEFTX,
            self._pygame.CONTROLLER_AXIS_RIGHTX,
        )
        # SDL's axes point down and to the right, the robot's forward, to the left and to the left.
        forward, lateral, yaw = (
            -_without_rest(self._pad.get_axis(stick) / _FULL) * limit
            for stick, limit in zip(sticks, self._limits, strict=True)
        )
        command = (forward, lateral, yaw)
        if command == self._last:
            return None
        self._last = command
        return command

    def close(self) -> None:
        """Give the gamepad back."""
        self._pygame.quit()


def _without_rest(value: float) -> float:
    """A stick's place from −1 to 1 with the middle cut out, so that a worn stick stands still; 0 and 1 stay."""
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
