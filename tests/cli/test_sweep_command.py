"""``gaitgauge sweep``: one sentence for what is wrong, and a whole sweep of small trainings."""

import json
import re
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from gaitgauge.cli.sweep import print_sweep
from gaitgauge.training.sweep.jobs import Jobs, SweepOutcome
from small_run import SMALL
from tiny_suite import SUITE

ROOT = Path(__file__).parents[2]


def sweep(**entries: str) -> str:
    settings = json.dumps([*SMALL, "environment.num_envs=8", "training.run.iterations=2"])
    text = f'name = "toy"\ntitle = "A toy"\nbackend = "fake"\nsuite = "tiny.toml"\ntraining_suite = "none"\nsettings = {settings}\n'
    return text + "".join(f'[[entry]]\nname = "{name}"\n{entry}\n' for name, entry in entries.items())


@pytest.fixture
def tiny(tmp_path):
    (tmp_path / "tiny.toml").write_text(SUITE)
    return tmp_path


def test_a_file_that_is_not_there(refused):
    assert "'none.toml' does not exist" in refused("sweep", "none.toml")


def test_no_cluster(refused, tiny, monkeypatch):
    (tiny / "sweep.toml").write_text(sweep(one='task = "go2-cts"'))
    monkeypatch.setitem(sys.modules, "ray", None)
    assert "'gaitgauge[cluster]'" in refused("sweep", "sweep.toml", "--cluster", "auto", "--out", tiny / "out")
    assert not (tiny / "out").exists()


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_machine_without_a_gpu(refused, tiny):
    (tiny / "sweep.toml").write_text(sweep(one='task = "go2-cts"\nbackend = "mujoco-warp"'))
    sentence = refused("sweep", "sweep.toml")
    assert "wants a GPU and this machine has none; write device = " in sentence and "--" not in sentence


@pytest.mark.parametrize("field", ["suite", "training_suite"])
def test_a_suite_that_is_not_there_leaves_no_folder(refused, tiny, field):
    text = re.sub(rf"^{field} = .*", f'{field} = "quik"', sweep(one='task = "go2-cts"'), flags=re.MULTILINE)
    (tiny / "sweep.toml").write_text(text)
    told = refused("sweep", "sweep.toml", "--out", "out")
    assert (
        told.startswith(f"sweep file 'sweep.toml': {field}: there is no suite 'quik'") and not (tiny / "out").exists()
    )


def test_a_folder_to_keep_runs_in_that_cannot_be_is_told_at_once(refused, tiny):
    (tiny / "sweep.toml").write_text(sweep(one='task = "go2-cts"'))
    (tiny / "file").touch()
    assert "--keep is 'out', the sweep's own folder" in refused("sweep", "sweep.toml", "--out", "out", "--keep", "out")
    assert "choose another --keep" in refused("sweep", "sweep.toml", "--out", "out", "--keep", "file")
    (tiny / "kept" / ".lock").mkdir(parents=True)
    assert "--keep cannot be used: " in refused("sweep", "sweep.toml", "--out", "out", "--keep", "kept")
    note = tiny / "other" / "runs" / "one" / "seed-0" / "entry.json"
    note.parent.mkdir(parents=True)
    note.write_text('{"task": "go2-flat"}')
    assert "another folder with --keep" in refused("sweep", "sweep.toml", "--out", "out", "--keep", "other")


def test_entries_that_cannot_start_for_different_reasons_are_all_named(run, tiny):
    text = sweep(one='task = "go2-ctss"', two='task = "go2-cts"\nsettings = ["environment.num_env=3"]')
    (tiny / "sweep.toml").write_text(text)
    result = run("sweep", "sweep.toml", "--out", "out")
    told = [line for line in result.stderr.splitlines() if line.startswith("gaitgauge: ")]
    assert result.exit_code == 1 and len(told) == 2
    assert "'one' cannot start: unknown task" in told[0] and "'two' cannot start" in told[1] and "num_envs" in told[1]
    assert result.stdout == "" and not (tiny / "out" / "sweep.html").exists()


def test_a_folder_of_other_settings_keeps_its_tables(run, tmp_path):
    """Every entry is refused, each in a sentence of its own."""
    shutil.unpack_archive(ROOT / "docs/data/sweeps/baselines.zip", tmp_path / "out")
    text = (ROOT / "benchmarks/sweeps/baselines.toml").read_text().replace("iterations=1530", "iterations=1531")
    (tmp_path / "sweep.toml").write_text(text)
    (tmp_path / "out/sweep.html").write_text("of an earlier call")
    result = run("sweep", "sweep.toml", "--out", "out", "--report")
    told = [line for line in result.stderr.splitlines() if line.startswith("gaitgauge: ")]
    assert result.exit_code == 1 and len(told) == 4
    assert all("whose training.run.iterations is '1530', and the sweep's file says '1531'" in line for line in told)
    assert (tmp_path / "out/sweep.html").read_text() == "of an earlier call"


