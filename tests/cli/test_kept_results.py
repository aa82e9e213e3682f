"""What a command keeps and takes: results of another command are never written over, a run directory is its checkpoint."""

import json
import sys
from pathlib import Path

import pytest
from gaitgauge.cli.errors import UserError
from gaitgauge.cli.studies import keep_others, study_folder
from gaitgauge.policy.finding import latest_checkpoint


def result(folder: Path, command: str) -> None:
    folder.mkdir(parents=True)
    (folder / "identify.json").write_text(json.dumps({"provenance": {"command": command}}))


@pytest.mark.parametrize(
    ("command", "kept"),
    [
        ("gaitgauge identify mon/chirp.npz", True),
        ("gaitgauge identify tue/chirp.npz --draws 9", True),
        ("/usr/bin/gaitgauge identify tue/chirp.npz --threads 2 --json", False),
        ("gaitgauge identify tue/chirp.npz --out=results/identify-chirp", False),
    ],
)
def test_results_of_another_command_are_kept(tmp_path, monkeypatch, command, kept):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["gaitgauge", "identify", "tue/chirp.npz"])
    usual = Path("results/identify-chirp")
    result(usual, command)
    chosen = study_folder("identify", "identify.json", out=None, of="chirp")
    assert chosen == (usual.with_name("identify-chirp-2") if kept else usual)
    keep_others(chosen / "identify.json")
    if kept:
        with pytest.raises(UserError, match=f"'{usual}' holds the results of '{command}', which would be lost"):
            keep_others(usual / "identify.json")


@pytest.mark.parametrize("text", ["{", "[]", '{"provenance": 3}'])
def test_a_file_that_no_study_wrote_is_no_result(tmp_path, text):
    (tmp_path / "identify.json").write_text(text)
    keep_others(tmp_path / "identify.json")


def test_studies_take_a_run_directory_for_its_checkpoint(refused, trained):
    """As every command that takes a policy does."""
    assert "unknown backend 'nope'" in refused("consistency", trained, "--backends", "mujoco,nope")
    said = refused("compare", trained, latest_checkpoint(trained), "--terrain", "flat", "--seed", 0, "--seed", 1)
    assert "is a folder" not in said and str(latest_checkpoint(trained)) in said
