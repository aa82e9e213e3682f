"""``gaitgauge train``: one run on the fake engine, how it goes on, and one clear sentence for whatever is wrong."""

import errno
import fcntl
import importlib.util
import json
import os
import pty
import signal
import subprocess
import sys
import termios
import threading
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import pytest
import torch
from gaitgauge.cli.errors import UserError
from gaitgauge.cli.train import _Watch, parse_duration
from gaitgauge.files import writing
from gaitgauge.gauge.result import TerrainScore, read_result
from gaitgauge.gauge.store import StoreError
from gaitgauge.training.configuration import ConfigurationError
from gaitgauge.training.overrides import override_keys
from gaitgauge.training.run.logger import make_writer
from gaitgauge.training.run.plan import prepare
from gaitgauge.training.run.request import TrainRequest
from gaitgauge.training.run.scoring import Scorer, scores_of
from gaitgauge.training.run.side_process import PROGRAM
from gaitgauge.training.run.stopping import Progress
from gaitgauge.training.starting import processes_to_start
from gaitgauge.training.tasks import TASKS
from small_run import FAKE, SMALL

# ---- runs -----------------------------------------------------------------------------------------------------------


def test_run_directory_and_settings(trained):
    assert (trained / "model_2.pt").is_file()
    assert (trained / "params" / "env.yaml").read_text().count("seed: 5") == 1
    description = json.loads((trained / "run.json").read_text())
    assert (description["task"], description["backend"], description["num_envs"]) == ("go2-flat", "fake", 8)
    settings = torch.load(trained / "model_2.pt", weights_only=True)["training"]["settings"]
    assert settings["environment"]["schedule"]["horizon_steps"] == 8
    assert settings["training"]["network"]["actor_hidden"] == [8]
    assert settings["backend"] == "fake"


def test_signal_writes_a_checkpoint_and_says_how_to_go_on(run, tmp_path):
    def stop_when_it_trains() -> None:
        while not list(tmp_path.rglob("model_2.pt")):
            if finished.wait(0.02):
                return
        os.kill(os.getpid(), signal.SIGTERM)

    finished = threading.Event()
    watcher = threading.Thread(target=stop_when_it_trains)
    watcher.start()
    result = run("train", "go2-flat", *FAKE, *SMALL, "--iterations", 100_000, "training.run.save_interval=2")
    finished.set()
    watcher.join()
    assert result.exit_code == 128 + signal.SIGTERM
    assert "gaitgauge train go2-flat --resume" in result.output
    last = max(int(f.stem.removeprefix("model_")) for f in tmp_path.rglob("model_*.pt"))
    assert last >= 2
    assert f"{last} iterations done" in result.output


@pytest.mark.slow
@pytest.mark.usefixtures("hangups")
def test_a_terminal_that_is_closed_is_a_stop_like_a_signal(tmp_path):
    """SIGHUP, and then nothing can be written any more."""
    window, terminal = pty.openpty()
    command = ["train", "go2-flat", *FAKE, *SMALL, "--iterations", 100_000, "training.run.save_interval=2"]
    training = subprocess.Popen(
        [*PROGRAM, *map(str, command), "--log-root", str(tmp_path)],
        **dict.fromkeys(("stdin", "stdout", "stderr"), terminal),
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )
    os.close(terminal)
    while not list(tmp_path.rglob("model_2.pt")):
        assert training.poll() is None
        os.read(window, 10_000)
    os.close(window)
    assert training.wait(60) == 128 + signal.SIGHUP
    (noted,) = tmp_path.rglob("run.json")
    assert json.loads(noted.read_text())["outcome"] == "signal"


def test_time_limit_ends_with_success(run, tmp_path):
    result = run("train", "go2-flat", *FAKE, *SMALL, "--iterations", 100_000, "--time", "0.5s")
    assert result.exit_code == 0, result.output
    assert "time is up" in result.output
    assert list(tmp_path.rglob("model_*.pt"))


