"""``gaitgauge train --resume`` and ``--init-from``: what goes on, what begins, and one clear sentence for what cannot."""

import json
from pathlib import Path

import pytest
import torch
from gaitgauge.files import writing
from gaitgauge.files.writing import lock_folder
from gaitgauge.training.run.plan import prepare
from gaitgauge.training.run.request import TrainRequest
from gaitgauge.training.run.stopping import TrainingOutcome
from gaitgauge.training.tasks import TASKS
from small_run import FAKE, SMALL


def test_resume_keeps_settings_directory_and_horizon(run, trained):
    result = run(
        "train", "go2-flat", "--resume", trained, "--device", "cpu", "--no-score", "--no-film", "--iterations", 3
    )
    assert result.exit_code == 0, result.output
    entries = torch.load(trained / "model_3.pt", weights_only=True)
    assert entries["iter"] == 3
    assert entries["training"]["settings"]["environment"]["schedule"]["horizon_steps"] == 8
    assert entries["training"]["log"]["total_steps"] == 3 * 4 * 8
    (trained / "model_3.pt").unlink()


def test_carried_checkpoint_continues_in_a_new_directory(run, trained, tmp_path):
    carried = tmp_path / "model_2.pt"
    carried.write_bytes((trained / "model_2.pt").read_bytes())
    result = run(
        "train", "go2-flat", "--resume", carried, "--device", "cpu", "--no-score", "--no-film", "--iterations", 3
    )
    assert result.exit_code == 0, result.output
    (new,) = (tmp_path / "logs" / "rsl_rl" / "go2_flat").iterdir()
    assert [f.name for f in new.glob("model_*.pt")] == ["model_3.pt"]
    assert json.loads((new / "run.json").read_text())["begun_with"] == str(carried)


def test_an_earlier_checkpoint_goes_on_in_a_directory_of_its_own(run, trained, tmp_path):
    """Or the run's last checkpoint, for --resume, latest and play, would be the other branch's."""
    before = {f: f.read_bytes() for f in trained.rglob("*") if f.is_file()}
    (trained / "model_9.pt").write_bytes((trained / "model_2.pt").read_bytes())
    result = run(
        "train",
        "go2-flat",
        "--resume",
        trained / "model_2.pt",
        *FAKE[2:4],
        "--no-score",
        "--no-film",
        "--iterations",
        3,
    )
    (trained / "model_9.pt").unlink()
    assert result.exit_code == 0, result.output
    assert "has gone on to iteration 9: what comes of 2 has a run directory of its own" in result.output
    (new,) = (tmp_path / "logs" / "rsl_rl" / "go2_flat").iterdir()
    assert [f.name for f in new.glob("model_*.pt")] == ["model_3.pt"]
    assert {f: f.read_bytes() for f in trained.rglob("*") if f.is_file()} == before


def test_a_run_that_is_resumed_says_what_it_is_trained_with_now(run, trained):
    before = (trained / "run.json").read_text()
    changed = ("--iterations", 3, "training.algorithm.epochs=2")
    assert (
        run("train", "go2-flat", "--resume", trained, "--device", "cpu", "--no-score", "--no-film", *changed).exit_code
        == 0
    )
    found, earlier = json.loads((trained / "run.json").read_text()), json.loads(before)
    (trained / "model_3.pt").unlink()
    (trained / "run.json").write_text(before)
    assert found["settings"]["training"]["algorithm"]["epochs"] == 2
    assert found["started"] == earlier["started"] and found["command"] == earlier["command"]
    assert len(found["resumed"]) == len(earlier.get("resumed", ())) + 1


def test_initial_weights_from_other_settings(run, trained, tmp_path):
    command = ("train", "go2-flat", *FAKE[:4], "--num-envs", 12, "--no-score", "--no-film", "--iterations", 1, *SMALL)
    slow = ("training.algorithm.learning_rate=1e-12", "training.algorithm.student_learning_rate=1e-12")
    fixed = ("training.algorithm.desired_kl=none", "--init-from", trained / "model_2.pt")
    result = run(*command, *slow, *fixed)
    assert result.exit_code == 0, result.output
    (new,) = (tmp_path / "logs" / "rsl_rl" / "go2_flat").iterdir()
    ours = torch.load(new / "model_1.pt", weights_only=True)
    theirs = torch.load(trained / "model_2.pt", weights_only=True)
    assert ours["iter"] == 1
    for name, value in theirs["state_dict"].items():
        torch.testing.assert_close(ours["state_dict"][name], value, rtol=0, atol=1e-6)


