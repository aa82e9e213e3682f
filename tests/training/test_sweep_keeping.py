"""What is kept of a sweep's runs: small, enough for a report anywhere, and no second training."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from gaitgauge.gauge.policies import file_digest
from gaitgauge.policy.finding import PRETRAINED
from gaitgauge.policy.loading import load_policy
from gaitgauge.robots import load_robot
from gaitgauge.training.sweep.curves import kept_curves_csv, learning_curves
from gaitgauge.training.sweep.file import Sweep, SweepEntry, SweepError
from gaitgauge.training.sweep.folding import fold_sweep
from gaitgauge.training.sweep.jobs import Jobs
from gaitgauge.training.sweep.keeping import keep_runs
from gaitgauge.training.sweep.runs import plan_runs
from torch.utils.tensorboard import SummaryWriter

CARD = Path(__file__).parents[2] / "docs" / "data" / "scorecards" / "pretrained-robogauge-1.1.json"
SWEEP = Sweep(
    name="toy",
    title="A toy",
    suite="robogauge-1.1",
    training_suite="none",
    settings=("training.run.iterations=3",),
    entry=(SweepEntry(name="one", task="go2-moe-cts", device="cpu"), SweepEntry(name="two", task="go2-cts")),
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder in which the first entry is done: the shipped policy stands for what was trained."""
    folder = tmp_path_factory.mktemp("sweep")
    runs, refused = plan_runs(SWEEP, folder, to_train=False)
    assert refused == {}
    made = runs[0].folder / "logs" / "go2_moe_cts" / "2026-01-01_00-00-00"
    made.mkdir(parents=True)
    with SummaryWriter(str(made)) as writer:
        for step in range(3):
            writer.add_scalar("Perf/total_steps", 1e6 * (step + 1), step)
            writer.add_scalar("Train/mean_reward", 0.5 * step, step)
    shutil.copy(PRETRAINED, made / "model_3.pt")
    note = {"task": "go2-moe-cts", "host": "lab-7", "command": "gaitgauge train --log-root /home/me", "seed": 0}
    note |= {"outcome": "finished", "iteration": 3, "environment_steps": 3_000_000, "training_seconds": 4.5}
    (made / "run.json").write_text(json.dumps(note))
    results = runs[0].folder / "gauge" / "model_3"
    results.mkdir(parents=True)
    card = json.loads(CARD.read_text())
    card["policy"] |= {"path": "/home/me/model_3.pt"}
    card["provenance"] |= {"host": "lab-7", "command": "gaitgauge evaluate /home/me/model_3.pt"}
    (results / "results.json").write_text(json.dumps(card))
    return folder


@pytest.fixture
def kept(finished, tmp_path):
    runs, _ = plan_runs(SWEEP, finished, to_train=False)
    assert keep_runs(SWEEP, runs, tmp_path / "kept") == ["one, seed 0"]
    return tmp_path / "kept"


def test_the_report_of_what_was_kept_is_that_of_the_sweep(finished, kept):
    tables = []
    for folder in (finished, kept):
        runs, _ = plan_runs(SWEEP, folder, to_train=False)
        found = fold_sweep(SWEEP, runs, {}, {}, folder)
        tables.append([{k: v for k, v in row.items() if k not in ("policy", "results")} for row in found["runs"]])
    assert tables[0] == tables[1]
    assert [row["state"] for row in tables[0]] == ["gauged", "unfinished"]
    assert tables[0][0]["score"] == json.loads(CARD.read_text())["score"]
    assert (finished / "curves.csv").read_text() == (kept / "curves.csv").read_text()
    assert "mean reward,2,0.5" in (kept / "curves.csv").read_text()


def test_it_is_small_and_names_no_machine_and_no_folder(kept):
    there = kept / "runs" / "one" / "seed-0"
    names = {str(p.relative_to(there)) for p in there.rglob("*") if p.is_file()}
    own = {f"kept/{name}" for name in ("run.json", "curves.csv", "policy.gauge.pt", "results.json")}
    assert names == {"entry.json", *own}
    for name in ("run.json", "results.json"):
        text = (there / "kept" / name).read_text()
        assert "lab-7" not in text and "/home/me" not in text
    assert (there / "kept" / "policy.gauge.pt").stat().st_size < 0.75 * PRETRAINED.stat().st_size


def test_the_results_are_a_card_of_the_policy(kept):
    place = kept / "runs" / "one" / "seed-0" / "kept"
    card = json.loads((place / "results.json").read_text())
    assert card["policy"]["path"] == "policy.gauge.pt"
    assert card["policy"]["file_sha256"] == file_digest(str(place / "policy.gauge.pt"))
    go2 = load_robot("go2")
    assert load_policy(place / "policy.gauge.pt", go2).digest == load_policy(PRETRAINED, go2).digest


