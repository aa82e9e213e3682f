"""Checkpoints that somebody else wrote or edited: what does not fit is one sentence, before a step is taken with it."""

import copy
from pathlib import Path

import pytest
import torch
from gaitgauge.policy.native import ForeignFile, save_policy
from gaitgauge.training.processes import Processes
from gaitgauge.training.run.checkpoint import CheckpointError, rank_file, read_checkpoint, trim_checkpoint
from gaitgauge.training.run.resuming import begin_with, resume_run
from gaitgauge.training.run.runner import TrainingRunner
from gaitgauge.training.run.seeding import random_state, restore_random_state
from small_environment import make
from toy_training import ToyEnv, toy_configuration, toy_contract


def runner(**options) -> TrainingRunner:
    return TrainingRunner(ToyEnv(), toy_configuration(), contract=toy_contract(), task="toy", **options)


@pytest.fixture(scope="module")
def entries(tmp_path_factory) -> dict:
    folder = tmp_path_factory.mktemp("run")
    return torch.load(runner(log_dir=folder).learn(1).checkpoint, weights_only=True)


def put(entries: dict, path: tuple, value: object) -> dict:
    """A copy of the entries with one of them replaced; ``gone`` takes it out."""
    changed = copy.deepcopy(entries)
    table = changed
    for key in path[:-1]:
        table = table[key]
    if value == "gone":
        del table[path[-1]]
    else:
        table[path[-1]] = value
    return changed


@pytest.fixture(scope="module")
def mine() -> TrainingRunner:
    """Refused checkpoints leave it as good as any other."""
    return runner()


def refused(call, *arguments, named: str | None = None) -> str:
    with pytest.raises(CheckpointError, match=named) as caught:
        call(*arguments)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 1500
    return str(caught.value)


MANY = torch.zeros(10_000, 3)
FIELDS = [
    *[("training", name) for name in ("log", "random", "environment", "num_envs", "world_size", "best_score", "task")],
    *[("training", "log", name) for name in ("returns", "lengths", "group_returns", "total_steps")],
    *[("training", "random", name) for name in ("python", "numpy", "torch")],
    ("training", "environment", "generator"),
    ("training", "version"),
    ("iter",),
    ("version",),
    ("network",),
    ("contract",),
    ("average", "iterations"),
    ("average", "actor_state_dict"),
    ("actor_state_dict",),
    ("critic_state_dict",),
    ("optimizer_state_dict",),
    ("optimizer_state_dict", "state"),
    ("student_optimizer_state_dict", "param_groups"),
]
ODD = ("\x1b[31m" + "x" * 5000, MANY, [[], {"a": MANY}])


@pytest.mark.filterwarnings("ignore:Using a non-tuple")
@pytest.mark.parametrize("field", FIELDS, ids=lambda f: ".".join(f))
def test_a_checkpoint_with_odd_entries_is_one_sentence(entries, mine, tmp_path, field):
    path = tmp_path / "model_1.pt"
    for value in ("gone", ODD[FIELDS.index(field) % 3]):
        changed = put(entries, field, value)
        changed.pop("checksum")
        torch.save(changed, path)
        refused(resume_run, mine, path, named=r"model_1\.pt")


@pytest.mark.parametrize(
    ("field", "value", "named"),
    [
        (("iter",), -3, "iteration is -3"),
        (("iter",), 1.5, "iteration is 1.5"),
        (("training", "num_envs"), True, "num_envs is True"),
        (("training", "world_size"), -1, "world_size is -1"),
        (("training", "best_score"), float("nan"), "best_score is nan"),
        (("training", "version"), 2, "version 2"),
        (("training", "progress"), float("nan"), "progress is nan"),
        (("optimizer_state_dict", "param_groups", 0, "lr"), float("nan"), "learning rate is nan"),
        (("optimizer_state_dict", "state", 0, "exp_avg"), torch.zeros(1), r"exp_avg of parameter 0 has shape \(1,\)"),
        (("optimizer_state_dict", "state", 10**6), {}, "moments of parameter 1000000"),
        (("average", "iterations"), "many", "invalid literal"),
        (("bootstrap",), {"left": 1.5, "optimizer": {}}, "lacks is learned for 1.5 more iterations"),
        (("bootstrap",), {"left": 3, "optimizer": {}}, "damaged|fit"),
        (("training", "random", "numpy", 2), 10**6, "random state is at word 1000000 of 624"),
        (("training", "log", "reward_sum"), 3, "no attribute"),
    ],
    ids=lambda value: value[-1] if isinstance(value, tuple) else None,
)
def test_numbers_out_of_range_are_named(entries, mine, tmp_path, field, value, named):
    path = tmp_path / "model_1.pt"
    changed = put(entries, field, value)
    changed.pop("checksum")
    torch.save(changed, path)
    refused(resume_run, mine, path, named=named)


