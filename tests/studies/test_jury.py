"""A jury of scripted engines, whose differences are known."""

import json
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
import torch
from gaitgauge.backends import BackendError
from gaitgauge.gauge.episodes import Record
from gaitgauge.gauge.ground_rules import build_terrain
from gaitgauge.gauge.store import StoreError
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.native import StoredNetwork, save_policy
from gaitgauge.policy.networks.architectures import MlpNetwork
from gaitgauge.robots import load_robot
from gaitgauge.robots.anatomy.body_plan import body_plan
from gaitgauge.studies.consistency import variants
from gaitgauge.studies.consistency.closed_loop import Cell
from gaitgauge.studies.consistency.request import ConsistencyError
from gaitgauge.studies.jury import request as asked
from gaitgauge.studies.jury import study as judging
from gaitgauge.studies.jury.page import write_page
from gaitgauge.studies.jury.request import BIPED_PARTS, ENGINES, PARTS, JuryError, JuryRequest, Part
from gaitgauge.studies.jury.verdict import Bench, sentences, verdict
from gaitgauge_fake_engine import FakeBackend, FakeScript

SUITE = """
extends = "jury"
name = "brief"
title = "two short commands"
goals = [{ name = "single", sub_commands = [
    [{ seconds = 0.2, velocity = [1.0, 0.0, 0.0] }], [{ seconds = 0.2, velocity = [0.0, 0.0, 1.0] }],
] }]
[settling]
longest = 0.04
speed = 10.0
shortest = 0.0
[metrics]
interval = 10
[scoring]
bootstrap = 200
"""
COLUMNS = (*load_suite("jury").metrics.weights, "quality")


@pytest.fixture
def brief(tmp_path, monkeypatch):
    """A request whose part is over in a second, of a policy that stands."""
    (tmp_path / "brief.toml").write_text(SUITE)
    part = Part(suite=str(tmp_path / "brief.toml"), grounds=(("flat", 0), ("slope_fd", 3)), frictions=(0.6,), seeds=2)
    monkeypatch.setattr(judging, "PARTS", {"short": part})
    return JuryRequest(policies=(standing(tmp_path / "standing.gauge.pt"),), engines=("fake", "fake@ls_iterations=7"))


def standing(path, robot="go2", contract=None):
    """Save a policy that never moves."""
    contract = contract or standard_contract(load_robot(robot))
    arguments = {"frame_width": 45, "num_actions": 12, "hidden": [8]}
    zeros = {k: torch.zeros_like(v) for k, v in MlpNetwork(**arguments).state_dict().items()}
    save_policy(path, contract, StoredNetwork(architecture="mlp", arguments=arguments, state_dict=zeros))
    return str(path)


def moving(speed):
    """A motion of the base forward [m/s], whatever is commanded."""

    def motion(backend):
        linear = torch.zeros(backend.num_worlds, 3, dtype=backend.dtype)
        linear[:, 0] = speed
        return linear, torch.zeros_like(linear)

    return motion


def judged(request, folder, fast=1.5, fail=(), **options):
    """A jury in which engines with ``ls_iterations`` 7 walk at another speed."""

    def make(name, scene, *, device, threads):
        special = scene.physics.ls_iterations == 7
        if special in fail:
            raise BackendError("it has no ground")
        return FakeBackend(scene, script=FakeScript(joint_law="track", motion=moving(fast if special else 1.0)))

    with patch.object(variants, "make_backend", make):
        return judging.jury(request, folder, **options)


def test_engines_that_differ_in_speed_are_told_apart(brief, tmp_path):
    results = judged(brief, tmp_path / "out")
    (block,) = results["policies"]
    forward = next(row for row in block["speeds"] if row["terrain"] == "flat" and row["command"] == [1.0, 0.0, 0.0])
    assert forward["shares"] == pytest.approx({"fake": 1.0, "fake@ls_iterations=7": 1.5}, abs=1e-5)
    assert forward["off"] == ["fake@ls_iterations=7"]
    assert (block["lowest"], block["highest"]) == ("fake@ls_iterations=7", "fake")
    assert block["ratio"] < 1.0
    fast, good = (block["engines"][e]["metrics"]["lin_vel_err"] for e in ("fake@ls_iterations=7", "fake"))
    assert 0.0 <= fast < good <= 1.0
    assert any("disagree most" in sentence for sentence in block["sentences"])
    assert results == json.loads((tmp_path / "out" / "jury.json").read_text())
    assert "fake@ls_iterations=7" in write_page(tmp_path / "out").read_text()


