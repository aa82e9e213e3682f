"""Contacts of single shapes with a height field: mujoco_warp's against MuJoCo's.

    python benchmarks/field_contacts.py            # as the engines of this project use mujoco_warp
    python benchmarks/field_contacts.py --plain    # as mujoco_warp is

Spheres, cylinders and boxes of the Go2's sizes are put at random places and in random attitudes into the gauge's wave, a
little above the ground to about half of them in it. Compared are the deepest contacts: depth, normal, and how often there
is one in one engine only. ``tests/backends/test_field_contacts.py`` holds them to bounds.
"""

from __future__ import annotations

import argparse

import mujoco
import mujoco_warp
import numpy as np
import warp as wp
from gaitgauge.backends.upstream.height_fields.repair import HEIGHT_FIELDS
from gaitgauge.terrains.base import Terrain
from gaitgauge.terrains.registry import make_terrain

MARGIN = 0.001
"""Contact margin of the shapes [m]."""
# The Go2's foot, shank, hip motor, thigh and trunk: type, size, and how high above the ground their centres are [m].
SHAPES = {
    "foot": ("sphere", "0.022", (0.005, 0.0235)),
    "shank": ("cylinder", "0.011 0.0325", (0.0, 0.04)),
    "hip": ("cylinder", "0.046 0.02", (0.01, 0.055)),
    "thigh": ("box", "0.1065 0.01225 0.017", (0.01, 0.06)),
    "trunk": ("box", "0.1881 0.04675 0.057", (0.03, 0.12)),
}

Contact = tuple[float, np.ndarray, np.ndarray]
"""Distance [m], normal out of the ground, position [m]."""


def model_of(name: str, terrain: Terrain) -> mujoco.MjModel:
    """One free shape over the terrain's height field."""
    kind, size, _ = SHAPES[name]
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><worldbody><body><freejoint/><geom type="{kind}" size="{size}" margin="{MARGIN}" mass="1"/></body>'
        "</worldbody></mujoco>"
    )
    heights = terrain.height_field
    assert heights is not None
    top = float(heights.heights.max())
    rows, columns = heights.heights.shape
    field = spec.add_hfield(name="field", nrow=rows, ncol=columns)
    field.size = np.array([*heights.half_size, top, heights.base])
    field.userdata = (heights.heights / top).astype(np.float32).ravel()
    place = [*heights.center, 0.0]
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="field", pos=place)
    model = spec.compile()
    model.hfield_data[:] = (heights.heights / top).ravel()
    return model


def poses(name: str, terrain: Terrain, count: int) -> np.ndarray:
    """Random poses of a shape's centre, near the ground: position and quaternion, (count, 7)."""
    random = np.random.default_rng(1)
    qpos = np.zeros((count, 7))
    qpos[:, 0], qpos[:, 1] = random.uniform(1.0, 9.0, count), random.uniform(-4.0, 4.0, count)
    qpos[:, 2] = terrain.height(qpos[:, 0], qpos[:, 1]) + random.uniform(*SHAPES[name][2], count)
    qpos[:, 3:] = random.normal(size=(count, 4))
    qpos[:, 3:] /= np.linalg.norm(qpos[:, 3:], axis=1, keepdims=True)
    return qpos


def contacts_of_mujoco(model: mujoco.MjModel, qpos: np.ndarray) -> list[list[Contact]]:
    """The contacts that act (nearer than the margin) in each pose."""
    data, found = mujoco.MjData(model), []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_forward(model, data)
        found.append([(c.dist, c.frame[:3].copy(), c.pos.copy()) for c in data.contact if c.dist < MARGIN])
    return found


def collided(model: mujoco.MjModel, qpos: np.ndarray) -> mujoco_warp.Data:
    """A world of mujoco_warp for each pose, all at once, on Warp's present device."""
    count = len(qpos)
    device_model = mujoco_warp.put_model(model)
    room = 8 * count * max(1, model.ngeom - 1)
    data = mujoco_warp.make_data(model, nworld=count, naconmax=room, naccdmax=room, njmax=64)
    data.qpos.assign(qpos.astype(np.float32))
    for stage in (mujoco_warp.kinematics, mujoco_warp.com_pos, mujoco_warp.collision):
        stage(device_model, data)
    return data


def contacts_of_mujoco_warp(model: mujoco.MjModel, qpos: np.ndarray) -> list[list[Contact]]:
    """The contacts that act (nearer than the margin) in each pose."""
    data = collided(model, qpos)
    if data.overflow.numpy().any():
        raise RuntimeError("contacts were lost: the benchmark makes too little room for them")
    contact, number = data.contact, int(data.nacon.numpy()[0])
    columns = [getattr(contact, name).numpy()[:number] for name in ("worldid", "dist", "frame", "pos")]
    found: list[list[Contact]] = [[] for _ in qpos]
    for world, distance, frame, position in zip(*columns, strict=True):
        if distance < MARGIN:
            found[world].append((float(distance), frame[0], position))
    return found


def compare(theirs: list[list[Contact]], ours: list[list[Contact]]) -> dict[str, np.ndarray]:
    """Deepest contacts of the poses that touch in both engines.

    Returns:
        ``depth``: difference of the depths [m]; ``angle`` between the normals [degrees]; ``apart``: distance of the
        positions [m]; ``only``: nearness to the margin of the deepest contact that one engine alone has [m].
    """
    rows, only = [], []
    for one, other in zip(theirs, ours, strict=True):
        if one and other:
            a, b = (min(contacts, key=lambda c: c[0]) for contacts in (one, other))
            angle = np.degrees(np.arccos(np.clip(a[1] @ b[1], -1.0, 1.0)))
            rows.append((b[0] - a[0], angle, np.linalg.norm(b[2] - a[2])))
        elif one or other:
            only.append(MARGIN - min(c[0] for c in one + other))
    depth, angle, apart = np.array(rows).T
    return {"depth": depth, "angle": angle, "apart": apart, "only": np.array(only)}


def main() -> None:
    """Print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plain", action="store_true", help="leave mujoco_warp as it is")
    parser.add_argument("--level", type=int, default=5, help="level of the wave")
    parser.add_argument("--count", type=int, default=400, help="poses of each shape")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    if not arguments.plain:
        HEIGHT_FIELDS.apply()
    terrain = make_terrain("wave", arguments.level)
    print("        touching   in one    depth difference [mm]     normals apart by     contacts a pose   into the")
    print("shape    in both     only   median    95 %     most   > 10 deg  > 90 deg    mujoco      warp     ground")
    for name in SHAPES:
        model, qpos = model_of(name, terrain), poses(name, terrain, arguments.count)
        theirs, ours = contacts_of_mujoco(model, qpos), contacts_of_mujoco_warp(model, qpos)
        seen = compare(theirs, ours)
        depth, angle = 1e3 * np.abs(seen["depth"]), seen["angle"]
        each = [np.mean([len(c) for c in contacts]) for contacts in (theirs, ours)]
        down = np.mean([contact[1][2] < 0.0 for contacts in ours for contact in contacts])
        print(
            f"{name:6} {len(depth):9} {len(seen['only']):8} {np.median(depth):8.3f} {np.quantile(depth, 0.95):7.2f} "
            f"{depth.max():8.2f} {np.mean(angle > 10.0):10.1%} {np.mean(angle > 90.0):9.1%} {each[0]:9.2f} {each[1]:9.2f} "
            f"{down:10.1%}"
        )


if __name__ == "__main__":
    main()
