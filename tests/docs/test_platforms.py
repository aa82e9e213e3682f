"""Platforms on the pages: which work, which were tried, and recipes for machines that are not one's own."""

import re
import shlex
from pathlib import Path

import gaitgauge
import pytest

ROOT = Path(gaitgauge.__path__[0]).resolve()
INSTALL = (ROOT / "docs/start/install.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("platform", ["Linux", "macOS", "Windows", "Docker", "Apptainer"])
def test_every_platform_is_in_the_table_with_its_state(platform):
    """No page named Windows or macOS."""
    rows = [line for line in INSTALL.splitlines() if line.startswith("|") and platform in line]
    assert any(re.search(r"\| (tried|not run)[^|]*\|$", row) for row in rows), rows


def test_docker_leaves_files_to_the_user():
    """Files in the mounted folder belonged to root; a user without a home in the image stopped libraries."""
    runs = [line for line in INSTALL.splitlines() if line.startswith("docker run")]
    assert runs and all("--user" in shlex.split(line) for line in runs)
    assert "ENV HOME=/tmp USER=gaitgauge" in (ROOT / "Dockerfile").read_text(encoding="utf-8")


def test_the_address_of_the_clone_is_explained_where_it_stands():
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        text = page.read_text(encoding="utf-8")
        cloned = re.findall(r"git clone (\S+)", text)
        assert set(cloned) <= {"REPOSITORY"}, page
    assert "`REPOSITORY` stands for" in " ".join(INSTALL.split())


def test_there_is_a_recipe_without_a_network():
    collected, installed = (
        next(shlex.split(line, comments=True) for line in INSTALL.splitlines() if line.startswith(start))
        for start in ("pip download", "pip install --no-index")
    )
    assert collected[collected.index("--dest") + 1] == installed[installed.index("--find-links") + 1]


def test_slurm_ends_a_job_with_the_signal_that_writes_a_checkpoint():
    from gaitgauge.training.run.stopping import STOP_SIGNALS

    guide = (ROOT / "docs/guides/cluster.md").read_text(encoding="utf-8")
    name = re.search(r"#SBATCH --signal=(\w+)@\d+", guide)[1]
    assert f"SIG{name}" in {signal.name for signal in STOP_SIGNALS}
