"""The search for failures of robots that fall by a rule: what it must find is known."""

import json
import math
import random

import numpy as np
import pytest
import torch
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.native import StoredNetwork, save_policy
from gaitgauge.policy.networks.architectures import MlpNetwork
from gaitgauge.robots import load_robot
from gaitgauge.studies.trials.scenario import load_scenario
from gaitgauge.studies.worst import playing, study
from gaitgauge.studies.worst.page import write_page
from gaitgauge.studies.worst.prepared import prepare_search
from gaitgauge.studies.worst.ranges import (
    FACTORS,
    NOMINAL,
    Measures,
    Ranges,
    describe_case,
    make_case,
    scenario_of,
)
from gaitgauge.studies.worst.request import WorstError, WorstRequest
from gaitgauge.studies.worst.search import (
    Elite,
    Outcome,
    Reduction,
    apart,
    choose_different,
    differ,
    hardness,
    random_case,
    upper_bound,
)
from gaitgauge_fake_engine import FakeBackend, FakeScript

RANGES = Ranges()
MEASURES = Measures(
    mass=15.0, leg_length=0.4, command_limits=(2.0, 1.0, 2.0), suite="gaitgauge-1", seed=0, torque_speed_limit=True
)
UPRIGHT = Outcome(fell=False, diverged=False, seconds=5.5, lean=0.3)
FALLEN = Outcome(fell=True, diverged=False, seconds=2.0, lean=1.0)


@pytest.fixture(scope="module")
def standing(tmp_path_factory):
    """A file of a policy that never moves."""
    path = tmp_path_factory.mktemp("policies") / "standing.gauge.pt"
    arguments = {"frame_width": 45, "num_actions": 12, "hidden": [8]}
    zeros = {k: torch.zeros_like(v) for k, v in MlpNetwork(**arguments).state_dict().items()}
    stored = StoredNetwork(architecture="mlp", arguments=arguments, state_dict=zeros)
    save_policy(path, standard_contract(load_robot("go2")), stored)
    return str(path)


@pytest.fixture
def searched(standing, monkeypatch):
    """A search in which a rule says of each scenario and engine whether the robot falls; 32 plays take a second."""
    plays = []

    def search(rule, folder, *, resume=False, minutes=1.5, others=("mujoco@foot_condim=3",), seed=0):
        def play(players, pairs, variant):
            plays.extend((scenario.name, s, variant.label) for scenario, s in pairs)
            return [FALLEN if rule(scenario, variant.label, s) else UPRIGHT for scenario, s in pairs]

        monkeypatch.setattr(study.Players, "play", play)
        monkeypatch.setattr("time.perf_counter", lambda: len(plays) / 32.0)
        request = WorstRequest(policy=standing, minutes=minutes, others=others, threads=1, device="cpu", seed=seed)
        return study.search_worst(request, folder, resume=resume)

    search.plays = plays
    return search


def newtons(scenario):
    return math.hypot(*(force.newtons[0] for force in scenario.forces)) if scenario.forces else 0.0


def frail(scenario, engine, seed=0):
    """Falls under a heavy load, in one engine alone; late; or pushed on slippery ground."""
    heavy = scenario.payload is not None and scenario.payload.kilograms > 2.0 and "@" not in engine
    late = scenario.latency is not None and scenario.latency > 0.03
    return heavy or late or (newtons(scenario) > 40.0 and scenario.friction < 0.6)