def test_trained_networks_go_on_where_their_schedules_stood(trained):
    """Schedules at the place that the file names, or at their end; small first steps. What is spelled out wins."""

    def plan(source: Path | str, *overrides: str):
        task = "go2-moe-cts" if source == "pretrained" else "go2-flat"
        return prepare(
            TrainRequest(task=task, backend="fake", device="cpu", init_from=str(source), overrides=overrides)
        )

    begun = plan("pretrained").task
    assert begun.environment.schedule.begin == 1.0
    assert begun.training.algorithm.learning_rate == pytest.approx(3e-4)
    assert begun.training.algorithm.desired_kl == pytest.approx(0.003)
    assert begun.training.network.initial_std == pytest.approx(0.3)
    spelled = plan("pretrained", "environment.schedule.begin=0.5", "training.algorithm.learning_rate=1e-4")
    assert spelled.task.environment.schedule.begin == 0.5
    assert spelled.task.training.algorithm.learning_rate == pytest.approx(1e-4)
    entries = torch.load(trained / "model_2.pt", weights_only=True)
    entries["training"]["progress"] = 0.25
    torch.save(entries, trained / "quarter.pt")
    quarter = plan(trained / "quarter.pt", *SMALL)
    assert quarter.task.environment.schedule.begin == 0.25
    assert quarter.settings["environment"]["schedule"]["begin"] == 0.25
    (trained / "quarter.pt").unlink()
    new = prepare(TrainRequest(task="go2-moe-cts", backend="fake", device="cpu")).task
    assert (new.environment.schedule.begin, new.training.network.initial_std) == (0.0, 1.0)


def test_what_is_told_to_go_on_with_keeps_what_checkpoints_do_not(run, monkeypatch):
    """A run on the CPU without scores, or with another suite's, is not scored by ``quick`` on a GPU by the command that is printed."""
    chosen = ("--threads", 2, "--no-fuse", "--score-suite", "robogauge-1.1", "--score-threads", 1)
    result = run("train", "go2-flat", *FAKE[:-2], "--no-film", *chosen, *SMALL, "--time", "0.5s")
    told = " ".join(result.output.partition("--resume")[2].split())
    assert told.endswith("--device cpu --threads 2 --no-fuse --no-film --score-suite robogauge-1.1 --score-threads 1")
    result = run("train", "go2-flat", *FAKE, *SMALL, "--time", "0.5s")
    assert " ".join(result.output.partition("--resume")[2].split()).endswith("--device cpu --no-film --no-score")


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        ({}, "go on with: gaitgauge train"),
        ({"WORLD_SIZE": "2"}, "go on with: gaitgauge train"),
        (
            {"WORLD_SIZE": "16", "LOCAL_WORLD_SIZE": "8"},
            "go on with, on every machine and with its --rdzv options: "
            "torchrun --nnodes 2 --nproc-per-node 8 -m gaitgauge.cli.main train",
        ),
    ],
)
def test_what_is_told_to_go_on_with_starts_as_many_processes(run, trained, monkeypatch, told, expected):
    def stopped(plan, **_):
        return TrainingOutcome(reason="time", iteration=2, checkpoint=trained / "model_2.pt", exit_code=0), trained

    monkeypatch.setattr("gaitgauge.training.run.launch.train", stopped)
    for name, value in told.items():
        monkeypatch.setenv(name, value)
    result = run("train", "go2-flat", *FAKE, *SMALL)
    assert result.exit_code == 0, result.output
    assert f"{expected} go2-flat --resume {trained}" in " ".join(result.output.split())


