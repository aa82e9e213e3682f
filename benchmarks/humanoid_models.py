"""Write descriptions of Unitree's humanoids, for public policies, from the maker's MuJoCo models without their meshes.

    python benchmarks/humanoid_models.py MODELS OUT

``MODELS`` holds ``g1_12dof.xml`` (unitree_rl_gym), ``g1_29dof.xml`` and ``h1.xml`` (unitree_mujoco). ``OUT`` gets a folder for each with
``robot.toml`` and a model: meshes become primitives of our own, feet get names, a sole that is a mesh becomes a box.
"""

from __future__ import annotations

import argparse
import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
import numpy as np

H1_SOLE = {"type": "box", "size": "0.13 0.03 0.01", "pos": "0.0486 0 -0.0605"}
"""In the frame of the H1's ankle [m]: a box of the foot's own inertia under its centre of mass, since its shape is a mesh."""
G1_ARMATURE = {
    **dict.fromkeys(("hip_roll", "knee"), 0.0251019),
    **dict.fromkeys(("hip_pitch", "hip_yaw", "waist_yaw"), 0.0101775),
    **dict.fromkeys(("ankle", "waist_roll", "waist_pitch"), 0.00721945),
    **dict.fromkeys(("wrist_pitch", "wrist_yaw"), 0.00425),
    **dict.fromkeys(("shoulder", "elbow", "wrist_roll"), 0.00360973),
}
"""Inertia of the G1's rotors and gears by its four motors [kg·m²], as MuJoCo Playground and mjlab have it; the model has 0.01."""
TRUNKS = {
    "g1_12dof": {"pelvis": ("0.09 0.1 0.2", "0 0 0.17")},
    "g1": {"pelvis": ("0.07 0.09 0.06", "0 0 -0.07"), "torso_link": ("0.08 0.1 0.15", "0 0 0.15")},
    "h1": {"pelvis": ("0.08 0.1 0.06", "0 0 -0.05"), "torso_link": ("0.1 0.13 0.2", "0 0 0.25")},
}
"""Boxes for trunks: half sizes and centres [m], by robot and body."""
LEGS = {
    "g1": {"hip_pitch": -0.1, "knee": 0.3, "ankle_pitch": -0.2},
    "h1": {"hip_pitch": -0.1, "knee": 0.3, "ankle": -0.2},
}
"""Standing poses of Unitree's policies [rad]; all other joints are at 0."""
H1_TORQUE = {
    **{f"hip_{axis}_joint": 200.0 for axis in ("yaw", "roll", "pitch")},
    **{f"shoulder_{axis}_joint": 40.0 for axis in ("roll", "pitch")},
    **{"knee_joint": 300.0, "ankle_joint": 40.0, "shoulder_yaw_joint": 18.0, "elbow_joint": 18.0, "joint": 200.0},
}
"""Limits of the H1's motors [N·m], which are its actuators' ranges; ``joint`` is the waist's."""
SOURCES = {"g1_12dof": "g1_12dof.xml", "g1": "g1_29dof.xml", "h1": "h1.xml"}


def model(source: Path, name: str) -> ElementTree.Element:
    """Return the model of a robot as XML, without meshes, motors, sensors and what is no part of the robot."""
    root = ElementTree.parse(source).getroot()
    for tag in ("asset", "sensor", "actuator", "keyframe", "visual", "statistic", "contact"):
        for element in root.findall(tag):
            root.remove(element)
    world = root.find("worldbody")
    assert world is not None
    for element in list(world):
        if element.tag != "body" or element.get("name") == "not_use_body":
            world.remove(element)
    base = world.find("body")
    assert base is not None
    for body in list(base.iter("body")):
        _shapes(body, name)
    for joint in base.iter("joint"):
        if joint.get("type") == "free":
            # the class of the model's joints would give the base damping and armature
            joint.tag, kept = "freejoint", joint.get("name")
            joint.attrib.clear()
            joint.set("name", str(kept))
    actuators = ElementTree.SubElement(root, "actuator")
    for joint in base.iter("joint"):
        ElementTree.SubElement(actuators, "position", joint=str(joint.get("name")), kp="100", kv="2")
    return root


def _shapes(body: ElementTree.Element, name: str) -> None:
    """Put primitives in place of a body's meshes, and name the shapes of a foot."""
    own = str(body.get("name"))
    for geom in body.findall("geom"):
        if geom.get("mesh") or geom.get("type") == "mesh":
            body.remove(geom)
    side = own.split("_")[0]
    foot = own.endswith("ankle_roll_link") or own.endswith("ankle_link")
    if foot and name == "h1":
        ElementTree.SubElement(body, "geom", H1_SOLE)
    for number, geom in enumerate(body.findall("geom")):
        geom.attrib.pop("class", None)
        geom.set("name", f"{side}_sole_{number}" if foot else f"{own}_shape_{number}")
        geom.set("mass", "0")
    if own in TRUNKS[name]:
        size, place = TRUNKS[name][own]
        ElementTree.SubElement(body, "geom", name=f"{own}_box", type="box", size=size, pos=place, mass="0")
    for number, child in enumerate(body.findall("body")):
        far = np.array([float(x) for x in child.get("pos", "0 0 0").split()])
        if np.linalg.norm(far) > 0.09 and own not in TRUNKS[name]:
            ends = " ".join(f"{x:g}" for x in (*0.25 * far, *0.8 * far))
            bar = {"type": "capsule", "size": "0.03", "fromto": ends, "mass": "0"}
            ElementTree.SubElement(body, "geom", bar | {"name": f"{own}_bar_{number}"})


