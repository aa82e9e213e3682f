"""What must not pay on the suite's own rules: standing, crouching, falling early, huge actions, knowing what no robot knows."""

import gzip
import json
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from gaitgauge.gauge.coverage import notes, score_label
from gaitgauge.gauge.evaluate import Request, prepare
from gaitgauge.policy.base import PolicySession
from gaitgauge.policy.contract import ObservationTerm, standard_contract
from gaitgauge.policy.finding import PRETRAINED
from gaitgauge.policy.native import FilePolicy, StoredNetwork, save_policy
from gaitgauge.policy.networks.architectures import MlpNetwork
from gaitgauge.studies.cards.board import board_data
from scripted_gauge import GO2, Puppet
from tiny_runs import evaluate

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import score_cards

CARD = Path(__file__).parents[2] / "docs/data/scorecards/pretrained-gaitgauge-1.json.gz"
CHEATS = {
    "standing": [0.0] * 12,
    "crouching": [0.0, 1.6, -3.2] * 4,
    "falling": [0.0, 4.0, 0.0, 0.0, -8.0, -4.0] * 2,
    "tipping": [4.0, 6.0, 0.0, 4.0, 6.0, 0.0] + [0.0, -6.0, -4.0] * 2,
    "huge": [100.0, -100.0, 100.0] * 4,
}
"""Actions that never change."""
MOMENT = """
extends = "gaitgauge-1"
name = "moment"
goals = [{ name = "max_velocity", phases = [0.8, 0.2] }, { name = "target_pos_velocity", phases = [] }]

[push]
after = [0.3, 0.5]

[settling]
longest = 0.5

[matrix]
terrains = ["flat"]
frictions = [0.6]
payloads = [0.0]
seeds = [0]

[physics]
timestep = 0.005
substeps = 4

[noise]
latency = 3

[metrics]
interval = 20
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("cheats")


@pytest.fixture(scope="module")
def policy(folder):
    def make(name):
        path = folder / f"{name}.gauge.pt"
        if name == "pretrained":
            return PRETRAINED
        score_cards.save_constant(path, CHEATS[name], kind=name)
        return path

    return cache(make)


@pytest.fixture(scope="module")
def moment(folder, policy):
    """Scores of a second of every sub-command on flat ground."""
    suite = folder / "moment.toml"
    suite.write_text(MOMENT)
    return cache(lambda name: evaluate(Request(policy=str(policy(name)), suite=str(suite)), folder / f"run-{name}"))


@pytest.mark.parametrize("name", [n if n == "standing" else pytest.param(n, marks=pytest.mark.slow) for n in CHEATS])
def test_one_action_for_everything_scores_far_below_walking(moment, name):
    assert moment(name).score < 0.6 * moment("pretrained").score


def test_a_policy_that_knows_what_no_robot_knows_has_no_plain_score(folder):
    """Base linear velocity is noisy, and the score is called what it is wherever it stands."""
    arguments = {"frame_width": 48, "num_actions": 12, "hidden": [1]}
    contract = standard_contract(GO2)
    terms = (ObservationTerm(name="base_linear_velocity_b", scale=(2.0,)), *contract.observation)
    network = StoredNetwork(architecture="mlp", arguments=arguments, state_dict=MlpNetwork(**arguments).state_dict())
    save_policy(folder / "told.gauge.pt", replace(contract, observation=terms), network)
    suite = folder / "told.toml"
    suite.write_text(MOMENT)
    request = Request(policy=str(folder / "told.gauge.pt"), suite=str(suite), backend="fake")
    found = evaluate(request, folder / "told", make=lambda name, scene, **options: Puppet(scene))
    assert score_label(found) == "privileged score"
    assert notes(found) == ["privileged observations: no sensor of a robot measures base_linear_velocity_b"]
    (table,) = board_data({"told": found})
    assert not table["ranked"] and table["others"][0]["observations"] == "privileged"


WHOLE = """
extends = "gaitgauge-1"
name = "whole"

