"""The whole study on scripted engines, whose differences are known."""

import dataclasses
import hashlib
import json
import os
import re
import shutil
import signal
import zlib
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import torch
from gaitgauge.backends import BackendError, make_backend
from gaitgauge.gauge.play.workers import WorkerError
from gaitgauge.gauge.store import StoreError
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.native import StoredNetwork, save_policy
from gaitgauge.policy.networks.architectures import MlpNetwork
from gaitgauge.robots import load_robot
from gaitgauge.studies.consistency import open_loop, variants
from gaitgauge.studies.consistency import study as studying
from gaitgauge.studies.consistency.attribution import choose_factors
from gaitgauge.studies.consistency.closed_loop import Design, make_cells
from gaitgauge.studies.consistency.page import render, verdict, write_page
from gaitgauge.studies.consistency.prepared import default_engines
from gaitgauge.studies.consistency.request import ConsistencyError, StudyRequest
from gaitgauge.studies.consistency.statistics import Estimate
from gaitgauge_fake_engine import FakeBackend, FakeScript

GO2 = load_robot("go2")
SUITE = """
extends = "robogauge-1.1"
name = "tiny"
title = "a second"
goals = [{ name = "max_velocity", phases = [0.1, 0.04] }, { name = "target_pos_velocity", phases = [] }]
[commands]
target_time = { slope = 0.1, wave = 0.1, stairs = 0.1, obstacle = 0.1 }
[settling]
longest = 0.04
speed = 10.0
shortest = 0.0
[physics]
timestep = 0.01
substeps = 2
watch_tilt = 0.4
[noise]
latency = 1
[events]
fall_tilt = 0.4
[metrics]
interval = 5
[scoring]
bootstrap = 100
"""
FAST = 0.5
"""Speed at which the shifted engine lifts every robot [m/s]: an error of its velocity, whatever is commanded."""
BOTH = ("flat", "slope_fd")
DURATION = 0.3
"""Length of the open-loop tests here [s]."""


@pytest.fixture(autouse=True)
def short_open_loop(monkeypatch):
    monkeypatch.setattr(open_loop, "DURATION", DURATION)


def requests_in(folder):
    """Return a maker of small requests of two engines; their parts can be replaced."""
    arguments = {"frame_width": 45, "num_actions": 12, "hidden": [8]}
    zeros = {name: torch.zeros_like(value) for name, value in MlpNetwork(**arguments).state_dict().items()}
    policy = folder / "standing <b>.gauge.pt"
    save_policy(
        policy, standard_contract(GO2), StoredNetwork(architecture="mlp", arguments=arguments, state_dict=zeros)
    )
    suite = folder / "tiny.toml"
    suite.write_text(SUITE)
    whole = StudyRequest(
        policies=(str(policy),),
        backends=("fake", "fake@ls_iterations=7"),
        device="cpu",
        suite=str(suite),
        terrains=("flat",),
        attribution=False,
    )

    def make_request(**changes):
        return dataclasses.replace(whole, **changes)

    return make_request


@pytest.fixture
def request_of(tmp_path):
    return requests_in(tmp_path)


def drifting(backend):
    """Upwards at a constant speed."""
    linear = torch.zeros(backend.num_worlds, 3, dtype=backend.dtype)
    linear[:, 2] = FAST
    return linear, torch.zeros_like(linear)


def engine(*, shifted=None, **shift):
    """Builds scripted engines; those with ``ls_iterations`` 7 follow another script."""
    shifted = shifted or FakeScript(joint_law="track", **shift)

    def make(name, scene, *, device, threads):
        special = scene.physics.ls_iterations == 7
        return FakeBackend(scene, script=shifted if special else FakeScript(joint_law="track"))

    return make


def study(request, folder, *, make=make_backend, **options):
    """A study whose engines are built by ``make``."""
    with patch.object(variants, "make_backend", make):
        return studying.study(request, folder, **options)


def only_pair(results):
    return results["policies"][0]["pairs"]["fake@ls_iterations=7"]


def zero(estimate):
    return estimate["value"] == 0.0 and estimate["interval"] == [0.0, 0.0]


