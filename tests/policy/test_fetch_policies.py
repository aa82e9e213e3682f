"""Policies that left the tree come back from the history, each with its SHA-256."""

import hashlib
import subprocess
import zipfile

import pytest
from fetch_policies import ROOT, fetch, listed
from gaitgauge.policy.loading import load_policy


def test_every_policy_of_the_sweeps_is_named_once():
    names = [each["name"] for each in listed()]
    assert len(names) == len(set(names)) == 16
    assert {each["path"].split("/")[3] for each in listed() if each["path"].startswith("docs")} == {
        "baselines",
        "from-nothing",
        "more-level-ground",
    }
    assert [each["name"] for each in listed("trainable-*")] == [f"trainable-{n}" for n in ("anymal_c", "go1", "go2")]


@pytest.mark.parametrize("entry", listed("*seed-1"), ids=lambda entry: entry["name"])
def test_a_card_of_a_sweep_is_of_the_policy_that_is_named(entry):
    _, _, _, sweep, *inside = entry["path"].split("/")
    with zipfile.ZipFile(ROOT / "docs" / "data" / "sweeps" / f"{sweep}.zip") as archive:
        card = archive.read("/".join(inside).replace("policy.gauge.pt", "results.json")).decode()
    assert entry["sha256"] in card


def test_a_policy_is_fetched_and_plays(tmp_path):
    (entry,) = listed("baselines-HIM-seed-0")
    if subprocess.run(["git", "-C", str(ROOT), "cat-file", "-e", entry["commit"]], capture_output=True).returncode:
        pytest.skip("a clone without history")
    path = fetch(entry, tmp_path / "policies")
    assert path.name == "baselines-HIM-seed-0.gauge.pt" and path.stat().st_size == entry["bytes"]
    assert load_policy(path).contract.robot == "go2"
    with pytest.raises(SystemExit, match="has SHA-256"):
        fetch(entry | {"sha256": hashlib.sha256(b"").hexdigest()}, tmp_path)
    with pytest.raises(SystemExit, match="not in this clone's history"):
        fetch(entry | {"commit": "0" * 40}, tmp_path)