def test_the_search_finds_what_each_fall_needs_and_nothing_else(searched, tmp_path):
    played = {}

    def keep(scenario, engine, _):
        fell = frail(scenario, engine)
        if fell:
            played[scenario.name, scenario.title] = scenario
        return fell

    results = searched(keep, tmp_path / "out")
    for failure in results["failures"]:
        scenario = load_scenario(str(tmp_path / "out" / failure["scenario"]))
        assert scenario == played[scenario.name, scenario.title]
    falls = [load_scenario(str(path)) for path in (tmp_path / "out" / "falls").glob("*.toml")]
    assert len(falls) == min(results["sample"]["falls"], 200) and all(frail(scenario, "mujoco") for scenario in falls)
    found = {frozenset(f["factors"]): f for f in results["failures"]}
    assert set(found) == {frozenset({"payload"}), frozenset({"latency"}), frozenset({"push", "friction"})}
    assert all(f["confirmed"] for f in found.values())
    assert [k for k, f in found.items() if f["only_here"]] == [frozenset({"payload"})]
    # milder than most that fall, and still falling
    assert 0.03 < found[frozenset({"latency"})]["values"]["latency"] < 0.04
    assert sorted(f["rank"] for f in results["failures"]) == [1, 2, 3] and found[frozenset({"payload"})]["rank"] == 3
    assert found[frozenset({"payload"})]["again"]["mujoco"] == [True] * 6
    assert results == json.loads((tmp_path / "out" / "worst.json").read_text())
    page = write_page(tmp_path / "out").read_text()
    assert "push + friction" in page and "No other engine knows it" in page


def test_a_robot_that_never_falls_has_no_failures(searched, tmp_path):
    results = searched(lambda *_: False, tmp_path / "out", minutes=0.4)
    assert results["failures"] == [] and results["sample"]["falls"] == 0
    # (1 - p)^n = 0.05
    assert (1.0 - results["sample"]["bound"]) ** results["sample"]["cases"] == pytest.approx(0.05)
    assert "found no failure" in results["sentences"][-1]
    assert "There is no confirmed failure" in write_page(tmp_path / "out").read_text()


def test_a_robot_that_always_falls_needs_no_condition(searched, tmp_path):
    results = searched(lambda *_: True, tmp_path / "out", minutes=0.4)
    (failure,) = results["failures"]
    assert failure["factors"] == [] and failure["hardness"] == 0.0
    assert results["sample"]["bound"] == 1.0
    assert "It falls where nothing is unusual." in results["sentences"]


def test_falls_by_luck_are_no_failures(searched, tmp_path):
    """Late actions always fell the robot; half as late ones, and loads, do with one seed in four."""

    def lucky(scenario, engine, seed):
        late = scenario.latency or 0.0
        unlucky = random.Random(f"{scenario.name} {seed}").random() < 0.25
        return late > 0.04 or (unlucky and (late > 0.02 or scenario.payload is not None))

    results = searched(lucky, tmp_path / "out")
    alone = {failure["factors"][0]: failure for failure in results["failures"] if len(failure["factors"]) == 1}
    assert alone["latency"]["confirmed"] and alone["latency"]["values"]["latency"] > 0.035
    assert alone["latency"]["rank"] == 1 and not any(f["confirmed"] for k, f in alone.items() if k != "latency")


def test_a_small_budget_finds_what_falls_alone(searched, tmp_path):
    results = searched(lambda scenario, *_: scenario.latency is not None, tmp_path / "out", minutes=0.1)
    assert [failure["factors"] for failure in results["failures"]] == [["latency"]]


def test_a_search_goes_on_where_it_stopped(searched, tmp_path):
    first = searched(frail, tmp_path / "out", minutes=0.4)
    once = len(searched.plays)
    again = searched(frail, tmp_path / "out", minutes=0.4, resume=True)
    assert len(searched.plays) == once
    assert {k: v for k, v in again.items() if k != "provenance"} == {
        k: v for k, v in first.items() if k != "provenance"
    }
    longer = searched(frail, tmp_path / "out", resume=True, minutes=0.8)
    assert len(searched.plays) > once and longer["search"]["generations"] > first["search"]["generations"]
    assert longer["sample"] == first["sample"]  # its size was decided once