@pytest.fixture(scope="module")
def drifted(tmp_path_factory):
    """A study with attribution in which the compared engine drifts: its request, folder and results."""
    folder = tmp_path_factory.mktemp("drifted")
    request = requests_in(folder)(terrains=BOTH, attribution=True, factors=("tolerance", "contacts"))
    with patch.object(open_loop, "DURATION", DURATION):
        return request, folder / "out", study(request, folder / "out", make=engine(motion=drifting))


def test_identical_engines_have_no_gap(request_of, tmp_path):
    request = request_of(terrains=BOTH)
    results = study(request, tmp_path / "out", make=engine())
    assert results["policies"][0]["file_sha256"] == hashlib.sha256(Path(request.policies[0]).read_bytes()).hexdigest()
    pair = only_pair(results)
    for block in (pair["overall"], *pair["terrains"].values()):
        assert zero(block["gap"]) and zero(block["difference"])
        assert block["verdict"] == "equivalent" and block["effect_size"] == 0.0
        assert all(zero(m["difference"]) and m["effect_size"] == 0.0 for m in block["metrics"].values())
        assert block["outcomes"]["fell"]["same"] == 1.0
    assert set(pair["terrains"]) == {"flat", "slope_fd"}
    assert pair["terrains"]["flat"]["outcomes"]["reached"] is None
    assert pair["overall"]["outcomes"]["reached"]["episodes"] == 3
    assert zero(results["policies"][0]["gaps"][0]["overall"]["gap"])
    for test in results["policies"][0]["open_loop"]["differences"]["fake@ls_iterations=7"].values():
        assert all(value == 0.0 for value in test["largest"].values())
        assert test["apart"] == {"0.01": None, "0.1": None}
    assert results == json.loads((tmp_path / "out" / "consistency.json").read_text())


def test_shifted_engine_is_found_out(drifted):
    results = drifted[2]
    overall = only_pair(results)["terrains"]["flat"]
    assert overall["gap"]["value"] > 0.01
    assert overall["gap"]["interval"][0] > 0.0
    assert overall["excess"]["interval"][0] > 0.0
    assert overall["verdict"] == "different"
    # 1 - ‖v - v*‖ / limit of a robot that stands, or drifts: only velocity tracking can tell
    assert overall["metrics"]["lin_vel_err"]["difference"]["interval"][1] < 0.0
    assert overall["difference"]["interval"][1] < 0.0
    assert overall["effect_size"] is None  # no noise reaches a scripted engine: every seed differs by the same
    walk = results["policies"][0]["open_loop"]["differences"]["fake@ls_iterations=7"]["walk"]
    assert walk["end"]["position"] == pytest.approx(FAST * DURATION, rel=1e-3)
    assert walk["apart"]["0.1"] == pytest.approx(0.2, abs=0.021)


def test_falls_in_one_engine_are_counted(request_of, tmp_path):
    make = engine(fall_time=torch.full((), 0.04))
    overall = only_pair(study(request_of(), tmp_path / "out", make=make))["overall"]
    fell = overall["outcomes"]["fell"]
    assert (fell["only_reference"], fell["only_compared"], fell["same"]) == (0, 3, 0.0)


def test_gap_is_the_mean_magnitude_of_the_rows(drifted):
    pair = only_pair(drifted[2])
    by_terrain = {}
    for row in pair["episodes"]:
        if row["stage"] == "eval":
            by_terrain.setdefault(row["terrain"], []).append(row["quality"][1] - row["quality"][0])
    assert pair["overall"]["gap"]["value"] == pytest.approx(np.mean([np.abs(v).mean() for v in by_terrain.values()]))
    assert pair["overall"]["difference"]["value"] == pytest.approx(np.mean([np.mean(v) for v in by_terrain.values()]))


