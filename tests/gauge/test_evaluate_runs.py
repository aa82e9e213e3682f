"""From a request to results, and what is refused."""

import csv
import hashlib
import json
import shutil
from dataclasses import replace
from itertools import count, pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from gaitgauge.files.provenance import commit
from gaitgauge.files.writing import json_text
from gaitgauge.gauge.evaluate import prepare
from gaitgauge.gauge.result import Health, TerrainScore, read_result
from gaitgauge.gauge.store import StoreError
from gaitgauge.gauge.suite import SuiteError
from gaitgauge.policy.base import PolicyError
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.native import StoredNetwork, save_policy
from gaitgauge.policy.networks.architectures import MlpNetwork
from gaitgauge.robots import RobotError
from gaitgauge.terrains.registry import TerrainError
from gaitgauge_fake_engine import FakeBackend
from scripted_gauge import GO2, Puppet
from tiny_runs import SMALL, TINY, evaluate, without_provenance


@pytest.mark.parametrize("change", [lambda path: path.unlink(), lambda path: path.write_bytes(b"another file")])
def test_results_name_the_file_that_was_played_whatever_became_of_it(request_for, tmp_path, change):
    request = request_for()
    path = Path(request.policy)
    expected = hashlib.sha256(path.read_bytes()).hexdigest()
    prepared = prepare(request)
    change(path)
    assert evaluate(prepared, tmp_path / "run").policy.file_sha256 == expected


@pytest.mark.parametrize("base", ["robogauge-1.1", "gaitgauge-1"])
def test_a_whole_run(request_for, tmp_path, base):
    folder = tmp_path / "run"
    returned = evaluate(request_for(base), folder)
    written = (folder / "results.json").read_text()
    assert written == json_text(returned.to_data())
    result = read_result(folder, StoreError)
    assert json_text(result.to_data()) == written
    flat, slope = result.environments
    assert (flat.terrain, flat.level) == ("flat", None)
    assert (slope.terrain, slope.level) == ("slope_fd", 2)
    assert slope.search == ({1: True} if base == "gaitgauge-1" else {}) | {2: True, 3: False}
    assert result.level == 2.0
    assert result.score == pytest.approx((flat.score + slope.score) / 2, abs=1e-6)
    assert result.score_interval[0] <= result.score <= result.score_interval[1]
    assert set(result.groups) == set(result.groups_interval) == {"tracking", "safety", "quality"}
    assert result.terrains["slope_fd"].score == pytest.approx(0.09 + 0.19 * slope.quality.mean50, abs=2e-4)
    assert result.health == Health(episodes=4, self_contact=0.0)
    assert result.suite.digest == result.provenance.digests["suite"]
    assert {len(d) for d in result.provenance.digests.values()} == {64}
    assert result.provenance.digests.keys() == {"policy", "suite", "robot", "source"}
    assert result.provenance.commit == commit()
    assert result.chance.seeds == (0, 1) and result.chance.search_seeds == (100, 101, 102)
    assert result.provenance.processor
    # every episode that was played is a row, those of the level tests too
    lines = list(csv.DictReader((folder / "episodes.csv").open()))
    rows = [r for r in lines if r["command"] == "all"]
    files = {p.stem for p in (folder / "episodes").iterdir()}
    parts = [r for r in lines if r["command"] != "all"]
    assert len(parts) == 4 * 14  # eight diagonals and six axes in each quality episode
    assert {r["command"] for r in parts} >= {"diagonal_velocity -x-y", "max_velocity +yaw"}
    of_flat = [r for r in rows if r["stage"] == "eval" and r["terrain"] == "flat"]
    quality = np.mean([float(r["quality_mean50"]) for r in of_flat])
    assert quality == pytest.approx(flat.score, abs=2e-4)
    # an area takes all search seeds beside the crossing and two at level 1, a test as many as decide it
    trials, far = (3, 2) if base == "gaitgauge-1" else (2, 0)
    assert len(rows) == len(files) == 4 + 2 * trials + far
    assert [r["success"] for r in rows if r["stage"] == "search" and r["level"] == "3"] == ["False"] * trials
    if base == "gaitgauge-1":
        assert slope.curve == {1: 1.0, 2: 1.0, 3: 0.0}
    assert sum(int(r["physics_steps"]) for r in rows) > 0


