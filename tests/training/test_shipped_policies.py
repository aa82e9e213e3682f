"""Policies that ship hold what plays; what training needs to go on from the Go2's lies beside it."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from gaitgauge.policy.finding import PRETRAINED, shipped_policies
from gaitgauge.policy.loading import load_policy
from gaitgauge.training.run.checkpoint import (
    CheckpointError,
    read_checkpoint,
    student_state,
    training_part,
    write_apart,
    write_checkpoint,
)
from gaitgauge.training.run.plan import prepare
from gaitgauge.training.run.request import TrainRequest
from gaitgauge.training.tasks import find_task

PLAYS = {"format", "version", "contract", "network", "state_dict", "checksum"}


@pytest.mark.parametrize("name", shipped_policies())
def test_what_ships_holds_what_plays_and_is_small(name):
    path = shipped_policies()[name]
    assert torch.load(path, weights_only=True).keys() == PLAYS
    assert path.stat().st_size < 6_000_000
    assert training_part(path).is_file() == (path == PRETRAINED)


def test_training_goes_on_from_the_go2_with_its_teacher_and_critic():
    entries = read_checkpoint(PRETRAINED, training_state=False, purpose="start from")
    actor = entries["actor_state_dict"]
    assert entries["training"]["task"] == "go2-moe-cts" and entries["critic_state_dict"]
    assert any(name.startswith("teacher_encoder.") for name in actor) and "distribution.std_param" in actor
    assert all(torch.equal(value, entries["state_dict"][name]) for name, value in student_state(actor).items())
    assert training_part(PRETRAINED).stat().st_size < 6_000_000


def planned(path: Path, **settings):
    request = TrainRequest(task="go2-moe-cts", init_from=str(path), backend="fake", device="cpu", score=False)
    return prepare(replace(request, **settings))


def test_going_on_takes_small_steps_but_for_the_parts_of_a_ramp_that_are_given():
    assert planned(PRETRAINED).task.training.algorithm.desired_kl == 0.003
    found = planned(PRETRAINED, overrides=("training.algorithm.desired_kl.start=0.008",)).task.training.algorithm
    assert found.desired_kl == replace(find_task("go2-moe-cts").training.algorithm.desired_kl, start=0.008)
    assert found.learning_rate == 0.0003


def test_a_policy_without_teacher_and_critic_is_told_apart(tmp_path):
    assert planned(PRETRAINED).notice == ""
    alone = tmp_path / "walk.gauge.pt"
    shutil.copyfile(PRETRAINED, alone)
    assert planned(alone).notice == (
        f"'{alone}' holds no teacher and no critic: the first 60 iterations find them for it "
        "(training.run.bootstrap_iterations)"
    )


@pytest.fixture
def whole(tmp_path) -> Path:
    """A policy with teacher and critic inside, as ``import --trainable`` writes it."""
    entries = read_checkpoint(PRETRAINED, training_state=False, purpose="start from")
    write_checkpoint(tmp_path / "whole.gauge.pt", entries)
    return tmp_path / "whole.gauge.pt"


def test_the_two_files_are_the_one(whole, tmp_path):
    write_apart(whole, tmp_path / "walk.gauge.pt")
    both = read_checkpoint(tmp_path / "walk.gauge.pt", training_state=False, purpose="start from")
    one = read_checkpoint(whole, training_state=False, purpose="start from")
    for part in ("state_dict", "actor_state_dict", "critic_state_dict"):
        assert both[part].keys() == one[part].keys()
        assert all(torch.equal(both[part][name], value) for name, value in one[part].items())
    assert (both["iter"], both["training"], both["checksum"]) == (one["iter"], one["training"], one["checksum"])
    assert load_policy(whole).digest == load_policy(tmp_path / "walk.gauge.pt").digest


def test_only_a_policy_with_teacher_and_critic_is_written_apart(whole, tmp_path):
    write_apart(whole, tmp_path / "walk.gauge.pt")
    training_part(tmp_path / "walk.gauge.pt").unlink()
    with pytest.raises(CheckpointError, match="no policy with teacher and critic"):
        write_apart(tmp_path / "walk.gauge.pt", tmp_path / "again.gauge.pt")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"policy": "another"}, "is not the policy that '.*walk.training.pt' belongs to; move that file away"),
        ({"actor_state_dict": 3}, "walk.training.pt' beside it was edited or is damaged"),
        ({"training": {"version": 9}}, "training state has version 9"),
        (None, "Cannot start: .*walk.training.pt"),
    ],
)
def test_a_wrong_file_beside_a_policy_is_one_sentence(whole, tmp_path, change, message):
    path = tmp_path / "walk.gauge.pt"
    write_apart(whole, path)
    part = training_part(path)
    if change is None:
        part.write_bytes(part.read_bytes()[:1000])
    else:
        torch.save({**torch.load(part, weights_only=True), **change}, part)
    with pytest.raises(CheckpointError, match=message):
        read_checkpoint(path, training_state=False, purpose="start from")
