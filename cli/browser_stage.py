"""Show a robot and its ground in the browser: geoms as meshes, one frame for each body."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import trimesh
import viser

from ..terrains.base import Terrain
from .picture import show
from .play_session import PlaySession
from .scenery import COLLISION_GROUP, visual_model

_BESIDE = 1.6
"""Distance between robots on the same ground [m]."""


def geom_mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh | None:
    """Return the surface of a geom in its own frame, None for a plane or a shape that cannot be drawn here."""
    size, shapes, kinds = model.geom_size[geom], trimesh.creation, mujoco.mjtGeom
    match mujoco.mjtGeom(model.geom_type[geom]):
        case kinds.mjGEOM_BOX:
            return shapes.box(extents=2.0 * size)
        case kinds.mjGEOM_SPHERE:
            return shapes.icosphere(subdivisions=2, radius=size[0])
        case kinds.mjGEOM_ELLIPSOID:
            return shapes.icosphere(subdivisions=3, radius=1.0).apply_scale(size)
        case kinds.mjGEOM_CYLINDER:
            return shapes.cylinder(radius=size[0], height=2.0 * size[1], sections=32)
        case kinds.mjGEOM_CAPSULE:
            return shapes.capsule(radius=size[0], height=2.0 * size[1], count=[16, 16])
        case kinds.mjGEOM_HFIELD:
            return _field_mesh(model, int(model.geom_dataid[geom]))
        case kinds.mjGEOM_MESH:
            mesh = model.mesh(model.geom_dataid[geom])
            corners = slice(mesh.vertadr[0], mesh.vertadr[0] + mesh.vertnum[0])
            faces = slice(mesh.faceadr[0], mesh.faceadr[0] + mesh.facenum[0])
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
    """Return red, green and blue of a geom, 0 to 255."""
    material = int(model.geom_matid[geom])
    rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
    red, green, blue = (round(255 * float(v)) for v in rgba[:3])
    return red, green, blue


class Stage:
    """Show one world in the browser. Its frame stands beside those of the other worlds; a frame for each body moves within it."""

    def __init__(
        self, server: viser.ViserServer, session: PlaySession, name: str, aside: float, *, titled: bool
    ) -> None:
        """Send the geoms.

        Args:
            session: gives robot and ground.
            aside: position of the world along y [m].
            titled: write the policy's name above the robot.
        """
        self.session, self.aside = session, aside
        self._model = visual_model(session.robot, session.terrain)
        self._data = mujoco.MjData(self._model)
        self._root: Any = server.scene.add_frame(f"/{name}", show_axes=False, position=(0.0, aside, 0.0))
        self._frames: dict[int, Any] = {}
        for geom in range(self._model.ngeom):
            mesh = geom_mesh(self._model, geom)
            if mesh is None or self._model.geom_group[geom] == COLLISION_GROUP:
                continue
            body = int(self._model.geom_bodyid[geom])
            if body not in self._frames:
                self._frames[body] = server.scene.add_frame(f"/{name}/body_{body}", show_axes=False)
            server.scene.add_mesh_simple(
                f"/{name}/body_{body}/geom_{geom}",
                vertices=np.asarray(mesh.vertices, dtype=np.float32),
                faces=np.asarray(mesh.faces, dtype=np.uint32),
                color=geom_color(self._model, geom),
                flat_shading=bool(self._model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX),
                position=self._model.geom_pos[geom],
                wxyz=self._model.geom_quat[geom],
            )
        self._title: Any = server.scene.add_label(f"/{name}/title", session.label) if titled else None
        self.move()

    def move(self) -> None:
        """Move the bodies to their present poses."""
        show(self._model, self._data, self.session.position())
        for body, frame in self._frames.items():
            if body:
                frame.position = self._data.xpos[body]
                frame.wxyz = self._data.xquat[body]
        if self._title is not None:
            self._title.position = self.session.position()[:3] + np.array([0.0, 0.0, 0.35])

    @property
    def middle(self) -> np.ndarray:
        """Return the position of the robot on the page, (3,) [m]."""
        return self.session.position()[:3] + np.array([0.0, self.aside, 0.0])

    def remove(self) -> None:
        """Take the world off the page."""
        self._root.remove()


def distance_between(terrain: Terrain) -> float:
    """Return the distance between worlds on the page [m]: close where their grounds look as one, else beside each other."""
    ground = [box for box in terrain.boxes if not box.wall]
    tilted = any(abs(box.quaternion[1]) + abs(box.quaternion[3]) > 1e-9 for box in ground)
    spans = {(box.center[1] - box.half_size[1], box.center[1] + box.half_size[1]) for box in ground}
    if terrain.height_field is None and not tilted and len(spans) <= 1:
        return _BESIDE
    edges = [abs(edge) for span in spans for edge in span]
    if terrain.height_field is not None:
        edges.append(abs(terrain.height_field.center[1]) + terrain.height_field.half_size[1])
    return 2.0 * max(edges) + 0.5
