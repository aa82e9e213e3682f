"""Scenario files: those that ship, and those that could not be played or decided."""

import hashlib
import json
from dataclasses import asdict, replace

import pytest
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.base import PolicyError
from gaitgauge.studies.trials import trialling
from gaitgauge.studies.trials.page import speeds, view
from gaitgauge.studies.trials.request import TrialRequest
from gaitgauge.studies.trials.scenario import Payload, ScenarioError, load_scenario, scenario_names, scenario_text
from gaitgauge.studies.trials.trialling import profile

COMMAND = "[[commands]]\n"
OWN = """
name = "own"
title = "One's own"
friction = 0.6

[[commands]]
seconds = 2.0
velocity = [1.0, 0.0, 0.0]

[success]
survive = true
"""


def load(tmp_path, text: str):
    path = tmp_path / "own.toml"
    path.write_text(text)
    return load_scenario(str(path))


def test_every_scenario_that_ships_can_be_loaded_and_has_ground():
    for name in scenario_names():
        scenario = load_scenario(name)
        assert scenario.name == name and scenario.about and scenario.seconds < 120.0
        assert scenario.terrain().height([scenario.start.x], [0.0]).shape == (1,)


@pytest.mark.parametrize(("name", "ours"), [("lateral-impulse", (18, 20)), ("obstacle-30cm", (17, 20))])
def test_what_the_paper_reports(name, ours):
    reported = {r.who: (r.successes, r.trials) for r in load_scenario(name).reported}
    assert reported["the paper's MoE-CTS"] == ours
    assert set(reported) == {"the paper's MoE-CTS", "Built-in RL", "CTS", "HIM", "DreamWaQ"}


def test_nobody_elses_robot_is_called_ours():
    assert not [r.who for name in scenario_names() for r in load_scenario(name).reported if r.who.lower() == "ours"]


def test_the_ground_of_the_shipped_scenarios_is_what_their_titles_say():
    def top(name: str, x: float) -> float:
        return float(load_scenario(name).terrain().height([x], [0.0])[0])

    assert top("tile-stairs", 1.15) == pytest.approx(0.155)
    assert top("tile-stairs", 32.5) == pytest.approx(85 * 0.155)
    assert (top("obstacle-30cm", 1.4), top("obstacle-30cm", 2.0), top("obstacle-30cm", 2.6)) == (0.0, 0.3, 0.0)
    assert (top("drop-60cm", 0.0), top("drop-60cm", 1.6)) == (0.6, 0.0)
    for name in ("slope-30deg", "slope-30deg-fast"):
        assert (top(name, 3.0) - top(name, 2.0)) == pytest.approx(0.57735, abs=1e-4)  # tan 30°
    stairs = [top("stairs-at-speed", x) for x in (1.15, 2.65, 3.0, 3.85, 4.75)]
    assert stairs == pytest.approx([0.1, 0.6, 0.6, 0.45, 0.0])


def test_a_walk_to_a_place_ends_long_before_its_limit():
    """The 110 s that tile stairs allow were told as left, of which 40 s are needed."""
    stairs, pull = load_scenario("tile-stairs"), load_scenario("lateral-pull")
    assert stairs.usual_rest(0.0, 0.0) == pytest.approx(1 + 32.5 / (0.85 * 0.8) + 1)
    assert stairs.usual_rest(31.0, 22.5) == pytest.approx(10 / (0.85 * 0.8) + 1)
    assert stairs.usual_rest(101.0, 22.5) == pytest.approx(10 + 1), "its limit"
    assert stairs.usual_rest(60.0, 33.0) == pytest.approx(1)
    assert (pull.usual_rest(0.0, 0.0), pull.usual_rest(4.0, 1.5)) == (pull.seconds, pull.seconds - 4.0)


def test_a_scenario_differs_in_its_digest_by_what_decides_about_outcomes_alone(tmp_path):
    own = load(tmp_path, OWN)
    assert load(tmp_path, OWN.replace("One's own", "Another title")).digest == own.digest
    assert load(tmp_path, OWN.replace("friction = 0.6", "friction = 0.7")).digest != own.digest


