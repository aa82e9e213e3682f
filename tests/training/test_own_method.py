"""A training method of one's own, named ``module:name``: the guide's example on the fake engine."""

import re
import sys
from pathlib import Path

import gaitgauge
import pytest
import torch
from gaitgauge.policy.loading import load_policy
from gaitgauge.training.algorithms.methods import find_method
from gaitgauge.training.configuration import ConfigurationError
from gaitgauge.training.run.checkpoint import CheckpointError
from gaitgauge.training.run.launch import train
from gaitgauge.training.run.plan import prepare
from gaitgauge.training.run.request import TrainRequest

GUIDE = Path(gaitgauge.__path__[0]) / "docs" / "guides" / "your-algorithm.md"
OWN = "training.algorithm.method=huber_cts:HuberCTS"
SMALL = ("training.network.teacher_hidden=8", "training.network.student_hidden=8", "training.network.critic_hidden=8")
BROKEN = """from gaitgauge.training.algorithms.cts import CTS
from gaitgauge.training.networks import CtsActor

class Raises(CTS):
    @classmethod
    def networks(cls, configuration, widths):
        return configuration.nothing

class Forgets(CTS):
    losses_class = None

class Late(CTS):
    def compute_returns(self, obs):
        raise ValueError("too late")

class Undeployed(CTS):
    @classmethod
    def networks(cls, configuration, widths):
        arguments = {"num_actions": widths.actions, "history_length": 5, "frame_width": widths.frame}
        actor = CtsActor(configuration.network, privileged_width=9, architecture="mine", arguments=arguments)
        return actor, super().networks(configuration, widths)[1]
"""


@pytest.fixture(autouse=True)
def modules(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("huber_cts", "broken_method"):
        sys.modules.pop(name, None)
    text = re.search(r"<!-- file: huber_cts.py -->\n```python\n(.*?)```", GUIDE.read_text(), re.S)[1]
    (tmp_path / "huber_cts.py").write_text(text)
    (tmp_path / "broken_method.py").write_text(BROKEN)


def request(folder, *settings, **options):
    options = {"backend": "fake", "num_envs": 8, "iterations": 2} | options
    overrides = (*SMALL, "training.run.steps_per_iteration=4", "training.algorithm.minibatches=1", *settings)
    return TrainRequest(
        task="go2-flat", device="cpu", log_root=folder, score=False, film=False, overrides=overrides, **options
    )


def test_an_own_method_trains_resumes_and_is_imported_where_it_is_trusted_only(tmp_path):
    plan = prepare(request(tmp_path / "logs", OWN))
    assert plan.needs_trust
    outcome, run = train(plan, began=0.0)
    assert outcome.iteration == 2 and load_policy(outcome.checkpoint) is not None
    stored = torch.load(outcome.checkpoint, weights_only=True)
    assert stored["training"]["settings"]["training"]["algorithm"]["method"] == "huber_cts:HuberCTS"
    assert any("layers.1" in name for name in stored["critic_state_dict"]), "the layer norm of the own critic"
    resume = {"backend": None, "num_envs": None, "iterations": 3, "resume": str(run)}
    sys.modules.pop("huber_cts")
    with pytest.raises(CheckpointError, match=r"would import 'huber_cts:HuberCTS'.*add --trust"):
        prepare(TrainRequest(task="go2-flat", device="cpu", resume=str(run), iterations=3))
    assert "huber_cts" not in sys.modules
    for named in ({"trust": True}, {"overrides": (OWN,)}):
        prepare(TrainRequest(task="go2-flat", device="cpu", resume=str(run), iterations=3, **named))
    assert train(prepare(request(tmp_path / "logs", OWN, **resume)), began=0.0)[0].iteration == 3


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("nowhere:Mine", r"method is 'nowhere:Mine', but No module named 'nowhere'"),
        ("huber_cts:Nothing", r"has no function 'Nothing'"),
        ("huber_cts:HuberLosses", r"must be a class derived from gaitgauge\.training\.algorithms\.ppo:PPO"),
        (
            "broken_method:Raises",
            r"'broken_method:Raises', which raised AttributeError: .* \(broken_method\.py, line 7\)",
        ),
        ("broken_method:Forgets", r"'broken_method:Forgets', which raised TypeError"),
        (
            "broken_method:Late",
            r"'broken_method:Late', which raised ValueError: too late \(broken_method\.py, line 14\)",
        ),
        ("broken_method:Undeployed", r"the deployed network is a 'mine'; allowed are mlp, recurrent, cts, "),
    ],
)
def test_a_method_that_does_not_fit_is_refused_with_one_sentence(tmp_path, name, reason):
    with pytest.raises(ConfigurationError, match=reason) as caught:
        train(prepare(request(tmp_path / "logs", f"training.algorithm.method={name}")), began=0.0)
    assert "\n" not in str(caught.value)


def test_built_in_methods_are_not_wrapped():
    assert find_method("cts").__module__ == "gaitgauge.training.algorithms.cts"