@pytest.mark.parametrize("parallel", [True, False])
def test_an_engine_from_outside_gets_the_workers_that_it_declares(whole_run, tmp_path, monkeypatch, parallel):
    request, once = whole_run
    monkeypatch.setattr(FakeBackend, "parallel_processes", parallel)
    results = evaluate(replace(request, threads=2), tmp_path / "run")
    assert results.provenance.processes == (2 if parallel else 1)
    assert without_provenance(tmp_path / "run") == without_provenance(once)
    assert (tmp_path / "run" / "episodes.csv").read_bytes() == (once / "episodes.csv").read_bytes()


def test_a_level_run_has_levels_and_no_score(request_for, tmp_path):
    result = evaluate(request_for(pipeline="level"), tmp_path / "run")
    assert result.score is None
    low, high = result.terrains["slope_fd"].level_interval
    assert 0.0 <= low < 2.0 < high <= 3.0
    assert result.terrains == {"slope_fd": TerrainScore(level=2.0, level_interval=(low, high))}
    written = json.loads((tmp_path / "run" / "results.json").read_text())
    assert written["terrains"] == {"slope_fd": {"level": 2.0, "level_interval": [low, high]}}


def test_a_policy_that_passes_nothing_scores_zero(request_for, tmp_path):
    request = request_for(terrains=("slope_fd",))
    result = evaluate(request, tmp_path / "run", make=lambda name, scene, **options: Puppet(scene))
    assert result.score == 0.0
    assert result.level == 0.0
    assert result.metrics["dof_power"].mean50 == 0.0


def test_seeds_and_frictions_given_twice_count_once(request_for, tmp_path):
    request = request_for(pipeline="multi", frictions=(0.5, 0.5), seeds=(1, 1))
    result = evaluate(request, tmp_path / "run")
    assert len(result.environments) == 1
    assert result.health.episodes == 1


def test_the_progress_lists_every_episode_once_and_counts_down(request_for, tmp_path, monkeypatch):
    """The clock ticks at each look: on a busy machine a step that took long made the rest seem longer."""
    monkeypatch.setattr("time.perf_counter", (0.001 * tick for tick in count()).__next__)
    seen = []
    evaluate(request_for(), tmp_path / "run", watch=seen.append)
    assert max(len(s.active) for s in seen) > 1
    assert all(len(set(s.active)) == len(s.active) for s in seen)
    shares = [s.remaining_work for s in seen]
    assert all(0.0 <= share <= 1.0 for share in shares)
    assert shares[0] > 0.9
    assert shares[-1] == 0.0
    # while nothing ends and nothing begins, work that is done shows
    steady = [
        (a, b) for a, b in pairwise(seen) if a.active == b.active and a.expected == b.expected and a.done == b.done
    ]
    assert steady
    assert all(b.remaining_work <= a.remaining_work for a, b in steady)


def test_results_are_written_whatever_the_provenance_holds(request_for, tmp_path):
    contract = replace(
        standard_contract(GO2), provenance={"note": float("nan"), "name": "\ud800", "[/x]": [float("inf")]}
    )
    request = request_for()
    prepared = prepare(request)
    prepared.policy.contract = contract
    result = evaluate(prepared, tmp_path / "run", command=["gaitgauge", "a b", "\udcff"])
    written = json.loads((tmp_path / "run" / "results.json").read_text())
    assert written["score"] == result.score
    assert written["policy"]["provenance"] == {"note": "nan", "name": "\\ud800", "[/x]": ["inf"]}
    assert written["provenance"]["command"] == "gaitgauge 'a b' '\\udcff'"


