"""What is kept of a sweep's runs: small, enough for a report anywhere, and no second training."""

import gzip
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from gaitgauge.policy.finding import PRETRAINED, SHIPPED
from gaitgauge.policy.loading import load_policy
from gaitgauge.robots import load_robot
from gaitgauge.studies.policies import file_digest
from gaitgauge.training.run.checkpoint import read_checkpoint, training_part, write_checkpoint
from gaitgauge.training.sweep.curves import kept_curves_csv, learning_curves
from gaitgauge.training.sweep.file import Sweep, SweepEntry, SweepError, load_sweep
from gaitgauge.training.sweep.folding import fold_sweep
from gaitgauge.training.sweep.jobs import Jobs
from gaitgauge.training.sweep.keeping import check_keep, keep_runs
from gaitgauge.training.sweep.runs import plan_runs
from torch.utils.tensorboard import SummaryWriter

ROOT = Path(__file__).parents[2]
CARD = ROOT / "docs" / "data" / "scorecards" / "standing-robogauge-1.1.json.gz"
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
            writer.add_scalar("Loss/surrogate", -0.25 * step, step)
    # with its teacher and critic, as a run's checkpoint
    write_checkpoint(made / "model_3.pt", read_checkpoint(PRETRAINED, training_state=False, purpose="start from"))
    note = {"task": "go2-moe-cts", "host": "lab-7", "command": "gaitgauge train --log-root /home/me", "seed": 0}
    note |= {"begun_with": "/home/me/first.pt", "resumed": [{"checkpoint": "model_1.pt", "command": "train /home/me"}]}
    note |= {"outcome": "finished", "iteration": 3, "environment_steps": 3_000_000, "training_seconds": 4.5}
    (made / "run.json").write_text(json.dumps(note))
    results = runs[0].folder / "gauge" / "model_3"
    results.mkdir(parents=True)
    card = json.loads(gzip.decompress(CARD.read_bytes()))
    card["policy"] |= {"path": "/home/me/model_3.pt", "provenance": {"iteration": 3}}
    card["policy"]["file_sha256"] = file_digest(str(made / "model_3.pt"))
    card["provenance"] |= {"host": "lab-7", "command": "gaitgauge evaluate /home/me/model_3.pt"}
    (results / "results.json").write_text(json.dumps(card))
    return folder


@pytest.fixture(scope="module")
def kept_once(finished, tmp_path_factory):
    folder = tmp_path_factory.mktemp("kept") / "kept"
    runs, _ = plan_runs(SWEEP, finished, to_train=False)
    assert keep_runs(SWEEP, runs, folder) == (["one, seed 0"], {})
    return folder


@pytest.fixture
def kept(kept_once, tmp_path):
    """A folder of kept runs, to be changed."""
    return Path(shutil.copytree(kept_once, tmp_path / "kept"))


def test_the_report_of_what_was_kept_is_that_of_the_sweep(finished, kept):
    tables = []
    for folder in (finished, kept):
        runs, _ = plan_runs(SWEEP, folder, to_train=False)
        found = fold_sweep(SWEEP, runs, {}, {}, folder)
        tables.append([{k: v for k, v in row.items() if k not in ("policy", "results")} for row in found["runs"]])
    assert tables[0] == tables[1]
    assert [row["state"] for row in tables[0]] == ["gauged", "unfinished"]
    assert tables[0][0]["score"] == json.loads(gzip.decompress(CARD.read_bytes()))["score"]
    assert (finished / "curves.csv").read_text() == (kept / "curves.csv").read_text()
    for row in ("mean reward,2,0.5", "Loss/surrogate,3,-0.5"):
        assert f"one,0,{row}\n" in (kept / "curves.csv").read_text()
    assert "Loss/" not in (kept / "sweep.html").read_text()


def test_it_is_small_and_names_no_machine_and_no_folder(kept):
    there = kept / "runs" / "one" / "seed-0"
    names = {str(p.relative_to(there)) for p in there.rglob("*") if p.is_file()}
    own = {f"kept/{name}" for name in ("run.json", "curves.csv", "policy.gauge.pt", "results.json")}
    assert names == {"entry.json", *own}
    for name in ("run.json", "results.json"):
        text = (there / "kept" / name).read_text()
        assert "lab-7" not in text and "/home/me" not in text
    whole = 0.75 * (PRETRAINED.stat().st_size + training_part(PRETRAINED).stat().st_size)
    assert (there / "kept" / "policy.gauge.pt").stat().st_size < whole


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
    assert keep_runs(SWEEP, [run], finished.with_name("elsewhere")) == (["one, seed 0"], {})


