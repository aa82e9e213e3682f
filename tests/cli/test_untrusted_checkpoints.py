"""Checkpoints of training that somebody else wrote: what they may say of a run, and what a command alone decides."""

import shutil
import sys
from pathlib import Path

import pytest
import torch
from gaitgauge.training.environment.own_terms import foreign_functions
from gaitgauge.training.run import logger
from gaitgauge.training.run import plan as planning
from gaitgauge.training.run.plan import prepare
from gaitgauge.training.run.request import TrainRequest
from small_run import FAKE, SMALL

RESUME = ("--device", "cpu", "--no-score", "--no-film", "--iterations", 3)


def stranger(trained: Path, folder: Path, **environment: object) -> Path:
    """A checkpoint whose settings name code that lies in the current folder."""
    sys.modules.pop("evil_code", None)
    (folder / "evil_code.py").write_text("open('executed', 'w').close()\nOwn = TASK = None\n")
    entries = torch.load(trained / "model_2.pt", weights_only=True)
    entries["training"]["settings"]["environment"] |= environment
    torch.save(entries, folder / "model_2.pt")
    return folder / "model_2.pt"


@pytest.mark.parametrize("place", ["generator", "level rule", "reward", "event"])
def test_functions_that_a_checkpoint_names_are_not_imported(refused, run, trained, tmp_path, monkeypatch, place):
    monkeypatch.syspath_prepend(str(tmp_path))
    stored = torch.load(trained / "model_2.pt", weights_only=True)["training"]["settings"]["environment"]
    term = {"name": "mine", "function": "evil_code:Own", "weight": 1.0}
    changed = {
        "generator": {"commands": stored["commands"] | {"generator": "evil_code:Own"}},
        "level rule": {"terrain": stored["terrain"] | {"level_rule": "evil_code:Own"}},
        "reward": {"rewards": stored["rewards"] | {"own": [term]}},
        "event": {"events": [{k: term[k] for k in ("name", "function")}]},
    }[place]
    path = stranger(trained, tmp_path, **changed)
    resume = ("train", "go2-flat", "--resume", path, "--device", "cpu", "--no-score", "--no-film", "--iterations", 3)
    message = refused(*resume)
    assert "'evil_code:Own'" in message and "--trust" in message
    run("import", path, tmp_path / "x.gauge.pt")
    run("list", "policies")
    assert not (tmp_path / "executed").exists()
    assert "evil_code" in refused(*resume, "--trust")
    assert (tmp_path / "executed").exists(), "it would not have been imported anyway"


def test_what_the_command_line_names_needs_no_trust(trained, tmp_path, monkeypatch):
    stored = torch.load(trained / "model_2.pt", weights_only=True)["training"]["settings"]["environment"]
    named = "environment.commands.generator=mine:Own"
    path = stranger(trained, tmp_path, commands=stored["commands"] | {"generator": "mine:Own"})
    request = TrainRequest(task="go2-flat", device="cpu", resume=str(path), overrides=(named,), iterations=3)
    plan = prepare(request)
    assert plan.task.environment.commands.generator == "mine:Own" and plan.needs_trust
    assert not prepare(TrainRequest(task="go2-flat", device="cpu", resume=str(trained), iterations=3)).needs_trust


def test_a_run_directory_that_leads_elsewhere_is_refused(refused, trained, tmp_path):
    """Scores and videos are written into its folders under names that can be known before."""
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    (tmp_path / "precious").mkdir()
    (run / "gauge").symlink_to(tmp_path / "precious")
    assert "'gauge' is a link" in refused("train", "go2-flat", "--resume", run, *RESUME)
    assert not list((tmp_path / "precious").iterdir())


@pytest.mark.parametrize(
    ("name", "foreign"),
    [
        ("gaitgauge.training.environment.commands:CommandGenerator", False),
        ("gaitgauge.training.environment.own_terms:import_module", True),
        ("gaitgauge.cli.main:train", True),
        ("gaitgauge.training.nothing:here", True),
        ("os:system", True),
    ],
)
def test_the_package_vouches_for_its_own_functions_alone(name, foreign):
    assert foreign_functions({"a": [{"b": name}]}, {}) == ([name] if foreign else [])
    assert foreign_functions({"a": [{"b": name}]}, {"known": name}) == []