def test_folders_that_a_search_cannot_have(searched, tmp_path):
    searched(frail, tmp_path / "out", minutes=0.2)
    with pytest.raises(WorstError, match="already holds this search; go on with --resume"):
        searched(frail, tmp_path / "out")
    with pytest.raises(WorstError, match=r"belongs to another search \(seed differ"):
        searched(frail, tmp_path / "out", seed=1, resume=True)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("dear")
    with pytest.raises(WorstError, match="is not empty and holds no search"):
        searched(frail, tmp_path / "full")
    with pytest.raises(WorstError, match="--others names 'mujoco', the engine that is searched"):
        searched(frail, tmp_path / "same", others=("mujoco",))


def test_the_sample_is_independent_of_the_search(searched, tmp_path):
    """Its cases are the same whatever falls, and all of them have all factors."""
    found = [searched(rule, tmp_path / name, minutes=0.4) for name, rule in (("a", frail), ("b", lambda *_: False))]
    assert found[0]["sample"]["cases"] == found[1]["sample"]["cases"]
    names = [name for name, seed, engine in searched.plays if "sample" in name and engine == "mujoco" and seed == 0]
    count = found[0]["sample"]["cases"]
    assert names[:count] == [f"worst-0-sample-{i}" for i in range(count)]
    cases = [random_case(np.random.default_rng([0, 1, i]), RANGES, str(i)) for i in range(300)]
    assert all(case.factors == frozenset(FACTORS) for case in cases)
    friction = [case.named["friction"] for case in cases]
    assert min(friction) < 0.22 and max(friction) > 0.98 and np.mean(friction) == pytest.approx(0.6, abs=0.03)
    assert {case.named["step_count"] for case in cases} == {1.0, 2.0, 3.0, 4.0}


def test_bound_of_clopper_and_pearson():
    """At the bound, at most so many falls have a chance of 5 %."""
    for falls, cases in ((0, 60), (3, 100), (12, 240)):
        p = upper_bound(falls, cases)
        chance = sum(math.comb(cases, i) * p**i * (1.0 - p) ** (cases - i) for i in range(falls + 1))
        assert chance == pytest.approx(0.05)
    assert upper_bound(5, 5) == 1.0
    assert upper_bound(0, 60) == pytest.approx(1.0 - 0.05 ** (1.0 / 60.0))


def test_what_a_fall_does_not_need_is_taken_away():
    values = NOMINAL | {"latency": 0.04, "friction": 0.3, "payload": 0.3, "slope": 0.2}
    case = make_case("one", values, ("latency", "friction", "payload", "slope"))
    reduction = Reduction(Elite(case, FALLEN), np.random.default_rng(0))
    while (tried := reduction.next) is not None:
        reduction.tell(Elite(tried, FALLEN, {"friction", "slope"} <= tried.factors or "latency" in tried.factors))
    assert reduction.elite.case.factors in ({"latency"}, {"friction", "slope"})
    assert reduction.elite.case.named["payload"] == 0.0


def test_values_of_factors_that_a_case_lacks_are_nominal():
    case = make_case("one", NOMINAL | {"step_count": 4.0, "friction": 0.2}, ("latency",))
    assert (case.named["step_count"], case.named["friction"]) == (NOMINAL["step_count"], NOMINAL["friction"])


def test_distances_and_hardness_by_hand():
    slow = make_case("a", NOMINAL | {"friction": 0.2, "latency": 0.03}, ("friction", "latency"))
    late = make_case("b", NOMINAL | {"latency": 0.06}, ("latency",))
    # one of two factors in common; friction 0.6 of its range of 0.8 apart, latency 0.03 of 0.06
    assert apart(slow, late, RANGES) == (0.5, pytest.approx(math.sqrt((0.6 / 0.8) ** 2 / 2 + 0.5**2 / 2)))
    assert differ(slow, late, RANGES) and not differ(late, late, RANGES)
    assert choose_different([late, late, slow], RANGES, 10) == [0, 2]
    # friction is at the end of its range, latency half way
    assert hardness(slow, RANGES) == pytest.approx(0.75)


