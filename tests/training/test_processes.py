"""Several processes of one run, as far as one process can show it; ``test_several_processes.py`` starts real ones."""

import pytest
import torch
from gaitgauge.training.configuration import ConfigurationError
from gaitgauge.training.processes import Processes
from gaitgauge.training.run.keepsake import Keepsake
from gaitgauge.training.run.logger import RunLogger
from gaitgauge.training.run.runner import TrainingRunner
from gaitgauge.training.run.seeding import seed_everything
from toy_training import ToyEnv, toy_configuration, toy_contract, toy_mirror


class Twins(Processes):
    """Two processes that compute the same: the sum over both is twice what one has."""

    def average(self, values):
        values += values.clone()
        values /= self.count

    def copy_first(self, tensors):
        pass

    def firsts(self, value):
        return value

    def largest(self, number):
        return number


@pytest.mark.parametrize(
    ("method", "symmetry"),
    [
        ("cts", "alternate"),
        ("dreamwaq", "alternate"),
        pytest.param("cts", "none", marks=pytest.mark.slow),
        pytest.param("ac_moe", "alternate", marks=pytest.mark.slow),
    ],
)
def test_a_step_in_two_halves_is_the_same_step(method, symmetry):
    def learned(processes):
        seed_everything(0)
        algorithm = {"symmetry": symmetry, "method": method}
        configuration = toy_configuration(encoder="moe" if method == "cts" else "mlp", algorithm=algorithm)
        runner = TrainingRunner(
            ToyEnv(), configuration, contract=toy_contract(), task="toy", mirror=toy_mirror(), processes=processes
        )
        runner.learn(2)
        return [p.detach() for p in (*runner.alg.actor.parameters(), *runner.alg.critic.parameters())]

    for alone, together in zip(learned(Processes()), learned(Twins(count=2)), strict=True):
        assert torch.equal(alone, together)


def test_a_keepsake_does_not_change_with_what_it_was_taken_of():
    weight, plain = torch.ones(3), {"lr": 0.1, "betas": (0.9, 0.999)}
    keepsake = Keepsake()
    assert keepsake.take() is None
    for iteration, value in ((1, 1.0), (2, 5.0)):
        weight.fill_(value)
        keepsake.keep({"state": {0: weight}, "groups": [plain]}, iteration, "cpu")
    weight.zero_()
    assert keepsake.iteration == 2
    kept = keepsake.take()
    assert kept["state"][0].tolist() == [5.0, 5.0, 5.0]
    assert kept["groups"] == [plain]


@pytest.mark.parametrize("name", ["RANK", "WORLD_SIZE"])
@pytest.mark.parametrize("value", ["x", "", "-1", "1.5", "9" * 400, "\u0663", "[/x]\x1b"])
def test_what_torchrun_did_not_say_is_one_sentence(monkeypatch, name, value):
    monkeypatch.setenv(name, value)
    with pytest.raises(ConfigurationError, match=f"the environment variable {name} is ") as caught:
        Processes.join("cpu")
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(("rank", "count"), [(1, None), (2, 2), (0, 0)])
def test_a_rank_beyond_the_processes_is_one_sentence(monkeypatch, rank, count):
    monkeypatch.setenv("RANK", str(rank))
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    if count is not None:
        monkeypatch.setenv("WORLD_SIZE", str(count))
    with pytest.raises(
        ConfigurationError, match=f"RANK is {rank} and WORLD_SIZE {1 if count is None else count}; ranks"
    ):
        Processes.join("cpu")


@pytest.mark.parametrize(
    "variables",
    [{}, {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "x"}, {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "-1"}],
)
def test_processes_that_are_not_there_are_one_sentence(monkeypatch, variables):
    for name in ("MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    for name, value in {"WORLD_SIZE": "2", "RANK": "0", **variables}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ConfigurationError, match=r"the other processes of the run cannot be joined: .*; start all"):
        Processes.join("cpu")


class Service:
    """A writer of a service: steps must rise."""

    def __init__(self):
        self.seen = []

    def add_scalar(self, name, value, step):
        self.seen.append((name, value, step))

    def save_model(self, path, step):
        self.seen.append(("model", path, step))

    def save_video(self, path, step):
        self.seen.append(("video", path, step))


def test_a_late_score_stands_where_it_came_back(tmp_path):
    logger = RunLogger(toy_configuration(), num_envs=8, processes=1, device="cpu")
    logger.writer = Service()
    logger.write({"Loss/value": 1.0}, 7)
    logger.write({"Gauge/quick/score": 0.5}, 4)
    logger.send(tmp_path / "model_8.pt", 8)
    logger.send(tmp_path / "model_4.mp4", 4)
    assert logger.writer.seen == [
        ("Loss/value", 1.0, 7),
        ("Gauge/quick/score", 0.5, 7),
        ("model", str(tmp_path / "model_8.pt"), 8),
        ("video", tmp_path / "model_4.mp4", 7),
    ]