def test_a_robot_with_its_feet_in_the_ground_is_not_judged(request_for, tmp_path):
    folder = tmp_path / "robot"
    shutil.copytree(GO2.mjcf.parent, folder)
    file = folder / "robot.toml"
    # with its trunk at 0.445 m the lowest feet hang 0.1215 m above the ground
    file.write_text(file.read_text().replace("stand_height = 0.445", "stand_height = 0.3075"))
    with pytest.raises(
        RobotError, match=r"at stand_height 0\.3075 m the geom '.*' is 0\.016 m below the ground; raise it to 0\.324 m"
    ):
        evaluate(request_for(robot=str(folder)), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_policy_that_answers_nonsense_leaves_what_was_finished(request_for, tmp_path):
    request = request_for(pipeline="multi")
    broken = {k: torch.full_like(v, torch.nan) for k, v in MlpNetwork(**SMALL).state_dict().items()}
    stored = StoredNetwork(architecture="mlp", arguments=SMALL, state_dict=broken)
    save_policy(request.policy, standard_contract(GO2), stored)
    with pytest.raises(
        PolicyError,
        match="returned nan for a finite observation at control step 0 of diagonal_velocity, sub-command 1, of episode eval-flat",
    ):
        evaluate(request, tmp_path / "run")
    assert not (tmp_path / "run" / "results.json").exists()


# ---- requests -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("choices", "error", "message"),
    [
        (
            {"pipeline": "base", "terrains": ("slope_fd",)},
            SuiteError,
            "plays one level of terrain 'slope_fd'; say which",
        ),
        ({"pipeline": "everything"}, SuiteError, "there is no pipeline 'everything'; choose one of base, multi"),
        ({"pipeline": "level", "terrains": ("flat",)}, SuiteError, "'flat' has no levels to search"),
        ({"pipeline": "level", "level": 3}, SuiteError, "pipeline 'level' searches the level; leave --level out"),
        ({"pipeline": "multi", "level": 3}, SuiteError, "terrain 'flat' has no levels, so --level 3 means nothing"),
        ({"pipeline": "base", "frictions": (0.5, 0.6)}, SuiteError, "plays one environment"),
        ({"level": 0}, SuiteError, "level 0 does not exist; choose 1 to 3"),
        ({"level": 11}, SuiteError, "level 11 does not exist"),
        ({"frictions": (-0.2,)}, SuiteError, "friction -0.2 is not possible"),
        ({"frictions": (float("nan"),)}, SuiteError, "friction nan is not possible"),
        ({"payloads": (-9.0,)}, SuiteError, "payload -9 kg is not possible"),
        ({"seeds": (-1,)}, SuiteError, "seed -1 is not possible"),
        ({"terrains": ("slop_fd",)}, TerrainError, "did you mean 'slope_fd'"),
        ({"terrains": ("wave",)}, SuiteError, r"has no commands\.target_speed for terrain family 'wave'"),
        ({"suite": "gaitgauge-2"}, SuiteError, "there is no suite 'gaitgauge-2'"),
        ({"policy": "nowhere.pt"}, PolicyError, "nowhere.pt"),
    ],
)
def test_impossible_requests_are_refused_before_anything_is_written(request_for, tmp_path, choices, error, message):
    with pytest.raises(error, match=message) as caught:
        evaluate(request_for(**choices), tmp_path / "run")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_terrains_keep_the_suites_order(request_for):
    environments = prepare(request_for(terrains=("slope_fd", "flat"))).environments
    assert [e.terrain for e in environments] == ["flat", "slope_fd"]


def test_a_base_run_is_one_episode(request_for, tmp_path):
    result = evaluate(request_for(pipeline="base", terrains=("slope_fd",), level=2), tmp_path / "run")
    assert result.health.episodes == 1
    assert result.environments[0].level == 2
    assert "search" not in result.environments[0].to_data()


@pytest.mark.parametrize("pipeline", ["base", "multi"])
def test_a_single_run_takes_the_suites_own_ground(request_for, tmp_path, pipeline):
    request = request_for(pipeline=pipeline)
    own = TINY.format(base="gaitgauge-1").replace('["flat", "slope_fd"]', '["slope_fd", "wave"]')
    own = own.replace("frictions = [0.6]", "frictions = [0.3]\nnominal_friction = 0.3")
    Path(request.suite).write_text(own)
    with pytest.raises(
        SuiteError, match=f"pipeline '{pipeline}' plays one level of terrain 'slope_fd'; say which with"
    ):
        prepare(request)
    (environment,) = prepare(replace(request, level=2)).environments
    assert environment.key == "slope_fd-f0.3-m0"
