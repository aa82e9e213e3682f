"""Scenes for tests of the mujoco_warp engine."""

import math
from dataclasses import replace

import numpy as np
import torch
from gaitgauge.backends import PhysicsOptions, Scene
from gaitgauge.robots import load_robot
from gaitgauge.terrains.base import Box, HeightField, Terrain

ROBOT = load_robot("go2")
FLAT = Terrain(name="flat", family="flat")
BLOCK = Box(center=(0.0, 0.0, 0.1), half_size=(2.0, 2.0, 0.1))
WALL = Box(
    center=(3.0, 0.0, 0.5), half_size=(0.1, 2.0, 0.5), quaternion=(math.sqrt(0.5), 0, 0, math.sqrt(0.5)), wall=True
)
BOXES = Terrain(name="boxes", family="boxes", boxes=(BLOCK, WALL))
COARSE = Terrain(
    name="coarse",
    family="field",
    height_field=HeightField(center=(0.5, 0.0), half_size=(2.0, 1.5), heights=np.full((4, 5), 0.3)),
)
FINE = Terrain(
    name="fine",
    family="field",
    height_field=HeightField(center=(0.0, 0.0), half_size=(2.0, 2.0), heights=np.full((21, 31), 0.05), base=0.2),
)
TRAINING = {
    "timestep": 0.005,
    "substeps": 4,
    "cone": "pyramidal",
    "impratio": 1.0,
    "foot_condim": 3,
    "self_collision": False,
}


def scene(*terrains, index=None, **physics):
    terrains = terrains or (FLAT,)
    index = tuple(range(len(terrains))) if index is None else index
    return Scene(
        robot=ROBOT,
        parameters=ROBOT.parameters["gauge"],
        terrains=terrains,
        terrain_index=index,
        physics=PhysicsOptions(**physics),
    )


def with_shell(folder, compiler):
    """A Go2 whose base bears a sphere of 3 kg that meets nothing, with these attributes of its ``compiler`` element."""
    shell = '<freejoint name="base"/><geom type="sphere" size="0.1" mass="3" contype="0" conaffinity="0"/>'
    text = ROBOT.mjcf.read_text().replace("<compiler ", f"<compiler {compiler}")
    mjcf = folder / "go2.xml"
    mjcf.write_text(text.replace('<freejoint name="base"/>', shell))
    return replace(ROBOT, mjcf=mjcf)


def upright(backend, height):
    """Arguments of a reset at the given base heights, in the default pose, held there."""
    n = backend.num_worlds
    position = torch.zeros((n, 3), dtype=backend.dtype, device=backend.device)
    position[:, 2] = torch.as_tensor(height, dtype=backend.dtype)
    quaternion = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=backend.dtype, device=backend.device).repeat(n, 1)
    pose = torch.tensor(ROBOT.default_joint_position, dtype=backend.dtype, device=backend.device).repeat(n, 1)
    return {"base_position": position, "base_quaternion": quaternion, "held_target": pose}
