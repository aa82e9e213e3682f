"""Mend a copy of a robot's model: take out what carries or slows the robot, or stands beside it, and say what and where."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from ...files.parsing import one_line

if TYPE_CHECKING:
    import mujoco

_GRAVITY = (0.0, 0.0, -9.81)
_COLLISION_GROUP = 3
"""Group of shapes that collide, by custom."""
_REFERENCES = ("objname", "refname", "geomname1", "geomname2", "bodyname1", "bodyname2")
"""Fields in which sensors, contact pairs and exclusions name their parts."""


def mend(path: Path, spec: mujoco.MjSpec, model: mujoco.MjModel) -> list[str]:
    """Mend the spec of a model, which holds one free joint at most; return a sentence with the line for each mend.

    Args:
        path: the model's file; the sentences name its lines.
        model: compiled from ``spec``.
    """
    import mujoco

    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    mends: list[str] = []

    def note(sentence: str, pattern: str) -> None:
        at = next((i for i, line in enumerate(lines, 1) if re.search(pattern, line)), None)
        mends.append(f"{path.name}{f', line {at}' if at else ''}: {sentence}")

    # elements of a spec that was not compiled have no ids; they stand in the order of the compiled ones
    free = [(i, joint) for i, joint in enumerate(spec.joints) if joint.type == mujoco.mjtJoint.mjJNT_FREE]
    roots = [body for body in range(1, model.nbody) if model.body_parentid[body] == 0]
    for place, joint in free:
        dof = int(model.jnt_dofadr[place])
        passive = {
            "damping": model.dof_damping[dof],
            "friction loss": model.dof_frictionloss[dof],
            "armature": model.dof_armature[dof],
            "stiffness": model.jnt_stiffness[place],
        }
        if found := [f"{kind} {value:g}" for kind, value in passive.items() if value]:
            joint.damping, joint.stiffness = 0.0 * joint.damping, 0.0 * joint.stiffness
            joint.frictionloss = joint.armature = 0.0
            free_line = r'<freejoint|type="free"'
            note(
                f"the free joint has {', '.join(found)}, perhaps of a <default>, which would carry the robot: taken out",
                free_line,
            )
    gone: set[str] = set()
    for geom in list(spec.worldbody.geoms):
        name = f" '{geom.name}'" if geom.name else ""
        note(
            f"the geom{name} of the world, such as a floor, is none of the robot: taken out", _named("geom", geom.name)
        )
        gone.add(geom.name)
        spec.delete(geom)
    for site in list(spec.worldbody.sites):
        note(f"the site '{site.name}' of the world is none of the robot: taken out", _named("site", site.name))
        gone.add(site.name)
        spec.delete(site)
    base = int(model.body_rootid[model.jnt_bodyid[free[0][0]]]) if len(free) == 1 else -1
    for root, body in zip(roots, list(spec.worldbody.bodies), strict=True):
        if base >= 0 and root != base:
            note(
                f"the body '{body.name}' hangs on the world and not on the robot: taken out", _named("body", body.name)
            )
            parts = (part for kind in ("body", "geom", "site", "joint") for part in body.find_all(kind))
            gone.update((body.name, *(part.name for part in parts)))
            spec.delete(body)
    gone.discard("")
    for element in (
        *spec.sensors,
        *spec.pairs,
        *spec.excludes,
    ):  # MuJoCo does not compile what names a part that is gone
        if any(getattr(element, key, "") in gone for key in _REFERENCES):
            spec.delete(element)
    held = (mujoco.mjtEq.mjEQ_WELD, mujoco.mjtEq.mjEQ_CONNECT)
    for equality in list(spec.equalities):
        if equality.type in held and "world" in (equality.name1 or "world", equality.name2 or "world"):
            note(f"the equality '{equality.name}' ties the robot to the world: taken out", r"<(weld|connect)\b")
            spec.delete(equality)
    option = spec.option
    if tuple(option.gravity) != _GRAVITY:
        note(f"gravity is {_told(option.gravity)}: made {_told(_GRAVITY)}", r"gravity=")
        option.gravity = _GRAVITY
    if option.density or option.viscosity or any(option.wind):
        note("the robot moves in a medium or wind (density, viscosity, wind): taken out", r"density=|viscosity=|wind=")
        option.density = option.viscosity = 0.0
        option.wind = (0.0, 0.0, 0.0)
    override = int(mujoco.mjtEnableBit.mjENBL_OVERRIDE)
    if option.disableflags or option.enableflags & override:
        note("parts of the physics are disabled or overridden (option flag): made usual", r"<flag\b")
        option.disableflags, option.enableflags = 0, option.enableflags & ~override
    light = [body for body in spec.bodies if body.gravcomp]
    for body in light:
        note(f"the body '{body.name}' has gravity compensation: taken out", r"gravcomp=")
        body.gravcomp = 0.0
    mends += _mend_shapes(path, spec)
    return mends + _mend_motors(path, spec, model)


def _mend_shapes(path: Path, spec: mujoco.MjSpec) -> list[str]:
    """Let shapes meet the ground in a model where none does, since its scene pairs them: those of group 3, else all primitives."""
    import mujoco

    if any((geom.contype | geom.conaffinity) & 1 for geom in spec.geoms):
        return []
    physical = [g for g in spec.geoms if g.type != mujoco.mjtGeom.mjGEOM_MESH or g.group == _COLLISION_GROUP]
    chosen = [g for g in physical if g.group == _COLLISION_GROUP] or physical
    for geom in chosen:
        geom.conaffinity = 1
    told = "no shape meets the ground (contype and conaffinity are 0 everywhere)"
    return (
        [f"{path.name}: {told}: {len(chosen)} shapes given conaffinity 1, so that they do, but not each other"]
        if chosen
        else []
    )


def _mend_motors(path: Path, spec: mujoco.MjSpec, model: mujoco.MjModel) -> list[str]:
    """Take motors out of a model that has not one on each hinge, with the sensors that read them; the engines bring their own."""
    import mujoco

    if not model.nu:
        return []
    hinges = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE]
    driven = [
        int(model.actuator_trnid[a, 0])
        for a in range(model.nu)
        if model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT
    ]
    if model.nu == len(hinges) and sorted(driven) == hinges:
        return []
    for sensor in list(spec.sensors):
        if sensor.objtype == mujoco.mjtObj.mjOBJ_ACTUATOR:
            spec.delete(sensor)
    for key in spec.keys:
        key.ctrl = []
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    at = next((f", line {i}" for i, line in enumerate(lines, 1) if "<actuator" in line), "")
    told = f"{model.nu} actuators for {len(hinges)} hinges, not one for each: taken out, the engines bring their own"
    return [f"{path.name}{at}: {told}"]


def _named(tag: str, name: str) -> str:
    return rf'<{tag}\b[^>]*name="{re.escape(name)}"' if name else rf"<{tag}\b"


def _told(values: object) -> str:
    return one_line(" ".join(f"{float(v):g}" for v in values))  # type: ignore[attr-defined]
