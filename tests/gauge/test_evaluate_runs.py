"""From a request to results: what is refused, what a killed run leaves, and that it ends with the very same results."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from gaitgauge.backends import make_backend
from gaitgauge.backends.base import BackendError
from gaitgauge.backends.fake import FakeScript
from gaitgauge.files.provenance import commit, versions
from gaitgauge.gauge import evaluate as evaluation
from gaitgauge.gauge.episodes import Record
from gaitgauge.gauge.evaluate import Request, identity, prepare
from gaitgauge.gauge.store import RunFolder, StoreError
from gaitgauge.gauge.suite import SuiteError
from gaitgauge.policy.base import PolicyError
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.native import StoredNetwork, save_policy
from gaitgauge.policy.networks import MlpNetwork
from gaitgauge.robots import RobotError
from gaitgauge.terrains.registry import TerrainError
from scripted_gauge import GO2, Puppet

TINY = """
extends = "{base}"
name = "tiny"
version = "1.0.0"
goals = [
  {{ name = "diagonal_velocity", phases = [0.04, 0.02] }},
  {{ name = "max_velocity", phases = [0.04, 0.02] }},
  {{ name = "target_pos_velocity", phases = [] }},
]

[physics]
timestep = 0.01
substeps = 2

[matrix]
terrains = ["flat", "slope_fd"]
frictions = [0.6]
payloads = [0.0]
seeds = [0, 1]
search_seeds = [100, 101, 102]

[commands]
target_radius = 0.5
target_time = {{ slope = 0.3 }}
target_speed = {{ slope = 1.0 }}

[noise]
latency = 1

[settling]
shortest = 0.02
longest = 0.2

[metrics]
interval = 2

