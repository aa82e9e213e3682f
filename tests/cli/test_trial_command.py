"""``gaitgauge trial`` with a policy that stands, where it takes a moment."""

import csv
import json
import shutil
from dataclasses import replace

import pytest
from filelock import FileLock
from gaitgauge.files.writing import LOCK
from gaitgauge.policy.native import save_policy

STANDS = """
name = "stands"
title = "Standing <b>still</b>"
friction = 0.6
repeats = 2

[[commands]]
seconds = 0.2
velocity = [0.0, 0.0, 0.0]

[success]
survive = true

[[reported]]
who = "Theirs"
successes = 5
trials = 20
"""
RUNS = """
name = "runs"
title = "Running"
friction = 0.6
repeats = 2

[[commands]]
seconds = 0.2
velocity = [3.0, 0.0, 0.0]

[success]
beyond = 0.5
"""


@pytest.fixture
def scenarios(tmp_path):
    (tmp_path / "stands.toml").write_text(STANDS)
    (tmp_path / "runs.toml").write_text(RUNS)
    (tmp_path / "never.toml").write_text(STANDS.replace("survive = true", "beyond = 0.1"))


def test_another_policy_s_trial_is_not_overwritten(run, refused, policy, contract, stored, scenarios, tmp_path):
    trial = ("--scenario", "stands.toml", "--threads", 1)
    for name in ("one/HIM/kept", "one/CTS/kept", "two/HIM/kept"):
        (tmp_path / name).mkdir(parents=True)
        shutil.copy(policy, tmp_path / name / "policy.gauge.pt")
    for name in ("HIM", "CTS"):
        assert run("trial", f"one/{name}/kept/policy.gauge.pt", *trial).exit_code == 0
    found = json.loads((tmp_path / "results" / "trial-HIM" / "trials.json").read_text())
    assert found["policies"][0]["label"] == "HIM"
    assert {p.name for p in (tmp_path / "results").iterdir()} == {"trial-HIM", "trial-CTS"}
    # the same again is wanted again, from elsewhere too
    assert run("trial", "two/HIM/kept/policy.gauge.pt", *trial).exit_code == 0
    other = replace(contract, provenance={"kind": "another"})
    save_policy(tmp_path / "one" / "HIM" / "kept" / "policy.gauge.pt", other, stored)
    before = (tmp_path / "results" / "trial-HIM" / "trials.json").read_text()
    assert run("trial", "one/HIM/kept/policy.gauge.pt", *trial).exit_code == 0
    assert {p.name for p in (tmp_path / "results").iterdir()} == {"trial-HIM", "trial-HIM-2", "trial-CTS"}
    sentence = refused("trial", "one/HIM/kept/policy.gauge.pt", *trial, "--out", "results/trial-HIM")
    assert "'results/trial-HIM' holds policy 'HIM' (two/HIM/kept/policy.gauge.pt)" in sentence
    assert "give another folder with --out" in sentence
    assert (tmp_path / "results" / "trial-HIM" / "trials.json").read_text() == before


def test_what_comes_of_it_is_printed_and_written(run, policy, scenarios, tmp_path):
    result = run(
        "trial", policy, "--scenario", "stands.toml", "--scenario", "runs.toml", "--threads", 1, "--out", "here"
    )
    assert result.exit_code == 0, result.output
    assert "2/2" in result.stdout and "0/2" in result.stdout and "Theirs: 5/20" in result.stdout
    assert (
        "standing in runs: told up to 3 m/s forward; made for up to 2 m/s forward, 1 m/s sideways and 2 rad/s"
        in result.stdout
    )
    found = json.loads((tmp_path / "here" / "trials.json").read_text())
    stands, runs = [entry["results"][0] for entry in found["scenarios"]]
    assert (stands["successes"], stands["trials"]) == (2, 2)
    # Wilson, all of two: (1 + z²/4 ± z²/4) / (1 + z²/2), z = 1.96
    assert stands["interval"] == pytest.approx([0.3424, 1.0], abs=1e-3)
    assert (runs["missed"], runs["fell"], runs["medians"]["reached"]) == (2, 0, None)
    rows = list(csv.DictReader((tmp_path / "here" / "trials.csv").open()))
    assert [(r["scenario"], r["seed"], r["outcome"]) for r in rows] == [
        ("stands", "0", "success"),
        ("stands", "1", "success"),
        ("runs", "0", "missed"),
        ("runs", "1", "missed"),
    ]
    page = (tmp_path / "here" / "trial.html").read_text()
    assert "Standing &lt;b&gt;still&lt;/b&gt;" in page and "<b>still" not in page and "Theirs: 5/20" in page
    # on phones rows are cards, whose values say what they are
    assert '<table class="trials stack">' in page and '<td data-label="came through"><strong>2/2' in page


def test_what_cannot_be_tried_is_said_and_the_others_go_on(run, policy, scenarios, tmp_path):
    (tmp_path / "empty").mkdir()
    words = ("--scenario", "stands.toml", "--scenario", "never.toml", "--repeats", 1, "--out", "here", "--json")
    result = run("trial", policy, "nobody.pt", "empty", "x" * 300, *words)
    assert result.exit_code == 1
    found = json.loads(result.stdout)
    assert [r["what"] for r in found["refused"]] == ["nobody.pt", "empty", "x" * 300, "never.toml"]
    assert "empty was left out: 'empty' is a folder; name a policy file in it" in result.stderr
    assert "success can never be decided" in result.stderr and "no policy file 'nobody.pt'" in result.stderr
    assert found["scenarios"][0]["results"][0]["successes"] == 1


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--scenario", "never.toml"), "so success can never be decided"),
        (("--scenario", "tile-stair"), "did you mean 'tile-stairs'"),
        (("--scenario", "stands.toml", "--backend", "bullet"), "unknown backend 'bullet'"),
        (("--scenario", "stands.toml", "--robot", "spot"), "spot"),
        (("--scenario", "stands.toml", "--out", "stands.toml"), "'stands.toml' is a file"),
    ],
)
def test_one_sentence_where_nothing_can_be_tried(refused, policy, scenarios, words, sentence):
    assert sentence in refused("trial", policy, *words)


@pytest.mark.parametrize("command", [("trial", "--scenario", "stands.toml"), ("latent", "--terrain", "flat")])
@pytest.mark.parametrize("out", ["/proc/here", "taken"])
def test_an_output_that_cannot_be_used_is_said_before_anything_is_played(
    refused, policy, scenarios, tmp_path, monkeypatch, command, out
):
    monkeypatch.setattr("gaitgauge.files.writing._PATIENCE", 0.1)
    monkeypatch.setattr("gaitgauge.studies.trials.trialling.load_policies", lambda *_, **__: pytest.fail("played"))
    monkeypatch.setattr("gaitgauge.studies.latent.study.load_policies", lambda *_, **__: pytest.fail("played"))
    (tmp_path / "taken").mkdir()
    with FileLock(tmp_path / "taken" / LOCK):
        sentence = refused(*command, policy, "--out", out)
    assert sentence.startswith(("cannot write '/proc/here'", "another process is writing to 'taken'"))


def test_what_is_refused_leaves_no_folder_but_one_that_was_there(refused, policy, tmp_path):
    (tmp_path / "mine").mkdir()
    for out in ("mine", "new"):
        assert "there is no scenario" in refused("trial", policy, "--scenario", "moon", "--out", out)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine", policy.name]
    assert not list((tmp_path / "mine").iterdir())
