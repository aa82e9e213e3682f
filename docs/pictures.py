"""Make the pictures of ``docs/media`` again: ``python docs/pictures.py [NAME …]``; without a name all of them.

Every picture comes from a command that a reader can type. Results are kept in ``build/pictures``, so that a second run takes
no evaluation. Needs Chromium (``apt-get install chromium``) and an off-screen renderer; a first run takes about half an
hour on two CPU cores. ``flow.svg`` and ``packages.svg`` are drawn by hand.
"""

from __future__ import annotations

import base64
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console
from rich.terminal_theme import SVG_EXPORT_THEME
from rich.text import Text
from websockets.sync.client import ClientConnection, connect

ROOT = Path(__file__).resolve().parents[1]
MEDIA, WORK, CARDS = ROOT / "docs" / "media", ROOT / "build" / "pictures", ROOT / "docs" / "data" / "scorecards"
LARGEST = 250_000
"""Size of a picture [bytes]."""
TERRAINS = ("flat", "slope_fd", "slope_bd", "stairs_fd", "stairs_bd", "wave", "obstacle")
TILES = ("slope_up", "slope_down", "rough_slope", "stairs_up", "stairs_down", "wave", "obstacles", "bars", "flat")


def gaitgauge(*words: str) -> list[str]:
    """Return the command line that runs ``gaitgauge`` with these words."""
    return [sys.executable, "-c", "from gaitgauge.cli.main import main; main()", *words]


def run(name: str, *words: str, columns: int = 100) -> str:
    """Run a command once, in ``build/pictures``; return what a terminal shows at its end, with its colours."""
    shown = WORK / f"{name}.ansi"
    if not shown.exists():
        WORK.mkdir(parents=True, exist_ok=True)
        colours = os.environ | {"FORCE_COLOR": "1", "TERM": "xterm-256color", "COLUMNS": str(columns)}
        done = subprocess.run(gaitgauge(*words), cwd=WORK, env=colours, stdout=subprocess.PIPE, text=True, check=False)
        # A progress bar draws over itself; what stays begins behind it. Codes of colours end in m and stay.
        text = re.sub(r"\x1b\[[0-9;?]*[A-Za-ln-z]|\r", "", done.stdout.rpartition("\x1b[?25h")[2])
        shown.write_text(text, encoding="utf-8")
    return shown.read_text(encoding="utf-8")


