"""Sweeps: their files, which runs they have, and what is told at the end."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gaitgauge.files.parsing import one_line
from gaitgauge.gauge.chance.intervals import Chance
from gaitgauge.gauge.report.page import charts
from gaitgauge.training.run.checkpoint import CheckpointError
from gaitgauge.training.sweep.across import across_seeds, chance_of_seeds
from gaitgauge.training.sweep.curves import by_figure, curves_csv
from gaitgauge.training.sweep.file import SweepEntry, SweepError, load_sweep
from gaitgauge.training.sweep.folding import _entry, fold_sweep
from gaitgauge.training.sweep.runs import SweepRun, plan_runs
from gaitgauge.training.tasks import find_task
from sample_results import sample
from scipy.stats import t as student_t
from scripted_sweep import ENTRY, SWEEP, scripted, work

ROOT = Path(__file__).parents[2]

BEST = replace(SWEEP, training_suite="quick", checkpoint="best")


def write(folder: Path, text: str) -> Path:
    path = folder / "sweep.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("name = 3\ntitle = 'b'\nentry = []", "name is 3; it must be a text"),
        ("name = 'a'\ntitle = 'b'", "lacks entry"),
        ("name = 'a'\ntitle = 'b'\nentry = []", "no entries; add a table"),
        ("name = 'a'\ntitle = 'b'\n[[entry]]\nname = 'c'", r"entry\[0\] lacks task"),
        ("name = '../a'\ntitle = 'b'\n[[entry]]\nname = 'c'\ntask = 'd'", "letters, digits"),
        ("name = 'a'\ntitle = 'b'\nseed = [1]\n[[entry]]\nname = 'c'\ntask = 'd'", "unknown field 'seed'.*'seeds'"),
        ("name = 'a'\ntitle = 'b'\ncheckpoint = 'first'\n[[entry]]\nname = 'c'\ntask = 'd'", "'last' or 'best'"),
        (
            "name = 'a'\ntitle = 'b'\ncheckpoint = 'best'\ntraining_suite = 'none'\n[[entry]]\nname = 'c'\ntask = 'd'",
            "which training_suite chooses",
        ),
        (
            "name = 'a'\ntitle = 'b'" + "\n[[entry]]\nname = 'C'\ntask = 'd'\n[[entry]]\nname = 'c'\ntask = 'd'",
            "sweep.toml': has the entries 'C' and 'c' in one folder; rename one",
        ),
        ("name = 'a'\ntitle = 'b'\n[[entry]]\nname = 'c'\ntaks = 'd'", r"unknown field 'entry\[0\].taks'.*'task'"),
        (
            f"name = 'a'\ntitle = 'b'\nseeds = {list(range(1001))}\n[[entry]]\nname = 'c'\ntask = 'd'",
            "1,001 trainings",
        ),
        (
            "name = 'a'\ntitle = 'b'\nsuite = 'quik'\n[[entry]]\nname = 'c'\ntask = 'd'",
            r"sweep.toml': suite: there is no suite 'quik'.*'quick'",
        ),
        (
            "name = 'a'\ntitle = 'b'\nsuite = 'none'\n[[entry]]\nname = 'c'\ntask = 'd'",
            "sweep.toml': suite: there is no suite 'none'",
        ),
        (
            "name = 'a'\ntitle = 'b'\ntraining_suite = 'quik'\n[[entry]]\nname = 'c'\ntask = 'd'",
            r"sweep.toml': training_suite: there is no suite 'quik'.*'quick'",
        ),
        ("name =", "not valid TOML"),
    ],
)
def test_files_that_are_wrong(tmp_path, text, sentence):
    with pytest.raises(SweepError, match=sentence):
        load_sweep(write(tmp_path, text))


def test_a_sweep_that_is_not_there(tmp_path):
    with pytest.raises(SweepError, match="does not exist"):
        load_sweep(tmp_path / "none.toml")


SHIPPED = sorted((ROOT / "benchmarks" / "sweeps").glob("*.toml"))


@pytest.mark.parametrize(
    "path",
    [p if p.stem != "going-on" else pytest.param(p, marks=pytest.mark.slow) for p in SHIPPED],
    ids=lambda p: p.stem,
)
def test_shipped_sweeps_could_start(tmp_path, path):
    sweep = load_sweep(path)
    assert sweep.name == path.stem
    runs, refused = plan_runs(
        replace(sweep, entry=tuple(replace(entry, device="cpu") for entry in sweep.entry)), tmp_path
    )
    assert refused == {} and len(runs) == sum(len(sweep.seeds_of(entry)) for entry in sweep.entry)


@pytest.mark.parametrize("name", ["baselines", "moe-ablation", "strategies"])
def test_the_paper_s_tables_are_sweeps_as_long_as_needed(name):
    sweep = load_sweep(ROOT / "benchmarks" / "sweeps" / f"{name}.toml")
    assert len(sweep.entry) >= 4 and len(sweep.seeds) >= 2
    for entry in sweep.entry:
        task = find_task(entry.task, (*sweep.settings, *entry.settings))
        run = task.training.run
        assert run.iterations * run.steps_per_iteration * task.environment.num_envs >= 600e6


def test_the_guide_s_sweep_fits(tmp_path):
    (text,) = re.findall(r"```toml\n(.*?)```", (ROOT / "docs" / "guides" / "methods.md").read_text(), re.S)
    sweep = load_sweep(write(tmp_path, text))
    for entry in sweep.entry:
        find_task(entry.task, (*sweep.settings, *entry.settings))


def test_entries_that_cannot_start_leave_the_others(tmp_path):
    entries = (
        ENTRY,
        SweepEntry(name="misspelt", task="go2-ctss"),
        SweepEntry(name="setting", task="go2-cts", settings=("training.algorithm.epoch=3",)),
        SweepEntry(name="engine", task="go2-cts", backend="physx"),
        SweepEntry(name="seed", task="go2-cts", settings=("training.run.seed=1",)),
        SweepEntry(name="seed of worlds", task="go2-cts", settings=(" environment.seed = 1",)),
        SweepEntry(name="seeds", task="go2-cts", seeds=(1, 1)),
        SweepEntry(name="no seeds", task="go2-cts", seeds=()),
        SweepEntry(name="method", task="go2-him", init_from="pretrained"),
        SweepEntry(
            name="width", task="go2-moe-cts", init_from="pretrained", settings=("training.network.latent_width=16",)
        ),
        replace(ENTRY, name="two", seeds=(7,)),
    )
    runs, refused = plan_runs(replace(SWEEP, entry=entries, seeds=(3, 4)), tmp_path)
    assert [run.label for run in runs] == ["one, seed 3", "two, seed 7", "one, seed 4"]
    assert list(refused) == [entry.name for entry in entries[1:-1]]
    for sentence, named in zip(
        refused.values(),
        (
            "go2-cts",
            "training.algorithm.epochs",
            "'physx'",
            "'training.run.seed=1' all seeds train the same run; write seeds",
            "' environment.seed = 1' all seeds train the same run",
            "seeds are [1, 1]; give at least one, and each once",
            "seeds are []; give at least one",
            "its network is moe_cts, this run's is him; begin with a file of him, or with none",
            "its network has latent_width 32 (this run's 16); give the same training.network.* settings",
        ),
        strict=True,
    ):
        assert named in sentence and "\n" not in sentence


def test_a_seed_among_the_settings_of_all_entries_stops_all_of_them(tmp_path):
    sweep = replace(SWEEP, settings=("training.run.seed=1",), entry=(ENTRY, replace(ENTRY, name="two")))
    runs, refused = plan_runs(sweep, tmp_path)
    assert runs == [] and list(refused) == ["one", "two"] and len(set(refused.values())) == 1


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_without_a_gpu_only_engines_of_the_cpu_start(tmp_path):
    sweep = replace(SWEEP, backend="mujoco-warp", entry=(ENTRY, replace(ENTRY, name="cpu", backend="mujoco")))
    runs, refused = plan_runs(sweep, tmp_path)
    assert [run.label for run in runs] == ["cpu, seed 0"] and not runs[0].on_gpu
    assert refused["one"] == (
        "backend 'mujoco-warp' wants a GPU and this machine has none; "
        """write device = "cpu" (slow) or backend = "mujoco" in the sweep's file"""
    )
    asked = (replace(ENTRY, device="cuda"), replace(ENTRY, name="cpu", device="cuda", backend="mujoco"))
    told = plan_runs(replace(sweep, entry=asked), tmp_path / "asked")[1]
    assert list(told) == ["one", "cpu"]
    for sentence in told.values():
        assert "--" not in sentence and sentence.endswith("""; write device = "cpu" in the sweep's file""")
    assert plan_runs(replace(sweep, entry=(replace(ENTRY, device="cpu"),)), tmp_path / "other")[1] == {}
    everywhere = replace(sweep, device="cpu", entry=(ENTRY, replace(ENTRY, name="two", device="cuda")))
    assert list(plan_runs(everywhere, tmp_path / "everywhere")[1]) == ["two"], "an entry's own goes first"


