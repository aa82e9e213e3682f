"""``gaitgauge play`` into a file: what stands in the picture, films and clips, and machines that cannot draw."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from gaitgauge.cli.errors import UserError
from gaitgauge.cli.overlay import annotate, summary, table
from gaitgauge.cli.picture import PLAIN, RICH, choose_renderer
from gaitgauge.cli.play_session import Readout
from gaitgauge.cli.video import film
from PIL import Image


def test_video_file_is_whole_or_not_there(tmp_path):
    import imageio.v3 as imageio

    path = tmp_path / "walk.mp4"
    with film(path, fps=25, size=(64, 48)) as add:
        for i in range(10):
            add(np.full((48, 64, 3), 20 * i, dtype=np.uint8))
    frames = imageio.imread(path, plugin="FFMPEG")
    assert frames.shape == (10, 48, 64, 3)
    assert frames[9].mean() > frames[0].mean() + 100
    with pytest.raises(RuntimeError, match="gone"), film(tmp_path / "half.mp4", fps=25, size=(64, 48)) as add:
        add(np.zeros((48, 64, 3), dtype=np.uint8))
        raise RuntimeError("gone")
    assert [f.name for f in tmp_path.glob("*.mp4")] == ["walk.mp4"]


@pytest.mark.parametrize("name", ["walk.mp4", "walk.gif"])
def test_a_film_that_the_encoder_gave_up_is_not_there(tmp_path, monkeypatch, name):
    """GIFs are encoded whole at the end, when nothing is left to add."""
    encoder = tmp_path / "ffmpeg"
    encoder.write_text(
        f"#!{sys.executable}\nimport sys\nopen(sys.argv[-1], 'wb').write(sys.stdin.buffer.read(99))\n"
        "sys.stdin.buffer.read()\nsys.exit('No space left\\non device')\n"
    )
    encoder.chmod(0o755)
    monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", lambda: str(encoder))
    refused = pytest.raises(UserError, match=rf"cannot write '.*{name}': No space left on device$")
    with refused, film(tmp_path / name, fps=25, size=(64, 48)) as add:
        add(np.zeros((48, 64, 3), dtype=np.uint8))
    assert list(tmp_path.iterdir()) == [encoder]


def test_machine_without_a_renderer(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setattr("gaitgauge.cli.picture.ask", lambda *a, **k: (None, "ended with exit code 1"))
    with pytest.raises(UserError, match="MUJOCO_GL=osmesa does not draw"):
        choose_renderer()
    monkeypatch.delenv("MUJOCO_GL")
    with pytest.raises(UserError, match="neither EGL nor OSMesa draws"):
        choose_renderer()


@pytest.mark.parametrize(
    ("platform", "asked", "sentence"),
    [
        ("darwin", None, "CGL does not draw on this machine; log in at the screen of this Mac"),
        ("win32", None, "WGL does not draw on this machine; install the graphics driver"),
        ("darwin", "egl", "MUJOCO_GL=egl does not draw on this machine; set MUJOCO_GL to cgl, or unset it"),
    ],
)
def test_each_platform_has_its_own_way_to_draw(monkeypatch, platform, asked, sentence):
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    tried = []
    monkeypatch.setattr("gaitgauge.cli.picture.ask", lambda program, MUJOCO_GL: (tried.append(MUJOCO_GL), "no"))  # noqa: N803
    if asked:
        monkeypatch.setenv("MUJOCO_GL", asked)
    with pytest.raises(UserError, match=sentence):
        choose_renderer()
    assert tried == [asked or {"darwin": "cgl", "win32": "wgl"}[platform]]


def test_driver_decides_what_a_picture_may_cost(monkeypatch):
    for driver, quality in (("llvmpipe (LLVM 15.0.6, 256 bits)", PLAIN), ("NVIDIA H200/PCIe/SSE2", RICH)):
        monkeypatch.setenv("MUJOCO_GL", "egl")
        monkeypatch.setattr("gaitgauge.cli.picture.ask", lambda *a, answer=driver, **k: (answer, ""))
        assert choose_renderer() is quality


READOUT = Readout(
    label="standing",
    place="wave level 3",
    friction=0.6,
    time=4.26,
    command=(1.0, -0.5, 0.0),
    speed=(0.934, -0.001, -0.27),
    falls=1,
    arrivals=2,
)


def test_words_of_the_overlay():
    assert table(READOUT)[1:] == [("command", "+1.00", "-0.50", "+0.00"), ("measured", "+0.93", "+0.00", "-0.27")]
    assert summary(READOUT) == "friction 0.6  ·  1 fall  ·  2 times at the target  ·  4.3 s"


@pytest.mark.parametrize(("width", "height", "tiles"), [(960, 540, 1), (480, 270, 1), (640, 240, 2), (1280, 240, 4)])
def test_every_tile_has_its_panel_and_the_rest_of_the_picture_stays(width, height, tiles):
    picture = np.full((height, width, 3), 200, dtype=np.uint8)
    shown = annotate(picture, [replace(READOUT, label=f"policy number {i} " * i) for i in range(1, tiles + 1)])
    assert (picture == 200).all()
    assert (shown[height // 2 :] == 200).all()
    for tile in np.split(shown, tiles, axis=1):
        dark = (tile < 120).all(axis=2)
        assert dark[: height // 3].sum() > 0.2 * dark[: height // 3].size
        assert not dark[:, -2:].any(), "a panel reaches into the next tile"
        assert (tile.min(axis=2) > 230).sum() > 100, "no letters"


@pytest.mark.parametrize("ending", ["gif", "webp"])
def test_clips_play_by_themselves(tmp_path, ending):
    path = tmp_path / f"walk.{ending}"
    with film(path, fps=12.5, size=(64, 48)) as add:
        for i in range(5):
            add(np.full((48, 64, 3), 40 * i, dtype=np.uint8))
    with Image.open(path) as read:
        read.seek(1)
        read.load()
        assert (read.size, read.n_frames, read.info["loop"], read.info["duration"]) == ((64, 48), 5, 0, 80)


@pytest.mark.slow
def test_film_of_two_policies(policy, tmp_path):
    import imageio.v3 as imageio

    before = os.environ.get("MUJOCO_GL")
    try:
        choose_renderer()
    except UserError as error:
        pytest.skip(str(error))
    finally:
        os.environ.pop("MUJOCO_GL") if before is None else os.environ.update(MUJOCO_GL=before)
    # In a process of its own: MuJoCo chooses the renderer when it is imported.
    command = [sys.executable, "-m", "gaitgauge.cli.main", "play", str(policy), "pretrained", "--terrain", "wave"]
    command += ["--out", str(tmp_path / "walk.mp4"), "--gif", str(tmp_path / "walk.gif"), "--seconds", "0.2"]
    done = subprocess.run([*command, "--command", "4", "0", "0"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("clips the command: forward 4 m/s") == 2
    frames = imageio.imread(tmp_path / "walk.mp4", plugin="FFMPEG")
    count, height, width, _ = frames.shape
    assert (count, width / height) == (5, pytest.approx(8 / 3))
    for tile in np.split(frames[2], 2, axis=1):
        middle, sky = tile[height // 2 : -height // 6, width // 8 : -width // 8], tile[: height // 8, -width // 8 :]
        assert middle.std() > 20, "no robot in the middle"
        assert sky[..., 2].mean() > sky[..., 0].mean() + 20, "no blue sky"
    assert imageio.imread(tmp_path / "walk.gif").shape == (3, 240, 640, 3)