def test_an_entry_of_which_one_seed_cannot_start_is_told_so(run, tiny):
    (tiny / "sweep.toml").write_text("seeds = [0, 1]\n" + sweep(one='task = "go2-cts"'))
    note = tiny / "out" / "runs" / "one" / "seed-0" / "entry.json"
    note.parent.mkdir(parents=True)
    note.write_text("{")
    result = run("sweep", "sweep.toml", "--out", "out", "--report", "--json")
    assert (
        result.exit_code == 1 and "entry 'one' cannot start in full: " in result.stderr and str(note) in result.stderr
    )
    assert [row["seed"] for row in json.loads(result.stdout)["runs"]] == [1]


@pytest.mark.parametrize(("limit", "code"), [([], 1), (["--time", "1h"], 0)])
def test_a_training_that_was_stopped_from_outside_is_no_success(run, tiny, monkeypatch, limit, code):
    """With a time limit, being unfinished is expected."""
    (tiny / "sweep.toml").write_text(sweep(one='task = "go2-cts"'))
    stopped = SweepOutcome(failures={}, unfinished=["one, seed 0"], stopped=None)
    monkeypatch.setattr(Jobs, "work", lambda *_: stopped)
    result = run("sweep", "sweep.toml", "--out", "out", *limit)
    assert result.exit_code == code and "1 of 1 runs are not done; go on with:" in result.stderr


def test_a_run_that_is_damaged_leaves_a_table_and_the_others_are_kept(run, tmp_path):
    shutil.unpack_archive(ROOT / "docs/data/sweeps/baselines.zip", tmp_path / "all")
    shutil.copytree(tmp_path / "all", tmp_path / "out", ignore=shutil.ignore_patterns("HIM", "MoE*", "seed-1"))
    (tmp_path / "out/comparison.html").write_text("of an earlier call")
    damaged = tmp_path / "out/runs/CTS/seed-0/kept/results.json"
    damaged.write_text("{")
    file = ROOT / "benchmarks/sweeps/baselines.toml"
    result = run("sweep", file, "--out", "out", "--report", "--keep", "kept")
    assert result.exit_code == 1 and "0.6945" in result.stdout and "comparison" not in result.stdout
    (failure,) = [line for line in result.stderr.splitlines() if "CTS, seed 0" in line]
    assert failure.startswith("CTS, seed 0 failed: ") and str(damaged) in failure
    assert "kept 1 run; 1 of 8 are in" in result.stderr
    assert (tmp_path / "kept/runs/DreamWaQ/seed-0/kept/results.json").is_file()
    # what is kept already and cannot be read is told, too
    place = tmp_path / "kept/runs/DreamWaQ/seed-0/kept/results.json"
    place.write_text("{")
    result = run("sweep", file, "--out", "out", "--report", "--keep", "kept")
    assert result.exit_code == 1 and "DreamWaQ, seed 0 is not kept: " in result.stderr and str(place) in result.stderr


def test_the_range_of_the_seeds_is_a_column_of_its_own():
    """In brackets behind mean and deviation it read as an interval of the mean."""
    best = {"seed": 1, "score": 0.7046, "score_interval": [0.6978, 0.7113], "level": 8.48, "groups": None}
    one = {"entry": "one", "reason": "", "best": best, "mean": 0.7046, "deviation": None, "range": None}
    several = one | {"entry": "several", "mean": 0.7031, "deviation": 0.0021, "range": [0.7007, 0.7046]}
    tables = []
    console = SimpleNamespace(print=tables.append, say=lambda _: None)
    for entries in ([several, one], [one]):
        found = {"title": "toy", "suite": "tiny", "entries": entries, "sentences": [], "compared": False}
        print_sweep(console, found, Path())
    first, second = ({str(c.header): list(c.cells) for c in table.columns} for table in tables)
    assert first["mean of seeds"] == ["0.7031 ± 0.0021", "0.7046"] and first["range"] == ["0.7007 to 0.7046", ""]
    assert second["mean of seeds"] == ["0.7046"] and "range" not in second


