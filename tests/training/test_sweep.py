"""Sweeps: their files, which runs they have, processes in their places, and what is told at the end."""

import fcntl
import json
import os
import re
import signal
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from gaitgauge.gauge.policies import file_digest
from gaitgauge.gauge.suite import load_suite
from gaitgauge.training.checkpoint import CheckpointError
from gaitgauge.training.sweep.curves import by_figure, curves_csv
from gaitgauge.training.sweep.file import Sweep, SweepEntry, SweepError, load_sweep
from gaitgauge.training.sweep.folding import across_seeds, fold_sweep
from gaitgauge.training.sweep.jobs import Jobs, visible_gpus
from gaitgauge.training.sweep.runs import SweepRun, plan_runs
from gaitgauge.training.tasks import find_task
from scipy.stats import t as student_t

ROOT = Path(__file__).parents[2]
CARD = ROOT / "docs" / "data" / "scorecards" / "pretrained-gaitgauge-1.json"
ENTRY = SweepEntry(name="one", task="go2-cts")
SWEEP = Sweep(name="toy", title="A toy", entry=(ENTRY,), backend="fake", training_suite="none")

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
        ("name = 'a'\ntitle = 'b'\nseeds = [1, 1]\n[[entry]]\nname = 'c'\ntask = 'd'", r"seeds \[1, 1\]; give"),
        ("name = 'a'\ntitle = 'b'\ncheckpoint = 'first'\n[[entry]]\nname = 'c'\ntask = 'd'", "'last' or 'best'"),
        (
            "name = 'a'\ntitle = 'b'\ncheckpoint = 'best'\ntraining_suite = 'none'\n[[entry]]\nname = 'c'\ntask = 'd'",
            "which training_suite chooses",
        ),
        (
            "name = 'a'\ntitle = 'b'" + "\n[[entry]]\nname = 'C'\ntask = 'd'\n[[entry]]\nname = 'c'\ntask = 'd'",
            "several",
        ),
        (
            f"name = 'a'\ntitle = 'b'\nseeds = {list(range(1001))}\n[[entry]]\nname = 'c'\ntask = 'd'",
            "1,001 trainings",
        ),
        (
            "name = 'a'\ntitle = 'b'\nsettings = ['training.run.seed=1']\n[[entry]]\nname = 'c'\ntask = 'd'",
            r"'training.run.seed=1', with which all seeds train the same run; write seeds",
        ),
        (
            "name = 'a'\ntitle = 'b'\n[[entry]]\nname = 'c'\ntask = 'd'\nsettings = [' environment.seed = 1']",
            "with which all seeds",
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


@pytest.mark.parametrize("path", SHIPPED, ids=lambda p: p.stem)
def test_shipped_sweeps_could_start(tmp_path, path):
    sweep = load_sweep(path)
    assert sweep.name == path.stem
    runs, refused = plan_runs(
        replace(sweep, entry=tuple(replace(entry, device="cpu") for entry in sweep.entry)), tmp_path
    )
    assert refused == {} and len(runs) == len(sweep.entry) * len(sweep.seeds)


@pytest.mark.parametrize("name", ["baselines", "moe-ablation", "strategies"])
def test_the_paper_s_tables_are_sweeps_as_long_as_needed(name):
    sweep = load_sweep(ROOT / "benchmarks" / "sweeps" / f"{name}.toml")
    assert len(sweep.entry) >= 4 and len(sweep.seeds) >= 2
    for entry in sweep.entry:
        task = find_task(entry.task, (*sweep.settings, *entry.settings))
        run = task.training.run
        assert run.iterations * run.steps_per_iteration * task.environment.num_envs >= 600e6


def test_the_guide_s_sweep_fits(tmp_path):
    (text,) = re.findall(r"```toml\n(.*?)```", (ROOT / "docs" / "methods.md").read_text(), re.S)
    sweep = load_sweep(write(tmp_path, text))
    for entry in sweep.entry:
        find_task(entry.task, (*sweep.settings, *entry.settings))


def test_entries_that_cannot_start_leave_the_others(tmp_path):
    entries = (
        ENTRY,
        SweepEntry(name="misspelt", task="go2-ctss"),
        SweepEntry(name="setting", task="go2-cts", settings=("training.algorithm.epoch=3",)),
        SweepEntry(name="engine", task="go2-cts", backend="physx"),
        replace(ENTRY, name="two", seeds=(7,)),
    )
    runs, refused = plan_runs(replace(SWEEP, entry=entries, seeds=(3, 4)), tmp_path)
    assert [run.label for run in runs] == ["one, seed 3", "two, seed 7", "one, seed 4"]
    assert list(refused) == ["misspelt", "setting", "engine"]
    for sentence, named in zip(refused.values(), ("go2-cts", "training.algorithm.epochs", "'physx'"), strict=True):
        assert named in sentence and "\n" not in sentence


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_without_a_gpu_only_engines_of_the_cpu_start(tmp_path):
    sweep = replace(SWEEP, backend="mujoco-warp", entry=(ENTRY, replace(ENTRY, name="cpu", backend="mujoco")))
    runs, refused = plan_runs(sweep, tmp_path)
    assert [run.label for run in runs] == ["cpu, seed 0"] and not runs[0].on_gpu
    assert "this machine has none" in refused["one"]
    assert plan_runs(replace(sweep, entry=(replace(ENTRY, device="cpu"),)), tmp_path / "other")[1] == {}


@pytest.mark.parametrize("note", [{"more": 1}, {"\x1b[31m": 1}, {"seed": 9}, {"more": None}, {"init_from": None}])
def test_a_note_that_was_edited_is_refused(tmp_path, note):
    ((run,), _) = plan_runs(SWEEP, tmp_path)
    path = run.folder / "entry.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | note))
    ((), refused) = plan_runs(SWEEP, tmp_path)
    assert "holds a training with another" in refused["one"] and refused["one"].isprintable()


@pytest.mark.parametrize("noted", [{"iteration": "5"}, {"iteration": None}, {"iteration": []}, {"outcome": 5}])
def test_a_run_description_that_was_edited_is_one_sentence(tmp_path, noted):
    ((run,), _) = plan_runs(SWEEP, tmp_path)
    made = run.folder / "logs" / "go2_cts" / "2026-01-01"
    made.mkdir(parents=True)
    (made / "model_1.pt").touch()
    (made / "run.json").write_text(json.dumps({"outcome": "finished"} | noted))
    with pytest.raises(CheckpointError, match=rf"run.json': {next(iter(noted))} is"):
        _ = run.trained


def test_a_folder_of_other_settings_is_refused(tmp_path):
    plan_runs(SWEEP, tmp_path)
    assert plan_runs(SWEEP, tmp_path)[1] == {}
    changed = replace(SWEEP, settings=("training.algorithm.epochs=3",))
    assert "holds a training with other settings" in plan_runs(changed, tmp_path)[1]["one"]


def test_a_seed_that_is_new_is_not_noted_with_settings_that_are_refused(tmp_path):
    """Or the file as it was would be refused for it."""
    plan_runs(SWEEP, tmp_path)
    more = replace(SWEEP, seeds=(1, 0))
    runs, refused = plan_runs(replace(more, settings=("training.algorithm.epochs=3",)), tmp_path)
    assert runs == [] and "holds a training with other settings" in refused["one"]
    assert plan_runs(more, tmp_path)[1] == {}


def test_a_training_begins_or_goes_on(tmp_path):
    (run,), _ = plan_runs(replace(SWEEP, settings=("environment.num_envs=8",)), tmp_path)
    begins = run.training_command(SWEEP, seconds=None, score_threads=2)
    assert begins[3:7] == ["train", "go2-cts", "environment.num_envs=8", "--no-score"]
    assert begins[begins.index("--seed") + 1] == "0" and "--resume" not in begins
    directory = run.folder / "logs" / "go2_cts" / "2026-01-01_00-00-00"
    directory.mkdir(parents=True)
    assert run.directory is None, "there is no checkpoint yet"
    (directory / "model_5.pt").touch()
    (directory / "run.json").write_text(json.dumps({"outcome": "finished", "iteration": run.iterations - 1}))
    assert not run.trained, "a shorter one was finished"
    goes_on = run.training_command(replace(SWEEP, training_suite="quick"), seconds=90.2, score_threads=2)
    assert goes_on[3:] == [
        *("train", "go2-cts", "environment.num_envs=8", "--resume", str(directory)),
        *("--score-suite", "quick", "--score-threads", "2", "--time", "90s", "--device", "cpu"),
        *("--log-root", str(run.folder / "logs")),
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
    assert "with another init_from" in plan_runs(replace(going_on, init_from=None), tmp_path)[1]["one"]


def test_a_gauging_is_played_where_it_is_told(tmp_path):
    run = scripted(tmp_path, "entry")
    results = run.folder / "gauge" / "model_3"
    (run.folder / "logs" / "x" / "2026").mkdir(parents=True)
    (run.folder / "logs" / "x" / "2026" / "model_3.pt").touch()
    command = SweepRun.gauging_command(run, SWEEP, where=["--cluster", "auto", "--threads", "4"])
    assert command[3:] == [
        *("evaluate", str(run.policy(SWEEP)), "--suite", SWEEP.suite, "--cluster", "auto", "--threads", "4"),
        *("--out", str(results), "--json", "--no-clip"),
    ]


class Scripted(SweepRun):
    """A run whose training and gauging are small programs."""

    def training_command(self, sweep, *, seconds, score_threads):
        program = f"""
import json, os, sys, time, pathlib
folder = pathlib.Path({str(self.folder)!r})
with open(folder.parents[2] / "order", "a") as file: file.write(f"{self.label} on {{os.environ['CUDA_VISIBLE_DEVICES']}}\\n")
(folder / "new").write_text(str(os.getpid()))
(folder / "new").rename(folder / "pid")
if {self.entry.name!r} == "deaf":
    import signal
    for number in (signal.SIGTERM, signal.SIGINT): signal.signal(number, signal.SIG_IGN)
    (folder / "is-deaf").touch()
time.sleep({0.3 if "slow" in self.entry.name else 60.0 if self.entry.name in ("long", "deaf") else 0.0})
if {self.entry.name!r} == "killed":
    print("iteration 60 of 1530, 23 min left", flush=True)
    os.kill(os.getpid(), 9)
if {self.entry.name!r} == "broken":
    sys.exit("gaitgauge: the physics has diverged")
run = folder / "logs" / "x" / "2026"
run.mkdir(parents=True, exist_ok=True)
if {self.entry.name!r} == "asked" and not (run / "model_1.pt").exists():
    (run / "model_1.pt").touch()
    print("go on with: gaitgauge train --resume", flush=True)
    sys.exit(128 + 15)
if {self.entry.name!r} == "asked-early":
    sys.exit(128 + 15)
(run / "model_3.pt").touch()
(run / "run.json").write_text(json.dumps(dict(outcome="finished", iteration={self.iterations})))
if {self.entry.name!r} == "damaged": (run / "run.json").write_text("{{")
"""
        return [sys.executable, "-S", "-c", program]

    def gauging_command(self, sweep, *, where):
        card = json.loads(CARD.read_text())
        card["policy"]["file_sha256"] = file_digest(str(self.policy(sweep)))
        (self.folder / "card.json").write_text(json.dumps(card))
        program = f"""
import pathlib, shutil
target = pathlib.Path({str(self.results(sweep))!r})
target.mkdir(parents=True, exist_ok=True)
shutil.copy({str(self.folder / "card.json")!r}, target / "results.json")
"""
        return [sys.executable, "-S", "-c", program]


def scripted(folder: Path, name: str, *, seed: int = 0, on_gpu: bool = True) -> Scripted:
    return Scripted(
        entry=SweepEntry(name=name, task="go2-cts"),
        seed=seed,
        settings=(),
        backend="fake",
        on_gpu=on_gpu,
        iterations=3,
        folder=folder / "runs" / name / f"seed-{seed}",
        suite_digest=load_suite(SWEEP.suite).digest,
    )


def work(runs, *, gpus=("3", "5"), per_gpu=1, deadline=None):
    said = []
    outcome = Jobs(SWEEP, threads=1, deadline=deadline, say=said.append, gpus=gpus, per_gpu=per_gpu).work(runs)
    return outcome, said


def test_each_gpu_has_one_training_and_a_failure_stops_nothing(tmp_path):
    runs = [scripted(tmp_path, name) for name in ("broken", "slow", "third")]
    runs.append(scripted(tmp_path, "processor", on_gpu=False))
    outcome, said = work(runs)
    order = (tmp_path / "order").read_text().splitlines()
    assert sorted(line.rpartition(" on ")[2] for line in order) == ["", "3", "3", "5"], "the short ones share a GPU"
    assert list(outcome.failures) == ["broken, seed 0"] and outcome.stopped is None and outcome.unfinished == []
    assert outcome.failures["broken, seed 0"].startswith("the physics has diverged (see '")
    assert all(run.trained and run.gauged(SWEEP) for run in runs[1:])
    assert sum("has been gauged" in sentence for sentence in said) == 3
    # Called again, only what failed is tried again.
    (tmp_path / "order").unlink()
    assert list(work(runs)[0].failures) == ["broken, seed 0"]
    assert (tmp_path / "order").read_text().startswith("broken, seed 0")


def test_a_training_that_was_killed_says_so_and_not_what_it_said_last(tmp_path):
    run = scripted(tmp_path, "killed")
    outcome, _ = work([run])
    assert outcome.failures["killed, seed 0"] == f"ended by SIGKILL (see '{run.log}')"


def test_a_training_that_was_stopped_from_outside_is_gone_on_with(tmp_path):
    """Not in the same call: who stopped it may want the machine."""
    run, early = scripted(tmp_path, "asked"), scripted(tmp_path, "asked-early")
    outcome, said = work([run, early])
    assert outcome.unfinished == ["asked, seed 0"] and list(outcome.failures) == ["asked-early, seed 0"]
    assert (
        "asked, seed 0 was stopped by SIGTERM from outside and has a checkpoint; a later call goes on with it" in said
    )
    assert work([run])[0].unfinished == [] and run.trained


def test_a_gpu_may_have_several_trainings(tmp_path):
    """All GPUs get one before any gets two."""
    runs = [scripted(tmp_path, name) for name in ("slow-1", "slow-2", "slow-3", "slow-4", "last")]
    outcome, said = work(runs, per_gpu=2)
    places = [s.partition(" is trained on ")[2].partition(";")[0] for s in said if " is trained on " in s]
    assert places[:4] == ["GPU 3", "GPU 5", "GPU 3, beside 1", "GPU 5, beside 1"]
    order = dict(line.split(" on ") for line in (tmp_path / "order").read_text().splitlines())
    assert [order[f"slow-{n}, seed 0"] for n in (1, 2, 3, 4)] == ["3", "5", "3", "5"]
    assert outcome.failures == {} and outcome.unfinished == []


def test_what_is_at_work_when_time_is_up_is_gone_on_with(tmp_path):
    runs = [scripted(tmp_path, "slow"), scripted(tmp_path, "late")]
    outcome, _ = work(runs, gpus=("0",), deadline=time.monotonic() + 0.15)
    assert outcome.unfinished == ["slow, seed 0", "late, seed 0"] and outcome.failures == {}
    assert work(runs, gpus=("0",))[0].unfinished == []


def test_a_signal_ends_what_is_at_work(tmp_path):
    runs = [scripted(tmp_path, "slow"), scripted(tmp_path, "late")]
    timer = threading.Timer(0.15, os.kill, (os.getpid(), signal.SIGTERM))
    timer.start()
    outcome, said = work(runs, gpus=("0",))
    timer.join()
    assert outcome.stopped == signal.SIGTERM and len(outcome.unfinished) == 2
    assert "SIGTERM received" in said[-1] and not any("late" in sentence for sentence in said)


def wait_for(path: Path) -> Path:
    until = time.monotonic() + 20.0
    while not path.exists():
        assert time.monotonic() < until, path
        time.sleep(0.02)
    return path


def alive(run: Scripted) -> bool:
    """Whether the training of a run lives, which was started from this process or from one that is gone."""
    try:
        os.kill(int((run.folder / "pid").read_text()), 0)
    except ProcessLookupError:
        return False
    return True


def signals_once(path: Path, *numbers: int) -> threading.Thread:
    """Sends this process signals, 30 ms apart, once a file is there."""

    def send() -> None:
        wait_for(path)
        for number in numbers:
            os.kill(os.getpid(), number)
            time.sleep(0.03)

    thread = threading.Thread(target=send)
    thread.start()
    return thread


def test_a_second_interrupt_shortens_the_wait_and_leaves_no_training(tmp_path, monkeypatch):
    monkeypatch.setattr("gaitgauge.training.sweep.jobs._LAST_PATIENCE", 0.3)
    run, began = scripted(tmp_path, "deaf"), time.monotonic()
    sender = signals_once(run.folder / "is-deaf", signal.SIGINT, signal.SIGINT)
    outcome, _ = work([run])
    sender.join()
    assert outcome.stopped == signal.SIGINT and outcome.unfinished == ["deaf, seed 0"]
    assert not alive(run) and time.monotonic() - began < 30.0


def test_a_terminal_that_is_closed_stops_a_sweep_like_a_signal(tmp_path):
    run = scripted(tmp_path, "long")
    sender = signals_once(run.folder / "pid", signal.SIGHUP)
    outcome, said = work([run])
    sender.join()
    assert outcome.stopped == signal.SIGHUP and not alive(run) and "SIGHUP received" in said[-1]


def test_a_mistake_of_the_sweep_itself_leaves_no_training(tmp_path, monkeypatch):
    run = scripted(tmp_path, "long")

    def broken(self):
        wait_for(run.folder / "pid")
        raise ZeroDivisionError

    monkeypatch.setattr(Jobs, "_collect", broken)
    with pytest.raises(ZeroDivisionError):
        work([run])
    assert not alive(run)


@pytest.mark.parametrize("place", ["train.log", "gauge.log"])
def test_a_log_that_cannot_be_written_is_the_failure_of_its_run(tmp_path, place):
    runs = [scripted(tmp_path, name) for name in ("first", "second")]
    (runs[0].folder / place).mkdir(parents=True)
    outcome, _ = work(runs)
    log = runs[0].folder / place
    assert outcome.failures == {"first, seed 0": f"'{log}': is a directory; mend that and call again"}
    assert runs[1].gauged(SWEEP)


def test_a_description_that_is_damaged_is_the_failure_of_its_run(tmp_path):
    """Also where it comes about while the run is trained."""
    runs = [scripted(tmp_path, name) for name in ("damaged", "second")]
    outcome, _ = work(runs)
    assert list(outcome.failures) == ["damaged, seed 0"] and outcome.unfinished == []
    assert "run.json' is not valid JSON" in outcome.failures["damaged, seed 0"] and runs[1].gauged(SWEEP)


def test_a_training_that_a_killed_sweep_left_is_not_started_again(tmp_path):
    runs = [scripted(tmp_path, name) for name in ("long", "second")]
    if not (sweep := os.fork()):
        work(runs[:1])
    number = int(wait_for(runs[0].folder / "pid").read_text())
    os.kill(sweep, signal.SIGKILL)
    os.waitpid(sweep, 0)
    outcome, _ = work(runs)
    assert list(outcome.failures) == ["long, seed 0"] and runs[1].gauged(SWEEP) and alive(runs[0])
    assert outcome.failures["long, seed 0"] == (
        f"it is still being trained on GPU 3 by process {number} of an earlier call; wait until that has ended, or stop it "
        f"with 'kill {number}', and call again"
    )
    os.kill(number, signal.SIGTERM)


@pytest.mark.parametrize("noted", ["", "1; rm -rf ~", "5", "\x1b[31m on \x1b"])
def test_what_a_lock_file_says_is_no_command(tmp_path, noted):
    """A full disk leaves it empty, versions before this one wrote a number alone; who wrote anything else is not known."""
    run = scripted(tmp_path, "one")
    run.folder.mkdir(parents=True)
    lock = run.folder / "train.lock"
    lock.write_text(noted)
    with lock.open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        sentence = work([run])[0].failures["one, seed 0"]
    assert ("kill 5'" in sentence) == (noted == "5") and "rm" not in sentence and sentence.isprintable()
    assert sentence.startswith("it is still being trained by ") and sentence.endswith("and call again")


@pytest.mark.parametrize("name", ["train.lock", "train.log", "gauge.lock", "gauge.log"])
def test_a_link_in_a_run_s_folder_is_not_written_through(tmp_path, name):
    """The folder may come from elsewhere."""
    run = scripted(tmp_path, "one")
    run.folder.mkdir(parents=True)
    (tmp_path / "precious").write_text("mine")
    (run.folder / name).symlink_to(tmp_path / "precious")
    sentence = work([run])[0].failures["one, seed 0"]
    assert (
        sentence
        == f"'{run.folder / name}' is a link, and a sweep writes to its own files alone; remove it and call again"
    )
    assert (tmp_path / "precious").read_text() == "mine"


def test_gpus_are_those_that_may_be_seen(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,GPU-1a")
    assert visible_gpus() == ["4", "GPU-1a"]
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    assert visible_gpus() == ["0", "1"]


def test_copies_of_a_run_are_no_seeds(tmp_path):
    runs = [scripted(tmp_path, "same", seed=seed) for seed in (0, 1)]
    work(runs)
    sweep = replace(SWEEP, entry=(runs[0].entry,))
    found = fold_sweep(sweep, runs, {}, {}, tmp_path)
    assert "All seeds of 'same' have the same score, which says nothing of their spread." in found["sentences"]


def test_a_suite_that_changes_during_a_gauging_is_not_played_for_ever(tmp_path):
    run = replace(scripted(tmp_path, "one"), suite_digest="another")
    assert "was changed while it was gauged; call again" in work([run])[0].failures["one, seed 0"]


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
    assert by_figure(curves, ["b", "a", "c"]) == {
        "mean reward": {"b": [([1.0], [0.25])], "a": [([1.0, 2.0], [0.5, 0.75])], "c": []}
    }


def test_entries_are_compared_over_their_seeds():
    """By hand: means 2 and 6, variances 1 and 4 of three runs each, so t = 4 / sqrt(5 / 3) with (5/3)² / (1/18 + 8/9) degrees."""
    found = across_seeds({"a": [0.1, 0.2, 0.3], "alone": [0.5], "b": [0.4, 0.6, 0.8], "c": [0.15, 0.2, 0.25]})
    assert [(p["first"], p["second"]) for p in found] == [("a", "b"), ("a", "c"), ("b", "c")]
    expected = 2.0 * student_t.sf(4.0 / (5.0 / 3.0) ** 0.5, (5.0 / 3.0) ** 2 / (1.0 / 18.0 + 8.0 / 9.0))
    assert found[0]["difference"] == pytest.approx(0.4) and found[0]["p_value"] == pytest.approx(expected)
    assert found[0]["corrected"] == pytest.approx(min(3.0 * expected, 1.0)) and found[1]["p_value"] == pytest.approx(
        1.0
    )
    assert across_seeds({"a": [0.5, 0.5], "b": [0.6, 0.6], "c": [0.6, 0.7]}) == [], "copies of a run are no seeds"
    assert across_seeds({"a": [0.5], "b": [0.6, 0.6]}) == []
