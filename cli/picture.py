"""Draw pictures without a display: MuJoCo's renderer off the screen, its quality, and a camera that follows the robot."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .errors import UserError
from .probe import ask

if TYPE_CHECKING:
    import mujoco

REMEDIES = {
    "egl": "install libegl1 and libgl1-mesa-dri",
    "osmesa": "install libosmesa6",
    "cgl": "log in at the screen of this Mac, not over ssh alone",
    "wgl": "install the graphics driver of the GPU's maker",
}
"""Advice by the way to draw without a window, which is the value of MUJOCO_GL."""
WITH_MJPYTHON = "start it as: mjpython -m gaitgauge.cli.main play POLICY"
"""Advice for the viewer's window on macOS."""
_ON_THE_CPU = ("llvmpipe", "softpipe", "swrast", "swiftshader", "apple software renderer", "gdi generic")
"""Names of drivers that draw without a GPU."""
PROBE = """
import json, mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 32, 32) as renderer:
    renderer.update_scene(data)
    assert renderer.render().max() > 0
    from OpenGL import GL
    print(json.dumps(GL.glGetString(GL.GL_RENDERER).decode()))
"""
"""Draws a picture, or fails, and prints the driver's name."""


@dataclass(frozen=True, kw_only=True)
class Quality:
    """Limit the cost of a picture. The defaults are for a GPU."""

    size: tuple[int, int] = (1280, 720)
    """Width and height of a picture of one robot [pixels]."""
    tile: tuple[int, int] = (640, 480)
    """Width and height of each picture where several stand side by side [pixels]."""
    samples: int = 4
    """Samples of each pixel, for smooth edges; 0 for one."""
    shadow_pixels: int = 4096
    """Width of the map of the sun's shadow [pixels]."""
    shadow_reach: float = 3.0
    """Distance from the robot within which there are shadows [m]."""
    ground_shadows: bool = True
    """True if the ground casts shadows too, beside the robot."""
    reflections: bool = True
    """True if the floor shines; everything is drawn twice then."""
    slices: int = 28
    """Corners on the circumference of round shapes."""
    stacks: int = 16
    """Rings along the axis of round shapes."""
    field_nodes: int = 1024
    """Nodes of a height field along each side, where so many show it as it is."""


RICH = Quality()
PLAIN = Quality(
    size=(960, 540),
    tile=(480, 360),
    samples=0,
    shadow_pixels=768,
    shadow_reach=2.5,
    ground_shadows=False,
    reflections=False,
    slices=12,
    stacks=6,
    field_nodes=64,
)
"""For a CPU that draws: an eighth of the time of ``RICH`` (``benchmarks/video_speed.py``)."""


def window_possible() -> bool:
    """Return False on macOS in a Python that ``mjpython`` did not start: MuJoCo's viewer needs it there."""
    return sys.platform != "darwin" or "MJPYTHON_BIN" in os.environ


def renderers() -> tuple[str, ...]:
    """Return the ways to draw without a window that MuJoCo has on this platform, the faster first."""
    return {"darwin": ("cgl",), "win32": ("wgl",)}.get(sys.platform, ("egl", "osmesa"))


def choose_renderer() -> Quality:
    """Return the quality that this machine can draw, and set ``MUJOCO_GL`` to the way; call it before MuJoCo is imported.

    Raises:
        UserError: nothing draws.
    """
    os.environ["MUJOCO_GL"], quality = find_renderer()
    return quality