def test_what_is_not_gauged_yet_is_kept_and_gauged_where_there_is_no_gpu(finished, tmp_path):
    alone = replace(SWEEP, entry=(replace(SWEEP.entry[0], device=None),))
    bare, kept = tmp_path / "bare", tmp_path / "kept"
    shutil.copytree(finished, bare)
    results = bare / "runs" / "one" / "seed-0" / "gauge" / "model_3" / "results.json"
    results.rename(tmp_path / "results.json")
    runs, _ = plan_runs(alone, bare, to_train=False)
    assert keep_runs(alone, runs, kept) == (["one, seed 0"], {}) and keep_runs(alone, runs, kept) == ([], {})
    (run,), refused = plan_runs(alone, kept)
    assert refused == {} and run.trained and not run.gauged(alone)
    command = run.gauging_command(alone, where=[])
    policy, out = run.folder / "kept" / "policy.gauge.pt", run.folder / "gauge" / "policy.gauge"
    assert command[4:6] == ["evaluate", str(policy)] and command[command.index("--out") + 1] == str(out)
    # once it is gauged, here or where it was trained, its results are kept too
    (tmp_path / "results.json").rename(results)
    assert keep_runs(alone, runs, kept) == (["one, seed 0"], {})
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
    assert keep_runs(SWEEP, runs, kept) == ([], {})
    assert {path: path.stat().st_mtime_ns for path in kept.rglob("*")} == before


TWO_SEEDS = replace(SWEEP, entry=(replace(SWEEP.entry[0], seeds=(0, 1)),))


@pytest.fixture
def seeds(finished, tmp_path):
    """A folder in which two seeds are done, and its runs."""
    shutil.copytree(finished, tmp_path / "seeds")
    one = tmp_path / "seeds" / "runs" / "one"
    shutil.copytree(one / "seed-0", one / "seed-1", ignore=shutil.ignore_patterns("entry.json"))
    runs, refused = plan_runs(TWO_SEEDS, tmp_path / "seeds", to_train=False)
    assert refused == {}
    return tmp_path / "seeds", runs


@pytest.mark.parametrize("name", ["logs/go2_moe_cts/2026-01-01_00-00-00/run.json", "gauge/model_3/results.json"])
def test_a_damaged_file_is_the_failure_of_its_run_alone(seeds, tmp_path, name):
    folder, runs = seeds
    (runs[0].folder / name).write_text("{")
    found = fold_sweep(TWO_SEEDS, runs, {}, {}, folder)
    assert [row["state"] for row in found["runs"]] == ["failed", "gauged"] and found["runs"][1]["score"]
    reason = found["runs"][0]["reason"]
    assert str(runs[0].folder / name) in reason and "delete it and call again" in reason and "\n" not in reason
    kept, failures = keep_runs(TWO_SEEDS, runs, tmp_path / "kept")
    assert kept == ["one, seed 1"] and failures == {"one, seed 0": reason}
    outcome = Jobs(TWO_SEEDS, threads=1, deadline=None, say=lambda _: None, gpus=["0"]).work(runs)
    assert outcome.failures == failures and outcome.unfinished == []


@pytest.mark.parametrize("name", ["score_interval", "level", "groups"])
def test_results_without_what_the_table_tells_are_the_failure_of_their_run_alone(seeds, name):
    folder, runs = seeds
    path = runs[0].folder / "gauge" / "model_3" / "results.json"
    card = json.loads(path.read_text())
    del card[name]
    path.write_text(json.dumps(card))
    rows = fold_sweep(TWO_SEEDS, runs, {}, {}, folder)["runs"]
    assert [row["state"] for row in rows] == ["failed", "gauged"]
    assert rows[0]["reason"] == f"results '{path}' lack {name}; delete it and call again, which makes it anew"


def test_a_damaged_note_refuses_its_seed_alone(seeds, tmp_path):
    folder, runs = seeds
    note = runs[0].folder / "entry.json"
    note.write_text("{")
    there, refused = plan_runs(TWO_SEEDS, folder, to_train=False)
    assert [run.label for run in there] == ["one, seed 1"] and there[0].gauged(TWO_SEEDS)
    assert str(note) in refused["one"] and "delete it if the training beside it is" in refused["one"]