# ---- bad input ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("go2-mo-cts",), ("'go2-mo-cts'", "go2-moe-cts")),
        (("go2-flat", "environment.push.linaer=1"), ("'environment.push.linaer'", "environment.push.linear")),
        (
            ("go2-flat", "--iterations", 3, "training.run.iterations=4"),
            ("--iterations 3 and training.run.iterations=4 contradict each other; leave one of them out",),
        ),
        (("go2-flat", "--num-envs", 3, "environment.num_envs = 4"), ("--num-envs 3 and environment.num_envs = 4",)),
        (("go2-flat", "num_envs=3"), ("'num_envs'", "environment.num_envs")),
        (("go2-flat", "training.run.iterations=many"), ("'many'", "whole number")),
        (("go2-flat", "something"), ("'something'", "key=value")),
        (("go2-flat", "--backend", "mujoco-wrap"), ("'mujoco-wrap'", "mujoco-warp")),
        (("go2-flat", "--time", "soon"), ("'soon'", "1h30m")),
        (("go2-flat", "--time", "0"), ("'0'", "longer")),
        (("go2-flat", "--device", "cpu", "--backend", "fake", "--capture"), ("--capture", "cpu")),
        (("go2-flat", "--score-suite", "quik", "--backend", "fake"), ("'quik'", "'quick'")),
        (("go2-flat", "--resume", "latest", "--backend", "fake"), ("no checkpoint", "go2_flat")),
        (("go2-flat", "--resume", "nowhere.pt"), ("'nowhere.pt'", "latest")),
        (("go2-flat", "--init-from", "nowhere.pt"), ("'nowhere.pt'",)),
        (("go2-flat", "--resume", "latest", "--init-from", "x.pt"), ("--resume", "--init-from")),
        (("go2-flat", "--backend", "fake", "environment.joints.parameters=nope"), ("'nope'", "training")),
        (("go2-flat", "--backend", "fake", "training.run.experiment=a/b"), ("a/b", "folder name")),
        (("go2-flat", *FAKE, "--num-envs", 1), ("1 environment cannot", "--num-envs (environment.num_envs) 2 or more")),
        (
            (
                "go2-flat",
                *FAKE,
                "--num-envs",
                3,
                "training.algorithm.minibatches=1000",
                "training.run.steps_per_iteration=4",
            ),
            (
                "4 steps of 1 teacher and 2 student environments do not fill 1000 minibatches",
                "training.algorithm.minibatches=4 or fewer, or more --num-envs",
            ),
        ),
        (
            (
                *("go2-flat", *FAKE, *SMALL, "--num-envs", 1),
                *("training.algorithm.method=him", "training.run.steps_per_iteration=1"),
            ),
            ("one step of one environment", "training.run.steps_per_iteration"),
        ),
        (("go2-flat", "--backend", "fake", "--logger", "paper"), ("'paper'", "tensorboard, wandb, neptune")),
    ],
)
def test_bad_request(refused, arguments, named):
    message = refused("train", *arguments)
    for text in named:
        assert text in message


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_no_gpu(refused, tmp_path):
    assert "--backend mujoco trains this task here in about" in refused("train", "go2-flat")
    assert "--device cpu" in refused("train", "go2-flat", "--backend", "fake", "--device", "cuda")
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--run-name", "a\nb"), "run_name is 'a\\nb'; it must be printable"),
        (("--run-name", "\x1b[31m"), "run_name is '\\x1b[31m'"),
        (("--run-name", "\udcff"), "run_name is '\\udcff'"),
        (("training.run.experiment=\u202ex",), "experiment is '\\u202ex'"),
        (
            ("--iterations", 10**20),
            "iterations' is '100000000000000000000'; it must be less than or equal to 1000000000",
        ),
    ],
)
def test_what_cannot_be_a_run_leaves_no_folder(refused, tmp_path, arguments, named):
    assert named in refused("train", "go2-flat", *FAKE, "--log-root", tmp_path / "logs", *arguments)
    assert not (tmp_path / "logs").exists()


