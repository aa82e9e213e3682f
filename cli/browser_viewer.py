"""The same in a browser, through viser: the robot's geoms as meshes, sliders for the command."""

from __future__ import annotations

import ipaddress
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

import mujoco
import numpy as np
import trimesh
import viser
import websockets.asyncio.server

from .console import Terminal
from .errors import UserError
from .play_session import Command, PlaySession
from .scenery import COLLISION_GROUP, show, visual_model

_REFRESH = 0.04
"""Time between two poses sent to the browser [s]."""


def geom_mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh | None:
    """The surface of a geom in its own frame, None for a plane or a shape that cannot be drawn here."""
    size = model.geom_size[geom]
    kind = mujoco.mjtGeom(model.geom_type[geom])
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return trimesh.creation.box(extents=2.0 * size)
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return trimesh.creation.icosphere(subdivisions=2, radius=size[0])
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        ball = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
        ball.apply_scale(size)
        return ball
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(radius=size[0], height=2.0 * size[1], sections=32)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return trimesh.creation.capsule(radius=size[0], height=2.0 * size[1], count=[16, 16])
    if kind == mujoco.mjtGeom.mjGEOM_HFIELD:
        return _field_mesh(model, int(model.geom_dataid[geom]))
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        corners = slice(model.mesh_vertadr[mesh], model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh])
        faces = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
        return trimesh.Trimesh(model.mesh_vert[corners], model.mesh_face[faces])
    return None


def _field_mesh(model: mujoco.MjModel, field: int) -> trimesh.Trimesh:
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    half_x, half_y, top, _ = model.hfield_size[field]
    start = int(model.hfield_adr[field])
    heights = model.hfield_data[start : start + rows * columns].reshape(rows, columns) * top
    x, y = np.meshgrid(np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows))
    node = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = node[:-1, :-1].ravel(), node[:-1, 1:].ravel(), node[1:, 1:].ravel(), node[1:, :-1].ravel()
    faces = np.concatenate((np.stack((a, b, c), axis=1), np.stack((a, c, d), axis=1)))
    return trimesh.Trimesh(np.stack((x, y, heights), axis=2).reshape(-1, 3), faces, process=False)


def geom_color(model: mujoco.MjModel, geom: int) -> tuple[int, int, int]:
    """Red, green and blue of a geom, 0 to 255."""
    material = int(model.geom_matid[geom])
    rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
    red, green, blue = (round(255 * float(v)) for v in rgba[:3])
    return red, green, blue


class Stage:
    """Robot and ground in the browser: one frame per body, that moves; its geoms hang below it."""

    def __init__(self, server: viser.ViserServer, model: mujoco.MjModel) -> None:
        """Send the geoms."""
        self._model = model
        self._frames: dict[int, Any] = {}
        server.scene.set_up_direction("+z")
        server.scene.add_grid("/floor", width=40.0, height=40.0, cell_size=1.0, section_size=5.0)
        for geom in range(model.ngeom):
            mesh = geom_mesh(model, geom)
            if mesh is None or model.geom_group[geom] == COLLISION_GROUP:
                continue
            body = int(model.geom_bodyid[geom])
            if body not in self._frames:
                self._frames[body] = server.scene.add_frame(f"/body_{body}", show_axes=False)
            server.scene.add_mesh_simple(
                f"/body_{body}/geom_{geom}",
                vertices=np.asarray(mesh.vertices, dtype=np.float32),
                faces=np.asarray(mesh.faces, dtype=np.uint32),
                color=geom_color(model, geom),
                flat_shading=bool(model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX),
                position=model.geom_pos[geom],
                wxyz=model.geom_quat[geom],
            )

    def move(self, data: mujoco.MjData) -> None:
        """Move the bodies to where they are now."""
        for body, frame in self._frames.items():
            if body:
                frame.position = data.xpos[body]
                frame.wxyz = data.xquat[body]


