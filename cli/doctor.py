"""Examine this machine: packages, devices, drawing, room, and what to do about what is missing (``gaitgauge doctor``).

GPU drivers and OpenGL, which could hang or kill the process, are tried in a child process.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, metadata, requires, version
from importlib.util import find_spec
from pathlib import Path

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from rich.text import Text

from ..files.choices import cores
from . import picture
from .console import Terminal, make_table, print_json
from .errors import UserError
from .probe import ask
from .requests import DoctorRequest

OK, WARNING, PROBLEM = "ok", "warning", "problem"
_STYLES = {OK: "green", WARNING: "yellow", PROBLEM: "bold red"}
_FREE_DISK = 5.0
"""Free space below which a training run with its checkpoints may not fit [GB]."""
_FREE_MEMORY = 4.0
"""Free memory below which the engines may not fit [GB]."""


@dataclass(frozen=True)
class Finding:
    """Describe one row of the table."""

    what: str
    status: str
    """``ok``, ``warning`` (something optional is missing) or ``problem`` (the project does not work)."""
    found: str
    advice: str = ""
    """Advice, where the status is not ok."""


def run_doctor(request: DoctorRequest) -> bool:
    """Examine this machine, or a policy as ``diagnosis.examine_policy`` does; return whether nothing is wrong.

    Raises:
        UserError: an option is for a policy, and none is named.
    """
    if request.policy is not None:
        from .diagnosis import examine_policy

        return examine_policy(request.policy, request)
    for name in ("contract", "robot", "out", "seconds", "trust", "threads"):
        if getattr(request, name):
            again = f"gaitgauge doctor POLICY --{name} …"
            raise UserError(f"--{name} is for the examination of a policy; name one: {again}")
    return examine(json_output=request.json_output)


def examine(*, json_output: bool = False) -> bool:
    """Print a table of all checks, or JSON; return False if there is a problem."""
    console = Terminal(stderr=json_output)
    table = make_table("gaitgauge doctor", "check", "status", "found", "what to do")
    findings = []
    with console.status("checking …"):
        for check in CHECKS:
            findings += list(check())
    if json_output:
        print_json([asdict(each) for each in findings])
        return all(each.status != PROBLEM for each in findings)
    for each in findings:
        table.add_row(each.what, Text(each.status, _STYLES[each.status]), each.found, each.advice)
    console.print(table)
    counts = {s: sum(f.status == s for f in findings) for s in (WARNING, PROBLEM)}
    words = [f"{n} {s}{'s' if n > 1 else ''}" for s, n in counts.items() if n]
    console.print(" and ".join(words) if words else "all is well")
    return counts[PROBLEM] == 0


def check_python() -> Iterator[Finding]:
    """Check the interpreter's version."""
    found = f"{platform.python_version()} in {sys.prefix}"
    try:
        wanted = SpecifierSet(metadata("gaitgauge")["Requires-Python"])
    except PackageNotFoundError:
        wanted = SpecifierSet()
    good = wanted.contains(platform.python_version(), prereleases=True)
    yield Finding("Python", OK, found) if good else Finding("Python", PROBLEM, found, f"use Python {wanted}")


def check_packages() -> Iterator[Finding]:
    """Check each package that the project declares against the range that it declares."""
    try:
        lines = requires("gaitgauge") or []
    except PackageNotFoundError:
        yield Finding("gaitgauge", PROBLEM, "not installed", "run 'make install', or pip install the project")
        return
    for line in lines:
        wanted = Requirement(line)
        if wanted.marker is not None and not wanted.marker.evaluate({"extra": ""}):
            continue
        try:
            present = version(wanted.name)
        except PackageNotFoundError:
            yield Finding(wanted.name, PROBLEM, "not installed", f"pip install '{line}'")
            continue
        if wanted.specifier.contains(present, prereleases=True):
            yield Finding(wanted.name, OK, present)
        else:
            found = f"{present}, but {wanted.specifier} is needed"
            yield Finding(wanted.name, PROBLEM, found, f"pip install '{line}'")


_TORCH_PROBE = """
import json, torch
gpus = []
if torch.cuda.is_available():
    for i in range(torch.cuda.device_count()):
        free, total = torch.cuda.mem_get_info(i)
        gpus.append([torch.cuda.get_device_name(i), free / 1e9, total / 1e9])
print(json.dumps([torch.version.cuda, gpus]))
"""


def check_gpu() -> Iterator[Finding]:
    """Check that torch can use a GPU, which training needs."""
    what, (answer, trouble) = "GPU (torch)", ask(_TORCH_PROBE)
    if trouble:
        yield Finding(what, PROBLEM, f"torch fails: {trouble}", "reinstall torch: make install")
        return
    built, gpus = answer
    driver = _driver()
    if gpus:
        text = "; ".join(f"{name}, {free:.0f} of {total:.0f} GB free" for name, free, total in gpus)
        yield Finding(what, OK, f"{text}; CUDA {built}, driver {driver or 'unknown'}")
    elif driver and not built:
        advice = "install a CUDA build of torch (pytorch.org, Get started), in the version that constraints.txt names"
        yield Finding(what, WARNING, f"driver {driver}, but torch is built without CUDA", advice)
    elif driver:
        advice = f"update the driver to one that CUDA {built} accepts; check with nvidia-smi"
        yield Finding(what, WARNING, f"driver {driver}, but torch finds no GPU", advice)
    else:
        yield Finding(what, WARNING, "none", "evaluating needs none; train on a machine with an NVIDIA GPU")