def test_fields_that_came_later_leave_digests_as_they_were(tmp_path):
    """The digest as it was before there were patches, payloads and latencies."""
    sprint = load_scenario("sprint")
    words = ("title", "about", "repeats", "legs", "reported", "patches", "payload", "latency")
    rules = {k: v for k, v in asdict(sprint).items() if k not in words} | {"suite": load_suite(sprint.suite).digest}
    assert sprint.digest == hashlib.sha256(json.dumps(rules, sort_keys=True).encode()).hexdigest()
    own = load(tmp_path, OWN)
    assert load(tmp_path, OWN.replace("friction = 0.6", "friction = 0.6\nlatency = 0.0")).digest != own.digest


def test_a_scenario_written_to_a_file_is_the_same_when_it_is_read(tmp_path):
    for name in scenario_names():
        scenario = replace(load_scenario(name), name="own", payload=Payload(kilograms=1.5), latency=0.02)
        assert load(tmp_path, scenario_text(scenario)) == scenario


def test_unknown_names_are_refused_with_those_that_are_near():
    with pytest.raises(
        ScenarioError, match=r"did you mean 'lateral-pull' or 'lateral-impulse'[?] choose one of drop-60cm, "
    ):
        load_scenario("lateral")
    with pytest.raises(ScenarioError, match="there is no scenario 'moon'; choose one of drop-60cm, "):
        load_scenario("moon")
    with pytest.raises(ScenarioError, match=r"scenario file 'nowhere\.toml' does not exist"):
        load_scenario("nowhere.toml")


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('name = "own"', 'name = "sprint"', "is called 'sprint' as a scenario that ships"),
        (
            "[success]",
            "[[patches]]\nbegin = 2.0\nseconds = 1.0\nfriction = 0.1\n[success]",
            r"patches\[0\] begins after 2 s, when the commands, of 2 s, are over",
        ),
        ("survive = true", "survive = false", "nothing says what success is, so it can never be decided"),
        ("[success]\nsurvive = true", "", "nothing says what success is"),
        ("survive = true", "beyond = 3.0", "commands lead no further than to 2.05 m, so success can never be decided"),
        ("survive = true", "beyond = 0.0", "success can never be decided; choose a place between"),
        (
            "velocity = [1.0",
            "until_x = 3.0\nvelocity = [-1.0",
            "no command leads along x from a heading of 0 rad, so success can never be decided",
        ),
        (
            "[success]\nsurvive = true",
            "[start]\nyaw = 3.0\n[success]\nbeyond = 1.5",
            "no command leads along x from a heading of 3 rad",
        ),
        ("survive = true", "speed = 1.5", "no more than 1 m/s is ever commanded, so success can never be decided"),
        ("velocity = [1.0", "until_x = 1.0\nvelocity = [1.0", "lead no further than to 1 m, so success can never"),
        (  # the first command would lead on, and ends at 1 m
            "velocity = [1.0",
            f"until_x = 1.0\nvelocity = [0.8, 0.0, 0.0]\n{COMMAND}seconds = 0.4\nvelocity = [1.0",
            "commands lead no further than to 1.4 m, so success can never be decided",
        ),
        (
            "[success]\nsurvive = true",
            f"{COMMAND}until_x = 0.5\nseconds = 1.0\nvelocity = [2.0, 0.0, 0.0]\n[success]\nspeed = 1.9",
            r"commands\[1\].until_x is x = 0.5 m, and robots are at up to 2.05 m by then, where it is over before it begins",
        ),
        ("friction = 0.6", "friction = 0.0", "friction is 0.0; it must be greater than 0"),
        ("seconds = 2.0", "seconds = -1.0", r"commands\[0\].seconds is -1.0"),
        ("friction = 0.6", "frictoin = 0.6", "unknown field 'frictoin'; did you mean 'friction'"),
        (
            "friction = 0.6",
            'friction = 0.6\nsuite = "nonesuch"',
            r"scenario file .*own\.toml: there is no suite 'nonesuch'",
        ),
        ("[success]", "[failure]\nlying = 0\n[success]", "failure.lying is 0; it must be greater than 0"),
        ("[success]", "[failure]\nlying = true\n[success]", "failure.lying is true; give the time"),
        (
            "[success]",
            "[failure]\nlying = false\ntilt = 3.1416\n[success]",
            "nothing counts as a fall: failure.lying is false, and failure.tilt is 3.1416 rad",
        ),
        ("[success]", "[ground]\nlevel = 3\n[success]", "ground.level is 3 of no terrain"),
        (
            "velocity = [1.0",
            "until_x = -5.0\nvelocity = [1.0",
            r"commands\[0\].until_x is x = -5 m.* over before it begins",
        ),
        (
            "friction = 0.6",
            "friction = 0.6\nrepeats = 10000",
            "repeats is 10000; it must be less than or equal to 1000",
        ),
        (
            "[success]",
            "[[commands]]\nseconds = 600.0\nvelocity = [1.0, 0.0, 0.0]\n" * 6 + "[success]",
            "the commands last 3602 s; at most 3600 s",
        ),
        (
            "[success]",
            '[[forces]]\ndirection = "left"\nnewtons = [1.0, 2.0]\nbegin = [0.0, 1.0]\nseconds = [1.0, 1.0]\n'
            "every = 1e-300\n[success]",
            r"forces\[0\] pulls every 1e-300 s of 2 s; at most 1,000 pulls",
        ),
        ("[success]", '[[reported]]\nwho = "a"\nsuccesses = 3\ntrials = 2\n[success]', "3 successes in 2 trials"),
        ("[success]", '[[reported]]\nwho = "a"\nsuccesses = 0\ntrials = 0\n[success]', "0 successes in 0 trials"),
        ("[success]", '[[reported]]\nwho = "a"\nsuccesses = 3\n[success]', "successes = 3 and no trials; give both"),
        ("[success]", '[[reported]]\nwho = "a"\ntrials = 3\n[success]', "has trials = 3 and no successes; give both"),
        ("[success]", '[[reported]]\nwho = "a"\n[success]', r"reported\[0\] says nothing of what was found"),
        ("[success]", '[ground]\nterrain = "moon"\n[success]', "unknown terrain 'moon'"),
        ("[success]", '[ground]\nterrain = "wave"\n[success]', "terrain 'wave' needs a level"),
        (
            "[success]",
            '[ground]\nterrain = "flat"\nstretches = [{ length = 1.0 }]\n[success]',
            "has the terrain 'flat' and stretches or boxes too",
        ),
        ("[success]", "[ground]\nstretches = [{ length = 1.0, rise = -0.1 }]\n[success]", "below the floor"),
        (
            "[success]",
            '[[forces]]\ndirection = "left"\nnewtons = [1.0, 2.0]\nbegin = [0.0, 2.0]\nseconds = [1.0, 1.0]\n[success]',
            "may begin after 2 s, when the commands, of 2 s, are over",
        ),
        (
            "[success]",
            '[[forces]]\ndirection = "up"\nnewtons = [1.0, 2.0]\nbegin = [0.0, 1.0]\nseconds = [1.0, 1.0]\n[success]',
            r"forces\[0\].direction is 'up'",
        ),
        (
            "[success]",
            '[[forces]]\ndirection = "left"\nnewtons = [3.0, 2.0]\nbegin = [0.0, 1.0]\nseconds = [1.0, 1.0]\n[success]',
            "newtons is 3 to 2; the least must come first",
        ),
    ],
)
def test_what_cannot_be_played_or_decided_is_refused_in_one_sentence(tmp_path, old, new, sentence):
    text = OWN.replace(old, new)
    if "until_x" in new and "[success]" not in new:
        text = text.replace("survive = true", "beyond = 1.5")
    with pytest.raises(ValueError, match=sentence) as caught:
        load(tmp_path, text)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("yaw", "velocity"),
    [(3.1416 - 0.0001, "-1.0, 0.0, 0.0"), (1.5, "0.0, -1.0, 0.0"), (3.0, "1.0, 0.0, 0.5"), (0.0, "-1.0, 0.0, 0.5")],
)
def test_a_way_along_x_may_begin_with_any_heading(tmp_path, yaw, velocity):
    back = f"[[commands]]\nseconds = 2.0\nuntil_x = 2.5\nvelocity = [{velocity}]\n\n"
    text = OWN.replace("velocity = [1.0, 0.0, 0.0]", f"velocity = [{velocity}]")
    text = text.replace("[success]\nsurvive = true", f"{back}[start]\nyaw = {yaw}\n[success]\nbeyond = 1.5")
    assert load(tmp_path, text).success.beyond == 1.5