def test_on_a_narrow_screen_every_value_of_the_page_has_its_column_s_name(run, tmp_path):
    """There the rows are cards, and no table hides what it has no room for."""
    shutil.unpack_archive(ROOT / "docs/data/sweeps/more-level-ground.zip", tmp_path / "out")
    assert run("sweep", ROOT / "benchmarks/sweeps/more-level-ground.toml", "--out", "out", "--report").exit_code == 0
    tables = re.findall(r"<table.*?</table>", (tmp_path / "out/sweep.html").read_text(), re.DOTALL)
    assert len(tables) == 2
    for table in tables:
        head, body = table.split("<tbody>")
        names = re.findall("<th[^>]*>(.*?)</th>", head)
        rows = re.findall("<tr>(.*?)</tr>", body)
        assert re.match('<table class="[^"]*stack', head) and rows
        for row in rows:  # the first cell is the card's title, a policy's path needs no name
            assert re.findall('data-label="(.*?)"', row) == [n for n in names[1:] if n != "policy"]
    assert '<td data-label="mean of seeds">0.6865</td>' in tables[0] and 'data-label="range">0.6830 to' in tables[0]


def test_a_suite_that_is_not_there(refused, tmp_path):
    (tmp_path / "sweep.toml").write_text(sweep(one='task = "go2-cts"').replace("tiny.toml", "robogauge-1.2"))
    assert "robogauge-1.2" in refused("sweep", "sweep.toml")


def test_two_sweeps_in_one_folder(refused, tiny, monkeypatch):
    from gaitgauge.files import writing

    monkeypatch.setattr(writing, "_PATIENCE", 0.1)
    (tiny / "sweep.toml").write_text(sweep(one='task = "go2-cts"'))
    (tiny / "out").mkdir()
    lock = writing.lock_folder(tiny / "out", ValueError)
    assert "another process is writing" in refused("sweep", "sweep.toml", "--out", "out")
    lock.release()


@pytest.mark.slow
def test_a_whole_sweep(run, tiny):
    """Two methods and an entry that cannot start; called again, there is nothing left to do."""
    text = sweep(CTS='task = "go2-cts"', HIM='task = "go2-him"', wrong='task = "go2-hym"')
    (tiny / "sweep.toml").write_text(text)
    result = run("sweep", "sweep.toml", "--out", "out", "--threads", 1)
    assert result.exit_code == 1, result.output
    (sentence,) = [line for line in result.stderr.splitlines() if line.startswith("gaitgauge: ")]
    assert "entry 'wrong' cannot start: unknown task 'go2-hym'" in sentence
    found = json.loads((tiny / "out" / "sweep.json").read_text())
    assert [(r["entry"], r["state"]) for r in found["runs"]] == [("CTS", "gauged"), ("HIM", "gauged")]
    assert len(found["sentences"]) >= 2 and "CTS" in found["sentences"][0] and "HIM" in found["sentences"][0]
    assert {f.name for f in (tiny / "out").iterdir()} >= {
        "sweep.html",
        "curves.csv",
        "comparison.html",
        "comparison.tex",
    }
    again = run("sweep", "sweep.toml", "--out", "out", "--json")
    assert again.exit_code == 1 and "is trained" not in again.stderr and json.loads(again.stdout) == found
    (tiny / "out" / "sweep.html").unlink()
    told = run("sweep", "sweep.toml", "--out", "out", "--report")
    assert told.exit_code == 1 and "HIM" in told.stdout
    assert "sweep.html" in told.stdout and "comparison.html" in told.stdout
    assert json.loads((tiny / "out" / "sweep.json").read_text()) == found
    keeps = run("sweep", "sweep.toml", "--out", "out", "--report", "--keep", "kept")
    assert "kept 2 runs; 2 of 2 are in" in keeps.stderr
    elsewhere = run("sweep", "sweep.toml", "--out", "kept", "--json")
    assert "is trained" not in elsewhere.stderr and "is gauged" not in elsewhere.stderr
    scores = [(r["entry"], r["state"], r["score"]) for r in json.loads(elsewhere.stdout)["runs"]]
    assert scores == [(r["entry"], r["state"], r["score"]) for r in found["runs"]]
    kept = tiny / "kept" / "runs" / "HIM" / "seed-0" / "kept"
    checked = run(
        "verify", kept / "results.json", "--policy", kept / "policy.gauge.pt", "--suite", "tiny.toml", "--json"
    )
    assert checked.exit_code == 0 and json.loads(checked.stdout)["holds"], checked.output