def test_a_damaged_checkpoint_says_what_to_do_and_its_results_do_not_count(seeds, tmp_path):
    folder, runs = seeds
    checkpoint = runs[0].directory / "model_3.pt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    found = fold_sweep(TWO_SEEDS, runs, {}, {}, folder)
    assert [row["state"] for row in found["runs"]] == ["trained", "gauged"]
    assert "Results of 'one, seed 0' are of another suite or checkpoint and do not count." in found["sentences"]
    kept, failures = keep_runs(TWO_SEEDS, runs, tmp_path / "kept")
    assert kept == ["one, seed 1"] and list(failures) == ["one, seed 0"]
    assert f"'{checkpoint}' is a damaged or truncated archive" in failures["one, seed 0"]
    assert "remove it and call again" in failures["one, seed 0"] and runs[1].damage(TWO_SEEDS) == ""


def test_damaged_kept_curves_leave_the_score(kept):
    runs, _ = plan_runs(SWEEP, kept, to_train=False)
    (runs[0].folder / "kept" / "curves.csv").write_text("no curves")
    row = fold_sweep(SWEEP, runs, {}, {}, kept)["runs"][0]
    assert row["state"] == "failed" and "delete it and call again" in row["reason"] and row["score"] is not None
    (runs[0].folder / "kept" / "curves.csv").unlink()
    assert fold_sweep(SWEEP, runs, {}, {}, kept)["runs"][0]["state"] == "gauged"


OTHER_SUITE = replace(SWEEP, suite="gaitgauge-1")
OTHER_CARD = CARD.with_name("standing-demo.json")


@pytest.mark.parametrize("begun", [False, True])
def test_results_of_another_suite_do_not_count_and_stay(seeds, begun):
    """``begun``: its gauging was not finished, or the results were taken away."""
    folder, (run, _) = seeds
    before = run.folder / "gauge" / "model_3" / "results.json"
    if begun:
        request = {"suite_digest": run.suite_digest, "policy": load_policy(run.directory / "model_3.pt").digest}
        before.with_name("request.json").write_text(json.dumps(request))
        before.unlink()
    (other, _), _ = plan_runs(OTHER_SUITE, folder, to_train=False)
    place = other.results(OTHER_SUITE)
    assert not other.gauged(OTHER_SUITE) and place.parent == before.parents[1] and place != before.parent
    assert "--resume" not in other.gauging_command(OTHER_SUITE, where=[])
    place.mkdir()
    shutil.copy(OTHER_CARD, place / "results.json")
    assert other.gauged(OTHER_SUITE) and run.gauged(SWEEP) is not begun and run.results(SWEEP) == before.parent


def test_kept_results_of_another_suite_do_not_count_and_stay(seeds, kept, tmp_path):
    (run, _), _ = plan_runs(OTHER_SUITE, kept, to_train=False)
    assert run.trained and not run.gauged(OTHER_SUITE)
    assert run.results(OTHER_SUITE) == run.folder / "gauge" / "policy.gauge"
    text = (run.folder / "kept" / "results.json").read_text()
    (gauged, _), _ = plan_runs(OTHER_SUITE, seeds[0], to_train=False)
    place = gauged.results(OTHER_SUITE)
    place.mkdir()
    shutil.copy(OTHER_CARD, place / "results.json")
    labels, failures = keep_runs(OTHER_SUITE, [gauged], kept)
    assert labels == [] and "give another --keep" in failures["one, seed 0"]
    assert (run.folder / "kept" / "results.json").read_text() == text
    (run.folder / "kept" / "policy.gauge.pt").unlink()
    with pytest.raises(SweepError, match=r"not of the suite gaitgauge-1 as it is now, and without policy\.gauge\.pt"):
        run.gauged(OTHER_SUITE)


@pytest.mark.parametrize("begun", [False, True])
def test_results_of_another_checkpoint_do_not_count(seeds, begun):
    """``begun``: its gauging was not finished."""
    _, (run, _) = seeds
    if begun:
        results = run.folder / "gauge" / "model_3" / "results.json"
        request = {"suite_digest": run.suite_digest, "policy": load_policy(run.directory / "model_3.pt").digest}
        results.with_name("request.json").write_text(json.dumps(request))
        results.unlink()
        assert run.results(SWEEP) == results.parent
    shutil.copy(SHIPPED / "go1.gauge.pt", run.directory / "model_3.pt")
    assert not run.gauged(SWEEP) and run.results(SWEEP) != run.folder / "gauge" / "model_3"


