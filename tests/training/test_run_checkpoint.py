import os
import random
import resource
import signal
from datetime import datetime

import numpy as np
import pytest
import torch
import yaml
from gaitgauge.policy.native import StoredNetwork
from gaitgauge.training.run.checkpoint import (
    CheckpointError,
    checkpoint_entries,
    read_checkpoint,
    write_checkpoint,
)
from gaitgauge.training.run.run_directory import (
    find_checkpoint,
    latest_checkpoint,
    new_run_directory,
    refuse_links,
    update_run_json,
    write_parameters,
)
from gaitgauge.training.run.seeding import random_state, restore_random_state, seed_everything
from toy_training import toy_configuration, toy_contract


def test_a_full_disk_leaves_the_previous_checkpoint(tmp_path):
    """A file size limit makes the kernel refuse the write half-way, as a full disk does."""
    path = tmp_path / "model_1.pt"
    write_checkpoint(path, {"weights": torch.zeros(10)})
    before = path.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
        with pytest.raises(CheckpointError) as error:
            write_checkpoint(path, {"weights": torch.zeros(1_000_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert path.read_bytes() == before and [f.name for f in tmp_path.iterdir()] == ["model_1.pt"]
    message = str(error.value)
    assert str(path) in message and "free some space" in message and "\n" not in message


def test_a_missing_folder_is_one_sentence(tmp_path):
    with pytest.raises(CheckpointError, match="no such file"):
        write_checkpoint(tmp_path / "gone" / "model_1.pt", {})


def test_checkpoints_hold_plain_data_only():
    network = StoredNetwork(architecture="mlp", arguments={}, state_dict={})
    with pytest.raises(CheckpointError, match=r"training\.environment\[1\] is a ndarray"):
        checkpoint_entries(toy_contract(), network, {"training": {"environment": [1, np.zeros(3)]}})
    with pytest.raises(CheckpointError, match="cannot be named contract"):
        checkpoint_entries(toy_contract(), network, {"contract": 1})


def test_a_bare_policy_cannot_be_resumed(tmp_path):
    path = tmp_path / "policy.pt"
    network = StoredNetwork(architecture="mlp", arguments={}, state_dict={})
    write_checkpoint(path, checkpoint_entries(toy_contract(), network, {}))
    with pytest.raises(CheckpointError, match="no training state"):
        read_checkpoint(path)


def test_random_state_survives_a_file(tmp_path):
    def draw():
        return random.random(), float(np.random.randn()), float(torch.rand(()))

    seed_everything(3)
    draw()
    write_checkpoint(tmp_path / "state.pt", random_state("cpu"))
    expected = [draw() for _ in range(3)]
    seed_everything(4)
    restore_random_state(torch.load(tmp_path / "state.pt", weights_only=True), "cpu")
    assert [draw() for _ in range(3)] == expected


def test_run_directories(tmp_path):
    now = datetime(2026, 1, 2, 3, 4, 5)
    first = new_run_directory(tmp_path, "go2", "trial", now)
    second = new_run_directory(tmp_path, "go2", "trial", now)
    assert first == tmp_path / "go2" / "2026-01-02_03-04-05_trial"
    assert second.name == "2026-01-02_03-04-06_trial"
    with pytest.raises(CheckpointError, match="There is no checkpoint: no run in"):
        find_checkpoint("latest", experiment="go2", root=tmp_path)
    for iteration in (900, 1000):
        (first / f"model_{iteration}.pt").touch()
    (first / "model_1000.rank1.pt").touch()
    assert latest_checkpoint(first) == first / "model_1000.pt"
    assert latest_checkpoint(second) is None
    # The newest run has no checkpoint yet.
    assert find_checkpoint("latest", experiment="go2", root=tmp_path) == first / "model_1000.pt"
    other = tmp_path / "mine" / "2027-01-01_00-00-00"
    other.mkdir(parents=True)
    (other / "model_3.pt").touch()
    (other / "run.json").write_text('{"task": "walk"}')
    assert find_checkpoint("latest", experiment="go2", root=tmp_path) == first / "model_1000.pt"
    assert find_checkpoint("latest", experiment="go2", task="run", root=tmp_path) == first / "model_1000.pt"
    assert find_checkpoint("latest", experiment="go2", task="walk", root=tmp_path) == other / "model_3.pt"
    # A task of one's own that was made of another one has its folder.
    own = tmp_path / "go2" / "2027-01-02_00-00-00"
    own.mkdir()
    (own / "model_4.pt").touch()
    (own / "run.json").write_text('{"task": "own:TASK"}')
    assert find_checkpoint("latest", experiment="go2", task="run", root=tmp_path) == first / "model_1000.pt"
    assert find_checkpoint("latest", experiment="go2", task="own:TASK", root=tmp_path) == own / "model_4.pt"
    assert find_checkpoint("latest", experiment="go2", root=tmp_path) == own / "model_4.pt"
    damaged = tmp_path / "mine" / "2028-01-01_00-00-00"
    damaged.mkdir()
    (damaged / "model_3.pt").touch()
    (damaged / "run.json").write_text('{"task": "wa')
    assert find_checkpoint("latest", experiment="go2", task="own:TASK", root=tmp_path) == own / "model_4.pt"
    (own / "run.json").write_text('{"task": "ow')
    with pytest.raises(CheckpointError, match=r"2027-01-02_00-00-00/run\.json' is not valid JSON"):
        find_checkpoint("latest", experiment="go2", task="own:TASK", root=tmp_path)
    assert find_checkpoint(str(first), experiment="other", root=tmp_path) == first / "model_1000.pt"
    run = tmp_path / "killed"
    run.mkdir()
    with pytest.raises(CheckpointError, match=r"killed' has no model_<iteration>\.pt\.$"):
        find_checkpoint(str(run), experiment="rough")
    (run / "run.json").write_text("{}")
    with pytest.raises(CheckpointError, match=r"\.pt; the run ended before its first one .*: start it again\.$"):
        find_checkpoint(str(run), experiment="rough")
    with pytest.raises(CheckpointError, match=r"There is no checkpoint 'none\.pt'"):
        find_checkpoint("none.pt", experiment="go2", root=tmp_path)


def test_a_place_whose_name_is_no_text_is_refused_before_it_is_made(tmp_path):
    root = tmp_path / os.fsdecode(b"\xff")
    with pytest.raises(CheckpointError, match=r"TensorBoard takes no path that is no UTF-8; choose another --log-root"):
        new_run_directory(root, "go2")
    assert not list(tmp_path.iterdir())


def test_a_name_that_python_takes_for_a_number_is_no_checkpoint(tmp_path):
    """Python says that a superscript is a digit, and makes no number of it."""
    (tmp_path / "model_\u00b2.pt").touch()
    assert latest_checkpoint(tmp_path) is None
    (tmp_path / "model_7.pt").touch()
    assert latest_checkpoint(tmp_path).name == "model_7.pt"


@pytest.mark.parametrize("link", ["gauge", "params", "gauge/quick/model_1.json"])
def test_a_run_directory_that_leads_elsewhere_is_refused(tmp_path, link):
    run, outside = tmp_path / "run", tmp_path / "outside"
    outside.mkdir()
    (run / link).parent.mkdir(parents=True)
    (run / "latest.pt").symlink_to("model_1.pt")  # a file of the run's own is nobody else's
    refuse_links(run)
    (run / link).symlink_to(outside)
    with pytest.raises(CheckpointError, match=f"'{link}' is a link"):
        refuse_links(run)


def test_parameters_are_safe_yaml(tmp_path):
    configuration = toy_configuration()
    write_parameters(tmp_path, environment={"range": (0.5, 1.5)}, agent=configuration)
    agent = yaml.safe_load((tmp_path / "params" / "agent.yaml").read_text())
    assert agent["network"]["actor_hidden"] == [32]
    assert agent["algorithm"]["learning_rate"] == configuration.algorithm.learning_rate
    assert yaml.safe_load((tmp_path / "params" / "env.yaml").read_text()) == {"range": [0.5, 1.5]}
    contract = toy_contract()
    update_run_json(tmp_path, {"contract_hash": contract.hash})
    update_run_json(tmp_path, {"outcome": "finished"})
    data = yaml.safe_load((tmp_path / "run.json").read_text())
    assert data["contract_hash"] == contract.hash and data["outcome"] == "finished"