def test_places_are_passed_again_after_a_way_back_and_after_a_turn(tmp_path):
    for between in ("-1.0, 0.0, 0.0", "0.0, 0.0, 1.57"):
        on = f"{COMMAND}seconds = 2.0\nvelocity = [{between}]\n{COMMAND}seconds = 2.0\nuntil_x = 1.0\nvelocity = [1.0, 0.0, 0.0]\n"
        assert load(tmp_path, OWN.replace("[success]", on + "[success]")).commands[2].until_x == 1.0


def test_upside_down_is_no_fall_where_something_else_can_be_missed_or_lying_is_one(tmp_path):
    for failure, success in (("lying = false", "beyond = 1.0"), ("lying = 2.0", "survive = true")):
        text = OWN.replace("[success]\nsurvive = true", f"[failure]\ntilt = 3.1416\n{failure}\n[success]\n{success}")
        assert load(tmp_path, text).failure.tilt == 3.1416


def test_the_ground_is_drawn_from_the_side_by_its_corners():
    stairs = load_scenario("stairs-at-speed")
    line = profile(stairs.terrain(), 0.0, 0.0, 5.5)
    assert line[0] == (-2.0, 0.0) and line[-1][1] == 0.0 and len(line) < 45
    assert max(z for _, z in line) == pytest.approx(0.6)
    assert profile(load_scenario("sprint").terrain(), 0.0, 0.0, None) == []


