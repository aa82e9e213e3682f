"""Videos without a display: MuJoCo's renderer off the screen, and a camera that follows the robot."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import TracebackType

import numpy as np

from ..files.writing import replacing
from .errors import UserError

RENDERERS = ("egl", "osmesa")
"""Ways to draw without a display, the faster first; the value of MUJOCO_GL."""
_PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 32, 32) as renderer:
    renderer.update_scene(data)
    assert renderer.render().max() > 0
"""


def choose_renderer() -> str:
    """A way to draw that works here, put into ``MUJOCO_GL``; must be called before MuJoCo is imported.

    Raises:
        UserError: none works.
    """
    asked = os.environ.get("MUJOCO_GL")
    for name in (asked,) if asked else RENDERERS:
        environment = {**os.environ, "MUJOCO_GL": name}
        tried = subprocess.run([sys.executable, "-c", _PROBE], env=environment, capture_output=True, check=False)
        if tried.returncode == 0:
            os.environ["MUJOCO_GL"] = name
            return name
    named = f"MUJOCO_GL={asked} does not draw" if asked else "neither EGL nor OSMesa draws"
    raise UserError(
        f"videos need off-screen rendering, and {named} on this machine; install libegl1 and libgl1-mesa-dri, or "
        "libosmesa6, or watch in a browser with --viewer viser"
    )


def check_video_path(path: Path) -> None:
    """Refuse a video file that cannot be.

    Raises:
        UserError: the folder is not there, or the file does not end in .mp4.
    """
    if path.suffix.lower() != ".mp4":
        raise UserError(f"--out is '{path}'; a video needs a name that ends in .mp4")
    if not path.absolute().parent.is_dir():
        raise UserError(f"folder '{path.parent}' of --out does not exist; create it first")


class Video:
    """Writes an MP4 file; the file gets its name when it is whole."""

    def __init__(self, path: Path, *, fps: float, width: int, height: int) -> None:
        """Start the encoder for a path that ``check_video_path`` lets pass."""
        import imageio_ffmpeg

        self.path = path
        self._whole = replacing(path, UserError, ending=path.suffix)
        self._writer = imageio_ffmpeg.write_frames(
            str(self._whole.__enter__()),
            (width, height),
            fps=fps,
            codec="libx264",
            pix_fmt_in="rgb24",
            pix_fmt_out="yuv420p",
            macro_block_size=2,
            output_params=["-crf", "20", "-preset", "veryfast", "-movflags", "+faststart"],
        )
        self._writer.send(None)

    def __enter__(self) -> Video:
        return self

    def add(self, picture: np.ndarray) -> None:
        """Add a picture (height, width, 3) uint8.

        Raises:
            UserError: it cannot be written.
        """
        try:
            self._writer.send(np.ascontiguousarray(picture))
        except OSError as error:
            raise UserError(f"cannot write '{self.path}': {' '.join(str(error).split())[:200]}") from error

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.close()
        self._whole.__exit__(kind, error, trace)


class Picture:
    """Draws a robot on its ground from a camera that follows it smoothly."""

    AZIMUTH = 55.0
    """Direction in which the camera looks, against the robot's first heading [deg]."""
    ELEVATION = -16.0
    DISTANCE = 1.9
    LAG = 0.25
    """Time constant of the camera [s]."""

    def __init__(self, model: object, *, width: int, height: int, heading: float) -> None:
        """Prepare the renderer.

        Args:
            model: what ``scenery.visual_model`` made.
            width: of the picture [pixels].
            height: of the picture [pixels].
            heading: of the robot at the start [rad].
        """
        import mujoco

        assert isinstance(model, mujoco.MjModel)
        self._model, self._data = model, mujoco.MjData(model)
        self._renderer = mujoco.Renderer(model, height, width)
        self._camera = mujoco.MjvCamera()
        self._camera.azimuth = np.degrees(heading) + self.AZIMUTH
        self._camera.elevation, self._camera.distance = self.ELEVATION, self.DISTANCE
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = 1
        self._options.sitegroup[:] = 0
        self._looks_at: np.ndarray | None = None

    def draw(self, position: np.ndarray, seconds: float) -> np.ndarray:
        """The picture of a pose (7 + J,), ``seconds`` after the one before; (height, width, 3) uint8."""
        from .scenery import show

        show(self._model, self._data, position)
        target = position[:3] - np.array([0.0, 0.0, 0.06])
        # A robot that was put back to the start is not followed on its way there.
        if self._looks_at is None or np.linalg.norm(target - self._looks_at) > 1.5:
            self._looks_at = target
        self._looks_at = self._looks_at + (target - self._looks_at) * min(1.0, seconds / self.LAG)
        self._camera.lookat[:] = self._looks_at
        self._renderer.update_scene(self._data, self._camera, self._options)
        return self._renderer.render()

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()