def test_physics_that_a_policy_was_trained_in_is_its_home(brief, tmp_path):
    """A file that states an engine with its settings ended the jury with a traceback."""
    physics = {"trained": [{"engine": "mujoco-warp", "settings": {"foot_condim": 6}}], "tuned": [{"engine": "other"}]}
    contract = standard_contract(load_robot("go2"))
    request = replace(
        brief,
        policies=(standing(tmp_path / "told.gauge.pt", contract=replace(contract, provenance={"physics": physics})),),
    )
    (block,) = judged(request, tmp_path / "out")["policies"]
    assert block["home"] == ["MuJoCo", "other"]
    assert block["training"]["trained"][0]["settings"] == {"foot_condim": 6}


def test_a_jury_goes_on_where_it_stopped(brief, tmp_path):
    first = judged(brief, tmp_path / "out")
    files = sorted((tmp_path / "out" / "fake" / "episodes").glob("*.npz"))
    assert len(files) == 4  # two grounds, two seeds
    files[0].unlink()
    times = {p: p.stat().st_mtime_ns for p in files[1:]}
    again = judged(brief, tmp_path / "out", resume=True)
    assert {p: p.stat().st_mtime_ns for p in files[1:]} == times
    assert again["policies"] == first["policies"]
    told = []
    with pytest.raises(StoreError, match="already holds this run; go on with --resume"):
        judged(brief, tmp_path / "out", told=told.append)
    assert told == []  # no speed was measured for it


def test_an_engine_that_fails_is_named_and_the_others_judge(brief, tmp_path):
    (block,) = judged(brief, tmp_path / "out", fail=(True,))["policies"]
    assert list(block["engines"]) == ["fake"]
    assert block["unable"] == [{"engine": "fake@ls_iterations=7", "reason": "it has no ground"}]
    assert block["advantages"] == []
    with pytest.raises(JuryError, match=r"no engine could judge 'standing': it has no ground"):
        judged(brief, tmp_path / "none", fail=(True, False))


def test_requests_that_no_jury_can_judge(brief, tmp_path):
    other = standing(tmp_path / "other.gauge.pt", "anymal_c")
    with pytest.raises(JuryError, match=r"'standing' is for robot 'go2', 'other' for 'anymal_c'; one jury judges"):
        judging.prepare_jury(replace(brief, policies=(*brief.policies, other)))
    with pytest.raises(JuryError, match=r"there is no part 'shor'; did you mean 'short'.*--part"):
        judging.prepare_jury(replace(brief, part="shor"))
    with pytest.raises(BackendError, match="unknown backend 'bullet'"):
        judging.prepare_jury(replace(brief, engines=("mujoco", "bullet")))
    with pytest.raises(ConsistencyError, match="'mujoco' is named twice; name every engine once"):
        judging.prepare_jury(replace(brief, engines=("mujoco", " mujoco")))
    with pytest.raises(JuryError, match="cannot be judged: "):
        judging.prepare_jury(replace(brief, policies=("missing.gauge.pt",)))


def test_engines_of_the_default_that_are_not_installed_are_left_out(brief, monkeypatch):
    def placed(variant, device):
        if not variant.backend.startswith("mujoco"):
            raise BackendError(f"backend '{variant.backend}' needs a package: pip install it")
        return variant

    monkeypatch.setattr(variants, "place", placed)
    prepared = judging.prepare_jury(replace(brief, engines=()))
    assert [v.label for v in prepared.engines] == ["mujoco", "mujoco@foot_condim=3"]
    assert [s["engine"] for s in prepared.skipped] == list(ENGINES[2:])
    assert set(prepared.families.values()) == {"MuJoCo"}


def made_records(bench, quality, share=1.0, seed=0):
    """Records of an engine with a quality, scattered by 0.01 from segment to segment alike in all engines."""
    random = np.random.default_rng(seed)
    found = {}
    for episode in bench.episodes():
        parts = np.repeat(np.arange(6), 10)
        samples = np.ones((60, len(COLUMNS)), np.float32)
        samples[:, -1] = quality + random.normal(0.0, 0.01, 6)[parts]
        samples[:, COLUMNS.index("motion_done")] = share
        found[episode] = Record(
            episode=episode, columns=COLUMNS, samples=samples, goal_index=np.zeros(60, np.int16), part_index=parts.astype(np.int16)
        )  # fmt: skip
    return found


@pytest.fixture
def bench():
    suite = load_suite("jury")
    return Bench(suite=suite, cells=(Cell(terrain="flat", level=0, friction=0.6),), seeds=(0, 1))


