"""Read a robot's model without its visual meshes: physics has no use for them, and they cost seconds and gigabytes to compile."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mujoco


def physical_spec(mjcf: Path) -> mujoco.MjSpec:
    """Return the model of a file without meshes that neither touch nor weigh anything."""
    import mujoco

    spec = mujoco.MjSpec.from_file(str(mjcf))
    if not spec.meshes:
        return spec
    for geom in [g for body in spec.bodies for g in body.geoms if is_visual_mesh(body, g)]:
        spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    skinned = bool(spec.skins)
    for mesh in list(spec.meshes):
        if mesh.name not in used and not skinned:
            spec.delete(mesh)
    return spec


def is_visual_mesh(body: mujoco.MjsBody, geom: mujoco.MjsGeom) -> bool:
    """Return whether a geom of a body is a mesh that meets nothing and whose mass counts for nothing."""
    import mujoco

    weightless = body.explicitinertial or geom.mass == 0.0 or geom.density == 0.0
    return geom.type == mujoco.mjtGeom.mjGEOM_MESH and not geom.contype and not geom.conaffinity and weightless