[matrix]
terrains = ["flat", "slope_bd", "wave", "obstacle"]
frictions = [0.6]
payloads = [0.0]
search_seeds = [100, 101]
"""
"""Whole goals on terrain that one might slide, roll or bounce along."""


@pytest.mark.slow
@pytest.mark.parametrize("name", CHEATS)
def test_a_cheat_has_at_most_a_quarter_on_flat_ground_and_nothing_elsewhere(folder, policy, name):
    suite = folder / "whole.toml"
    suite.write_text(WHOLE)
    found = evaluate(Request(policy=str(policy(name)), suite=str(suite), threads=2), folder / f"whole-{name}")
    assert found.terrains["flat"].score < 0.25
    assert {row.score for name, row in found.terrains.items() if name != "flat"} == {0.0}


class Altered(FilePolicy):
    """The policy that ships, with other commands than it is given, or other actions than it answers."""

    def __init__(self, walking, *, command=None, action=None):
        self.walking, self.command, self.action = walking, command, action
        self.contract, self.path, self.stored = walking.contract, walking.path, walking.stored

    def session(self, num_episodes, *, device="cpu"):
        return AlteredSession(self, self.walking.session(num_episodes, device=device), num_episodes)


class AlteredSession(PolicySession):
    def __init__(self, policy, walking, num_episodes):
        self.policy, self.walking, self.step = policy, walking, torch.zeros(num_episodes)
        widths = policy.contract.term_widths
        place = [t.name for t in policy.contract.observation].index("command")
        self.scale = torch.tensor(policy.contract.observation[place].scale)
        self.frame, self.place = sum(widths), sum(widths[:place])

    def reset(self, episodes=None):
        self.walking.reset(episodes)
        self.step[... if episodes is None else episodes] = 0.0

    def act(self, observation, rows=None):
        frames = observation.clone().unflatten(1, (-1, self.frame))
        commands = frames[:, :, self.place : self.place + 3]
        if self.policy.command:
            commands[:] = self.policy.command(commands / self.scale) * self.scale
        action = self.walking.act(frames.flatten(1))
        if self.policy.action:
            action = self.policy.action(action, self.step * self.policy.contract.control_period)
        self.step += 1.0
        return action


ALTERED = {
    "falls at the end of every long sub-command": {
        "action": lambda action, time: torch.where((time > 6.6)[:, None], torch.full_like(action, 8.0), action)
    },
    "stands where two directions are asked for at once": {
        "command": lambda c: torch.where((c[..., :2].abs() > 0.3).all(-1, keepdim=True), 0.0 * c, c)
    },
    "marches on the spot": {"command": lambda c: 0.0 * c},
    "spins": {"command": lambda c: torch.tensor([0.0, 0.0, 2.0]).expand_as(c)},
    "freezes when it is told to stand": {
        "action": lambda action, time: torch.where((time > 5.0)[:, None], 0.0 * action, action)
    },
}


@pytest.fixture(scope="module")
def altered(folder):
    request = Request(
        policy="pretrained",
        suite="gaitgauge-1",
        pipeline="multi",
        terrains=("flat",),
        frictions=(0.6,),
        payloads=(0.0,),
        seeds=(0,),
    )
    prepared = prepare(request)

    def score(name):
        policy = Altered(prepared.policy, **ALTERED.get(name, {}))
        return evaluate(replace(prepared, policy=policy), folder / f"altered-{name}".replace(" ", "-")).score

    return cache(score)


@pytest.mark.slow
def test_walking_as_it_is_earns_what_its_card_says(altered):
    """Else what is altered of it below is no walking. Machines differ in the last bits, and so do their scores."""
    card = json.loads(gzip.decompress(CARD.read_bytes()))
    place = {"terrain": "flat", "friction": 0.6, "payload": 0.0}
    (environment,) = (e for e in card["environments"] if place.items() <= e.items())
    assert altered("as it is") == pytest.approx(environment["runs"]["0"]["quality"], abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("name", ALTERED)
def test_walking_that_picks_its_moments_earns_less_than_walking(altered, name):
    assert altered(name) < 0.97 * altered("as it is")


COMMANDED = """
extends = "robogauge-1.1"
name = "commanded"

[metrics]
angular_velocity = "commanded"
linear_velocity = "commanded"
"""
"""The reference, but for tracking: only what is commanded counts, as in gaitgauge-1."""


@pytest.mark.slow
def test_on_obstacles_the_reference_takes_most_of_what_walking_earns_and_little_of_what_standing_does(folder, policy):
    """A quirk of the reference that is kept, and said in docs/reference/suites.md: there vertical speed and rates of roll and pitch, which
    climbing needs, are tracking errors."""
    commanded = folder / "commanded.toml"
    commanded.write_text(COMMANDED)

    def quality(name, suite):
        request = Request(
            policy=str(policy(name)),
            suite=str(suite),
            pipeline="multi",
            terrains=("obstacle",),
            level=9,
            frictions=(0.6,),
            payloads=(0.0,),
            seeds=(0,),
            threads=2,
        )
        found = evaluate(request, folder / f"obstacle-{Path(suite).name}-{name}")
        return found.environments[0].quality.mean50

    assert quality("pretrained", "robogauge-1.1") < 0.5 * quality("pretrained", commanded)
    assert quality("standing", "robogauge-1.1") > 0.8 * quality("standing", commanded)
    assert quality("standing", "gaitgauge-1") < 0.5 * quality("pretrained", "gaitgauge-1")
