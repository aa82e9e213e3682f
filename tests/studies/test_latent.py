"""How well classes separate, on points that can be worked out by hand, and a moment of walking."""

import csv
import json
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from gaitgauge.gauge.episodes import Episode
from gaitgauge.gauge.suite import SuiteError, load_suite
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import StoredNetwork, save_policy
from gaitgauge.policy.networks.architectures import ARCHITECTURES
from gaitgauge.robots import load_robot
from gaitgauge.studies.latent.collecting import SPREAD, Notes, collect, start
from gaitgauge.studies.latent.figures import _colour
from gaitgauge.studies.latent.request import LatentRequest
from gaitgauge.studies.latent.separation import principal_components, separation, silhouette
from gaitgauge.studies.latent.study import LatentError, _blocks, _experts, look, study_latents
from gaitgauge.studies.policies import Loaded
from gaitgauge.terrains.registry import make_terrain


def test_principal_components_of_points_on_a_cross():
    # variances 2·9/4 and 2·1/4 along axes turned by the 3-4-5 triangle
    long, across = np.array([0.6, 0.8]), np.array([-0.8, 0.6])
    points = np.array([3 * long, -3 * long, across, -across])
    points += (5.0, 7.0)
    spread, shares = principal_components(points)
    assert np.allclose(shares, [0.9, 0.1])
    # of the second axis the largest coefficient, -0.8, is made positive
    assert np.allclose(spread, [[3, 0], [-3, 0], [0, -1], [0, 1]])


def test_points_on_a_line_have_a_second_axis_of_nothing():
    spread, shares = principal_components(np.array([[1.0], [2.0], [6.0]]))
    assert np.allclose(spread, [[-2, 0], [-1, 0], [3, 0]]) and shares.tolist() == [1.0, 0.0]


def test_silhouette_of_two_pairs():
    points, classes = np.array([[0.0], [1.0], [10.0], [11.0]]), np.array([0, 0, 1, 1])
    # (10.5 − 1) / 10.5 at the ends, (9.5 − 1) / 9.5 inside
    assert silhouette(points, classes) == pytest.approx((9.5 / 10.5 + 8.5 / 9.5) / 2)
    # pairs of one class around a point of the other: the single one counts 0
    points, classes = np.array([[0.0], [2.0], [1.0]]), np.array([0, 0, 1])
    assert silhouette(points, classes) == pytest.approx((1 - 2) / 2 * 2 / 3)


def test_a_probe_finds_what_lies_apart_and_guesses_where_nothing_does():
    random = np.random.default_rng(0)
    classes, robots = np.repeat([0, 1, 2], 200), np.tile(np.repeat([0, 1, 2, 3], 50), 3)
    apart = np.eye(3)[classes] + 0.05 * random.standard_normal((600, 3))
    found = separation(apart, classes, robots)
    assert found.probe == 1.0 and found.silhouette > 0.85 and found.chance == pytest.approx(1 / 3)
    same = separation(random.standard_normal((600, 3)), classes, robots)
    assert 0.25 < same.probe < 0.42 and abs(same.silhouette) < 0.03
    assert same.probe_range[0] <= same.probe <= same.probe_range[1]


def test_a_probe_is_not_told_what_robots_are_by_other_samples_of_theirs():
    """Every robot has a place of its own, which says nothing of its class: knowing it by heart would find every class."""
    random = np.random.default_rng(1)
    robots, classes = np.repeat(np.arange(60), 8), np.repeat(random.permutation(np.arange(60) % 2), 8)
    places = random.standard_normal((60, 80))[robots] + 0.01 * random.standard_normal((480, 80))
    assert separation(places, classes, robots).probe < 0.7
    assert separation(places, classes, np.arange(480) % 8).probe == 1.0  # where each fold has seen every robot


def test_classes_that_lost_samples_count_as_much_as_the_others():
    random = np.random.default_rng(2)
    classes = np.array([0] * 400 + [1] * 40)
    robots = np.arange(440) % 4
    points = classes[:, None] + 0.8 * random.standard_normal((440, 1))
    found = separation(points, classes, robots)
    assert min(found.recall) > 0.6 and found.probe == pytest.approx(sum(found.recall) / 2)


