"""Make a MuJoCo model of a robot and its ground for drawing; the physics runs elsewhere and only poses are copied."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from scipy.ndimage import zoom

from ..robots import Robot
from ..terrains.base import FloatArray, Terrain
from .picture import RICH, Quality

VISUAL_GROUP = 2
"""Geom group of the visible shapes of a robot."""
COLLISION_GROUP = 3
FIELD_COLOR = (0.72, 0.76, 0.74, 1.0)
BOX_COLORS = ((0.66, 0.70, 0.76, 1.0), (0.58, 0.62, 0.69, 1.0))
"""Neighbouring boxes differ a little, so that steps can be told apart."""
LOAD_COLOR = (0.93, 0.55, 0.16, 1.0)
_FLOOR_REACH = 40.0
"""Half extent of the drawn floor [m]."""
_SAME_GROUND = 0.01
"""Difference in height that nobody sees [m]."""
_LOAD_DENSITY = 1000.0
"""Density of the drawn load [kg/m³], that of water: its size tells its mass."""
_EXTENT = 3.0
"""Size of the scene for MuJoCo's camera and shadows [m]."""


def visual_model(
    robot: Robot, terrain: Terrain, quality: Quality = RICH, load: tuple[float, Sequence[float]] | None = None
) -> mujoco.MjModel:
    """Return a model of robot, terrain, sky and light, with the robot's ``qpos``; walls, which would hide the robot, are left out.

    ``load``: a mass on the base [kg] and its place from the base's centre of mass [m], drawn as a cube of water.
    """
    spec = mujoco.MjSpec.from_file(str(robot.mjcf))
    _set_light(spec, quality)
    for i, box in enumerate(box for box in terrain.boxes if not box.wall):
        shape = {"size": box.half_size, "pos": box.center, "quat": box.quaternion, "rgba": BOX_COLORS[i % 2]}
        _add_geom(spec, f"step_{i}", mujoco.mjtGeom.mjGEOM_BOX, **shape)
    if terrain.height_field is not None:
        _add_field(spec, terrain, quality.field_nodes)
    if terrain.target is not None:
        x, y = terrain.target[:2]
        place, color = [x, y, float(terrain.height(x, y)) + 0.006], [0.95, 0.45, 0.15, 1.0]
        _add_geom(spec, "target", mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.12, 0.004, 0.0], pos=place, rgba=color)
    # Last, since drawing goes in this order: parts of the floor under steps need not be drawn.
    _add_floor(spec, reflectance=0.04 if quality.reflections else 0.0)
    seen, solid = (
        {geom.parent.name for geom in spec.geoms if geom.group == group} for group in (VISUAL_GROUP, COLLISION_GROUP)
    )
    complete = 2 * len(seen) > len(solid)  # else the visible shapes are not all of the robot
    for geom in list(spec.geoms):
        if geom.group == COLLISION_GROUP and complete:
            spec.delete(geom)
    if load is not None and load[0] > 0.0:
        mass, offset = load
        middle = spec.compile().body(robot.base_body).ipos + np.asarray(offset)
        half = [0.5 * (mass / _LOAD_DENSITY) ** (1.0 / 3.0)] * 3
        unseen = {"contype": 0, "conaffinity": 0, "mass": 0.0, "group": VISUAL_GROUP}
        cube = {"name": "load", "type": mujoco.mjtGeom.mjGEOM_BOX, "size": half, "pos": middle, "rgba": LOAD_COLOR}
        spec.body(robot.base_body).add_geom(**cube, **unseen)
    return spec.compile()


def _add_geom(spec: mujoco.MjSpec, name: str, kind: mujoco.mjtGeom, **shape: Any) -> None:
    """Add a geom without collisions to the world."""
    spec.worldbody.add_geom(name=name, type=kind, contype=0, conaffinity=0, **shape)


def _set_light(spec: mujoco.MjSpec, quality: Quality) -> None:
    visual = spec.visual
    visual.global_.offwidth, visual.global_.offheight = quality.size
    visual.quality.shadowsize = quality.shadow_pixels
    visual.quality.offsamples = quality.samples
    visual.quality.numslices, visual.quality.numstacks = quality.slices, quality.stacks
    visual.quality.numquads = 1  # of a box's side: the light of one sun needs no more
    visual.headlight.ambient = [0.38, 0.38, 0.40]
    visual.headlight.diffuse = [0.30, 0.30, 0.30]
    visual.headlight.specular = [0.05, 0.05, 0.05]
    visual.rgba.haze = [0.86, 0.90, 0.95, 1.0]
    visual.map.haze = 0.35
    visual.map.znear = 0.01
    # Shadows are sharp where they fall within this distance of the sun's axis, and absent beyond it.
    spec.stat.extent = _EXTENT
    visual.map.shadowclip = quality.shadow_reach / _EXTENT
    # The sun follows the robot: a shadow map that covers the whole ground would be too coarse.
    colors = {"diffuse": [0.62, 0.60, 0.56], "specular": [0.15, 0.15, 0.15]}
    sun = spec.worldbody.add_light(name="sun", pos=[0.0, 0.0, 4.0], dir=[0.35, 0.45, -1.0], castshadow=True, **colors)
    sun.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    gradient = {"builtin": mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, "rgb1": [0.45, 0.62, 0.82], "rgb2": [0.90, 0.94, 0.98]}
    spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=512, height=3072, **gradient)


def _add_floor(spec: mujoco.MjSpec, reflectance: float) -> None:
    squares = {"builtin": mujoco.mjtBuiltin.mjBUILTIN_CHECKER, "rgb1": [0.74, 0.77, 0.80], "rgb2": [0.66, 0.69, 0.73]}
    edges = {"mark": mujoco.mjtMark.mjMARK_EDGE, "markrgb": [0.80, 0.83, 0.86]}
    kind = mujoco.mjtTexture.mjTEXTURE_2D
    texture = spec.add_texture(name="checker", type=kind, width=512, height=512, **squares, **edges)
    material = spec.add_material(name="floor", texrepeat=[1.0, 1.0], texuniform=True, reflectance=reflectance)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture.name
    _add_geom(spec, "floor", mujoco.mjtGeom.mjGEOM_PLANE, size=[_FLOOR_REACH, _FLOOR_REACH, 1.0], material="floor")


def _add_field(spec: mujoco.MjSpec, terrain: Terrain, most_nodes: int) -> None:
    field = terrain.height_field
    assert field is not None
    heights = drawn_heights(field.heights, most_nodes)
    top = max(float(heights.max()), 1e-6)
    hfield = spec.add_hfield(name="ground", nrow=heights.shape[0], ncol=heights.shape[1])
    hfield.size = np.array([*field.half_size, top, field.base])
    hfield.userdata = (heights / top).astype(np.float32).ravel()
    shape = {"hfieldname": "ground", "pos": [*field.center, 0.0], "rgba": FIELD_COLOR}
    _add_geom(spec, "ground", mujoco.mjtGeom.mjGEOM_HFIELD, **shape)


def drawn_heights(heights: FloatArray, most_nodes: int) -> FloatArray:
    """Return heights (rows, columns) [m] with at most ``most_nodes`` a side where these show the same ground, else as they are."""
    factors = [min(1.0, most_nodes / n) for n in heights.shape]
    fewer = zoom(heights, factors, order=1)
    back = zoom(fewer, [n / m for n, m in zip(heights.shape, fewer.shape, strict=True)], order=1)
    return np.asarray(fewer) if np.abs(back - heights).max() <= _SAME_GROUND else heights