def test_attribution_switches_one_factor_and_finds_the_one_that_matters(request_of, tmp_path):
    def make(name, scene, *, device, threads):
        pyramid = scene.physics.cone == "pyramidal"
        return FakeBackend(scene, script=FakeScript(joint_law="track", motion=drifting if pyramid else None))

    request = request_of(
        backends=("fake", "fake@cone=pyramidal"),
        attribution=True,
        factors=("cone", "tolerance", "precision"),
        terrains=("flat",),
    )
    results = study(request, tmp_path / "out", make=make)
    rows = {row["factor"]: row for row in results["policies"][0]["attribution"]}
    assert set(rows) == {"cone", "tolerance", "precision"}
    cone, tolerance = rows["cone"], rows["tolerance"]
    assert cone["variant"] == "fake@cone=pyramidal"
    assert zero(tolerance["gap"])
    assert zero(tolerance["to"]["fake@cone=pyramidal"]["change"])
    assert cone["gap"]["interval"][0] > 0.0
    switched = cone["to"]["fake@cone=pyramidal"]
    assert (tolerance["to"]["fake@cone=pyramidal"]["verdict"], switched["verdict"]) == ("equivalent", "different")
    assert switched["gap_after"] == 0.0
    assert switched["change"]["interval"][1] < 0.0
    # the switched reference is the compared engine, and no episode was played twice
    assert sorted(p.name for p in (tmp_path / "out").iterdir() if p.is_dir()) == [
        "fake",
        "fake@cone=pyramidal",
        "fake@tolerance=1e-05",
        "fake~1e-07r#1",
        "fake~1e-07r#2",
        "fake~1e-07r#3",
    ]


def test_a_study_goes_on_where_it_stopped(drifted, tmp_path):
    request, _, first = drifted
    folder = shutil.copytree(drifted[1], tmp_path / "out")
    with pytest.raises(StoreError, match="--resume"):
        study(request, folder, make=engine())
    files = sorted((folder / "fake" / "episodes").glob("*.npz"))
    assert len(files) == 9  # two terrains' quality and one's crossing, three seeds each
    files[0].unlink()
    before = {p: p.stat().st_mtime_ns for p in files[1:]}
    again = study(request, folder, resume=True, make=engine(motion=drifting))
    assert {p: p.stat().st_mtime_ns for p in files[1:]} == before
    assert again["policies"] == first["policies"]
    with pytest.raises(StoreError, match="another run"):
        study(dataclasses.replace(request, seeds=4), folder, resume=True, make=engine())


def test_engines_that_cannot_run_are_left_out_until_one_is_left(request_of, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    request = request_of(backends=("mujoco", "mujoco@cone=pyramidal", "mujoco-warp"), device=None)
    results = study(request, tmp_path / "out", make=engine())
    assert results["compared"] == ["mujoco@cone=pyramidal"]
    assert [s["backend"] for s in results["skipped"]] == ["mujoco-warp"]
    assert "--device cpu" in results["skipped"][0]["reason"]
    with pytest.raises(ConsistencyError, match=r"only 'mujoco' is left.*--device cpu"):
        study(request_of(backends=("mujoco", "mujoco-warp"), device=None), tmp_path / "two")
    assert not (tmp_path / "two").exists()


def test_engine_that_fails_while_playing_is_left_out(request_of, tmp_path, monkeypatch):
    def make(name, scene, *, device, threads):
        if scene.physics.impratio == 1.0:
            raise BackendError("it has no impratio")
        return FakeBackend(scene)

    request = request_of(
        backends=("fake", "fake@cone=pyramidal", "fake@impratio=1"), attribution=True, factors=("impratio",)
    )
    prepared = studying.prepare_study(request)
    with monkeypatch.context() as patched:
        patched.setattr(studying, "prepare_study", None)  # what was prepared is not prepared again, nor changed
        results = study(prepared, tmp_path / "out", make=make)
    assert prepared.skipped == [] and len(prepared.others) == 2
    assert results["skipped"] == [{"backend": "fake@impratio=1", "reason": "it has no impratio"}]
    assert results["policies"][0]["attribution"][0]["not_run"] == "it has no impratio"
    with pytest.raises(ConsistencyError, match="it has no impratio"):
        study(request_of(backends=("fake", "fake@impratio=1")), tmp_path / "three", make=make)


def test_a_process_that_is_lost_ends_the_study_and_no_engine_is_left_out_for_it(request_of, tmp_path):
    """Nothing was said of it, the exit code was 0, and --resume went on without the engine."""
    parent = os.getpid()

    def make(name, scene, *, device, threads):
        if scene.physics.ls_iterations == 7 and os.getpid() != parent:
            os.kill(os.getpid(), signal.SIGKILL)  # as the system does where memory runs out
        return FakeBackend(scene, script=FakeScript(joint_law="track"))

    engines = ("mujoco", "mujoco@cone=pyramidal", "mujoco@ls_iterations=7")
    with pytest.raises(WorkerError, match=r"was ended by signal 9; what had finished is kept: go on with --resume"):
        study(request_of(backends=engines, threads=2), tmp_path / "out", make=make)
    assert not (tmp_path / "out" / "consistency.json").exists()


def test_every_layer_plays_with_the_gains_of_the_suite_s_rule(request_of, tmp_path):
    request = request_of()
    contract = replace(standard_contract(GO2), stiffness=(40.0,) * 12, damping=(1.0,) * 12)
    arguments = {"frame_width": 45, "num_actions": 12, "hidden": [8]}
    zeros = MlpNetwork(**arguments).state_dict()
    save_policy(request.policies[0], contract, StoredNetwork(architecture="mlp", arguments=arguments, state_dict=zeros))
    for gains, wanted in (("contract", 40.0), ("suite", 20.0)):
        Path(request.suite).write_text(SUITE.replace('name = "tiny"', f'name = "tiny"\ngains = "{gains}"'))
        seen = set()

        def make(name, scene, *, device, threads, seen=seen):
            seen.add(scene.parameters.stiffness)
            return FakeBackend(scene, script=FakeScript(joint_law="track"))

        study(request, tmp_path / gains, make=make)
        assert seen == {(wanted,) * 12}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"backends": ("fake",)}, "two engines"),
        ({"backends": ("fake", "fake")}, "'fake' is named twice"),
        ({"backends": ("fake", "nonsense")}, "unknown backend 'nonsense'"),
        ({"seeds": 1}, "--seeds"),
        ({"levels": (11,)}, "--level"),
        ({"frictions": (0.0,)}, "--friction"),
        ({"terrains": ("moon",)}, "moon"),
        ({"attribution": True, "factors": ("magic",)}, "--factor"),
        ({"backends": ("fake", "fake@timestep=0.003")}, "does not divide"),
    ],
)
def test_impossible_requests_are_refused_before_anything_is_written(request_of, tmp_path, changes, words):
    with pytest.raises((ValueError, RuntimeError), match=words):
        study(request_of(**changes), tmp_path / "out", make=engine())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("reference", [pytest.param("fake", marks=pytest.mark.slow), "fake@ls_iterations=7"])