@pytest.fixture(scope="module")
def walks():
    asked = LatentRequest(policies=(), settling=0.2, seconds=0.2, robots=2, threads=2)
    return asked, load_suite("gaitgauge-1"), (make_terrain("flat"), make_terrain("slope_bd", 3))


def test_what_robots_noted_belongs_to_where_they_were(walks):
    policy, robot = load_policy("pretrained"), load_robot("go2")
    notes = collect(policy, robot, *walks)
    # two terrains, four commands, two robots, 0.1 s and 0.2 s
    assert notes.walkers == 16 and notes.falls == 0 and len(notes.time) == 32
    assert np.bincount(notes.terrain).tolist() == [16, 16] and np.bincount(notes.command).tolist() == [8] * 4
    assert sorted(set(notes.time.round(3))) == [0.1, 0.2]
    assert np.allclose(np.linalg.norm(notes.latent, axis=1), 1.0, atol=1e-5)
    assert np.allclose(notes.weights.sum(axis=1), 1.0, atol=1e-5)
    # the newest frame holds the command, scaled by 2, 2 and 0.25 (protocol §5)
    told = notes.history[:, -45 + 6 : -45 + 9] / (2.0, 2.0, 0.25)
    expected = np.array([(0.8, 0, 0), (-0.8, 0, 0), (0, 0, 1), (0, 0, -1)])[notes.command]
    assert np.allclose(told, expected, atol=1e-6)
    asked, *places = walks
    again = collect(policy, robot, replace(asked, threads=1), *places)
    assert np.array_equal(notes.latent, again.latent)


@pytest.mark.parametrize("name", ["flat", "stairs_fd", "stairs_bd", "obstacle", "wave"])
def test_robots_start_beside_each_other_with_a_foot_on_the_ground_and_none_in_it(name):
    terrain = make_terrain(name, None if name == "flat" else 10)
    spawn = terrain.spawns["level_eval"]
    feet = np.array([(0.2, 0.14), (0.2, -0.14), (-0.2, 0.14), (-0.2, -0.14)])
    ahead = -1.0 if name == "stairs_bd" else 1.0
    places = set()
    for seed in range(20):
        episode = Episode(
            terrain=name, level=10, friction=0.8, payload=0.0, seed=seed, stage="latent forward", goals=()
        )
        found = start(terrain, episode, feet)
        assert found == start(terrain, episode, feet) and found.yaw == spawn.yaw
        x, y, z = found.position
        assert abs(x - spawn.position[0]) <= SPREAD and abs(y - spawn.position[1]) <= SPREAD
        ground = terrain.height(x + ahead * feet[:, 0], y + ahead * feet[:, 1])
        assert z - ground.max() == pytest.approx(0.0, abs=1e-9)
        places.add((x, y))
    assert len(places) == 20


def test_means_are_of_notes_of_one_robot_that_follow_each_other():
    # at each moment robots 0 and 1 of terrain 0, then robot 0 of terrain 1, which falls after three of five
    rows = [(0, 0, m) for m in range(5)] + [(0, 1, m) for m in range(5)] + [(1, 0, m) for m in range(3)]
    terrain, robot, moment = np.array(sorted(rows, key=lambda row: row[2])).T
    nothing = np.zeros(len(rows), dtype=np.int64)
    notes = Notes(
        latent=None,
        weights=None,
        history=np.zeros((len(rows), 1)),
        terrain=terrain,
        command=nothing,
        robot=robot,
        time=0.1 * moment,
        falls=1,
        walkers=3,
    )
    found = [[(terrain[i], robot[i], moment[i]) for i in block] for block in _blocks(notes, 2)]
    robots = [(0, 0), (0, 1), (1, 0)]
    expected = [[(*r, 2 * b), (*r, 2 * b + 1)] for r in robots for b in range(1 if r == (1, 0) else 2)]
    assert found == expected