@pytest.mark.parametrize("note", [{"more": 1}, {"\x1b[31m": 1}, {"seed": 9}, {"more": None}, {"init_from": None}])
def test_a_note_that_was_edited_is_refused(tmp_path, note):
    ((run,), _) = plan_runs(SWEEP, tmp_path)
    path = run.folder / "entry.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | note))
    ((), refused) = plan_runs(SWEEP, tmp_path)
    (name,) = note
    its = f"whose {one_line(name)} is {note[name]}, and the sweep's file says {0 if name == 'seed' else 'none'}; give another"
    assert its in refused["one"] and refused["one"].isprintable()


@pytest.mark.parametrize("noted", [{"iteration": "5"}, {"iteration": None}, {"iteration": []}, {"outcome": 5}])
def test_a_run_description_that_was_edited_is_one_sentence(tmp_path, noted):
    ((run,), _) = plan_runs(SWEEP, tmp_path)
    made = run.folder / "logs" / "go2_cts" / "2026-01-01"
    made.mkdir(parents=True)
    (made / "model_1.pt").touch()
    (made / "run.json").write_text(json.dumps({"outcome": "finished"} | noted))
    with pytest.raises(CheckpointError, match=rf"run.json': {next(iter(noted))} is"):
        _ = run.trained


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        (
            ("epochs=3",),
            "whose training.algorithm.epochs is '2', and the sweep's file says '3'; give another folder with --out",
        ),
        (("clip=0.1", "epochs=2"), "whose training.algorithm.clip is none, and the sweep's file says '0.1'"),
        ((), "whose training.algorithm.epochs is '2', and the sweep's file says none"),
        (("epochs=3", "epochs=2"), "whose settings is ['training.algorithm.epochs=2'], and the sweep's file says ['"),
    ],
)
def test_a_folder_of_other_settings_is_refused(tmp_path, changed, sentence):
    before = replace(SWEEP, settings=("training.algorithm.epochs=2",))
    plan_runs(before, tmp_path)
    assert plan_runs(before, tmp_path)[1] == {}
    settings = tuple(f"training.algorithm.{setting}" for setting in changed)
    assert f"holds a training {sentence}" in plan_runs(replace(SWEEP, settings=settings), tmp_path)[1]["one"]