def description(compiled: mujoco.MjModel, name: str, file: str) -> str:
    """Return a robot.toml."""
    joints = [compiled.joint(j).name for j in range(1, compiled.njnt)]
    legs = LEGS[name.partition("_")[0]]
    pose = [next((a for k, a in legs.items() if k in j and "waist" not in j and "wrist" not in j), 0.0) for j in joints]
    solid = {int(compiled.geom_bodyid[g]) for g in range(compiled.ngeom) if compiled.geom_contype[g]}
    soles = {
        s: [g for g in range(compiled.ngeom) if compiled.geom(g).name.startswith(f"{s}_sole")]
        for s in ("left", "right")
    }
    feet = {int(compiled.geom_bodyid[g]) for sole in soles.values() for g in sole}
    bodies = [compiled.body(b).name for b in sorted(solid - feet)]
    data = mujoco.MjData(compiled)
    for joint, angle in zip(joints, pose, strict=True):
        data.joint(joint).qpos[0] = angle
    data.qpos[:3] = 0.0
    mujoco.mj_kinematics(compiled, data)
    low = min(_lowest(compiled, data, g) for sole in soles.values() for g in sole)
    dofs = [int(compiled.joint(j).dofadr[0]) for j in joints]
    names = {s: [compiled.geom(g).name for g in sole] for s, sole in soles.items()}
    limit = [
        float(compiled.jnt_actfrcrange[compiled.joint(j).id].max()) or H1_TORQUE[j.partition("_")[2]] for j in joints
    ]
    rows = {
        "name": name,
        "title": {"g1_12dof": "Unitree G1, 12 joints", "g1": "Unitree G1, 29 joints", "h1": "Unitree H1"}[name],
        "mjcf": file,
        "joint_names": joints,
        "default_joint_position": pose,
        "base_body": compiled.body(1).name,
        "foot_names": ["left", "right"],
        "foot_shapes": list(names.values()),
        "collision_bodies": bodies,
        "trunk_shapes": [f"{compiled.body(1).name}_box"],
        "stand_height": round(-low + 0.005, 4),
        "default_parameters": "gauge",
        "command_limits": [1.0, 0.5, 1.0],
    }
    lines = [f"{key} = {json.dumps(value)}" for key, value in rows.items()]
    ratio = [_gain(j, 0) for j in joints], [_gain(j, 1) for j in joints]
    lines += ["[parameters.gauge]", f"stiffness = {ratio[0]}", f"damping = {ratio[1]}", f"torque_limit = {limit}"]
    rotors = compiled.dof_armature[dofs].tolist()
    if name == "g1":
        rotors = [next(value for word, value in G1_ARMATURE.items() if word in j) for j in joints]
    lines += [f"armature = {rotors}", f"joint_damping = {compiled.dof_damping[dofs].tolist()}"]
    lines += [f"friction_loss = {compiled.dof_frictionloss[dofs].tolist()}"]
    # of the robot's motors no torque over speed is known here: the whole torque at every speed
    lines += [f"full_torque_speed = {[50.0] * len(joints)}", f"no_load_speed = {[60.0] * len(joints)}"]
    return "\n".join(lines) + "\n"


def _gain(joint: str, which: int) -> float:
    """Return kp or kd of the maker's legs; arms and waist are held."""
    table = {
        "knee": (150.0, 4.0),
        "ankle": (40.0, 2.0),
        "hip": (100.0, 2.0),
        "waist": (200.0, 5.0),
        "torso": (300.0, 6.0),
    }
    return next((gains[which] for word, gains in table.items() if word in joint), (40.0, 2.0)[which])


def _lowest(compiled: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    center, half = compiled.geom_aabb[geom, :3], compiled.geom_aabb[geom, 3:]
    up = data.geom_xmat[geom].reshape(3, 3)[2]
    return float(data.geom_xpos[geom, 2] + up @ center - np.abs(up) @ half)


def write(models: Path, folder: Path) -> Path:
    """Write the robot that a folder is named after, with its model, into the folder; return its ``robot.toml``."""
    name = folder.name
    folder.mkdir(parents=True, exist_ok=True)
    root = model(models / SOURCES[name], name)
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode")
    (folder / f"{name}.xml").write_text(text, encoding="utf-8")
    written = folder / "robot.toml"
    compiled = mujoco.MjModel.from_xml_string(text)
    written.write_text(description(compiled, name, f"{name}.xml"), encoding="utf-8")
    return written


def main() -> None:
    """Write all robots that there are models for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    for name in SOURCES:
        written = write(arguments.models, arguments.out / name)
        compiled = mujoco.MjModel.from_xml_path(str(written.parent / f"{name}.xml"))
        print(f"{written}: {compiled.njnt - 1} joints, {compiled.body_mass.sum():.2f} kg")


if __name__ == "__main__":
    main()