FAMILIES = {"a": "A", "a@feet": "A", "b": "B", "c": "C"}


def test_consensus_gives_every_family_the_same_weight(bench):
    found = {label: made_records(bench, q) for label, q in {"a": 0.9, "a@feet": 0.7, "b": 0.5, "c": 0.5}.items()}
    block = verdict(bench, found, FAMILIES, [], "walk")
    mean = np.mean([s.quality for s in [bench.segments(found["b"])]]) - 0.5
    assert block["consensus"]["value"] == pytest.approx((0.8 + 0.5 + 0.5) / 3 + mean, abs=1e-6)
    assert block["ratio"] == pytest.approx((0.5 + mean) / (0.9 + mean), abs=1e-6)


@pytest.mark.parametrize(
    ("home", "words"), [(["A"], "has learned its judge"), (["B"], None), ([], "if it was trained")]
)
def test_an_advantage_at_home_is_said(bench, home, words):
    found = {label: made_records(bench, 0.8 if label == "a" else 0.7) for label in FAMILIES}
    block = verdict(bench, found, FAMILIES, home, "walk")
    entry = next(e for e in block["advantages"] if e["engine"] == "a")
    assert entry["difference"]["value"] == pytest.approx(0.1, abs=1e-6)
    assert entry["above"] and not any(e["above"] for e in block["advantages"] if e["engine"] != "a")
    said = " ".join(sentences(block, "walk"))
    assert words in said if words else "its score is" not in said


def test_equal_engines_have_no_advantage(bench):
    found = {label: made_records(bench, 0.8) for label in FAMILIES}
    block = verdict(bench, found, FAMILIES, ["A"], "walk")
    assert not any(e["above"] for e in block["advantages"])
    assert block["ratio"] == 1.0


def test_parts_fit_the_suite():
    assert PARTS.keys() == BIPED_PARTS.keys()
    for part in (*PARTS.values(), *BIPED_PARTS.values()):
        suite = load_suite(part.suite)
        assert all((level == 0) == (terrain == "flat") for terrain, level in part.grounds)
        assert all(0 <= level <= suite.scoring.levels for _, level in part.grounds)


@pytest.mark.parametrize("part", BIPED_PARTS)
def test_a_biped_begins_above_the_ground(part):
    """On the Go2's stairs of level 6 the front of a G1's soles begins 3 cm inside a step, and some engines throw it."""
    robot = load_robot("g1")
    plan = body_plan(robot)
    depths = []
    for asked_for in (BIPED_PARTS[part], PARTS[part]):
        ground = load_suite(asked_for.suite).ground
        terrains = [build_terrain(ground, robot, name, level) for name, level in asked_for.grounds]
        places = [(t, t.spawns.get("level_eval", next(iter(t.spawns.values())))) for t in terrains]
        depths.append(
            max(
                float(t.height(place.position[0] + foot[0] + along, place.position[1] + foot[1]))
                - (place.position[2] + robot.stand_height - plan.standing_height)
                for t, place in places
                if place.yaw == 0.0
                for foot in plan.foot_position
                for along in (-0.06, 0.0, 0.13)
            )
        )
    assert depths[0] <= 0.0 and depths[1] > 0.03


def test_two_legs_are_judged_on_ground_in_their_own_measure():
    prepared = judging.prepare_jury(JuryRequest(policies=("pretrained-g1",), engines=("mujoco",)))
    assert prepared.suite.name == "jury-biped" and prepared.world_steps <= 150_000
    assert judging.prepare_jury(JuryRequest(policies=("pretrained",), engines=("mujoco",))).suite.name == "jury"


def test_what_a_jury_takes_is_said_first_and_the_default_is_small(brief, tmp_path):
    heard = []
    told = lambda cost: heard.append((cost, (tmp_path / "out" / "fake").exists()))  # noqa: E731
    judged(brief, tmp_path / "out", told=told)
    ((cost, began),) = heard
    assert not began
    # two commands of 0.2 s and twice 0.04 s to settle, in steps of 2 ms; two grounds, two seeds
    assert (cost.engines, cost.policies, cost.episodes, cost.world_steps) == (2, 1, 4, 4 * 240)
    assert cost.seconds > 0.0


def test_the_default_part_is_at_most_150_000_steps_of_one_world(brief, monkeypatch):
    monkeypatch.setattr(judging, "PARTS", asked.PARTS)
    assert judging.prepare_jury(brief).world_steps <= 150_000