def test_a_seed_that_is_new_is_not_noted_with_settings_that_are_refused(tmp_path):
    """Or the file as it was would be refused for it."""
    plan_runs(SWEEP, tmp_path)
    more = replace(SWEEP, seeds=(1, 0))
    runs, refused = plan_runs(replace(more, settings=("training.algorithm.epochs=3",)), tmp_path)
    assert runs == [] and "holds a training whose training.algorithm.epochs is none" in refused["one"]
    assert plan_runs(more, tmp_path)[1] == {}


def test_a_training_begins_or_goes_on(tmp_path):
    (run,), _ = plan_runs(replace(SWEEP, settings=("environment.num_envs=8",)), tmp_path)
    begins = run.training_command(SWEEP, seconds=None, score_threads=2)
    assert begins[4:8] == ["train", "go2-cts", "environment.num_envs=8", "--no-score"]
    assert begins[begins.index("--seed") + 1] == "0" and "--resume" not in begins
    directory = run.folder / "logs" / "go2_cts" / "2026-01-01_00-00-00"
    directory.mkdir(parents=True)
    assert run.directory is None, "there is no checkpoint yet"
    (directory / "model_5.pt").touch()
    (directory / "run.json").write_text(json.dumps({"outcome": "finished", "iteration": run.iterations - 1}))
    assert not run.trained, "a shorter one was finished"
    goes_on = run.training_command(replace(SWEEP, training_suite="quick"), seconds=90.2, score_threads=2)
    assert goes_on[4:] == [
        *("train", "go2-cts", "environment.num_envs=8", "--resume", str(directory)),
        *("--score-suite", "quick", "--score-threads", "2", "--time", "90s", "--device", "cpu"),
        *("--no-film", "--log-root", str(run.folder / "logs")),
    ]
    (directory / "best.pt").touch()
    assert run.policy(SWEEP).name == "model_5.pt" and run.policy(BEST).name == "best.pt"