def _driver() -> str | None:
    """Return the version of the NVIDIA driver, None where there is none."""
    if (program := shutil.which("nvidia-smi")) is None:
        return None
    command = [program, "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.splitlines()[0].strip() if done.returncode == 0 and done.stdout.strip() else None


_WARP_PROBE = """
import json, warp
warp.config.log_level = warp.LOG_WARNING
warp.init()
print(json.dumps([str(d) for d in warp.get_devices()]))
"""


def check_warp() -> Iterator[Finding]:
    """Check the devices of Warp, on which the training engines run."""
    what, (answer, trouble) = "Warp devices", ask(_WARP_PROBE)
    if trouble:
        yield Finding(what, PROBLEM, f"Warp fails: {trouble}", "reinstall warp-lang: make install")
    elif any(d.startswith("cuda") for d in answer):
        yield Finding(what, OK, ", ".join(answer))
    else:
        advice = "mujoco-warp and newton run here with --device cpu only, slowly"
        yield Finding(what, WARNING, ", ".join(answer) or "none", advice)


_MUJOCO_PROBE = """
import json, mujoco, mujoco.batch
print(json.dumps([mujoco.__version__, mujoco.mj_versionString()]))
"""


def check_mujoco() -> Iterator[Finding]:
    """Check that MuJoCo loads, with the batched stepping that the gauge runs on."""
    what, (answer, trouble) = "MuJoCo engine", ask(_MUJOCO_PROBE)
    if trouble:
        yield Finding(what, PROBLEM, f"fails: {trouble}", "reinstall it: make install")
        return
    package, library = answer
    if package == library:
        yield Finding(what, OK, f"{library}, mujoco.batch, {cores()} CPU threads")
    else:
        advice = "another MuJoCo comes first: unset LD_LIBRARY_PATH and MUJOCO_PATH"
        yield Finding(what, PROBLEM, f"package {package} loads library {library}", advice)


def check_rendering() -> Iterator[Finding]:
    """Check MuJoCo's ways to render without a window; one is enough for videos."""
    works = {backend: not ask(picture.PROBE, MUJOCO_GL=backend)[1] for backend in picture.renderers()}
    for backend, good in works.items():
        what = f"rendering ({backend})"
        if good:
            yield Finding(what, OK, f"works (MUJOCO_GL={backend})")
        elif any(works.values()):
            yield Finding(what, OK, "does not work, but the other way does")
        else:
            advice = f"for videos, {picture.REMEDIES[backend]}"
            advice += ", with apt on Debian and Ubuntu" if sys.platform == "linux" else ""
            yield Finding(what, WARNING, "does not work", advice)


def check_display() -> Iterator[Finding]:
    """Check that a window can be opened."""
    own = "the system's own" if sys.platform in ("darwin", "win32") else None
    if not picture.window_possible():
        advice = f"{picture.WITH_MJPYTHON}, or watch in a browser with --viewer viser"
        yield Finding("display", WARNING, f"{own}; on macOS the viewer's window needs mjpython", advice)
    elif display := own or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        yield Finding("display", OK, display)
    else:
        advice = "only the viewer's window needs one; over ssh use ssh -X, or --viewer viser for a browser"
        yield Finding("display", WARNING, "neither DISPLAY nor WAYLAND_DISPLAY is set", advice)


def check_ffmpeg() -> Iterator[Finding]:
    """Check the program that encodes videos."""
    if find_spec("imageio_ffmpeg") is None:
        yield Finding("ffmpeg", PROBLEM, "imageio-ffmpeg is not installed", "pip install imageio-ffmpeg")
        return
    import imageio_ffmpeg

    try:
        program = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError:
        advice = "for videos, install ffmpeg, or set IMAGEIO_FFMPEG_EXE to it"
        yield Finding("ffmpeg", WARNING, "no program for this platform", advice)
        return
    yield Finding("ffmpeg", OK, program)


def check_room() -> Iterator[Finding]:
    """Check free disk and memory, and that the folders of runs and results can be written."""
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    advice = "" if free >= _FREE_DISK else f"make room: a training run may write up to {_FREE_DISK:g} GB"
    yield Finding("free disk", WARNING if advice else OK, f"{free:.1f} GB in {Path.cwd()}", advice)
    if (memory := _free_memory()) is not None:
        advice = "" if memory >= _FREE_MEMORY else f"close programs: the engines may want {_FREE_MEMORY:g} GB"
        yield Finding("free memory", WARNING if advice else OK, f"{memory:.1f} GB", advice)
    for name in ("logs", "results"):
        yield _writable(Path(name))


def _free_memory() -> float | None:
    """Return the memory that programs can still get [GB]; None where the system does not tell."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    kilobytes = [int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    return kilobytes[0] / 1e6 if kilobytes else None


def _writable(folder: Path) -> Finding:
    """Check that a folder, or the nearest one above it that exists, takes files."""
    there = folder.absolute()
    while not there.exists():
        there = there.parent
    what = f"folder {folder}/"
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        return Finding(what, PROBLEM, f"{there}: {error.strerror}", f"make {there} writable, or work in another folder")
    found = "writable" if there == folder.absolute() else "will be created when it is needed"
    return Finding(what, OK, found)


CHECKS: tuple[Callable[[], Iterator[Finding]], ...] = (
    check_python, check_packages, check_gpu, check_warp, check_mujoco,
    check_rendering, check_display, check_ffmpeg, check_room,
)  # fmt: skip
"""All checks, in the order of the table."""