def test_what_was_kept_is_not_trained_again(kept):
    runs, _ = plan_runs(replace(SWEEP, entry=SWEEP.entry[:1]), kept)
    outcome = Jobs(SWEEP, threads=1, deadline=None, say=lambda _: None, gpus=["0"]).work(runs)
    assert outcome.failures == {} and outcome.unfinished == []
    assert not list(kept.rglob("train.log"))


def test_without_its_policy_a_kept_run_is_still_done(finished, kept):
    (kept / "runs" / "one" / "seed-0" / "kept" / "policy.gauge.pt").unlink()
    (run, _), _ = plan_runs(SWEEP, kept, to_train=False)
    assert run.trained and run.gauged(SWEEP) and run.policy(SWEEP) is None
    assert keep_runs(SWEEP, [run], finished.with_name("elsewhere")) == ["one, seed 0"]


def test_what_is_not_gauged_yet_is_kept_and_gauged_where_there_is_no_gpu(finished, tmp_path):
    alone = replace(SWEEP, entry=(replace(SWEEP.entry[0], device=None),))
    bare, kept = tmp_path / "bare", tmp_path / "kept"
    shutil.copytree(finished, bare)
    results = bare / "runs" / "one" / "seed-0" / "gauge" / "model_3" / "results.json"
    results.rename(tmp_path / "results.json")
    runs, _ = plan_runs(alone, bare, to_train=False)
    assert keep_runs(alone, runs, kept) == ["one, seed 0"] and keep_runs(alone, runs, kept) == []
    (run,), refused = plan_runs(alone, kept)
    assert refused == {} and run.trained and not run.gauged(alone)
    command = run.gauging_command(alone, where=[])
    policy, out = run.folder / "kept" / "policy.gauge.pt", run.folder / "gauge" / "policy.gauge"
    assert command[3:5] == ["evaluate", str(policy)] and command[command.index("--out") + 1] == str(out)
    # once it is gauged, here or where it was trained, its results are kept too
    (tmp_path / "results.json").rename(results)
    assert keep_runs(alone, runs, kept) == ["one, seed 0"]
    assert run.gauged(alone) and run.results(alone) == run.folder / "kept"


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_seed_that_is_trained_is_gauged_where_the_other_cannot_be_trained(finished):
    both = replace(SWEEP, entry=(replace(SWEEP.entry[0], device=None, seeds=(0, 1)),))
    runs, refused = plan_runs(both, finished)
    assert [run.label for run in runs] == ["one, seed 0"]
    assert "this machine has none" in refused["one"]


def test_half_of_a_small_form_is_none(kept):
    (kept / "runs" / "one" / "seed-0" / "kept" / "run.json").unlink()
    (run, _), _ = plan_runs(SWEEP, kept, to_train=False)
    assert run.directory is None and not run.trained


def test_what_was_kept_before_stays(finished, kept):
    runs, _ = plan_runs(SWEEP, finished, to_train=False)
    before = {path: path.stat().st_mtime_ns for path in kept.rglob("*")}
    assert keep_runs(SWEEP, runs, kept) == []
    assert {path: path.stat().st_mtime_ns for path in kept.rglob("*")} == before


@pytest.mark.parametrize(
    "text",
    [
        "",
        "figure,value\n",
        "mean reward,1,2\n",
        "{head}loss,1,2\n",
        "{head}mean reward,1\n",
        "{head}mean reward,1,nan\n",
    ],
)
def test_damaged_curves_are_one_sentence(tmp_path, text):
    (tmp_path / "curves.csv").write_text(text.format(head="figure,environment_steps_millions,value\n"))
    with pytest.raises(SweepError, match="are damaged: each row has a figure") as refusal:
        learning_curves(tmp_path)
    assert "\n" not in str(refusal.value)


def test_curves_come_back_as_they_were(tmp_path):
    curves = {"mean reward": ([1.0, 2.0], [0.5, -0.25]), "mean terrain level in training": ([1.0], [3.0])}
    (tmp_path / "curves.csv").write_text(kept_curves_csv(curves))
    assert learning_curves(tmp_path) == curves


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_report_needs_no_gpu(tmp_path):
    sweep = replace(SWEEP, entry=SWEEP.entry[1:])
    assert "this machine has none" in plan_runs(sweep, tmp_path)[1]["two"]
    assert [run.label for run in plan_runs(sweep, tmp_path, to_train=False)[0]] == ["two, seed 0"]