@pytest.mark.parametrize("noted", [True, False])
def test_another_checkpoint_that_was_kept_does_not_count(finished, kept, tmp_path, noted):
    """``noted``: by this version; else the results say which it is."""
    (run, _), _ = plan_runs(SWEEP, kept, to_train=False)
    path = run.folder / "kept" / "run.json"
    description = json.loads(path.read_text()) | {"best_iteration": 2}
    assert description["kept_iteration"] == 3
    if not noted:
        del description["kept_iteration"]
    path.write_text(json.dumps(description))
    assert run.gauged(SWEEP)
    best = replace(SWEEP, training_suite="quick", checkpoint="best")
    with pytest.raises(SweepError, match="policy of iteration 3, and checkpoint 'best' is that of 2"):
        run.gauged(best)


@pytest.mark.slow
def test_the_shipped_folders_are_read(tmp_path):
    """The newest and the oldest."""
    for name in ("baselines", "from-nothing"):
        shutil.unpack_archive(ROOT / "docs" / "data" / "sweeps" / f"{name}.zip", tmp_path / name)
        sweep = load_sweep(ROOT / "benchmarks" / "sweeps" / f"{name}.toml")
        runs, refused = plan_runs(sweep, tmp_path / name, to_train=False)
        there = [run for run in runs if run.directory]
        assert refused == {} and len(there) >= 2 and all(run.trained and run.gauged(sweep) for run in there)


def test_what_cannot_be_kept_is_known_before_a_training(kept):
    runs, _ = plan_runs(SWEEP, kept, to_train=False)
    changed = [replace(run, settings=("training.run.iterations=4",)) for run in runs]
    with pytest.raises(
        SweepError, match=r"one/seed-0' holds a training whose .*iterations is '3', .*'4'; give another .* --keep"
    ):
        check_keep(changed, kept)
    check_keep(runs, kept / "new")
    assert not (kept / "new").exists()


@pytest.mark.parametrize("description", [None, {"outcome": "running", "iteration": 1}])
def test_a_training_is_done_when_its_last_checkpoint_is_there(seeds, tmp_path, description):
    """Killed while it waited for a score, or its description was deleted since it was damaged: it could not be gone on with."""
    _, (run, _) = seeds
    path = run.directory / "run.json"
    path.unlink() if description is None else path.write_text(json.dumps(description))
    assert run.trained and keep_runs(SWEEP, [run], tmp_path / "kept")[0] == ["one, seed 0"]
    there = replace(run, folder=tmp_path / "kept" / "runs" / "one" / "seed-0")
    assert there.trained and there.gauged(SWEEP)


def test_an_earlier_comparison_is_not_named_as_new(finished):
    (finished / "comparison.html").touch()
    runs, _ = plan_runs(SWEEP, finished, to_train=False)
    assert fold_sweep(SWEEP, runs, {}, {}, finished)["compared"] is False
    assert "comparison.html" not in (finished / "sweep.html").read_text()


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
    curves["Loss/value"] = ([1.0, 2.0], [0.125, 0.0625])
    (tmp_path / "curves.csv").write_text(kept_curves_csv(curves))
    assert learning_curves(tmp_path) == curves


def test_long_curves_are_thinned_out_to_their_last_point(tmp_path):
    with SummaryWriter(str(tmp_path)) as writer:
        for step in range(950):
            for tag in ("Perf/total_steps", "Train/mean_reward", "Loss/value"):
                writer.add_scalar(tag, 1e6 * (step + 1), step)
    found = learning_curves(tmp_path)
    assert {title: (len(x), x[-1]) for title, (x, _) in found.items()} == {
        "mean reward": (317, 950.0),
        "Loss/value": (95, 950.0),
    }


def test_a_report_notes_nothing(tmp_path):
    """Of runs that are not there: a file with a mistake in it would be what they are asked for later."""
    assert len(plan_runs(SWEEP, tmp_path, to_train=False)[0]) == 2 and not any(tmp_path.iterdir())


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_report_needs_no_gpu(tmp_path):
    sweep = replace(SWEEP, entry=SWEEP.entry[1:])
    assert "this machine has none" in plan_runs(sweep, tmp_path)[1]["two"]
    assert [run.label for run in plan_runs(sweep, tmp_path, to_train=False)[0]] == ["two, seed 0"]