def test_a_training_may_begin_with_a_shipped_policy_or_a_checkpoint(tmp_path):
    going_on = replace(SWEEP, entry=(replace(ENTRY, task="go2-moe-cts"),), init_from="pretrained")
    (run,), _ = plan_runs(going_on, tmp_path)
    begins = run.training_command(going_on, seconds=None, score_threads=2)
    assert begins[begins.index("--init-from") + 1] == "pretrained"
    other = replace(going_on, entry=(replace(ENTRY, init_from="none.pt"),))
    assert "none.pt" in plan_runs(other, tmp_path / "other")[1]["one"]
    without = plan_runs(replace(going_on, init_from=None), tmp_path)[1]["one"]
    assert "whose init_from is 'pretrained', and the sweep's file says none" in without


def test_a_gauging_is_played_where_it_is_told(tmp_path):
    run = scripted(tmp_path, "entry")
    results = run.folder / "gauge" / "model_3"
    (run.folder / "logs" / "x" / "2026").mkdir(parents=True)
    (run.folder / "logs" / "x" / "2026" / "model_3.pt").touch()
    command = SweepRun.gauging_command(run, SWEEP, where=["--cluster", "auto", "--threads", "4"])
    assert command[4:] == [
        *("evaluate", str(run.policy(SWEEP)), "--suite", SWEEP.suite, "--cluster", "auto", "--threads", "4"),
        *("--out", str(results), "--json", "--no-clip"),
    ]


def test_copies_of_a_run_are_no_seeds(tmp_path):
    runs = [scripted(tmp_path, "same", seed=seed) for seed in (0, 1)]
    work(runs)
    sweep = replace(SWEEP, entry=(runs[0].entry,))
    found = fold_sweep(sweep, runs, {}, {}, tmp_path)
    assert "All seeds of 'same' have the same score, which says nothing of their spread." in found["sentences"]


def test_an_entry_is_its_best_run_and_the_spread_of_all():
    scores = {0: 0.704, 1: 0.7, 2: None, 3: 0.708}
    rows = [
        {"seed": seed, "score": score, "reason": "", **dict.fromkeys(("score_interval", "level", "groups", "results"))}
        for seed, score in scores.items()
    ]
    entry = _entry("one", rows, None)
    assert (entry["runs"], entry["scored"], entry["best"]["seed"]) == (4, 3, 3)
    assert (entry["mean"], entry["deviation"]) == (pytest.approx(0.704), pytest.approx(0.004))
    assert entry["range"] == [0.7, 0.708]
    assert _entry("one", rows[:1], None)["range"] is None


def test_tables_tell_what_is_missing(tmp_path):
    """Nothing has been trained: rows and a page all the same."""
    sweep = replace(SWEEP, entry=(ENTRY, replace(ENTRY, name="<b>")), title="A & B")
    runs, refused = plan_runs(replace(sweep, entry=(ENTRY,)), tmp_path)
    found = fold_sweep(sweep, runs, {"<b>": "no such task"}, {"one, seed 0": "it broke"}, tmp_path)
    assert [(r["state"], r["reason"]) for r in found["runs"]] == [("failed", "it broke")]
    assert [(e["entry"], e["reason"], e["best"]) for e in found["entries"]] == [
        ("one", "it broke", None),
        ("<b>", "no such task", None),
    ]
    page = (tmp_path / "sweep.html").read_text()
    assert "&lt;b&gt;" in page and "A &amp; B" in page and "no score yet" in page and refused == {}
    assert json.loads((tmp_path / "sweep.json").read_text()) == found


def test_curves_keep_their_entries():
    curves = {("a", 0): {"mean reward": ([1.0, 2.0], [0.5, 0.75])}, ("b", 1): {"mean reward": ([1.0], [0.25])}}
    assert curves_csv(curves).splitlines()[1:] == [
        "a,0,mean reward,1,0.5",
        "a,0,mean reward,2,0.75",
        "b,1,mean reward,1,0.25",
    ]
    nothing = ([], [])
    assert by_figure(curves, {"b": (0, 1), "a": (0,), "c": (0,)}) == {
        "mean reward": {"b": [nothing, ([1.0], [0.25])], "a": [([1.0, 2.0], [0.5, 0.75])], "c": [nothing]}
    }