class Panel:
    """Sliders and buttons."""

    def __init__(self, server: viser.ViserServer, limits: Command, command: Command | None) -> None:
        """Add them to the page."""
        gui = server.gui
        self.auto: Any = gui.add_checkbox("find its own way", initial_value=command is None)
        start = command or (0.0, 0.0, 0.0)
        names = ("forward [m/s]", "left [m/s]", "turn [rad/s]")
        self._sliders: list[Any] = [
            gui.add_slider(name, min=-limit, max=limit, step=0.05, initial_value=max(-limit, min(limit, value)))
            for name, limit, value in zip(names, limits, start, strict=True)
        ]
        self.follow = gui.add_checkbox("camera follows", initial_value=True)
        self.restart = False
        stand, restart = gui.add_button("stand"), gui.add_button("back to the start")
        stand.on_click(lambda _: self._stand())
        restart.on_click(lambda _: setattr(self, "restart", True))

    def _stand(self) -> None:
        self.auto.value = False
        for slider in self._sliders:
            slider.value = 0.0

    @property
    def command(self) -> Command | None:
        """What the sliders say, None for the robot's own way."""
        if self.auto.value:
            return None
        forward, lateral, yaw = (float(slider.value) for slider in self._sliders)
        return forward, lateral, yaw


def is_loopback(host: str) -> bool:
    """Whether a host name or address is this machine's own."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_own_request(headers: Any, host: str) -> bool:
    """Whether a request may come from the viewer's own page.

    Args:
        headers: of the request, by name.
        host: the interface that is listened on. On a loopback one a request must be addressed to this machine, so that no page
            of another server gets here by giving its own name this machine's address.
    """
    addressed = headers.get("Host") or ""
    origin = headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc != addressed:
        return False
    return not is_loopback(host) or is_loopback(urlsplit(f"//{addressed}").hostname or "")


@contextmanager
def own_requests_only(host: str) -> Iterator[None]:
    """Servers of web sockets that are started meanwhile refuse what does not come from their own page: viser takes any origin
    and has no setting for it.
    """
    library: Any = websockets.asyncio.server
    original: Callable[..., Any] = library.serve

    def guarded(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            if not is_own_request(request.headers, host):
                return connection.respond(HTTPStatus.FORBIDDEN, "not from this page\n")
            return None if process_request is None else process_request(connection, request)

        return original(*arguments, process_request=check, **options)

    library.serve = guarded
    try:
        yield
    finally:
        library.serve = original


def serve(session: PlaySession, command: Command | None, seconds: float | None, port: int, host: str) -> None:
    """Serve the page until Ctrl-C or until the time is over.

    Raises:
        UserError: the port is taken, or the host is none of this machine's.
    """
    try:
        with own_requests_only(host):
            server = viser.ViserServer(host=host, port=port, verbose=False)
    except OSError as error:
        raise UserError(
            f"port {port} of {host} cannot be used: {error.strerror or error}; choose another --port or --host"
        ) from error
    model = visual_model(session.robot, session.terrain)
    data = mujoco.MjData(model)
    stage, panel = Stage(server, model), Panel(server, session.limits, command)
    middle = session.position()[:3]

    server.initial_camera.position = middle + np.array([-1.2, -1.8, 0.9])
    server.initial_camera.look_at = middle
    console = Terminal()
    shown = "localhost" if is_loopback(host) else host
    console.say(f"open http://{shown}:{server.get_port()} in a browser; Ctrl-C ends")
    if not is_loopback(host):
        console.say(f"everybody who reaches {host} can steer this robot; leave --host out to serve this machine alone")
    due, sent = time.monotonic(), 0.0
    try:
        while seconds is None or session.time < seconds:
            if panel.restart:
                panel.restart = False
                session.reset()
            session.step(panel.command or session.autopilot())
            if session.time - sent >= _REFRESH - 1e-9:
                sent = session.time
                show(model, data, session.position())
                with server.atomic():
                    stage.move(data)
                moved, middle = session.position()[:3] - middle, session.position()[:3]
                if panel.follow.value:
                    for client in server.get_clients().values():
                        # Takes the point that it looks at along.
                        client.camera.position = client.camera.position + moved
            due = max(due + session.period, time.monotonic() - session.period)
            time.sleep(max(0.0, due - time.monotonic()))
    finally:
        server.stop()