def test_a_single_robot_that_is_left_is_no_one_to_try_a_probe_on():
    rows = [(t, c) for t in range(2) for c in range(4)]
    terrain, command = np.array(rows).T
    notes = Notes(
        latent=np.eye(8),
        weights=None,
        history=np.eye(8),
        terrain=terrain,
        command=command,
        robot=np.full(8, 1),
        time=np.full(8, 0.1),
        falls=8,
        walkers=16,
    )
    loaded = Loaded(policy=load_policy("pretrained"), robot=load_robot("go2"))
    with pytest.raises(LatentError, match=r"all robots but number 2 fell at once.*a lower --level or more --robots"):
        look("mine", loaded, notes, ["flat", "wave"])


@pytest.mark.parametrize("total", [1.0, 2.0, 0.02])
def test_experts_count_by_their_shares(total):
    """Where experts are multiplied their weights do not add up to one."""
    decided = np.eye(4)[[0, 1, 0, 1]]
    for shares, at_once, in_all in ((np.full((4, 4), 0.25), 4.0, 4.0), (decided, 1.0, 2.0)):
        notes = Notes(
            latent=None,
            weights=total * shares,
            history=np.zeros((4, 1)),
            terrain=np.zeros(4, dtype=np.int64),
            command=np.zeros(4, dtype=np.int64),
            robot=np.arange(4),
            time=np.full(4, 0.1),
            falls=0,
            walkers=4,
        )
        found = _experts(notes, {"terrains": ["flat"]}, {"terrains": np.full(4, True)}, {"terrains": notes.terrain})
        assert found["at_once"] == pytest.approx(at_once) and found["in_all"] == pytest.approx(in_all)
        assert found["terrains"]["flat"] == pytest.approx(total * shares.mean(axis=0))


@pytest.fixture(scope="module")
def policies(tmp_path_factory) -> dict[str, str]:
    """A plain student and a perceptron, both of which stand more or less still."""
    folder = tmp_path_factory.mktemp("policies")
    networks = {
        "a<b>": ("cts", {"encoder_hidden": [16], "actor_hidden": [8]}),
        "plain": ("mlp", {"frame_width": 45, "num_actions": 12, "hidden": [8]}),
    }
    paths = {}
    for name, (architecture, arguments) in networks.items():
        torch.manual_seed(3)
        weights = ARCHITECTURES[architecture](**arguments).state_dict()
        weights |= {k: 0.01 * v for k, v in weights.items() if k.startswith(("actor", "network"))}
        paths[name] = str(folder / f"{name}.gauge.pt")
        stored = StoredNetwork(architecture=architecture, arguments=arguments, state_dict=weights)
        save_policy(paths[name], standard_contract(load_robot("go2")), stored)
    return paths


def test_several_policies_side_by_side_and_one_that_has_nothing_to_look_at(policies, tmp_path):
    request = LatentRequest(
        policies=("pretrained", policies["plain"], policies["a<b>"]),
        terrains=("flat", "slope_fd"),
        seconds=0.2,
        settling=0.2,
        robots=2,
    )
    results = study_latents(request, tmp_path)
    assert results == json.loads((tmp_path / "latent.json").read_text())
    assert [r["what"] for r in results["refused"]] == ["plain"]
    assert "has neither an encoder nor experts" in results["refused"][0]["reason"]
    mixture, student = results["policies"]
    assert mixture["terrains"].keys() == {"latent", "experts", "input", "explained"}
    assert student["terrains"].keys() == {"latent", "input", "explained"} and student["experts"] is None
    for pair, count in (("terrains", 2), ("commands", 4)):
        rows = np.array(list(mixture["experts"][pair].values()))
        assert rows.shape == (count, 8) and np.allclose(rows.sum(axis=1), 1.0, atol=1e-5)
    assert 1.0 <= mixture["experts"]["at_once"] <= mixture["experts"]["in_all"] <= 8.0
    rows = list(csv.DictReader((tmp_path / "points.csv").open()))
    assert len(rows) == mixture["samples"] + student["samples"] == 64
    assert rows[0]["policy"] == "pretrained" and rows[-1]["expert_0"] == "" and rows[-1]["latent_31"] != ""
    forward = [r for r in rows if r["command"] == "forward"]
    assert all((r["terrains_pc1"] != "") == (r in forward) for r in rows)
    for name in ("terrains", "commands", "experts"):
        picture = ElementTree.parse(tmp_path / f"latent-{name}.svg").getroot()
        titles = [t.text for t in picture.iter("{http://www.w3.org/2000/svg}text")]
        assert "pretrained" in titles and ("a<b>" in titles) == (name != "experts")
    page = (tmp_path / "latent.html").read_text()
    assert "a<b>" not in page and "plain was left out" in page
    # two panels of terrains, two of commands and one of experts, each a picture of its own that may stand below the others
    assert page.count("<figure>") == 5 and page.count('<svg viewBox="-22.0 -2.0 324.0 326.0"') == 4