def test_a_seed_is_drawn_alike_whether_or_not_earlier_ones_have_a_curve():
    curves = {("a", 0): {}, ("a", 1): {"mean reward": ([1.0, 2.0], [0.5, 0.75])}}
    (series,) = by_figure(curves, {"a": (0, 1)}).values()
    (line,) = [line for line in charts.curves(series)["lines"] if line["points"]]
    assert (line["label"], line["place"]) == ("a", 1)


def test_entries_are_compared_over_their_seeds():
    """By hand: means 2 and 6, variances 1 and 4 of three runs each, so t = 4 / sqrt(5 / 3) with (5/3)² / (1/18 + 8/9) degrees."""
    found = across_seeds({"a": [0.1, 0.2, 0.3], "b": [0.4, 0.6, 0.8], "c": [0.15, 0.2, 0.25]})
    assert [(p["first"], p["second"]) for p in found] == [("a", "b"), ("a", "c"), ("b", "c")]
    expected = 2.0 * student_t.sf(4.0 / (5.0 / 3.0) ** 0.5, (5.0 / 3.0) ** 2 / (1.0 / 18.0 + 8.0 / 9.0))
    assert found[0]["difference"] == pytest.approx(0.4) and found[0]["p_value"] == pytest.approx(expected)
    assert found[0]["corrected"] == pytest.approx(min(3.0 * expected, 1.0)) and found[1]["p_value"] == pytest.approx(
        1.0
    )
    found = across_seeds({"a": [0.5, 0.5], "b": [0.6, 0.6], "c": [0.6, 0.7]})
    assert found == [], "copies of a run are no seeds"


def test_an_entry_with_one_run_has_the_pooled_spread_of_the_others():
    """By hand: variances 1 and 4 with two degrees each, pooled 2.5 with four; (0.9 - 0.2) against sqrt(1/3 + 2.5)."""
    found = across_seeds({"a": [0.1, 0.2, 0.3], "b": [0.4, 0.6, 0.8], "alone": [0.9]})
    pair = next(p for p in found if (p["first"], p["second"]) == ("a", "alone"))
    assert pair["error"] == pytest.approx((1.0 / 3.0 + 2.5) ** 0.5 / 10.0)
    freedom = (1.0 / 3.0 + 2.5) ** 2 / (1.0 / 9.0 / 2.0 + 2.5**2 / 4.0)
    assert pair["p_value"] == pytest.approx(2.0 * student_t.sf(0.7 / pair["error"], freedom))


def test_a_seed_of_the_gauge_that_is_easy_for_one_entry_counts_and_one_that_is_easy_for_all_does_not():
    """By hand: runs without spread but for 0.001; deviations that differ by 0.03, -0.03 and 0 between the entries."""
    scores = {"a": [0.5, 0.502], "b": [0.6, 0.602]}

    def chances(own):
        easy = np.array([[0.2, -0.1, -0.1]])
        return {"a": Chance(levels=np.zeros(1), seeds=(easy,)), "b": Chance(levels=np.zeros(1), seeds=(easy + own,))}

    training = 2 * 2e-6 / 2
    alike = across_seeds(scores, chances(np.zeros((1, 3))))[0]
    assert alike["error"] == pytest.approx(training**0.5) and alike["p_value"] == across_seeds(scores)[0]["p_value"]
    apart = across_seeds(scores, chances(np.array([[0.03, -0.03, 0.0]])))[0]
    assert apart["error"] == pytest.approx((training + 0.0018 / 6) ** 0.5)
    assert apart["p_value"] > alike["p_value"]


def test_the_seeds_of_a_card_are_the_mean_of_its_entrys_runs():
    one = sample(suite="quick")
    both = chance_of_seeds([one, one], name="a")
    table = both.seeds[0]
    assert table.shape[1] == len(one.chance.seeds) and table.sum(axis=1) == pytest.approx(0.0, abs=1e-9)
    assert np.array_equal(table, chance_of_seeds([one]).seeds[0])
    assert both.levels.std() == chance_of_seeds([one], name="a").levels.std() > 0.0, "two runs find no surer levels"


def test_entries_without_a_spread_are_not_compared():
    assert across_seeds({"a": [0.5], "b": [0.6, 0.6]}) == []