def test_a_case_as_a_scenario_in_the_robot_s_own_measure():
    values = NOMINAL | {
        "forward_1": -1.0,
        "turn_1": 0.5,
        "push_forward": 0.3,
        "push_left": -0.4,
        "payload": 0.2,
        "payload_forward": 0.25,
        "slope": -0.2,
        "step": 0.25,
        "step_count": 2.0,
        "heading": 0.3,
    }
    case = make_case("one", values, FACTORS)
    scenario = scenario_of(case, MEASURES)
    assert scenario.name == "worst-0-one" and scenario.seconds == pytest.approx(5.5)
    assert scenario.commands[1].velocity == (-2.0, 0.0, 1.0)
    pushes = {force.direction: force.newtons[0] for force in scenario.forces}
    weight = 15.0 * 9.81
    assert pushes == {"forward": pytest.approx(0.3 * weight), "right": pytest.approx(0.4 * weight)}
    assert scenario.payload.kilograms == pytest.approx(3.0) and scenario.payload.place == (0.1, 0.0, 0.0)
    ground = scenario.terrain()
    begin, down = float(ground.height(0.0, 0.0)), 1.5 * math.tan(0.2)
    assert float(ground.height(2.3, 0.0)) - begin == pytest.approx(-down, abs=1e-3)
    assert float(ground.height(10.0, 20.0)) - begin == pytest.approx(0.2 - 2.0 * down, abs=1e-3)
    assert float(ground.height(-15.0, -20.0)) == begin
    words = describe_case(case, MEASURES)
    assert any("push of 74 N at -53° from ahead" in w for w in words) and any(
        "2 steps up of 0.10 m" in w for w in words
    )
    assert str(scenario_of(make_case("up", values | {"slope": 0.2}, FACTORS), MEASURES).ground.height) == "0.0"
    bare = scenario_of(make_case("bare", values, ()), MEASURES)
    assert (bare.forces, bare.patches, bare.payload, bare.latency) == ((), (), None, None)
    assert bare.commands[1].velocity == (1.0, 0.0, 0.0) and not bare.terrain().boxes


def test_outcomes_are_those_of_the_engine(standing, monkeypatch, tmp_path):
    """Two robots without physics, the second of which falls after 0.3 s."""
    suite = tmp_path / "coarse.toml"
    suite.write_text(
        'extends = "gaitgauge-1"\nname = "coarse"\n[physics]\ntimestep = 0.02\nsubsteps = 1\n[noise]\nlatency = 0\n'
    )
    script = FakeScript(fall_time=torch.tensor([math.inf, 0.3], dtype=torch.float64))
    monkeypatch.setattr(
        "gaitgauge.studies.consistency.variants.make_backend",
        lambda name, scene, *, device, threads: FakeBackend(scene, script=script),
    )
    request = WorstRequest(policy=standing, backend="fake", others=(), suite=str(suite), threads=1, device="cpu")
    prepared = prepare_search(request)
    with playing.Players(prepared.loaded.policy, prepared.robot, 1) as players:
        pair = [(scenario_of(make_case(name, NOMINAL, ()), prepared.measures), 0) for name in ("a", "b")]
        upright, fallen = players.play(pair, prepared.engine)
    assert (upright.fell, upright.lean, upright.seconds) == (False, pytest.approx(0.0, abs=1e-6), pytest.approx(5.5))
    assert fallen.fell and 0.3 < fallen.seconds < 0.7 and fallen.lean == 1.0


@pytest.mark.slow
def test_outcomes_do_not_depend_on_processes():
    request = WorstRequest(policy="pretrained", others=(), threads=2, device="cpu")
    prepared = prepare_search(request)
    random = np.random.default_rng(5)
    plays = [(scenario_of(random_case(random, RANGES, str(i)), prepared.measures), 0) for i in range(5)]
    found = []
    for threads in (1, 2):
        with playing.Players(prepared.loaded.policy, prepared.robot, threads) as players:
            found.append(players.play(plays, prepared.engine))
    assert found[0] == found[1]
