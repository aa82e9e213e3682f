"""The average of the weights over the later part of a run."""

from dataclasses import replace

import mean_policy
import pytest
import torch
from gaitgauge.policy.contract import PolicyContract
from gaitgauge.policy.loading import load_policy
from gaitgauge.training.configuration import ConfigurationError
from gaitgauge.training.run.averaging import WeightAverage
from gaitgauge.training.run.checkpoint import learned_networks, read_checkpoint, trim_checkpoint, write_checkpoint
from gaitgauge.training.run.resuming import begin_with, resume_run, stored_network
from gaitgauge.training.run.runner import TrainingRunner
from gaitgauge.training.run.seeding import seed_everything
from torch import nn
from toy_training import ToyEnv, toy_configuration, toy_contract


def runner(folder=None, *, seed=0, **arguments):
    seed_everything(seed)
    return TrainingRunner(
        ToyEnv(seed=seed), toy_configuration(), contract=toy_contract(), task="toy", log_dir=folder, **arguments
    )


def averaged(weights, age):
    """Averages after each iteration of one number that takes these values."""
    module = nn.Linear(1, 1, bias=False).requires_grad_(False)
    average = WeightAverage({"module": module}, age=age)
    seen = []
    for weight in weights:
        module.weight.fill_(weight)
        average.update()
        seen.append(average.state_dict()["module"]["weight"].item())
    return seen


@pytest.mark.parametrize("age", [0.05, 0.1, 0.5])
def test_the_average_lies_its_age_back(age):
    """Of weights that rise by one in every iteration, the average after t lags by age (t - 1): by hand from the recursion."""
    expected = [t - age * (t - 1) for t in range(1, 201)]
    assert averaged(range(1, 201), age) == pytest.approx(expected, rel=1e-5)


def test_the_oldest_age_is_the_plain_mean_and_none_is_the_last():
    assert averaged([1.0, 2.0, 6.0, -1.0], 0.5) == pytest.approx([1.0, 1.5, 3.0, 2.0])
    assert averaged([1.0, 2.0, 6.0, -1.0], 0.0) == [1.0, 2.0, 6.0, -1.0]


@pytest.mark.parametrize("age", [-0.1, 0.6])
def test_other_ages_are_refused(age):
    with pytest.raises(
        ConfigurationError, match=rf"average_age is {age:g}; it must be between 0 \(no average\) and 0\.5"
    ):
        toy_configuration(run={"average_age": age})


def test_a_checkpoint_plays_the_average_and_resumes_the_raw_weights(tmp_path):
    made = runner(tmp_path)
    made.learn(3)
    entries = read_checkpoint(tmp_path / "model_3.pt")
    assert torch.equal(entries["actor_state_dict"]["student.actor.0.weight"], made.alg.actor.student.actor[0].weight)
    mean = entries["average"]["actor_state_dict"]["student.actor.0.weight"]
    assert torch.equal(entries["state_dict"]["actor.0.weight"], mean)
    assert not torch.equal(mean, entries["actor_state_dict"]["student.actor.0.weight"])
    observation = ToyEnv(seed=3).get_observations()["policy"]
    played = load_policy(tmp_path / "model_3.pt").session(8).act(observation)
    history = torch.zeros(8, 5, 45)
    history[:, -1] = observation
    student = made.alg.actor.student
    student.load_state_dict(entries["state_dict"])
    with torch.no_grad():
        assert torch.allclose(played, student(history), atol=1e-6)


def test_a_new_run_and_a_trimmed_policy_begin_with_the_average(tmp_path):
    runner(tmp_path).learn(3)
    entries = read_checkpoint(tmp_path / "model_3.pt")
    trim_checkpoint(tmp_path / "model_3.pt", tmp_path / "mean.pt")
    trim_checkpoint(tmp_path / "model_3.pt", tmp_path / "raw.pt", raw=True)
    for file, raw in (("model_3.pt", False), ("mean.pt", False), ("raw.pt", True)):
        begun = runner(seed=5)
        begin_with(begun, tmp_path / file)
        expected = learned_networks(entries, raw=raw)
        for part, module in (("actor_state_dict", begun.alg.actor), ("critic_state_dict", begun.alg.critic)):
            for name, value in module.state_dict().items():
                assert torch.equal(value, expected[part][name]), (file, name)
        for name, value in stored_network(begun).state_dict.items():
            assert torch.equal(value, begun.alg.actor.student.state_dict()[name]), "the average begins anew"
    assert load_policy(tmp_path / "raw.pt").contract.provenance["weights"] == "last update"
    assert "weights" not in load_policy(tmp_path / "mean.pt").contract.provenance


def test_a_checkpoint_without_an_average_is_continued(tmp_path):
    """As written before training averaged."""
    runner(tmp_path).learn(2)
    entries = torch.load(tmp_path / "model_2.pt", weights_only=True)
    del entries["average"]
    torch.save(entries, tmp_path / "old.pt")
    said = []
    resumed = runner(seed=5, message=said.append)
    resume_run(resumed, tmp_path / "old.pt")
    assert said == [f"'{tmp_path / 'old.pt'}' holds no average of weights: it begins here."]
    raw = entries["actor_state_dict"]["student.actor.0.weight"]
    assert torch.equal(stored_network(resumed).state_dict["actor.0.weight"], raw)


def test_the_mean_of_policies_may_be_of_a_part_and_knows_the_physics_of_all(tmp_path, monkeypatch):
    """By hand: what has "encoder" in its name is half of both files, the rest that of the last."""
    physics = ({"trained": [{"engine": "a"}], "tuned": []}, {"trained": [{"engine": "b"}], "tuned": []})
    for name, seed, each in zip("ab", (0, 1), physics, strict=True):
        made = runner(tmp_path / name, seed=seed)
        made.learn(1)
        entries = read_checkpoint(tmp_path / name / "model_1.pt")
        contract = PolicyContract.from_json(entries["contract"])
        contract = replace(contract, provenance={**contract.provenance, "physics": each})
        write_checkpoint(tmp_path / f"{name}.pt", entries | {"contract": contract.to_json()})
    a, b, out = (tmp_path / name for name in ("a.pt", "b.pt", "mean.gauge.pt"))
    monkeypatch.setattr("sys.argv", ["mean_policy.py", str(out), str(a), str(b), "--only", "encoder"])
    mean_policy.main()
    first, last, mean = (learned_networks(read_checkpoint(file))["actor_state_dict"] for file in (a, b, out))
    parts = {"encoder" in name for name in mean}
    assert parts == {True, False}
    for name, value in mean.items():
        expected = (first[name] + last[name]) / 2 if "encoder" in name else last[name]
        assert torch.allclose(value, expected), name
    said = PolicyContract.from_json(read_checkpoint(out)["contract"]).provenance
    assert [engine["engine"] for engine in said["physics"]["trained"]] == ["a", "b"]
    assert said["mean_of_part"] == "encoder" and len(said["mean_of"]) == 2