@pytest.mark.parametrize("value", [{"left": 1.5}, {"left": 0}, {}, [3], "many"])
def test_beginning_with_an_odd_number_of_iterations_for_a_bare_policy_is_one_sentence(entries, mine, tmp_path, value):
    path = tmp_path / "model_1.pt"
    changed = put(entries, ("bootstrap",), value)
    changed.pop("checksum")
    torch.save(changed, path)
    refused(begin_with, mine, path, named=r"model_1\.pt")
    refused(trim_checkpoint, path, tmp_path / "out.pt", named=r"model_1\.pt")


def test_weights_that_were_edited_are_found(entries, mine, tmp_path):
    path = tmp_path / "model_1.pt"
    changed = copy.deepcopy(entries)
    next(iter(changed["state_dict"].values())).add_(1.0)
    torch.save(changed, path)
    for call in (resume_run, begin_with):
        refused(call, mine, path, named="checksum")


def test_optimizers_keep_the_settings_of_this_run(entries, tmp_path):
    path = tmp_path / "model_1.pt"
    torch.save(put(entries, ("optimizer_state_dict", "param_groups", 0, "betas"), "no numbers"), path)
    mine = runner()
    resume_run(mine, path)
    assert mine.alg.optimizer.param_groups[0]["betas"] == (0.9, 0.999)
    assert mine.alg.learning_rate == pytest.approx(float(entries["optimizer_state_dict"]["param_groups"][0]["lr"]))
    mine.learn(1)


@pytest.mark.parametrize("content", [b"", b"no archive", {"log": 3}, {"log": {}, "random": MANY}, [1], "pickle"])
def test_the_file_of_another_process_is_read_as_carefully(entries, mine, tmp_path, content, monkeypatch):
    """``model_1.rank1.pt`` lies beside the checkpoint, and is a stranger's as well."""
    path = tmp_path / "model_1.pt"
    torch.save(put(entries, ("training", "world_size"), 2), path)
    beside = rank_file(path, 1)
    if isinstance(content, bytes):
        beside.write_bytes(content)
    elif content == "pickle":
        torch.save({"log": Path("x")}, beside)
    else:
        torch.save(content, beside)
    monkeypatch.setattr(mine, "processes", Processes(rank=1, count=2))
    refused(resume_run, mine, path)


@pytest.mark.filterwarnings("ignore:Using a non-tuple")
@pytest.mark.parametrize("field", [*FIELDS[-7:], ("iter",)], ids=lambda f: ".".join(f))
def test_beginning_or_trimming_with_odd_entries_is_one_sentence(entries, mine, tmp_path, field):
    path = tmp_path / "model_1.pt"
    for value in ("gone", ODD[FIELDS.index(field) % 3]):
        changed = put(entries, field, value)
        changed.pop("checksum")
        torch.save(changed, path)
        for call in (lambda: begin_with(mine, path), lambda: trim_checkpoint(path, tmp_path / "out.pt")):
            try:
                call()
            except CheckpointError as error:
                assert str(error).isprintable() and len(str(error)) < 1500


def test_a_program_inside_a_policy_file_is_nothing_to_begin_with(mine, tmp_path):
    path = tmp_path / "own.gauge.pt"
    save_policy(path, toy_contract(), ForeignFile(kind="onnx", data=b"\x08" + bytes(30)))
    refused(begin_with, mine, path, named=r"carries a program \(onnx\), not weights")


def test_a_checkpoint_of_any_size_is_not_read(tmp_path):
    path = tmp_path / "model_1.pt"
    with path.open("wb") as file:
        file.truncate(2**40)
    refused(read_checkpoint, path, named="larger than 512 MiB")


@pytest.mark.parametrize("name", ["level", "terrain_index"])
@pytest.mark.parametrize("value", [-1, 10**6])
def test_tiles_that_are_not_there_are_refused(name, value):
    """Engines look terrains up by these numbers without checking."""
    environment = make(4)
    state = environment.state_dict()
    state["memory"][name][1] = value
    with pytest.raises(ValueError, match=f"'{name}' is not between 0 and"):
        environment.load_state_dict(state)
    if name == "level":
        progress = environment.progress_dict()
        progress["level"][1] = -1
        with pytest.raises(ValueError, match="'level' is not between 0 and"):
            environment.load_state_dict(progress)


@pytest.mark.parametrize("part", ["memory", "motors", "bodies", "observations", "physics"])
def test_tensors_of_another_shape_are_refused(part):
    environment = make(4)
    for value in (torch.zeros(1), None, "text"):
        state = environment.state_dict()
        name = next(iter(state[part]))
        state[part][name] = value
        with pytest.raises(ValueError, match=f"'{name}' (has shape|is missing)"):
            environment.load_state_dict(state)


@pytest.mark.parametrize("position", [-1, 625, 10**9])
def test_numpy_s_generator_never_reads_beyond_its_words(position):
    state = random_state("cpu")
    state["numpy"][2] = position
    with pytest.raises(ValueError, match="random state is at word"):
        restore_random_state(state, "cpu")