def test_full_disk_keeps_the_previous_checkpoint(run, tmp_path, monkeypatch):
    real = os.replace

    def replaces(source: Path, target: Path) -> None:
        if target.name == "model_2.pt":
            raise OSError(errno.ENOSPC, "No space left on device")
        real(source, target)

    monkeypatch.setattr(writing.os, "replace", replaces)
    result = run("train", "go2-flat", *FAKE, *SMALL, "--iterations", 3, "training.run.save_interval=1")
    assert result.exit_code == 2
    (sentence,) = result.stderr.splitlines()
    assert "model_2.pt" in sentence
    assert "no space left on device" in sentence
    assert "--resume latest" in sentence
    (run_directory,) = (tmp_path / "logs" / "rsl_rl" / "go2_flat").iterdir()
    assert [f.name for f in run_directory.iterdir() if "model" in f.name] == ["model_1.pt"]
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    again = run("train", "go2-flat", "--resume", "latest", "--no-score", "--no-film")
    assert again.exit_code == 0, again.output
    assert (run_directory / "model_3.pt").is_file()


# ---- pieces ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "seconds"), [("90", 90.0), ("1.5", 1.5), ("20s", 20.0), ("9m", 540.0), ("2h", 7200.0), ("1h30m", 5400.0)]
)
def test_durations(text, seconds):
    assert parse_duration(text) == seconds


@pytest.mark.parametrize("text", ["", "m", "-5", "9 m", "9d", "1e3", "0s", "9" * 400, "9" * 400 + "h", "²", "10000h1s"])
def test_impossible_durations(text):
    with pytest.raises(UserError, match="--time"):
        parse_duration(text)


@pytest.mark.parametrize("name", ["wandb", "neptune"])
def test_a_logger_that_is_not_there(refused, tmp_path, name):
    if importlib.util.find_spec(name) is not None:
        pytest.skip(f"{name} is installed")
    message = refused("train", "go2-flat", "--backend", "fake", "--logger", name)
    assert f"pip install {name}" in message
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize("name", ["wandb", "neptune"])
def test_a_folder_with_the_name_of_a_logger_is_no_logger(refused, tmp_path, monkeypatch, name):
    if importlib.util.find_spec(name) is not None:
        pytest.skip(f"{name} is installed")
    (tmp_path / name).mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    assert f"pip install {name}" in refused("train", "go2-flat", "--backend", "fake", "--logger", name)


