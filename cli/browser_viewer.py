"""Show robots in a browser, through viser: terrain, level, friction, policies and the command are chosen on the page."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from ..backends.base import BackendError
from ..files.parsing import one_line
from ..policy.base import PolicyError
from ..policy.contract import ContractError
from ..policy.finding import find_policy, shipped_policies
from ..robots import RobotError
from ..terrains.gauge_terrains import LEVELS
from ..terrains.registry import TerrainError, gauge_terrain_names
from .browser_access import check_host, is_loopback, own_requests_only
from .browser_stage import Stage, distance_between
from .console import Terminal
from .errors import UserError
from .overlay import summary, table
from .play_session import Command, PlaySession, clip
from .requests import PlayRequest
from .worlds import WorldMaker

_REFRESH = 0.04
"""Time between two poses sent to the browser [s]."""
_TOLD_EVERY = 0.2
"""Time between two readouts of speed and falls [s]."""
_AIMING = 2.0
"""Time for which a new camera is aimed at the robots [s]."""
_LOST = 4.0
"""How far from the robots a camera may look before it is aimed again [m]."""
_FRICTIONS = (0.05, 1.5)
_OF_RUNS = ("best", "latest")
_REFUSALS = (PolicyError, ContractError, RobotError, TerrainError, BackendError, UserError)
"""Errors of a choice; the page shows them and goes on as before."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """The choices on the page that take new worlds."""

    terrain: str
    level: int | None
    policies: tuple[str, ...]
    """From left to right."""


class Panel:
    """Hold menus, sliders and buttons."""

    def __init__(
        self, server: viser.ViserServer, chosen: Choice, sessions: Sequence[PlaySession], command: Command | None
    ) -> None:
        gui = server.gui
        self._server = server
        with gui.add_folder("ground"):
            self._terrains = list(dict.fromkeys([*gauge_terrain_names(), chosen.terrain]))
            self._terrain: Any = gui.add_dropdown("terrain", self._terrains, initial_value=chosen.terrain)
            level = chosen.level or WorldMaker.default_level("stairs_fd") or LEVELS[0]
            self._level: Any = gui.add_slider("level", LEVELS[0], LEVELS[-1], step=1, initial_value=level)
            friction = sessions[0].friction
            self._frictions = least, most = min(_FRICTIONS[0], friction), max(_FRICTIONS[1], friction)
            self._friction: Any = gui.add_slider("friction", least, most, step=0.05, initial_value=friction)
        self._names = _policies(chosen.policies)
        self._policies: list[Any] = []
        self._readings: list[Any] = []
        for number, choice in enumerate(chosen.policies, 1):
            with gui.add_folder("policy" if len(chosen.policies) == 1 else f"policy {number}"):
                self._policies.append(gui.add_dropdown("file", self._names, initial_value=choice))
                self._readings.append(gui.add_markdown(""))
        with gui.add_folder("command"):
            self.auto: Any = gui.add_checkbox("find its own way", initial_value=command is None)
            limits = self._reach = _limits(sessions)
            start = clip(command or (0.0, 0.0, 0.0), limits)
            self._sliders: list[Any] = [
                gui.add_slider(name, min=-limit, max=limit, step=0.05, initial_value=value)
                for name, limit, value in zip(("forward m/s", "left m/s", "turn rad/s"), limits, start, strict=True)
            ]
            stand = gui.add_button("stand")
        self.follow: Any = gui.add_checkbox("camera follows", initial_value=True)
        self.restart = False
        stand.on_click(lambda _: self._stand())
        gui.add_button("back to the start").on_click(lambda _: setattr(self, "restart", True))

    def _stand(self) -> None:
        self.auto.value = False
        for slider in self._sliders:
            slider.value = 0.0

    @property
    def chosen(self) -> Choice:
        """Return the present choice, of the values offered: a client can send anything, the path of another file too."""
        terrain = _offered(self._terrain.value, self._terrains)
        self._level.disabled = terrain == "flat"
        level = None if terrain == "flat" else int(_within(self._level.value, LEVELS[0], LEVELS[-1]))
        policies = tuple(_offered(menu.value, self._names) for menu in self._policies)
        return Choice(terrain=terrain, level=level, policies=policies)

    @property
    def friction(self) -> float:
        """Return the friction coefficient of the ground."""
        return _within(self._friction.value, *self._frictions)

    @property
    def command(self) -> Command | None:
        """Return the command of the sliders, None where the robot finds its own way."""
        if self.auto.value:
            return None
        forward, lateral, yaw = (
            _within(slider.value, -limit, limit) for slider, limit in zip(self._sliders, self._reach, strict=True)
        )
        return forward, lateral, yaw

    def tell(self, sessions: Sequence[PlaySession]) -> None:
        """Write down command, speed and falls of each robot."""
        for reading, session in zip(self._readings, sessions, strict=True):
            readout = session.readout()
            head, *rows = (f"| {' | '.join(cells)} |" for cells in table(readout))
            reading.content = "\n".join((head, "| --- | ---: | ---: | ---: |", *rows, "", summary(readout)))

    def refit(self, sessions: Sequence[PlaySession]) -> None:
        """Set the ends of the sliders to the limits of the policies."""
        self._reach = _limits(sessions)
        for slider, limit in zip(self._sliders, self._reach, strict=True):
            slider.value = max(-limit, min(limit, slider.value))
            slider.min, slider.max = -limit, limit

    def refuse(self, reason: str, chosen: Choice) -> None:
        """Show the reason, and set the menus back to the worlds on the page."""
        for client in self._server.get_clients().values():
            client.add_notification("this cannot be shown", reason, color="red")
        self._terrain.value = chosen.terrain
        if chosen.level is not None:
            self._level.value = chosen.level
        for menu, policy in zip(self._policies, chosen.policies, strict=True):
            menu.value = policy


def _offered(value: object, options: Sequence[str]) -> str:
    """Return a value of a menu; the first one in place of a value that the menu lacks."""
    return value if isinstance(value, str) and value in options else options[0]


def _within(value: Any, low: float, high: float) -> float:
    """Return a value of a slider within its ends; the lower end in place of NaN."""
    number = float(value)
    return min(number, high) if number >= low else low


def _limits(sessions: Sequence[PlaySession]) -> Command:
    """Return the largest command that any of the policies takes; a slider needs some length."""
    forward, lateral, yaw = (max(0.05, *(s.limits[axis] for s in sessions)) for axis in range(3))
    return forward, lateral, yaw


def _policies(chosen: Sequence[str]) -> list[str]:
    """Return the menu of policies: those of the command line, and those that have names."""
    found = list(chosen)
    for name in (*shipped_policies(), *_OF_RUNS):
        with suppress(PolicyError):
            find_policy(name)
            found.append(name)
    return list(dict.fromkeys(found))


class Page:
    """Hold the worlds on the page, side by side."""

    def __init__(self, server: viser.ViserServer, sessions: Sequence[PlaySession]) -> None:
        """Show worlds; the page closes them when others replace them."""
        self._server = server
        self.stages: list[Stage] = []
        self.show(sessions)

    def show(self, sessions: Sequence[PlaySession]) -> None:
        """Replace the worlds."""
        self.close()
        apart = distance_between(sessions[0].terrain)
        for i, session in enumerate(sessions):
            aside = apart * (0.5 * (len(sessions) - 1) - i)  # from left to right, seen along x
            self.stages.append(Stage(self._server, session, f"world_{i}", aside, titled=len(sessions) > 1))

    @property
    def sessions(self) -> list[PlaySession]:
        """Return the sessions of all worlds."""
        return [stage.session for stage in self.stages]

    @property
    def middle(self) -> np.ndarray:
        """Return the mean position of the robots, (3,) [m]."""
        return np.asarray(np.mean([stage.middle for stage in self.stages], axis=0))

    def close(self) -> None:
        """Take the worlds off and free their physics."""
        for stage in self.stages:
            stage.remove()
            stage.session.close()
        self.stages = []


class Cameras:
    """Move the cameras of all clients: each is aimed at the robots at first, and follows them if that is wanted."""

    def __init__(self, server: viser.ViserServer, page: Page) -> None:
        self._server, self._page = server, page
        self._aim_until: dict[int, float] = {}
        self._middle = page.middle

    def new_worlds(self) -> None:
        """Aim all cameras again."""
        self._aim_until.clear()

    def _aim(self, camera: Any) -> None:
        """Aim a camera at the robots, far enough away to see all of them."""
        alone = len(self._page.stages) == 1
        away = np.array([-1.2, -1.8, 0.9]) if alone else self._farther * np.array([-2.0, 0.0, 1.1])
        camera.position, camera.look_at = self._page.middle + away, self._page.middle

    @property
    def _farther(self) -> float:
        """Return the distance from the robots, relative to the distance from a single one."""
        return 1.0 + 0.8 * max(abs(stage.aside) for stage in self._page.stages)

    def follow(self, wanted: bool) -> None:
        """Move the cameras with the robots, where that is wanted."""
        middle, now = self._page.middle, time.monotonic()
        moved, self._middle = middle - self._middle, middle
        self._aim(self._server.initial_camera)  # for new browsers and for "reset view"
        for number, client in self._server.get_clients().items():
            # A new browser overwrites the first camera that it is sent with its initial one.
            until = self._aim_until.setdefault(number, now + _AIMING)
            camera = client.camera
            if now < until:
                self._aim(camera)
            elif wanted:
                if np.linalg.norm(camera.look_at - middle) > _LOST * self._farther:
                    self._aim_until[number] = now + _AIMING
                camera.position = camera.position + moved  # viser moves the point that it looks at too


def serve(sessions: Sequence[PlaySession], maker: WorldMaker, chosen: Choice, asked: PlayRequest) -> None:
    """Serve the page until Ctrl-C or until ``asked.seconds`` of simulated time are over.

    Args:
        asked: gives host, port, time and the robots' first command; without one they walk to the target, or on a tour.

    Raises:
        UserError: the port is taken, or the host is not an interface of this machine.
    """
    host, port = asked.host, asked.port
    try:
        check_host(host)
        with own_requests_only(host):
            server = viser.ViserServer(host=host, port=port, verbose=False)
    except OSError as error:
        for session in sessions:
            session.close()
        reason = error.strerror or error
        raise UserError(
            f"port {port} of '{one_line(host)}' cannot be used: {reason}; choose another --port or --host"
        ) from error
    server.scene.set_up_direction("+z")
    server.scene.add_grid("/floor", width=40.0, height=40.0, cell_size=1.0, section_size=5.0)
    panel, page = Panel(server, chosen, sessions, asked.command), Page(server, sessions)
    console = Terminal()
    shown = "localhost" if host == "127.0.0.1" else f"[{host}]" if ":" in host else host
    console.say(f"open http://{shown}:{server.get_port()} in a browser; Ctrl-C ends")
    if not is_loopback(host):
        console.say(f"everybody who reaches {host} can steer this robot; leave --host out to serve this machine alone")
    try:
        _run(server, panel, page, maker, chosen, asked.seconds)
    finally:
        page.close()
        server.stop()


def _run(
    server: viser.ViserServer, panel: Panel, page: Page, maker: WorldMaker, shown: Choice, seconds: float | None
) -> None:
    """Play the choices of the panel in real time."""
    time_played, told = 0.0, -_TOLD_EVERY
    due, cameras = time.monotonic(), Cameras(server, page)
    while seconds is None or time_played < seconds - 1e-9:
        chosen = panel.chosen
        if chosen != shown:
            try:
                page.show(maker.make_all(chosen.policies, chosen.terrain, chosen.level, panel.friction))
            except _REFUSALS as error:
                panel.refuse(str(error), shown)
            else:
                shown = chosen
                panel.refit(page.sessions)
                cameras.new_worlds()
        for session in page.sessions:
            if session.friction != panel.friction:
                session.set_friction(panel.friction)
            if panel.restart:
                session.reset()
        panel.restart = False
        time_played += _REFRESH
        for session in page.sessions:
            until = session.time + _REFRESH - 1e-9
            while session.time < until:
                session.step(panel.command or session.autopilot())
        with server.atomic():
            for stage in page.stages:
                stage.move()
        if time_played - told >= _TOLD_EVERY:
            told = time_played
            panel.tell(page.sessions)
        cameras.follow(panel.follow.value)
        due = max(due + _REFRESH, time.monotonic() - _REFRESH)
        time.sleep(max(0.0, due - time.monotonic()))
