"""Make the pictures of ``docs/media`` again: ``python docs/pictures.py [PART …]``; all parts without one.

Every picture comes from a command that a reader can type. Results are kept in ``build/pictures``, so that a second run plays
nothing. Needs Chromium (``apt-get install chromium``) and an off-screen renderer; a first run takes about half an hour on
two CPU cores. ``flow.svg`` and ``packages.svg`` are drawn by hand.
"""

from __future__ import annotations

import base64
import gzip
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
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

from PIL import Image
from rich.console import Console
from rich.terminal_theme import SVG_EXPORT_THEME
from rich.text import Text
from terrain_pictures import terrains
from websockets.sync.client import connect

ROOT = Path(__file__).resolve().parents[1]
MEDIA, WORK, CARDS = ROOT / "docs" / "media", ROOT / "build" / "pictures", ROOT / "docs" / "data" / "scorecards"
LARGEST = 250_000  # size of a picture [bytes]
CHROMIUM = ("--headless=new", "--no-sandbox", "--remote-debugging-port=0", "--hide-scrollbars", "about:blank")
WEBGL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
TERMINAL = (
    '<meta charset="utf-8"><style>body {{margin: 24px; background: white}} pre {{display: inline-block; padding: 20px; '
    "border-radius: 10px; font: 14px/1.35 'DejaVu Sans Mono'; color: {foreground}; background: {background}}}</style>"
    "<pre>{code}</pre>"
)


def gaitgauge(*words: str) -> list[str]:
    """Return the command line that runs ``gaitgauge`` with these words."""
    return [sys.executable, "-c", "from gaitgauge.cli.main import main; main()", *words]


def run(name: str, *words: str) -> str:
    """Run a command once, in ``build/pictures``; return what a terminal shows at its end, with its colours."""
    shown = WORK / f"{name}.ansi"
    if not shown.exists():
        WORK.mkdir(parents=True, exist_ok=True)
        colours = os.environ | {"FORCE_COLOR": "1", "TERM": "xterm-256color", "COLUMNS": "100"}
        done = subprocess.run(gaitgauge(*words), cwd=WORK, env=colours, stdout=subprocess.PIPE, text=True, check=False)
        # A progress bar draws over itself; what stays begins behind it. Codes of colours end in m and stay.
        shown.write_text(re.sub(r"\x1b\[[0-9;?]*[A-Za-ln-z]|\r", "", done.stdout.rpartition("\x1b[?25h")[2]))
    return shown.read_text(encoding="utf-8")


