"""What a wheel holds, every package and every data file of the repository, and what it asks for."""

from __future__ import annotations

import ast
import re
import runpy
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import packages_distributions

import pytest
from product_sources import PACKAGES, ROOT, import_statements

PARTS = {
    "google": "protobuf",
    "pydantic_core": "pydantic",
    "pygame": "pygame-ce",
    "pydrake": "drake",
    "mcap_ros2": "mcap-ros2-support",
}
"""Who provides a module, where that is not told by what is installed."""


def project() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def distribution(requirement: str) -> str:
    """The name in a requirement, spelled in one way."""
    return re.sub(r"[-_.]+", "-", re.split(r"[\[<>=~! ]", requirement)[0]).lower()


def imported() -> dict[str, str]:
    """What the package imports of others, and where: distributions."""
    known, found = packages_distributions(), {}
    for file, statements in import_statements().items():
        for node in statements:
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and not node.level and node.module:
                names = [node.module]
            for module in {name.partition(".")[0] for name in names} - sys.stdlib_module_names - {"gaitgauge"}:
                found[distribution(PARTS.get(module) or known.get(module, [module])[0])] = str(file)
    return found


def test_the_checkout_is_no_package_of_tests(request):
    """Pytest would import its ``__init__.py`` by the folder's name, which a folder with a dash in its name does not survive."""
    assert not [node for node in request.node.listchain() if isinstance(node, pytest.Package)]


def test_what_is_imported_is_asked_for_and_nothing_else():
    listed, extras = project()["project"]["dependencies"], project()["project"]["optional-dependencies"]
    asked = {distribution(text) for text in listed}
    optional = {
        distribution(text) for name in ("gamepad", "cluster", "drake", "physx", "mcap") for text in extras[name]
    }
    found = imported()
    assert {name: file for name, file in found.items() if name not in asked | optional} == {}
    assert asked - found.keys() == set()


def test_what_is_asked_for_is_pinned():
    pinned = {distribution(line) for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()}
    listed, extras = project()["project"]["dependencies"], project()["project"]["optional-dependencies"]
    named = {distribution(text) for text in (*listed, *extras["dev"], *extras["docs"])}
    assert named - pinned == set()


def test_every_folder_with_code_is_an_installed_package(monkeypatch):
    """setup.py finds the packages; a folder without ``__init__.py`` would stay out of the wheel."""
    named: dict = {}
    monkeypatch.setattr("setuptools.setup", named.update)
    monkeypatch.chdir(ROOT)
    runpy.run_path("setup.py")
    found = {"gaitgauge"}
    for top in PACKAGES:
        for file in (ROOT / top).rglob("*.py"):
            found.add(".".join(("gaitgauge", *file.parent.relative_to(ROOT).parts)))
    assert set(named["packages"]) == found


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
        ["git", "ls-files", *PACKAGES], cwd=ROOT, check=True, capture_output=True, text=True
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