def test_a_latent_of_one_entry_and_parts_of_none(tmp_path):
    """Networks that files may hold, whatever they are good for."""
    narrow = {"encoder_hidden": [8], "actor_hidden": [8]}
    networks = {
        "one": ("cts", narrow | {"latent_width": 1}),
        "none": ("cts", narrow | {"latent_width": 0}),
        "nobody": ("moe_cts", {"num_experts": 0}),
    }
    for name, (architecture, arguments) in networks.items():
        weights = {k: 0.01 * v for k, v in ARCHITECTURES[architecture](**arguments).state_dict().items()}
        stored = StoredNetwork(architecture=architecture, arguments=arguments, state_dict=weights)
        save_policy(tmp_path / f"{name}.gauge.pt", standard_contract(load_robot("go2")), stored)
    request = LatentRequest(
        policies=tuple(str(tmp_path / f"{name}.gauge.pt") for name in networks),
        terrains=("flat",),
        seconds=0.2,
        settling=0.2,
        robots=2,
    )
    found = study_latents(request, tmp_path / "out")
    one, none, nobody = found["policies"]
    assert one["commands"].keys() == {"latent", "input", "explained"} and one["commands"]["explained"][1] == 0.0
    assert none["commands"].keys() == {"input"} and nobody["experts"] is None
    # one terrain: commands are told apart on it, and nothing is drawn or listed of terrains
    assert one["terrains"] == {} and not (tmp_path / "out" / "latent-terrains.svg").exists()
    reason = "'flat' is the only terrain, so there is nothing to tell it from; name more of them with --terrain"
    assert found["refused"] == [{"what": "telling terrains apart", "reason": reason}]
    page = (tmp_path / "out" / "latent.html").read_text()
    assert "telling terrains apart was left out" in page and "Terrains, walking forward" not in page


def test_one_sentence_where_there_is_nothing_to_look_at(policies, tmp_path):
    with pytest.raises(LatentError, match="neither an encoder nor experts"):
        study_latents(LatentRequest(policies=(policies["plain"],)), tmp_path)
    with pytest.raises(ValueError, match="unknown terrain 'moon'"):
        study_latents(LatentRequest(policies=("pretrained",), terrains=("moon",)), tmp_path)
    with pytest.raises(ValueError, match="friction 0 is not possible"):
        study_latents(LatentRequest(policies=("pretrained",), friction=0.0), tmp_path)
    assert not list(tmp_path.iterdir())


def test_every_class_has_a_colour_of_its_own():
    """From the ninth terrain on, colours of the legend repeated."""
    colours = [_colour(index) for index in range(40)]
    assert len(set(colours)) == 40


def test_a_suite_with_ground_in_each_robot_s_measure_is_refused(tmp_path):
    request = LatentRequest(policies=("pretrained-g1",), suite="gaitgauge-biped-1")
    with pytest.raises(SuiteError, match="builds its ground in each robot's own measure"):
        study_latents(request, tmp_path)
