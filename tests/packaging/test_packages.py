"""What a wheel holds: every package and every data file of the repository."""

from __future__ import annotations

import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import gaitgauge
import pytest

ROOT = Path(gaitgauge.__path__[0])
TOP = ("backends", "cli", "files", "gauge", "policy", "robots", "terrains", "training")


def settings() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]


def test_every_package_is_named_in_pyproject():
    found = {"gaitgauge"}
    for top in TOP:
        for file in (ROOT / top).rglob("*.py"):
            found.add(".".join(("gaitgauge", *file.parent.relative_to(ROOT).parts)))
    assert set(settings()["packages"]) == found


@pytest.mark.slow
def test_a_wheel_runs_from_any_folder(tmp_path):
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(tmp_path), str(ROOT)],
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("gaitgauge-*.whl")
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    tracked = subprocess.run(
        ["git", "ls-files", *TOP], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.split()
    missing = [name for name in tracked if not (site / "gaitgauge" / name).is_file()]
    assert not missing
    program = "import sys; sys.path.insert(0, sys.argv[1]); sys.argv[1:] = sys.argv[2:]\n"
    program += "import gaitgauge; assert gaitgauge.__path__[0].startswith(sys.path[0])\n"
    program += "from gaitgauge.cli.main import main; main()"
    ended = subprocess.run(
        [sys.executable, "-c", program, str(site), "evaluate", "pretrained", "--suite", "demo", "--terrain", "flat"],
        cwd=tmp_path,
        env={"PATH": "/usr/bin:/bin", "MUJOCO_GL": "off"},
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 0, ended.stderr[-2000:]
    assert (tmp_path / "results").is_dir()
