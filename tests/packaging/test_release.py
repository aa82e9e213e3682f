"""What is released: the source archive gives the same wheel, and nothing is published that was not tried."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import gaitgauge
import pytest
import typer
import yaml
from gaitgauge.cli.main import app

ROOT = Path(gaitgauge.__path__[0])
WORKFLOW = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text(encoding="utf-8"))
DOCKERFILE = (ROOT / "Dockerfile").read_text(encoding="utf-8")


def steps(job: str) -> str:
    """All shell lines of a job."""
    return "\n".join(step.get("run", "") for step in WORKFLOW["jobs"][job]["steps"])


def test_only_a_tag_whose_wheel_was_tried_is_published():
    publish = WORKFLOW["jobs"]["publish"]
    assert set(publish["needs"]) == {"build", "test"}
    assert "github.ref_type == 'tag'" in publish["if"]
    assert WORKFLOW["jobs"]["test"]["needs"] == "build"
    assert "version.py" in steps("build")
    assert WORKFLOW["permissions"] == {"contents": "read"}


@pytest.mark.parametrize("text", [steps("test"), DOCKERFILE], ids=["workflow", "Dockerfile"])
def test_commands_exist_with_these_options(text):
    lines = re.findall(r"(?:^|do )\s*gaitgauge ([^\n|;]+)", text, re.M)
    assert lines
    group = typer.main.get_command(app)
    for line in lines:
        name, *words = shlex.split(line.replace("$arch", "sm_90"))
        if not name.startswith("-"):
            group.commands[name].make_context(name, words)


def test_no_index_is_named_but_the_public_ones():
    for text in (DOCKERFILE, yaml.safe_dump(WORKFLOW)):
        assert set(re.findall(r"https?://([^/\s]+)", text)) <= {"download.pytorch.org"}


def test_the_image_takes_torch_of_the_pinned_version_for_both_devices():
    assert "grep '^torch==' /opt/constraints.txt" in DOCKERFILE
    assert re.findall(r"^ +(cpu|cuda)\) pip install \"\$torch\"", DOCKERFILE, re.M) == ["cpu", "cuda"]


@pytest.mark.slow
def test_the_source_archive_gives_the_same_wheel(tmp_path):
    tree = tmp_path / "tree"
    tree.mkdir()
    archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, check=True, capture_output=True).stdout
    subprocess.run(["tar", "-x", "-C", str(tree)], input=archive, check=True)

    def wheel(source: Path, out: Path) -> set[str]:
        command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(out), str(source)]
        subprocess.run(command, check=True, capture_output=True)
        (made,) = out.glob("*.whl")
        with zipfile.ZipFile(made) as opened:
            return set(opened.namelist())

    build = "import sys; from setuptools import build_meta; build_meta.build_sdist(sys.argv[1])"
    subprocess.run([sys.executable, "-c", build, str(tmp_path)], cwd=tree, check=True, capture_output=True)
    (source,) = tmp_path.glob("gaitgauge-*.tar.gz")
    with tarfile.open(source) as opened:
        assert not [name for name in opened.getnames() if "/tests/" in name and name.endswith(".pt")]
    assert wheel(source, tmp_path / "from-source") == wheel(tree, tmp_path / "from-tree")