def save(image: Image.Image, name: str) -> None:
    """Write a picture with as many colours as fit into ``LARGEST``; the octree keeps those of a few dots apart."""
    for colours in (256, 128, 64, 32):
        image.convert("RGB").quantize(colours, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(
            MEDIA / name, optimize=True
        )
        if (MEDIA / name).stat().st_size <= LARGEST:
            break
    print(f"{name}: {image.width} x {image.height}, {(MEDIA / name).stat().st_size / 1000:.0f} kB, {colours} colours")


def shoot(address: str, file: str, *, width: int = 1150, height: int = 900, at: str = "", wait: float = 1.0) -> None:
    """Write a picture of a page's top, or of a part of it, about 1,300 pixels wide.

    Args:
        width, height: of the window, and at most of the picture [CSS pixels].
        at: the heading of a section, or a CSS selector.
        wait: for what moves or loads [s].
    """
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        words = [program, f"--user-data-dir={profile}", *WEBGL, *CHROMIUM]
        chromium = subprocess.Popen(words, stderr=subprocess.DEVNULL)
        port = Path(profile) / "DevToolsActivePort"
        while not port.exists() or not port.read_text():
            time.sleep(0.1)
        with urllib.request.urlopen(f"http://127.0.0.1:{port.read_text().split()[0]}/json") as pages:
            tab = next(page["webSocketDebuggerUrl"] for page in json.load(pages) if page["type"] == "page")
        numbers = itertools.count(1)
        with connect(tab, max_size=None) as socket:

            def call(method: str, **parameters: Any) -> Any:
                number = next(numbers)
                socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
                while (answer := json.loads(socket.recv(timeout=120))).get("id") != number:
                    pass
                return answer["result"]

            size = {"width": width, "height": height, "deviceScaleFactor": 1300 / width, "mobile": False}
            call("Emulation.setDeviceMetricsOverride", **size)
            call("Page.navigate", url=address)
            time.sleep(wait)
            notice = "document.querySelectorAll('[role=alert]').forEach(e => e.remove());"  # rendering without a GPU
            section = f"[...document.querySelectorAll('section')].find(s => s.innerText.trim().startsWith({at!r}))"
            found = f"({section} ?? document.querySelector({at!r})).getBoundingClientRect()"
            script = f"(r => [r.x - 12, r.y - 8 + scrollY, r.width + 24, r.height + 16])({found})"
            script = notice + (script if at else f"[0, 0, {width}, {height}]")
            x, y, wide, high = call("Runtime.evaluate", expression=script, returnByValue=True)["result"]["value"]
            clip = {"x": max(x, 0), "y": y, "width": min(wide, width), "height": min(high, height), "scale": 1}
            data = call("Page.captureScreenshot", clip=clip, captureBeyondViewport=True)["data"]
        chromium.terminate()
        chromium.wait()
    save(Image.open(BytesIO(base64.b64decode(data))), file)


def terminal(file: str, command: str, text: str) -> None:
    """Write a picture of a terminal with a command and its output."""
    console = Console(record=True, width=100, file=StringIO(), force_terminal=True, color_system="truecolor")
    console.print(Text(f"$ {command}", style="bold green"))
    console.print(Text.from_ansi(text.strip("\n")))
    shown = WORK / f"{file}.html"
    shown.write_text(console.export_html(theme=SVG_EXPORT_THEME, code_format=TERMINAL, inline_styles=True))
    shoot(shown.as_uri(), file, width=960, height=1600, at="pre")


def viewer() -> None:
    """Shoot the browser's viewer while a policy climbs stairs."""
    words = ("play", "pretrained", "--viewer", "viser", "--port", "8093", "--terrain", "stairs_fd", "--level", "6")
    playing = subprocess.Popen(gaitgauge(*words), stdout=subprocess.DEVNULL)
    time.sleep(25)
    shoot("http://127.0.0.1:8093", "viewer.png", width=1300, height=760, wait=45)
    playing.terminate()
    playing.wait()


def terminals() -> None:
    """Show the examination of a machine, and of a robot with the picture that the check writes."""
    private = re.compile(
        r" /|/site-packages|inaries/|free disk|│ 0\.\d +│|imageio-ff|Python  "
    )  # paths of this machine
    text = "\n".join(line for line in run("doctor", "doctor").splitlines()[1:] if not private.search(line))
    terminal("terminal-doctor.png", "gaitgauge doctor", text)
    text = run("robot", "robot", "check", "go2", "--picture", "go2-standing.png")
    terminal("robot-check.png", "gaitgauge robot check go2 --picture go2-standing.png", text)
    shown, standing = Image.open(MEDIA / "robot-check.png").convert("RGB"), Image.open(WORK / "go2-standing.png")
    standing = standing.resize((shown.width, shown.width * 9 // 16)).crop((0, 90, shown.width, 610))
    both = Image.new("RGB", (shown.width, shown.height + 520), "white")
    both.paste(shown)
    both.paste(standing, (0, shown.height))
    save(both, "robot-check.png")


def evaluation() -> None:
    """Show the evaluation of the quick start, the page of a whole one made from its score card, and a training curve."""
    from gaitgauge.gauge.report.page import write_report

    text = run("evaluate", "evaluate", "pretrained", "--suite", "demo", "--out", "demo")
    terminal("terminal-evaluate.png", "gaitgauge evaluate pretrained --suite demo --out demo", text)
    whole = WORK / "whole"
    whole.mkdir(exist_ok=True)
    (whole / "results.json").write_bytes(gzip.decompress((CARDS / "pretrained-robogauge-1.1.json.gz").read_bytes()))
    shutil.copy(WORK / "demo" / "clip.webp", whole / "clip.webp")
    report = write_report(whole).as_uri()
    shoot(report, "report.png", width=1000)
    shoot(report, "report-terrains.png", width=1280, at="Terrains")
    shoot(report, "level-search.png", width=1000, at="Level searches")
    shoot((ROOT / "docs/data/go2-moe-cts-curve.svg").as_uri(), "curve.png", width=800, at="svg")


def studies() -> None:
    """Shoot the pages of a comparison, a board, field trials, a look into the latent and a study of engines."""
    WORK.mkdir(parents=True, exist_ok=True)
    if not (WORK / "docs").exists():
        (WORK / "docs").symlink_to(ROOT / "docs")  # pages show the cards' paths as a reader types them
    cards = str(CARDS.relative_to(ROOT))
    a, b = f"{cards}/pretrained-gaitgauge-1.json.gz", f"{cards}/cts-gaitgauge-1.json.gz"
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
    for file, name, page, words in (
        ("comparison", "compare", "compare/comparison.html", ("compare", a, b)),
        ("board", "board", "board.html", ("board", cards)),
        ("trials", "trials", "trials/trial.html", ("trial", "pretrained")),
        ("latent", "latent", "latent/latent.html", ("latent", "pretrained", "--robots", "2")),
        ("consistency", "consistency", "consistency/consistency.html", ("consistency", "pretrained", *engines)),
        ("jury", "jury", "jury/jury.html", ("jury", "pretrained")),
    ):
        run(name, *words, "--out", "board.html" if name == "board" else name)
        shoot((WORK / page).as_uri(), f"{file}.png")


PARTS = {f.__name__: f for f in (terminals, evaluation, studies, viewer)}

if __name__ == "__main__":
    for part in sys.argv[1:] or [*PARTS, "terrains"]:
        if part == "terrains":
            for file, image in terrains().items():
                save(image, file)
        else:
            PARTS[part]()