class Browser:
    """A headless Chromium that is steered through its debugging port."""

    def __init__(self, socket: ClientConnection) -> None:
        """Steer the page behind a socket."""
        self._socket, self._number = socket, itertools.count(1)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the DevTools protocol and return its result."""
        number = next(self._number)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while (answer := json.loads(self._socket.recv(timeout=120))).get("id") != number:
            pass
        return dict(answer["result"])

    def evaluate(self, script: str) -> Any:
        """Return the value of an expression of JavaScript in the page."""
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def shoot(self, address: str, file: str, *, width: int, height: int, at: str = "", wait: float = 1.0) -> None:
        """Write a picture of a page's top, or of a part of it.

        Args:
            width, height: of the window, and at most of the picture [CSS pixels]; pictures are about 1,300 pixels wide.
            at: the heading of a section, or a CSS selector.
            wait: for what moves or loads [s].
        """
        size = {"width": width, "height": height, "deviceScaleFactor": 1300 / width, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.call("Page.navigate", url=address)
        time.sleep(wait)
        self.evaluate("document.querySelector('.mantine-Notifications-root')?.remove()")  # on rendering without a GPU
        if at:
            section = f"[...document.querySelectorAll('section')].find(s => s.innerText.trim().startsWith({at!r}))"
            found = f"({section} ?? document.querySelector({at!r})).getBoundingClientRect()"
            script = f"(r => [r.x - 12, r.y - 8 + scrollY, r.width + 24, r.height + 16])({found})"
            x, y, wide, high = self.evaluate(script)
        else:
            x, y, wide, high = 0, 0, width, height
        clip = {"x": max(x, 0), "y": y, "width": min(wide, width), "height": min(high, height), "scale": 1}
        data = self.call("Page.captureScreenshot", clip=clip, captureBeyondViewport=True)["data"]
        save(Image.open(BytesIO(base64.b64decode(data))), file)


@contextmanager
def browser() -> Iterator[Browser]:
    """Start Chromium, and end it."""
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        words = ["--headless=new", "--no-sandbox", "--remote-debugging-port=0", f"--user-data-dir={profile}"]
        words += ["--hide-scrollbars", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "about:blank"]
        chromium = subprocess.Popen([program, *words], stderr=subprocess.DEVNULL)
        port = Path(profile) / "DevToolsActivePort"
        while not port.exists() or not port.read_text():
            time.sleep(0.1)
        with urllib.request.urlopen(f"http://127.0.0.1:{port.read_text().split()[0]}/json") as pages:
            address = next(page["webSocketDebuggerUrl"] for page in json.load(pages) if page["type"] == "page")
        with connect(address, max_size=None) as socket:
            yield Browser(socket)
        chromium.terminate()
        chromium.wait()


def save(image: Image.Image, name: str) -> None:
    """Write a picture with as many colours as fit into ``LARGEST``."""
    for colours in (256, 128, 64, 32):
        image.convert("RGB").quantize(colours, dither=Image.Dither.FLOYDSTEINBERG).save(MEDIA / name, optimize=True)
        if (MEDIA / name).stat().st_size <= LARGEST:
            break
    print(f"{name}: {image.width} x {image.height}, {(MEDIA / name).stat().st_size / 1000:.0f} kB, {colours} colours")


def page(file: str, source: Path, *, width: int = 1000, height: int = 800, at: str = "") -> Callable[[], None]:
    """Return a function that shoots a page which a command has written."""

    def shoot() -> None:
        with browser() as window:
            window.shoot(source.as_uri(), file, width=width, height=height, at=at)

    return shoot


def terminal(file: str, command: str, text: str, *, lines: int = 60, columns: int = 100) -> None:
    """Write a picture of a terminal with a command and its output."""
    console = Console(
        record=True, width=columns, file=open(os.devnull, "w"), force_terminal=True, color_system="truecolor"
    )
    console.print(Text(f"$ {command}", style="bold green"))
    console.print(Text.from_ansi("\n".join(text.strip("\n").splitlines()[:lines])))
    html = (
        '<meta charset="utf-8"><style>body {{margin: 24px; background: white}} pre {{display: inline-block; margin: 0; '
        "padding: 18px 22px; border-radius: 10px; font: 14px/1.35 'DejaVu Sans Mono', monospace; color: {foreground}; "
        "background: {background}; box-shadow: 0 3px 12px #0004}}</style><pre>{code}</pre>"
    )
    shown = WORK / f"{file}.html"
    shown.write_text(
        console.export_html(theme=SVG_EXPORT_THEME, code_format=html, inline_styles=True), encoding="utf-8"
    )
    page(file, shown, width=columns * 9 + 60, height=1600, at="pre")()


def viewer() -> None:
    """Shoot the browser's viewer while a policy climbs stairs."""
    words = ("play", "pretrained", "--viewer", "viser", "--port", "8093", "--terrain", "stairs_fd", "--level", "6")
    playing = subprocess.Popen(gaitgauge(*words), stdout=subprocess.DEVNULL)
    try:
        time.sleep(25)
        with browser() as window:
            window.shoot("http://127.0.0.1:8093", "viewer.png", width=1300, height=760, wait=25)
    finally:
        playing.terminate()
        playing.wait()


def drawn(title: str, terrain: Any, size: tuple[int, int], *, at: float, down: float, far: float) -> Image.Image:
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
    from gaitgauge.robots.body_plan import default_pose

    robot = load_robot("go2")
    quality = replace(quality, size=(2 * size[0], 2 * size[1]), field_nodes=256, shadow_reach=9.0, shadow_pixels=2048)
    _, data = default_pose(robot)
    pose, position = next(iter(terrain.spawns.values())), data.qpos[: 7 + robot.num_joints].copy()
    position[:7] = (*pose.position, np.cos(pose.yaw / 2), 0, 0, np.sin(pose.yaw / 2))
    position[2] += robot.stand_height
    model = visual_model(robot, terrain, quality)
    model.vis.map.znear = 0.3  # faces that lie nearly in each other would flicker
    model.geom("floor").pos[2] -= 0.02
    for i in range(model.ngeom):
        if "slope" in terrain.name and model.geom(i).name.startswith("step_"):
            model.geom(i).rgba[:] = model.geom("step_0").rgba
    if "slope" in terrain.name:  # shadows of flat faces that touch each other flicker too
        model.light_castshadow[:] = False
    picture = Picture(Tile(model=model, heading=0.0, leg_length=far), size=quality.size)
    picture._camera.elevation = -down
    image = Image.fromarray(picture.draw(position, np.array([at, 0.0, 0.3])))
    picture.close()
    image = image.resize(size, Image.Resampling.LANCZOS)
    font = ImageFont.truetype("DejaVuSans.ttf", 17)
    ImageDraw.Draw(image).text((10, 8), title, "black", font, stroke_width=3, stroke_fill="white")
    return image