def test_checkpoint_of_another_task(refused, trained, tmp_path):
    message = refused("train", "go2-cts", "--resume", trained, "--device", "cpu")
    assert "'go2-flat'" in message
    assert "'go2-cts'" in message
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize("option", ["--resume", "--init-from"])
@pytest.mark.parametrize("damage", ["empty", "truncated", "text"])
def test_damaged_checkpoint(refused, trained, tmp_path, damage, option):
    whole = (trained / "model_2.pt").read_bytes()
    content = {"empty": b"", "truncated": whole[: len(whole) // 2], "text": b"once upon a time\n"}[damage]
    (tmp_path / "model_9.pt").write_bytes(content)
    message = refused("train", "go2-flat", "--backend", "fake", option, tmp_path / "model_9.pt")
    assert message.startswith(f"Cannot {'resume' if option == '--resume' else 'start'}: ") and "model_9.pt" in message
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize("kind", ["torchscript", "tensors"])
def test_what_a_run_cannot_begin_with_is_not_resumed(refused, tmp_path, kind):
    path = tmp_path / "walk.pt"
    if kind == "torchscript":
        torch.jit.script(torch.nn.Identity()).save(str(path))
    else:
        torch.save({"a": 1}, path)
    message = refused("train", "go2-flat", *FAKE, "--init-from", path)
    assert message.startswith(f"Cannot start from '{path}': ") and ".gauge.pt" in message
    assert "esume" not in message
    assert refused("import", "--trainable", path, tmp_path / "x.pt").startswith(f"Cannot use '{path}': ")


def test_a_run_can_begin_with_any_policy_that_ships(refused):
    """Only the first of them had a name here; the other's robot does not fit, which is said of its file."""
    assert "go1.gauge.pt" in refused("train", "go2-flat", *FAKE, "--init-from", "pretrained-go1")
    assert "pretrained-go1" in refused("train", "go2-flat", *FAKE, "--init-from", "nowhere.pt")


def test_resume_with_another_number_of_environments(refused, trained):
    message = refused("train", "go2-flat", "--resume", trained, "--device", "cpu", "--num-envs", 16)
    assert "8 environments" in message
    assert "16" in message
    assert "--init-from" in message


def test_policy_without_training_state(refused, policy):
    assert "no training state" in refused("train", "go2-flat", "--backend", "fake", "--resume", policy)


def test_initial_weights_of_other_networks(refused, trained):
    bigger = [s.replace("student_hidden=8", "student_hidden=16") for s in SMALL]
    message = refused("train", "go2-flat", *FAKE, "--init-from", trained / "model_2.pt", *bigger)
    assert message == (
        f"Cannot start from '{trained / 'model_2.pt'}': its network has encoder_hidden [8] (this run's [16]); give the same "
        "training.network.* settings."
    )


def test_initial_weights_of_another_method(refused, trained, tmp_path):
    message = refused("train", "go2-him", *FAKE, "--init-from", trained / "model_2.pt", *SMALL)
    assert message.endswith("': its network is cts, this run's is him; begin with a file of him, or with none.")
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize(
    ("setting", "named"),
    [
        ("training.network.latent_width=16", "has latent_width 32 (this run's 16)"),
        ("training.algorithm.method=him", "is cts, this run's is him"),
        ("environment.observations.history_length=7", "has history_length 5 (this run's 7)"),
    ],
)
def test_resuming_with_another_network(refused, trained, setting, named):
    before = sorted(trained.rglob("*"))
    message = refused("train", "go2-flat", "--resume", trained, "--device", "cpu", "--iterations", 3, setting)
    assert (
        f"Cannot resume from '{trained / 'model_2.pt'}': its network {named}; a resumed run keeps its network"
        in message
    )
    assert sorted(trained.rglob("*")) == before


def test_finished_run_says_what_to_give(refused, trained):
    message = refused(
        "train", "go2-flat", "--resume", trained / "model_2.pt", "--device", "cpu", "--no-score", "--no-film"
    )
    assert "2 of 2 iterations" in message
    assert "--iterations" in message


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (("--iterations", 1), "has done 2 of 1 iterations"),
        (("--iterations", 3, "environment.observations.history_start=zeros"), "policy contract differs"),
        (("--iterations", 3, "training.algorithm.minibatches=1000"), "do not fill 1000 minibatches"),
    ],
)
def test_a_resume_that_is_refused_changes_nothing(refused, trained, change, named):
    before = {f: f.read_bytes() for f in trained.rglob("*") if f.is_file()}
    assert named in refused(
        "train", "go2-flat", "--resume", trained, "--device", "cpu", "--no-score", "--no-film", *change
    )
    assert {f: f.read_bytes() for f in trained.rglob("*") if f.is_file()} == before


@pytest.mark.parametrize("name", [n if i < 3 else pytest.param(n, marks=pytest.mark.slow) for i, n in enumerate(TASKS)])
def test_a_resumed_run_has_the_settings_of_its_checkpoint_whatever_the_task_says_today(trained, name, monkeypatch):
    """All of them, also those that nobody had spelled out."""
    from gaitgauge.training.run import plan

    entries = torch.load(trained / "model_2.pt", weights_only=True)
    made = prepare(TrainRequest(task=name, backend="fake", device="cpu", num_envs=8, seed=3, iterations=70))
    entries["training"] |= {"task": name, "settings": dict(made.settings)}
    path = trained / "other.pt"
    torch.save(entries, path)
    elsewhere = prepare(
        TrainRequest(task=name, backend="fake", device="cpu", overrides=("training.algorithm.clip=0.9",))
    )
    monkeypatch.setattr(plan, "find_task", lambda *_, **__: elsewhere.task)
    monkeypatch.setattr(plan, "check_network", lambda *_: None)  # the file's network is of its own task
    resumed = prepare(TrainRequest(task=name, device="cpu", resume=str(path)))
    assert resumed.task.environment == made.task.environment
    assert resumed.task.training == made.task.training
    assert resumed.backend == "fake" and resumed.settings == made.settings
    changed = prepare(TrainRequest(task=name, device="cpu", resume=str(path), iterations=90)).task
    assert changed.training.run.iterations == 90
    assert changed.environment == made.task.environment, "the horizon of the schedules stays"
    path.unlink()


def test_two_processes_do_not_share_a_run(run, trained, monkeypatch):
    monkeypatch.setattr(writing, "_PATIENCE", 0.1)
    lock = lock_folder(trained, RuntimeError)
    before = sorted(f.name for f in trained.iterdir())
    resume = ("train", "go2-flat", "--resume", trained, "--device", "cpu", "--no-score", "--no-film", "--iterations", 3)
    result = run(*resume)
    assert result.exit_code == 2
    assert "another process is writing to" in result.stderr
    assert sorted(f.name for f in trained.iterdir()) == before
    lock.release()


def test_a_checkpoint_without_its_settings_begins_a_new_run(refused, trained):
    entries = torch.load(trained / "model_2.pt", weights_only=True)
    entries["training"]["settings"] = {"backend": "fake", "overrides": []}
    torch.save(entries, trained / "early.pt")
    message = refused("train", "go2-flat", "--resume", trained / "early.pt", "--device", "cpu")
    assert f"--init-from {trained / 'early.pt'}" in message
    (trained / "early.pt").unlink()