@pytest.mark.parametrize("text", ["[]", "{", '{"resumed": 3}', '{"best_score": "high"}', "[" * 9999])
def test_damaged_descriptions_of_a_run(refused, trained, tmp_path, text):
    (tmp_path / "model_2.pt").write_bytes((trained / "model_2.pt").read_bytes())
    (tmp_path / "run.json").write_text(text)
    assert "run.json" in refused(
        "train", "go2-flat", "--resume", tmp_path, "--device", "cpu", "--no-score", "--no-film"
    )


def test_a_task_that_a_checkpoint_names_is_no_command_to_paste(refused, trained, tmp_path):
    entries = torch.load(trained / "model_2.pt", weights_only=True)
    entries["training"]["task"] = "evil_code:TASK; rm -rf /"
    torch.save(entries, tmp_path / "model_2.pt")
    message = refused("train", "go2-flat", "--resume", tmp_path / "model_2.pt", "--device", "cpu")
    assert "gaitgauge train evil_code" not in message


@pytest.mark.parametrize("service", ["wandb", pytest.param("neptune", marks=pytest.mark.slow)])
def test_a_checkpoint_never_chooses_where_data_go(run, trained, tmp_path, monkeypatch, service):
    entries = torch.load(trained / "model_2.pt", weights_only=True)
    settings = entries["training"]["settings"]["training"]["run"]
    settings |= {"logger": service, "logger_project": "stranger"}
    path = tmp_path / "model_2.pt"
    torch.save(entries, path)
    started, checked = [], []
    monkeypatch.setattr(planning, "check_logger", checked.append)
    monkeypatch.setattr(logger.importlib, "import_module", lambda name: started.append(name))
    result = run("train", "go2-flat", "--resume", path, *RESUME)
    assert result.exit_code == 0 and started == []
    assert f"add --logger {service} to go on with that" in " ".join(result.output.split())
    request = TrainRequest(task="go2-flat", device="cpu", resume=str(path), iterations=3)
    plan = prepare(request)
    assert (plan.task.training.run.logger, plan.task.training.run.logger_project) == ("tensorboard", "gaitgauge")
    asked = prepare(TrainRequest(task="go2-flat", device="cpu", resume=str(path), iterations=3, logger=service))
    assert (asked.task.training.run.logger, asked.task.training.run.logger_project) == (service, "gaitgauge")
    assert checked == ["tensorboard", "tensorboard", service]


@pytest.mark.parametrize(
    ("field", "value", "named"),
    [
        ("experiment", "../../outside", "plain folder name"),
        ("run_name", "/../../outside", "part of a folder's name"),
        ("logger", "evil_code", "tensorboard, wandb, neptune"),
        ("steps_per_iteration", 10**30, "2.63"),
    ],
)
def test_settings_that_reach_elsewhere_are_refused(refused, trained, tmp_path, field, value, named):
    entries = torch.load(trained / "model_2.pt", weights_only=True)
    entries["training"]["settings"]["training"]["run"][field] = value
    path = tmp_path / "in" / "model_2.pt"
    path.parent.mkdir()
    torch.save(entries, path)
    assert named in refused("train", "go2-flat", "--resume", path, *RESUME).replace("^", ".")


def test_settings_larger_than_the_machine_are_one_sentence(refused, trained, tmp_path):
    entries = torch.load(trained / "model_2.pt", weights_only=True)
    for width, named in ((10**7, "less than or equal to 65536"), (30_000, "(this run's [30000, 30000])")):
        entries["training"]["settings"]["training"]["network"]["actor_hidden"] = [width, width]
        torch.save(entries, tmp_path / "model_2.pt")
        assert named in refused("train", "go2-flat", "--resume", tmp_path / "model_2.pt", *RESUME)
    large = "training.network.actor_hidden=30000,30000"
    assert "weights; at most" in refused("train", "go2-flat", *FAKE, large)


@pytest.mark.parametrize("trust", [(), ("--trust",)])
def test_what_lies_beside_a_checkpoint_is_no_code(refused, tmp_path, policy, trust):
    assert "holds no training state" in refused("train", "go2-flat", "--backend", "fake", "--resume", policy, *trust)
    assert "network is mlp, this run's is cts" in refused(
        "train", "go2-flat", *FAKE, "--init-from", policy, *SMALL, *trust
    )