def test_any_engine_is_the_reference_and_a_difference_has_one_interval(request_of, tmp_path, monkeypatch, reference):
    """Resamples are drawn by name: with another name in another table, one difference would have two intervals."""

    plain = Design.estimate

    def estimate(design, values, name, rows=None, *, magnitude=False):
        number = float(zlib.crc32(name.encode()))
        value = plain(design, values, name, rows, magnitude=magnitude).value
        return Estimate(value=value, low=-number, high=number)

    monkeypatch.setattr(Design, "estimate", estimate)
    found = study(request_of(reference=reference), tmp_path / "out", make=engine(motion=drifting))
    results = found["policies"][0]
    (gap,), (pair,) = results["gaps"], results["pairs"].values()
    assert found["reference"] == gap["pair"][0] == reference
    assert (pair["overall"]["difference"]["value"] > 0.0) is (reference != "fake")
    for name in ("gap", "difference"):
        assert gap["overall"][name] == pair["overall"][name]


def test_cells():
    cells = make_cells(["flat", "wave"], [2, 4], [0.5, 1.0])
    assert [(c.terrain, c.level, c.friction) for c in cells] == [
        ("flat", 0, 0.5),
        ("flat", 0, 1.0),
        ("wave", 2, 0.5),
        ("wave", 2, 1.0),
        ("wave", 4, 0.5),
        ("wave", 4, 1.0),
    ]


def test_factors_by_name():
    assert [f.name for f in choose_factors(["cone", "impratio"])] == ["cone", "impratio"]
    assert len(choose_factors([])) > 5


