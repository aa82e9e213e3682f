"""Real processes and real physics: threads change nothing, and a process that ends takes nothing with it."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import replace
from pathlib import Path

import pytest
from gaitgauge.gauge.play.workers import WorkerError
from gaitgauge.gauge.store import RunFolder
from gaitgauge.policy.base import PolicyError
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.native import StoredNetwork, save_policy
from gaitgauge.policy.networks.architectures import MlpNetwork
from scripted_gauge import GO2
from tiny_runs import SMALL, evaluate, without_provenance

CHILD = """
import sys
sys.path.insert(0, {tests!r})
import tiny_runs as runs
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
    text = text.replace("timestep = 0.01\nsubsteps = 2", "timestep = 0.005\nsubsteps = 4").replace(
        "interval = 2", "interval = 4"
    )
    text = (
        text.replace("[0.04, 0.02]", "[0.2, 0.1]")
        .replace("slope = 0.3", "slope = 1.0")
        .replace("latency = 1", "latency = 2")
    )
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
    network = MlpNetwork(**SMALL)
    network.network[-1].bias.data.fill_(float("nan"))
    stored = StoredNetwork(architecture="mlp", arguments=SMALL, state_dict=network.state_dict())
    save_policy(Path(real_request.policy), standard_contract(GO2), stored)
    with pytest.raises(PolicyError, match="returned nan"):
        evaluate(replace(real_request, threads=2), tmp_path / "run")


@pytest.mark.slow
def test_a_process_that_is_killed_costs_nothing_that_was_finished(real_request, tmp_path, monkeypatch):
    request = replace(real_request, threads=2)
    evaluate(request, tmp_path / "whole")
    put = RunFolder.put

    def put_and_kill(folder, record):
        """The first record is kept; then a worker ends, which has not been told to stop, whatever it is at."""
        put(folder, record)
        monkeypatch.setattr(RunFolder, "put", put)
        (worker,) = [p for p in multiprocessing.active_children() if p.name == "worker-1"]
        os.kill(worker.pid, signal.SIGKILL)

    monkeypatch.setattr(RunFolder, "put", put_and_kill)
    with pytest.raises(WorkerError, match=r"was ended by signal 9; what had finished is kept: go on with --resume"):
        evaluate(request, tmp_path / "run")
    assert len(list((tmp_path / "run" / "episodes").glob("*.npz"))) > 0
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
