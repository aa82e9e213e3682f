"""Draw terrains side by side for ``docs/pictures.py``."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

TILES = ("slope_up", "slope_down", "rough_slope", "stairs_up", "stairs_down", "wave", "obstacles", "bars", "flat")


def drawn(title: str, terrain: Any, *, at: float = 0.0, down: float, far: float) -> Image.Image:
    """Return a picture of a terrain with its name and a Go2 where robots start.

    Args:
        at: x of the point that the camera looks at [m].
        down: angle by which the camera looks down [deg].
        far: distance of the camera, in units of ``Picture.DISTANCE`` [m].
    """
    from gaitgauge.cli.picture import Picture, Tile, choose_renderer

    quality = choose_renderer()  # before MuJoCo is imported
    from gaitgauge.cli.scenery import visual_model
    from gaitgauge.robots import load_robot
    from gaitgauge.robots.anatomy.body_plan import default_pose

    robot = load_robot("go2")
    quality = replace(quality, size=(720, 400), field_nodes=256, shadow_reach=9.0, shadow_pixels=2048)
    _, data = default_pose(robot)
    pose, position = next(iter(terrain.spawns.values())), data.qpos[: 7 + robot.num_joints].copy()
    position[:7] = (*pose.position, np.cos(pose.yaw / 2), 0, 0, np.sin(pose.yaw / 2))
    position[2] += robot.stand_height
    model = visual_model(robot, terrain, quality)
    model.vis.map.znear = 0.3  # faces that lie nearly in each other would flicker
    model.geom_sameframe[model.geom("floor").id] = 0  # its own position counts
    model.geom("floor").pos[2] -= 0.1 if terrain.name == "tile_rough_slope" else 0.02
    if "slope" in terrain.name:  # so would shadows of flat faces that touch each other
        model.light_castshadow[:] = False
        for i in range(model.ngeom):
            if model.geom(i).name.startswith("step_"):
                model.geom(i).rgba[:] = model.geom("step_0").rgba
    picture = Picture(Tile(model=model, heading=0.0, leg_length=far), size=quality.size)
    picture._camera.elevation = -down
    image = Image.fromarray(picture.draw(position, np.array([at, 0.0, 0.3]))).resize((360, 200))
    picture.close()
    font = ImageFont.truetype("DejaVuSans.ttf", 16)
    ImageDraw.Draw(image).text((8, 6), title, "black", font, stroke_width=3, stroke_fill="white")
    return image


def terrains() -> dict[str, Image.Image]:
    """Return pictures by file name: the gauge's terrains at levels 1, 5 and 10, training tiles at level 8 of 0 to 11."""
    from gaitgauge.terrains import gauge_terrain_names, make_terrain
    from gaitgauge.terrains.training_tiles import make_tile

    flat = [drawn(text, make_terrain("flat"), down=24, far=1.5) for text in ("flat: no levels", "", "")]
    places = [(name, level) for name in gauge_terrain_names() if name != "flat" for level in (1, 5, 10)]
    levels = [drawn(f"{n}, level {i}", make_terrain(n, i), at=5.0, down=24, far=2.6) for n, i in places]
    tiles = [drawn(name, make_tile(name, 8), down=38, far=2.2) for name in TILES]
    sheets = {}
    for file, images in (("terrains.png", flat + levels), ("terrains-training.png", tiles)):
        paper = Image.new("RGB", (1088, len(images) // 3 * 204 - 4), "white")
        for i, image in enumerate(images):
            paper.paste(image, (i % 3 * 364, i // 3 * 204))
        sheets[file] = paper
    return sheets