[scoring]
levels = 3
pass_rate = 0.6
bootstrap = 20
"""


def gliding(backend):
    """Robots rush up gentle slopes once they have settled, and never move on level 3."""
    level = torch.tensor([t.level for t in backend.scene.terrains])[backend.terrain_index]
    linear = torch.zeros(backend.num_worlds, 3, dtype=torch.float64)
    linear[:, 0] = 20.0 * (backend.state.time.ge(0.045) & level.ge(1) & level.le(2))
    return linear, torch.zeros_like(linear)


def puppets(name, scene, *, device="cpu", threads=1):
    return Puppet(scene, script=FakeScript(motion=gliding))


def evaluate(request, folder, *, make=None, **options):
    """An evaluation, on the engine without physics where a request names that."""
    make = make or (puppets if getattr(request, "backend", "fake") == "fake" else make_backend)
    return evaluation.evaluate(request, folder, make=make, **options)


@pytest.fixture
def request_for(tmp_path, monkeypatch):
    """Makes requests for a tiny suite on an engine without physics."""
    torch.manual_seed(0)
    arguments = {"frame_width": 45, "num_actions": 12, "hidden": [8]}
    network = MlpNetwork(**arguments)
    policy = tmp_path / "policy.gauge.pt"
    stored = StoredNetwork(architecture="mlp", arguments=arguments, state_dict=network.state_dict())
    save_policy(policy, standard_contract(GO2), stored)
    monkeypatch.setattr(evaluation, "_WATCH_INTERVAL", 0.0)

    def make(base="gaitgauge-1", **choices):
        suite = tmp_path / f"{base}.toml"
        suite.write_text(TINY.format(base=base))
        return Request(**{"policy": str(policy), "suite": str(suite), "backend": "fake", **choices})

    return make


def without_provenance(folder):
    results = json.loads((folder / "results.json").read_text())
    del results["provenance"]
    return json.dumps(results)


class Killed(BaseException):
    pass


# ---- results --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("base", ["robogauge-1.1", "gaitgauge-1"])
def test_a_whole_run(request_for, tmp_path, base):
    folder = tmp_path / "run"
    returned = evaluate(request_for(base), folder)
    results = json.loads((folder / "results.json").read_text())
    assert results == json.loads(json.dumps(returned))
    flat, slope = results["environments"]
    assert (flat["terrain"], flat["level"]) == ("flat", None)
    assert (slope["terrain"], slope["level"]) == ("slope_fd", 2)
    assert slope["search"] == {"2": True, "3": False}
    assert results["level"] == 2.0
    assert results["score"] == pytest.approx((flat["score"] + slope["score"]) / 2, abs=1e-6)
    assert results["score_interval"][0] <= results["score"] <= results["score_interval"][1]
    assert set(results["groups"]) == set(results["groups_interval"]) == {"tracking", "safety", "quality"}
    assert results["terrains"]["slope_fd"]["score"] == pytest.approx(0.09 + 0.19 * slope["quality"]["mean50"], abs=2e-4)
    assert results["health"] == {"episodes": 4, "falls": 0, "diverged": 0, "overflowed": 0}
    assert results["suite"]["digest"] == results["provenance"]["digests"]["suite"]
    assert {len(d) for d in results["provenance"]["digests"].values()} == {64}
    assert results["provenance"]["digests"].keys() == {"policy", "suite", "robot", "source"}
    assert results["provenance"]["commit"] == commit()
    assert results["chance"]["seeds"] == [0, 1] and results["chance"]["search_seeds"] == [100, 101, 102]
    assert results["provenance"]["processor"]
    # every episode that was played is a row, those of the level tests too
    lines = list(csv.DictReader((folder / "episodes.csv").open()))
    rows = [r for r in lines if r["command"] == "all"]
    files = {p.stem for p in (folder / "episodes").iterdir()}
    parts = [r for r in lines if r["command"] != "all"]
    assert len(parts) == 4 * 14  # eight diagonals and six axes in each quality episode
    assert {r["command"] for r in parts} >= {"diagonal_velocity -x-y", "max_velocity +yaw"}
    of_flat = [r for r in rows if r["stage"] == "eval" and r["terrain"] == "flat"]
    quality = np.mean([float(r["quality_mean50"]) for r in of_flat])
    assert quality == pytest.approx(flat["score"], abs=2e-4)
    trials = 3 if base == "gaitgauge-1" else 2  # a curve plays all search seeds, a test as many as decide it
    assert len(rows) == len(files) == 4 + 2 * trials
    assert [r["success"] for r in rows if r["stage"] == "search" and r["level"] == "3"] == ["False"] * trials
    if base == "gaitgauge-1":
        assert slope["curve"] == {"2": 1.0, "3": 0.0}
    assert sum(int(r["physics_steps"]) for r in rows) > 0


def test_the_same_request_gives_the_same_results(request_for, tmp_path):
    evaluate(request_for(), tmp_path / "a")
    evaluate(request_for(threads=2), tmp_path / "b")
    assert without_provenance(tmp_path / "a") == without_provenance(tmp_path / "b")
    assert (tmp_path / "a" / "episodes.csv").read_bytes() == (tmp_path / "b" / "episodes.csv").read_bytes()


def test_a_level_run_has_levels_and_no_score(request_for, tmp_path):
    results = evaluate(request_for(pipeline="level"), tmp_path / "run")
    assert results["score"] is None
    low, high = results["terrains"]["slope_fd"].pop("level_interval")
    assert 0.0 <= low < 2.0 < high <= 3.0
    assert results["terrains"] == {"slope_fd": {"level": 2.0}}


def test_a_policy_that_passes_nothing_scores_zero(request_for, tmp_path):
    request = request_for(terrains=("slope_fd",))
    results = evaluate(request, tmp_path / "run", make=lambda name, scene, **options: Puppet(scene))
    assert results["score"] == 0.0
    assert results["level"] == 0.0
    assert results["metrics"]["dof_power"]["mean50"] == 0.0


def test_seeds_and_frictions_given_twice_count_once(request_for, tmp_path):
    request = request_for(pipeline="multi", frictions=(0.5, 0.5), seeds=(1, 1))
    results = evaluate(request, tmp_path / "run")
    assert len(results["environments"]) == 1
    assert results["health"]["episodes"] == 1


def test_the_progress_lists_every_episode_once_and_counts_down(request_for, tmp_path):
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


# ---- interruption ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("counts", [(0, 3, 7), pytest.param(range(9), marks=pytest.mark.slow)])
def test_a_run_killed_after_any_episode_ends_with_the_very_same_results(request_for, tmp_path, monkeypatch, counts):
    request, puts = request_for("robogauge-1.1"), []
    put = RunFolder.put
    monkeypatch.setattr(RunFolder, "put", lambda self, record: (puts.append(record.episode.key), put(self, record)))
    evaluate(request, tmp_path / "whole")
    episodes = sorted(puts)
    assert len(set(episodes)) == len(episodes) == 8
    for count in counts:
        folder = tmp_path / f"killed-{count}"
        puts.clear()

        def watch(status, count=count):
            if status.done >= count:
                raise Killed

        with pytest.raises(Killed):
            evaluate(request, folder, watch=watch)
        assert not (folder / "results.json").exists()
        assert len(puts) >= count
        evaluate(request, folder, resume=True)
        assert sorted(puts) == episodes, "an episode was played twice or never"
        assert without_provenance(folder) == without_provenance(tmp_path / "whole")
        assert (folder / "episodes.csv").read_bytes() == (tmp_path / "whole" / "episodes.csv").read_bytes()


def test_speculative_episodes_that_nothing_asked_for_are_gone_at_the_end(request_for, tmp_path):
    """A killed run may leave some: they are no part of results, whatever they say."""
    evaluate(request_for(), tmp_path / "whole")
    evaluate(request_for(), tmp_path / "run")
    (tmp_path / "run" / "results.json").unlink()
    with RunFolder(tmp_path / "run", identity(prepare(request_for())), resume=True) as folder:
        counted = next(e for e in folder.records if e.stage == "search")
        extra = Record(episode=replace(counted, level=1), success=False)
        assert extra.episode not in folder.records
        folder.put(extra)
    evaluate(request_for(), tmp_path / "run", resume=True)
    assert without_provenance(tmp_path / "run") == without_provenance(tmp_path / "whole")
    files = [{p.name: p.read_bytes() for p in (tmp_path / n / "episodes").iterdir()} for n in ("run", "whole")]
    assert files[0] == files[1]


def test_two_processes_cannot_use_one_folder(request_for, tmp_path, monkeypatch):
    monkeypatch.setattr("gaitgauge.files.writing._PATIENCE", 0.1)
    with (
        RunFolder(tmp_path / "run", identity(prepare(request_for())), resume=False),
        pytest.raises(StoreError, match="another process is writing to"),
    ):
        evaluate(request_for(), tmp_path / "run", resume=True)


def test_a_finished_run_resumes_to_itself_without_playing(request_for, tmp_path, monkeypatch):
    evaluate(request_for(), tmp_path / "run")
    before = without_provenance(tmp_path / "run")
    monkeypatch.setattr(Puppet, "step", lambda *_, **__: pytest.fail("an episode was played again"))
    evaluate(request_for(), tmp_path / "run", resume=True)
    assert without_provenance(tmp_path / "run") == before


def test_a_damaged_episode_is_set_aside_and_played_again(request_for, tmp_path):
    evaluate(request_for(), tmp_path / "run")
    before = without_provenance(tmp_path / "run")
    file = next((tmp_path / "run" / "episodes").glob("eval-flat*s1*"))
    whole = file.read_bytes()
    file.write_bytes(whole[:100])
    results = evaluate(request_for(), tmp_path / "run", resume=True)
    assert without_provenance(tmp_path / "run") == before
    assert file.read_bytes() == whole
    assert results["provenance"]["set_aside"] == [file.name + ".damaged"]
    assert file.with_name(file.name + ".damaged").read_bytes() == whole[:100]


def test_results_are_written_whatever_the_provenance_holds(request_for, tmp_path):
    contract = replace(
        standard_contract(GO2), provenance={"note": float("nan"), "name": "\ud800", "[/x]": [float("inf")]}
    )
    request = request_for()
    prepared = prepare(request)
    prepared.policy.contract = contract
    results = evaluate(prepared, tmp_path / "run", command=["gaitgauge", "a b", "\udcff"])
    written = json.loads((tmp_path / "run" / "results.json").read_text())
    assert written["score"] == results["score"]
    assert written["policy"]["provenance"] == {"note": "nan", "name": "\\ud800", "[/x]": ["inf"]}
    assert written["provenance"]["command"] == "gaitgauge 'a b' '\\udcff'"


def test_a_run_does_not_go_on_with_another_robot(request_for, tmp_path):
    folder = tmp_path / "robot"
    shutil.copytree(GO2.mjcf.parent, folder)
    request = request_for(robot=str(folder))
    evaluate(request, tmp_path / "run")
    evaluate(request, tmp_path / "run", resume=True)
    file = folder / "robot.toml"
    file.write_text(file.read_text().replace("stiffness = 20.0", "stiffness = 20.5", 1))
    with pytest.raises(StoreError, match=r"belongs to another run \(robot_digest differs\)"):
        evaluate(request, tmp_path / "run", resume=True)


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


def test_a_run_does_not_go_on_with_another_engine_version(request_for, tmp_path, monkeypatch):
    evaluate(request_for(), tmp_path / "run")
    monkeypatch.setattr(evaluation, "versions", lambda: {**versions(), "mujoco": "0.0"})
    with pytest.raises(StoreError, match=r"versions.mujoco was '[0-9.]+', now '0.0'"):
        evaluate(request_for(), tmp_path / "run", resume=True)


@pytest.mark.parametrize(
    "changes", [{"seeds": (0,)}, {"frictions": (0.5,)}, {"pipeline": "level"}, {"base": "robogauge-1.1"}]
)
def test_the_folder_of_another_request_is_refused(request_for, tmp_path, changes):
    evaluate(request_for(), tmp_path / "run")
    before = (tmp_path / "run" / "results.json").read_bytes()
    with pytest.raises(StoreError, match="belongs to another run"):
        evaluate(request_for(**changes), tmp_path / "run", resume=True)
    assert (tmp_path / "run" / "results.json").read_bytes() == before


def test_a_suite_that_changed_under_its_name_is_another_run(request_for, tmp_path):
    request = request_for()
    evaluate(request, tmp_path / "run")
    suite = Path(request.suite)
    suite.write_text(suite.read_text().replace("interval = 2", "interval = 4"))
    with pytest.raises(StoreError, match="belongs to another run"):
        evaluate(request, tmp_path / "run", resume=True)


def test_a_policy_that_answers_nonsense_leaves_what_was_finished(request_for, tmp_path):
    request = request_for(pipeline="multi")
    arguments = {"frame_width": 45, "num_actions": 12, "hidden": [8]}
    broken = {k: torch.full_like(v, torch.nan) for k, v in MlpNetwork(**arguments).state_dict().items()}
    save_policy(
        request.policy,
        standard_contract(GO2),
        StoredNetwork(architecture="mlp", arguments=arguments, state_dict=broken),
    )
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
    results = evaluate(request_for(pipeline="base", terrains=("slope_fd",), level=2), tmp_path / "run")
    assert results["health"]["episodes"] == 1
    assert results["environments"][0]["level"] == 2
    assert "search" not in results["environments"][0]


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


# ---- real kills and real physics --------------------------------------------------------------------------------------------

CHILD = """
import sys
sys.path.insert(0, {tests!r})
import test_evaluate_runs as runs
from gaitgauge.gauge.evaluate import Request
from pathlib import Path
runs.evaluate(Request(policy={policy!r}, suite={suite!r}, backend="fake"), Path({folder!r}), resume=True)
"""


@pytest.mark.slow
def test_a_process_killed_by_the_system_resumes(request_for, tmp_path):
    request = request_for()
    evaluate(request, tmp_path / "whole")
    for wanted in (0, 1, 3, 5):
        folder = tmp_path / f"killed-{wanted}"
        child = CHILD.format(
            tests=str(Path(__file__).parent), policy=request.policy, suite=request.suite, folder=str(folder)
        )
        process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(child)])
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline and process.poll() is None:
            if (folder / "episodes").exists() and len(list((folder / "episodes").glob("*.npz"))) >= wanted:
                break
            time.sleep(0.002)
        if process.poll() is None:
            os.kill(process.pid, signal.SIGKILL)
        process.wait()
        assert process.returncode in (0, -signal.SIGKILL)
        evaluate(request, folder, resume=True)
        assert without_provenance(folder) == without_provenance(tmp_path / "whole")


@pytest.fixture
def real_request(request_for, monkeypatch):
    """A request for real terrains and contacts, a random policy that stumbles and falls, short goals."""
    monkeypatch.undo()
    request = request_for()
    text = Path(request.suite).read_text()
    text = text.replace("timestep = 0.01\nsubsteps = 2", "").replace("interval = 2", "interval = 10")
    text = text.replace("[0.04, 0.02]", "[0.4, 0.2]").replace("slope = 0.3", "slope = 2.0").replace("latency = 1", "")
    Path(request.suite).write_text(text)
    return replace(request, backend="mujoco")


def test_threads_change_no_bit_of_the_results_in_mujoco(real_request, tmp_path):
    for threads in (1, 2):
        evaluate(replace(real_request, threads=threads), tmp_path / f"threads-{threads}")
    provenance = [json.loads((tmp_path / f"threads-{n}" / "results.json").read_text())["provenance"] for n in (1, 2)]
    assert [p["processes"] for p in provenance] == [1, 2]
    assert json.loads((tmp_path / "threads-1" / "results.json").read_text())["solver"]["iterations"] == 100
    assert provenance[0]["physics_steps"] == provenance[1]["physics_steps"]
    assert all(0.0 < p["engine_seconds"] < p["processes"] * p["seconds"] for p in provenance)
    one, two = (without_provenance(tmp_path / f"threads-{n}") for n in (1, 2))
    assert one == two
    assert 0.0 < json.loads(one)["score"] < 1.0
    episodes = [{f.name: f.read_bytes() for f in (tmp_path / f"threads-{n}" / "episodes").iterdir()} for n in (1, 2)]
    assert episodes[0] == episodes[1]


def test_an_error_in_a_process_is_the_runs_error(real_request, tmp_path):
    arguments = {"frame_width": 45, "num_actions": 12, "hidden": [8]}
    network = MlpNetwork(**arguments)
    network.network[-1].bias.data.fill_(float("nan"))
    stored = StoredNetwork(architecture="mlp", arguments=arguments, state_dict=network.state_dict())
    save_policy(Path(real_request.policy), standard_contract(GO2), stored)
    with pytest.raises(PolicyError, match="returned nan"):
        evaluate(replace(real_request, threads=2), tmp_path / "run")


@pytest.mark.slow
def test_a_process_that_is_killed_costs_nothing_that_was_finished(real_request, tmp_path):
    request = replace(real_request, threads=2)
    evaluate(request, tmp_path / "whole")
    killed = []

    def kill(status):
        if status.done and not killed:
            (child, *_) = children()
            os.kill(child, signal.SIGKILL)
            killed.append(child)

    with pytest.raises(BackendError, match=r"was ended by signal 9; what had finished is kept: go on with --resume"):
        evaluate(request, tmp_path / "run", watch=kill)
    assert children() == []
    evaluate(request, tmp_path / "run", resume=True)
    assert without_provenance(tmp_path / "run") == without_provenance(tmp_path / "whole")


ORPHANS = """
from gaitgauge.gauge import evaluate as evaluation
from pathlib import Path
evaluation.evaluate(evaluation.Request(policy={policy!r}, suite={suite!r}, backend="mujoco", threads=2), Path({folder!r}))
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="reads /proc")
def test_processes_end_with_the_one_that_started_them(real_request, tmp_path):
    code = ORPHANS.format(policy=real_request.policy, suite=real_request.suite, folder=str(tmp_path / "run"))
    process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(code)])
    deadline = time.monotonic() + 60
    workers: list[int] = []
    while time.monotonic() < deadline and len(workers) < 2:
        workers = children(process.pid)
        time.sleep(0.01)
    assert len(workers) == 2
    process.kill()
    process.wait()
    while time.monotonic() < deadline and any(map(at_work, workers)):
        time.sleep(0.05)
    assert not any(map(at_work, workers))


def at_work(process):
    """Whether a process exists and has not ended."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def children(process=None):
    """Process ids of a process's children, this one's if none is given, from /proc."""
    tasks = Path(f"/proc/{process or os.getpid()}/task").glob("*/children")
    return [int(number) for task in tasks for number in task.read_text().split()]