def find_renderer() -> tuple[str, Quality]:
    """Return the way to draw on this machine, a value of ``MUJOCO_GL``, and its quality. Raises UserError: nothing draws."""
    asked, ways = os.environ.get("MUJOCO_GL"), renderers()
    for name in (asked,) if asked else ways:
        driver, trouble = ask(PROBE, MUJOCO_GL=name)
        if not trouble:
            return name, PLAIN if name == "osmesa" or any(n in driver.lower() for n in _ON_THE_CPU) else RICH
    named = {"egl": "EGL", "osmesa": "OSMesa", "cgl": "CGL", "wgl": "WGL"}
    failed = (
        f"neither {' nor '.join(named[w] for w in ways)} draws" if len(ways) > 1 else f"{named[ways[0]]} does not draw"
    )
    remedies = [REMEDIES[w] for w in ways]
    if asked:
        failed = f"MUJOCO_GL={asked} does not draw"
        remedies = [REMEDIES[asked] if asked in ways else f"set MUJOCO_GL to {' or '.join(ways)}, or unset it"]
    raise UserError(
        f"videos need off-screen rendering, and {failed} on this machine; {', or '.join(remedies)}, or watch in a browser "
        "with --viewer viser"
    )


class Follower:
    """Follow a robot smoothly with the point at which a camera looks."""

    ABOVE = 0.06
    """Height of the point above the base, which leaves room for words above the robot [m]."""
    LAG = 0.25
    """Time constant [s]."""

    def __init__(self) -> None:
        self._at: np.ndarray | None = None

    def follow(self, position: np.ndarray, seconds: float) -> np.ndarray:
        """Return the point for a pose (7 + J,), ``seconds`` after the previous one; (3,) [m]."""
        target = position[:3] + np.array([0.0, 0.0, self.ABOVE])
        # A robot that was put back to the start is not followed on its way there.
        if self._at is None or np.linalg.norm(target - self._at) > 1.5:
            self._at = target
        self._at = self._at + (target - self._at) * min(1.0, seconds / self.LAG)
        return self._at


@dataclass(frozen=True, kw_only=True)
class Tile:
    """Describe one robot of a picture."""

    model: mujoco.MjModel
    """Made by ``scenery.visual_model``."""
    heading: float
    """Heading of the robot at the start [rad]."""
    leg_length: float
    """Length of the robot's legs [m]."""
    ground_shadows: bool = True
    """True if the ground casts shadows too."""


class Picture:
    """Draw a robot on its ground."""

    AZIMUTH = 55.0
    """Direction in which the camera looks, against the robot's first heading [deg]."""
    ELEVATION = -16.0
    DISTANCE = 4.46
    """Distance of the camera, in lengths of the robot's legs."""

    def __init__(self, tile: Tile, *, size: tuple[int, int]) -> None:
        """Prepare the renderer of a picture of this width and height [pixels]."""
        import mujoco

        model = tile.model
        self._model, self._data = model, mujoco.MjData(model)
        self._renderer = mujoco.Renderer(model, size[1], size[0])
        self._camera = mujoco.MjvCamera()
        self._camera.azimuth = np.degrees(tile.heading) + self.AZIMUTH
        self._camera.elevation, self._camera.distance = self.ELEVATION, self.DISTANCE * tile.leg_length
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = 1
        self._options.sitegroup[:] = 0
        self._ground_shadows = tile.ground_shadows

    def draw(self, position: np.ndarray, looks_at: np.ndarray) -> np.ndarray:
        """Return the picture of a pose (7 + J,) from a camera that looks at a point (3,) [m]; (height, width, 3) uint8."""
        show(self._model, self._data, position)
        self._camera.lookat[:] = looks_at
        self._renderer.update_scene(self._data, self._camera, self._options)
        if not self._ground_shadows:
            self._take_shadows_from_ground()
        return self._renderer.render()

    def _take_shadows_from_ground(self) -> None:
        """Mark the ground as decoration: decoration receives shadows in MuJoCo and casts none."""
        import mujoco

        scene = self._renderer.scene
        for geom in scene.geoms[: scene.ngeom]:
            if geom.category == mujoco.mjtCatBit.mjCAT_STATIC:
                geom.category = mujoco.mjtCatBit.mjCAT_DECOR

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()


def show(model: mujoco.MjModel, data: mujoco.MjData, position: np.ndarray) -> None:
    """Put the model into a pose, (7 + J,), and move the sun along."""
    import mujoco

    data.qpos[: len(position)] = position
    sun = model.light("sun").id
    model.light_pos[sun] = (*position[:2] - np.array([1.4, 1.8]), position[2] + 4.0)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