def test_a_logger_whose_package_does_not_work_is_one_sentence(tmp_path, monkeypatch):
    (tmp_path / "wandb.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "wandb", raising=False)
    configuration = prepare(TrainRequest(task="go2-flat", backend="fake", device="cpu", logger="wandb")).task.training
    with pytest.raises(ConfigurationError, match="--logger wandb cannot start: "):
        make_writer(configuration, tmp_path, None)
    sys.modules.pop("wandb", None)


def test_a_rank_without_processes_is_refused_before_anything_is_made(refused, tmp_path, monkeypatch):
    monkeypatch.setenv("RANK", "1")
    message = refused("train", "go2-flat", *FAKE, *SMALL, "--iterations", 1)
    assert "RANK is 1 and WORLD_SIZE 1" in message and "torchrun" in message
    assert not (tmp_path / "logs").exists()


def test_a_run_in_which_nothing_was_written_leaves_no_directory(refused, tmp_path, monkeypatch):
    def too_large(*_, **__):
        raise MemoryError

    monkeypatch.setattr("gaitgauge.training.run.launch.TrainingRunner", too_large)
    assert "smaller --num-envs" in refused("train", "go2-flat", *FAKE, *SMALL)
    assert list((tmp_path / "logs" / "rsl_rl" / "go2_flat").iterdir()) == []


@pytest.mark.parametrize(
    ("asked", "device", "given", "count"),
    [
        (None, None, "cuda:0", 4),
        (None, "cuda", "cuda:0", 4),
        (2, None, "cuda:0", 2),
        (None, "cuda:1", "cuda:1", 1),
        (None, None, "cpu", 1),
    ],
)
def test_a_training_uses_all_gpus_unless_it_is_told(monkeypatch, asked, device, given, count):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    assert processes_to_start(asked, device, given) == count
    monkeypatch.setenv("WORLD_SIZE", "4")
    assert processes_to_start(asked, device, given) == 1


def test_more_gpus_than_there_are(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    with pytest.raises(
        ConfigurationError, match=r"--gpus is 3, but this command has 2 GPUs; give --gpus 2 or leave it out"
    ):
        processes_to_start(3, None, "cuda:0")
    with pytest.raises(ConfigurationError, match=r"--gpus is 2, but this command trains on 'cuda:1' alone"):
        processes_to_start(2, "cuda:1", "cuda:1")


def test_several_gpus_get_the_command_as_it_was_typed(run, monkeypatch):
    started = []
    monkeypatch.setattr("gaitgauge.training.starting.processes_to_start", lambda *_: 3)
    monkeypatch.setattr("gaitgauge.training.starting.start_processes", lambda *given, began: started.append(given) or 5)
    monkeypatch.setattr(sys, "argv", ["gaitgauge", "train", "go2-flat"])
    assert run("train", "go2-flat", *FAKE, *SMALL).exit_code == 5
    assert started == [(3, ["train", "go2-flat"])]


def test_more_processes_than_gpus(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setenv("LOCAL_RANK", "2")
    with pytest.raises(ConfigurationError, match="give --nproc-per-node 2"):
        prepare(TrainRequest(task="go2-flat", backend="fake", device="cuda"))


def test_settings_are_listed_with_default_unit_and_meaning(run):
    result = run("train", "--list-settings", "go2-flat", "environment.num_envs=64")
    assert result.exit_code == 0, result.output
    lines = result.output.splitlines()
    assert max(map(len, lines)) <= 80
    group = lines.index(next(line for line in lines if line == "environment.observations"))
    assert lines[group + 1] == "  Inputs of the networks"
    scan = lines.index("  scan_length = 1.6", group)
    assert lines[scan + 1] == "      Extent of the height scan along the heading [m]."
    assert "  num_envs = 64" in lines
    keys = set(override_keys(TASKS["go2-flat"].environment))
    listed, head = set(), ""
    for line in lines[2:]:
        if line and not line.startswith(" "):
            head = line.partition(" ")[0]
        elif " = " in line and line.startswith("  ") and line[2] != " ":
            listed.add(f"{head}.{line.strip().partition(' = ')[0]}")
    missing = {f"environment.{key}" for key in keys} - listed
    assert not missing


def test_settings_are_listed_as_the_options_beside_change_them(run):
    options = ("--num-envs", 7, "--iterations", 11, "--seed", 5, "--score-every", 3, "environment.seed=6")
    result = run("train", "go2-flat", "--list-settings", *options)
    assert result.exit_code == 0, result.output
    lines = result.output.splitlines()
    assert {"  num_envs = 7", "  iterations = 11", "  seed = 5", "  seed = 6", "  gauge_interval = 3"} <= set(lines)


def test_every_setting_says_what_it_means():
    from gaitgauge.cli.settings import _groups

    for root in ("environment", "training"):
        for group, _, entries in _groups(root, getattr(TASKS["go2-moe-cts"], root)):
            for name, _, text in entries:
                assert text, f"{group}.{name}"


def test_options_are_overrides_that_settings_may_repeat():
    request = TrainRequest(
        task="go2-flat",
        backend="fake",
        num_envs=24,
        seed=7,
        overrides=("environment.num_envs=24", "environment.seed=8"),
        score_every=50,
    )
    task = prepare(request).task
    assert task.environment.num_envs == 24
    assert (task.environment.seed, task.training.run.seed) == (8, 7)
    assert task.training.run.gauge_interval == 50


def test_time_limit_waits_for_no_score_unless_asked():
    def wait(*overrides: str, seconds: float | None) -> float:
        request = TrainRequest(task="go2-flat", backend="fake", seconds=seconds, overrides=overrides)
        return prepare(request).task.training.run.gauge_wait

    assert wait(seconds=None) > 0.0
    assert wait(seconds=60.0) == 0.0
    assert wait("training.run.gauge_wait=30", seconds=60.0) == 30.0
    assert wait("training.run.gauge_wait = 30", seconds=60.0) == 30.0


@pytest.mark.parametrize(
    ("choices", "suite"),
    [
        ({"task": "toy"}, "toy"),
        ({"task": "toy", "score_suite": "demo"}, "demo"),
        ({"task": "toy", "score": False}, None),
        ({"task": "go2-flat", "backend": "fake"}, None),  # its training is shorter than a score
        ({"task": "go2-cts", "backend": "fake"}, "quick"),
    ],
)
def test_a_task_has_a_suite_for_its_scores(choices, suite):
    assert prepare(TrainRequest(**choices)).suite == suite


def test_the_time_until_the_next_score_is_told():
    said = []

    class Display:
        def update(self, share, text, values, *, last):
            said.append(text)

    now = iter((100.0, 102.0, 104.0, 280.0))
    watch = _Watch(Display(), deadline=None)
    with patch("gaitgauge.cli.train.clock.monotonic", lambda: next(now)):
        for iteration, ahead in ((10, 40), (11, 39), (12, None), (100, None)):
            figures = {"scalars": {}, "best_score": None, "best_iteration": None, "next_score": ahead}
            watch.update(Progress(iteration=iteration, total_iterations=100, elapsed=20.0, **figures))
    assert said == [
        "iteration 10 of 100, estimating time",
        "iteration 11 of 100, 2 min 58 s left, score in 1 min 18 s",
        "iteration 12 of 100, 2 min 56 s left",
        "iteration 100 of 100",  # the film takes a minute, of which "0 s left" would be wrong
    ]


def test_scorer_runs_the_command_line_of_evaluate(tmp_path, monkeypatch):
    from gaitgauge.training.run import side_process

    started = []

    class Process:
        def __init__(self, command, **options):
            started.append((command, options["env"]))

        def poll(self):
            return None

    monkeypatch.setattr(side_process.subprocess, "Popen", Process)
    old = tmp_path / "gauge" / "quick" / "model_5" / "results.json"
    old.parent.mkdir(parents=True)
    old.write_text("{}")
    scorer = Scorer(tmp_path, suite="quick", threads=3)
    for iteration in (5, 6, 7):
        scorer.submit(tmp_path / f"model_{iteration}.pt", iteration)
    ((command, environment),) = started
    assert command[3:6] == ["gaitgauge.cli.main", "evaluate", str(tmp_path / "model_5.pt")]
    assert command[command.index("--threads") + 1] == "3"
    assert environment["CUDA_VISIBLE_DEVICES"] == ""
    assert not old.exists(), "results of the same iteration before a resume would be refused"
    (skipped,) = scorer.drain(0.0)
    assert skipped.iteration == 6
    assert "skipped" in skipped.failure


def test_scores_taken_from_results():
    card = read_result(Path(__file__).parents[1] / "fuzz" / "seeds" / "results" / "results.json", StoreError)
    terrains = {"flat": TerrainScore(mean=0.5), "wave": TerrainScore(level=3.0, mean=0.25)}
    result = replace(card, score=0.375, terrains=terrains, groups={"safety": 0.9})
    expected = {"score": 0.375, "terrain/flat": 0.5, "level/wave": 3.0, "terrain/wave": 0.25, "group/safety": 0.9}
    assert scores_of(result) == expected
    with pytest.raises(ValueError, match="no score"):
        scores_of(replace(result, score=None))