def test_page_is_self_contained_and_escapes_names(drifted, tmp_path):
    _, folder, results = drifted
    html = write_page(folder).read_text()
    assert html == render(json.loads(json.dumps(results)))
    assert "standing &lt;b&gt;.gauge.pt" in html and "standing <b>" not in html
    assert not re.search(r"(?:src|href)\s*=|url\(|@import", html)
    assert html.count("<svg") > 30
    # what is beside a swatch is not broken where there is room: a sentence would make a phone's page three screens wide
    assert max(len(words) for words in re.findall(r'"key-line">(?:<svg.*?</svg>)?([^<]*)<', html)) < 60
    assert "nan" not in re.sub(r"<style>.*?</style>", "", html, flags=re.S).lower().replace("provenance", "")
    for words in ("Gap", "Models", "Not described by", "Open loop", "Attribution", "linear velocity tracking"):
        assert words in html
    (tmp_path / "empty").mkdir()
    (tmp_path / "consistency.json").write_text(json.dumps({**results, "schema": 99}))
    with pytest.raises(StoreError, match=r"has schema 99, this version reads \d; run gaitgauge consistency again"):
        write_page(tmp_path)
    with pytest.raises(StoreError, match="gaitgauge consistency"):
        write_page(tmp_path / "empty")


def test_a_head_breaks_before_an_engine_s_setting():
    """The table of the closed loop was wider than a page of 1,400 pixels, and its verdicts were out of sight."""
    seed = Path(__file__).parents[1] / "fuzz" / "seeds" / "consistency" / "consistency.json"
    assert "<th>mujoco@\u200btimestep=0.005</th>" in render(json.loads(seed.read_text()))


def test_several_policies_have_folders_of_their_own(request_of, tmp_path):
    name = request_of().policies[0]
    results = study(request_of(policies=(name, name)), tmp_path / "out", make=engine())
    assert len(results["policies"]) == 2
    folders = sorted(p.name for p in (tmp_path / "out").iterdir() if p.is_dir())
    assert [f[0] for f in folders] == ["1", "2"]
    assert (tmp_path / "out" / folders[1] / "fake" / "episodes").is_dir()


# ---- what is said ---------------------------------------------------------------------------------------------------


def judged(difference, excess, verdict_word):
    estimates = {
        name: {"value": sum(ends) / 2, "interval": list(ends)}
        for name, ends in (("difference", difference), ("excess", excess))
    }
    return verdict({**estimates, "verdict": verdict_word, "deciding_seeds": 7}, 0.02)


def test_two_seeds_do_not_say_no_more_than_chaos():
    """Their excess may be anything: zero lies within, and so does ten times the margin."""
    text = judged((-0.2, 0.25), (-0.3, 0.31), "undecided")
    assert "no more than" not in text
    assert "Whether the qualities differ is open" in text and "may differ by up to 0.3100 more" in text
    assert "about 7 seeds would decide" in text


def test_no_difference_is_said_within_the_margin_alone():
    text = judged((-0.003, 0.004), (-0.002, 0.005), "equivalent")
    assert "equivalent" in text and "within ±0.02" in text and "by no more than single precision" in text
    assert "lower by 0.0500" in judged((-0.08, -0.02), (0.01, 0.02), "different")
    assert "by more than single precision" in judged((-0.08, -0.02), (0.01, 0.02), "different")


def test_every_episode_and_draw_of_the_floor_has_a_perturbation_of_its_own(request_of, tmp_path):
    resets = {}

    class Listener(FakeBackend):
        def reset(self, start, worlds=None):
            joints = start.joint_position
            if joints is not None:
                resets.setdefault(id(self), set()).update(tuple(row) for row in joints.tolist())
            super().reset(start, worlds)

    def make(name, scene, *, device, threads):
        return Listener(scene)

    request = request_of(backends=("fake", "fake@cone=pyramidal"), terrains=("flat",))
    results = study(request, tmp_path / "out", make=make)
    assert results["draws"] == 3
    states = set().union(*resets.values())
    # three draws; in each two seeds and every sub-command of two goals begin otherwise
    assert len(states) >= 3 * len(results["seeds"]) * 2


@pytest.mark.parametrize(
    ("gpu", "drake", "second"),
    [(True, True, "mujoco-warp"), (False, True, "drake"), (False, False, "mujoco@foot_condim=3")],
)
def test_a_study_starts_light(monkeypatch, gpu, drake, second):
    """On a CPU there was no result after 15 minutes: seven terrains, three engines that compile, ten factors."""

    def find(name, device):
        if not drake:
            raise BackendError("drake is not installed")

    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    monkeypatch.setattr("gaitgauge.studies.consistency.prepared.find_backend", find)
    assert default_engines() == ("mujoco", second)
    request = StudyRequest(policies=("pretrained",))
    assert (request.suite, request.seeds, request.attribution, request.factors) == ("jury", 3, False, ())