def test_ways_are_seen_from_the_side_where_the_ground_has_a_shape_and_from_above_elsewhere():
    path = [(0.0, 0.5, 0.3, 0.0), (2.0, -0.5, 0.5, 0.0), (float("nan"), 0.0, 0.0, 0.0)]
    result = {"rows": [{"path": path, "outcome": "fell", "seed": 3, "seconds": 1.0}]}
    above = view({"profile": []}, result)
    [way] = above["paths"]
    assert above["kind"] == "above" and len(way["points"]) == 2 and way["title"] == "seed 3: fell after 1.0 s"
    assert way["points"][1][1] > way["points"][0][1]  # to the right is downwards
    side = view({"profile": [(-1.0, 0.0), (3.0, 0.0)]}, result)
    assert side["kind"] == "side" and side["paths"][0]["points"][1][1] < side["paths"][0]["points"][0][1]
    (left, _), (right, _) = side["ground"]
    assert right - left == pytest.approx(side["size"][0] - 2 * 34.0)


def test_a_sprint_is_drawn_as_speed_over_time_with_the_speed_to_reach():
    """Robots that nobody steers drew a scribble from above."""
    path = [(0.0, 0.0, 0.3, 0.0), (0.3, 0.4, 0.3, 0.0), (0.3, 0.6, 0.3, 0.0)]
    assert speeds(path) == [pytest.approx((0.05, 5.0)), pytest.approx((0.15, 2.0))]
    rows = [{"path": path, "outcome": "missed", "seed": 0, "seconds": 0.3}]
    drawn = view({"profile": [], "success": {"speed": 4.0}}, {"rows": rows})
    [way] = drawn["paths"]
    (early, fast), (late, slow) = way["points"]
    assert drawn["kind"] == "speed" and early < late and fast < drawn["wanted"] < slow
    assert [t["text"] for t in drawn["values"]][::2] == ["0", "1", "2", "3", "4", "5"]


@pytest.mark.parametrize(("asked", "tried"), [((), 4), (("all", "low-steps"), 4), (("shoves",), None)])
def test_all_sends_a_robot_through_the_scenarios_for_its_number_of_legs(asked, tried, monkeypatch, tmp_path):
    def refuse(policy, robot, scenario, *_, **__):
        played.append(scenario.name)
        raise PolicyError("no")

    played = []
    monkeypatch.setattr(trialling, "run_scenario", refuse)
    with pytest.raises(ScenarioError, match="no"):
        trialling.run_trials(TrialRequest(policies=("pretrained",), scenarios=asked), tmp_path)
    fitting = {name for name in scenario_names() if load_scenario(name).legs in (None, tried) and tried}
    assert set(played) == fitting | {name for name in asked if name != "all"}
    assert load_scenario("shoves").legs == load_scenario("low-steps").legs == 2