def sheet(file: str, images: list[Image.Image], columns: int) -> None:
    """Write pictures of one size side by side."""
    wide, high = images[0].size
    paper = Image.new("RGB", (columns * wide + 4 * (columns - 1), -(-len(images) // columns) * (high + 4) - 4), "white")
    for i, image in enumerate(images):
        paper.paste(image, (i % columns * (wide + 4), i // columns * (high + 4)))
    save(paper, file)


def terrains() -> None:
    """Draw the gauge's terrains at levels 1, 5 and 10."""
    from gaitgauge.terrains import make_terrain

    size, kinds = (360, 190), TERRAINS[1:]
    levelled = [
        drawn(f"{n}, level {i}", make_terrain(n, i), size, at=5.0, down=24, far=2.6) for n in kinds for i in (1, 5, 10)
    ]
    flat = [drawn(text, make_terrain("flat"), size, at=0.0, down=24, far=1.5) for text in ("flat: no levels", "", "")]
    sheet("terrains.png", [*flat, *levelled], 3)


def training_terrains() -> None:
    """Draw the nine kinds of training tiles at level 8 of 0 to 11."""
    from gaitgauge.terrains.training_tiles import make_tile

    shown = [drawn(n, make_tile(n, 8), (430, 270), at=0.0, down=38, far=2.2) for n in TILES]
    sheet("terrains-training.png", shown, 3)


def robot_check() -> None:
    """Show what the check of a robot prints, and the picture that it writes."""
    text = run("robot", "robot", "check", "go2", "--picture", "go2-standing.png")
    terminal("robot-check.png", "gaitgauge robot check go2", text)
    shown, standing = Image.open(MEDIA / "robot-check.png").convert("RGB"), Image.open(WORK / "go2-standing.png")
    standing = standing.convert("RGB").resize((shown.width, shown.width * standing.height // standing.width))
    cut = standing.crop((0, standing.height // 8, standing.width, standing.height * 7 // 8))
    both = Image.new("RGB", (shown.width, shown.height + cut.height), "white")
    both.paste(shown, (0, 0))
    both.paste(cut, (0, shown.height))
    save(both, "robot-check.png")


def studies() -> None:
    """Shoot the pages of a comparison, a board, field trials, a look into the latent and a study of engines."""
    a, b = CARDS / "pretrained-gaitgauge-1.json", CARDS / "cts-gaitgauge-1.json"
    run("compare", "compare", str(a), str(b), "--out", "compare")
    run("board", "board", str(CARDS), "--out", "board.html")
    run("trials", "trial", "pretrained", "--out", "trials")
    run("latent", "latent", "pretrained", "--robots", "2", "--out", "latent")
    engines = (
        "--backends",
        "mujoco,mujoco@foot_condim=3",
        "--terrain",
        "flat",
        "--terrain",
        "stairs_fd",
        "--seeds",
        "2",
    )
    run("consistency", "consistency", "pretrained", *engines, "--out", "consistency")
    page("comparison.png", WORK / "compare" / "comparison.html", width=1150, height=900)()
    page("board.png", WORK / "board.html", height=760)()
    page("trials.png", WORK / "trials" / "trial.html", width=1250, height=900)()
    page("latent.png", WORK / "latent" / "latent.html", height=900)()
    page("consistency.png", WORK / "consistency" / "consistency.html", width=1150, height=900)()


def evaluation() -> None:
    """Show the evaluation of the quick start: terminal and page."""
    text = run("evaluate", "evaluate", "pretrained", "--suite", "demo", "--out", "demo")
    terminal("terminal-evaluate.png", "gaitgauge evaluate pretrained --suite demo --out demo", text)
    # The page of a whole evaluation from its score card, with the film of the same policy.
    from gaitgauge.gauge.report import write_report

    whole = WORK / "whole"
    whole.mkdir(exist_ok=True)
    shutil.copy(CARDS / "pretrained-gaitgauge-1.json", whole / "results.json")
    shutil.copy(WORK / "demo" / "clip.webp", whole / "clip.webp")
    report = write_report(whole)
    page("report.png", report, height=900)()
    page("report-terrains.png", report, width=1280, height=900, at="Terrains")()
    page("level-search.png", report, height=900, at="Level searches")()


def doctor() -> None:
    """Show the examination of a machine."""
    private = re.compile(
        r" /|/site-packages|inaries/|free disk|│ 0\.\d +│|imageio-ff|Python  "
    )  # paths of this machine
    text = "\n".join(line for line in run("doctor", "doctor").splitlines()[1:] if not private.search(line))
    terminal("terminal-doctor.png", "gaitgauge doctor", text)


def curve() -> None:
    """Turn the training curve of the shipped policy into a picture."""
    page("curve.png", ROOT / "docs" / "data" / "go2-moe-cts-curve.svg", width=800, height=430, at="svg")()


def main() -> None:
    """Make the pictures that are named, or all."""
    made = {
        "terrains": terrains,
        "terrains-training": training_terrains,
        "evaluation": evaluation,
        "doctor": doctor,
        "curve": curve,
        "studies": studies,
        "viewer": viewer,
        "robot-check": robot_check,
    }
    for name in sys.argv[1:] or made:
        made[name]()


if __name__ == "__main__":
    main()
