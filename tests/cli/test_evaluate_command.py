"""The whole command on a suite of a few seconds."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from gaitgauge.cli.evaluate import doubtful_assumptions, print_results
from gaitgauge.gauge.result import Health, read_result
from gaitgauge.gauge.store import StoreError
from gaitgauge.gauge.suite import load_suite
from tiny_suite import SUITE


@pytest.fixture
def tiny(tmp_path) -> Path:
    path = tmp_path / "tiny.toml"
    path.write_text(SUITE)
    return path


def reproducible(folder: Path) -> tuple[dict, bytes]:
    """What must be the same whenever the same command runs."""
    results = json.loads((folder / "results.json").read_text())
    del results["provenance"]
    return results, (folder / "episodes.csv").read_bytes()


def test_a_part_is_called_one_and_what_went_wrong_is_said_in_words(run, tmp_path, policy, tiny):
    part = ("--terrain", "flat", "--friction", 0.6, "--seed", 0)
    done = run("evaluate", policy, "--suite", tiny, *part, "--out", tmp_path / "run", "--threads", 1)
    assert done.exit_code == 0, done.output
    printed = " ".join(done.stdout.split())
    assert "score of a part (1 of 2 terrains, 1 of 2 frictions" in printed and "(no interval: one seed)" in printed
    result = read_result(tmp_path / "run", StoreError)
    said = []
    console = SimpleNamespace(print=lambda *_: None, say=lambda text: said.append(str(text)))
    print_results(console, replace(result, health=Health(episodes=3, falls=2, self_contact=0.0429)))
    assert "in 3 quality episodes: 2 falls, parts of the robot touch each other in 4.3 % of the samples" in said
    print_results(console, replace(result, health=Health(episodes=1, falls=1, diverged=1)))
    assert "in 1 quality episode: 1 fall, 1 diverged" in said
    said.clear()
    print_results(console, replace(result, health=Health(episodes=3)))
    assert not any("quality episodes" in line for line in said)


def test_results_and_their_reproducibility(run, refused, tmp_path, policy, tiny):
    tiny.write_text(SUITE.replace("[0.6, 0.9]", "[0.6]"))
    command = ("evaluate", policy, "--suite", tiny, "--out")
    done = run(*command, tmp_path / "first", "--threads", 1)
    assert done.exit_code == 0, done.output
    assert "score" in done.stdout
    assert str(tmp_path / "first" / "results.json") in done.stdout.replace("\n", "")
    results = json.loads((tmp_path / "first" / "results.json").read_text())
    assert results["suite"]["name"] == "tiny"
    assert results["coverage"]["kind"] == "complete"
    assert "tiny 1.0.0, complete" in done.stdout
    assert set(results["terrains"]) == {"flat", "slope_fd"}
    assert len(results["environments"]) == 2
    assert 0.0 <= results["score"] <= 1.0
    assert len(results["metrics"]) == 9
    assert results["policy"]["contract_hash"]
    assert results["provenance"]["versions"]["mujoco"]
    assert "<html" in (tmp_path / "first" / "report.html").read_text()

    assert "--resume" in refused(*command, tmp_path / "first")
    assert json.loads((tmp_path / "first" / "results.json").read_text()) == results

    again = run(*command, tmp_path / "second", "--threads", 2, "--json")
    assert again.exit_code == 0, again.output
    printed = json.loads(again.stdout)
    del printed["provenance"]
    assert reproducible(tmp_path / "second") == reproducible(tmp_path / "first")
    assert printed == reproducible(tmp_path / "first")[0]

    episodes = sorted((tmp_path / "second" / "episodes").glob("*.npz"))
    kept, lost = episodes[::2], episodes[1::2]
    for path in [*lost, tmp_path / "second" / "results.json", tmp_path / "second" / "episodes.csv"]:
        path.unlink()
    before = {path: path.stat().st_mtime_ns for path in kept}
    resumed = run(*command, tmp_path / "second", "--resume")
    assert resumed.exit_code == 0, resumed.output
    assert reproducible(tmp_path / "second") == reproducible(tmp_path / "first")
    assert {path: path.stat().st_mtime_ns for path in kept} == before

    other = refused(*command, tmp_path / "first", "--seed", 5, "--resume")
    assert "another run" in other
    assert json.loads((tmp_path / "first" / "results.json").read_text()) == results


def test_assumptions_are_repeated_where_the_robot_falls_at_once(tmp_path, contract):
    suite = load_suite("gaitgauge-1")
    guessed = replace(contract, provenance={"assumed": "5 frames of the standard observation"})
    period, longest = contract.control_period, suite.settling.longest
    at_once = round((longest + 0.5) / period)

    def said(contract, *rows):
        lines = [line for falls, steps in rows for line in (f"all,{falls},{steps}", "max_velocity +x,,")]
        (tmp_path / "episodes.csv").write_text("\n".join(["command,falls,control_steps", *lines]))
        return doubtful_assumptions(contract, suite, tmp_path)

    falling, walking = (1, at_once), (0, 4000)
    assert "fell at once in 2 of 3 episodes" in said(guessed, falling, (3, 3 * at_once), walking)
    assert "taken for granted (5 frames" in said(guessed, falling)
    assert said(guessed, falling, walking) is None
    assert said(guessed, (1, 4000)) is None  # it fell late
    assert "gaitgauge doctor" in said(contract, falling)
    assert "taken for granted" not in said(contract, falling)  # nothing was guessed
    asked = doubtful_assumptions(guessed, suite, tmp_path, within=False)
    assert "commands more than the policy was made for" in asked and "doctor" not in asked
