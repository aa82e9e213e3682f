"""Ray clusters of this machine: neither nodes nor their deaths show in results."""

import importlib.util
import json
from pathlib import Path

import pytest
from gaitgauge.gauge.evaluate import Request, evaluate
from gaitgauge.gauge.play import cluster
from gaitgauge.gauge.play.cluster import Cluster, ClusterError
from gaitgauge.gauge.play.cluster_node import fingerprint
from gaitgauge.policy.finding import PRETRAINED

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed"),
]


SUITE = """
extends = "gaitgauge-1"
name = "small"
title = "some seconds"
goals = [{ name = "max_velocity", phases = [1.0, 0.2] }, { name = "target_pos_velocity", phases = [] }]

[matrix]
terrains = ["flat", "slope_fd"]
frictions = [0.6, 0.9]
payloads = [0.0]
seeds = [0, 1, 2, 3]
search_seeds = [100, 101]

[commands]
target_time = { slope = 0.3, wave = 0.3, stairs = 0.3, obstacle = 0.3 }

[settling]
longest = 0.3
"""


STORE = 80 * 2**20


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("suite") / "small.toml"
    path.write_text(SUITE)
    return path


@pytest.fixture(scope="module")
def alone(small, tmp_path_factory) -> Path:
    """The results of one process."""
    folder = tmp_path_factory.mktemp("alone") / "run"
    evaluate(Request(policy=str(PRETRAINED), suite=str(small)), folder)
    return folder


@pytest.fixture(scope="module")
def head():
    """A cluster whose head plays nothing."""
    from ray.cluster_utils import Cluster as LocalCluster

    found = LocalCluster(
        initialize_head=True,
        head_node_args={"num_cpus": 0, "object_store_memory": STORE, "include_dashboard": False},
    )
    yield found
    found.shutdown()


@pytest.fixture
def nodes(head):
    """Three nodes of one CPU each, as a list; those that a test has taken out were killed."""
    there = [head.add_node(num_cpus=1, object_store_memory=STORE) for _ in range(3)]
    yield there
    for node in there:
        head.remove_node(node, allow_graceful=False)


def reproducible(folder: Path) -> tuple[dict, bytes]:
    results = json.loads((folder / "results.json").read_text())
    del results["provenance"]
    return results, (folder / "episodes.csv").read_bytes()


def kept(folder: Path) -> int:
    return len(list((folder / "episodes").glob("*.npz")))


@pytest.mark.parametrize("dying", [0, 1])
def test_three_nodes_equal_one_machine_also_when_one_is_killed(head, nodes, small, alone, tmp_path, dying):
    folder, killed = tmp_path / "run", []

    def watch(status):
        if len(killed) < dying and kept(folder) >= 5:
            head.remove_node(nodes.pop(), allow_graceful=False)
            killed.append(kept(folder))

    request = Request(policy=str(PRETRAINED), suite=str(small), threads=3, cluster=head.address)
    result = evaluate(request, folder, watch=watch)
    assert reproducible(folder) == reproducible(alone)
    assert len(killed) == dying
    assert result.provenance.processes == 3
    assert result.provenance.cluster.address == head.address


def test_a_cluster_without_nodes_ends_in_a_sentence_and_the_run_goes_on_elsewhere(head, nodes, small, alone, tmp_path):
    folder = tmp_path / "run"

    def watch(status):
        while nodes and kept(folder) >= 3:
            head.remove_node(nodes.pop(), allow_graceful=False)

    request = Request(policy=str(PRETRAINED), suite=str(small), threads=2, cluster=head.address)
    with pytest.raises(
        ClusterError, match=r"no node of the Ray cluster is left; what had finished is kept: go on with --resume"
    ):
        evaluate(request, folder, watch=watch)
    before = {path: path.stat().st_mtime_ns for path in (folder / "episodes").glob("*.npz")}
    assert len(before) >= 3
    with pytest.raises(ClusterError, match=r"has no free CPU \(of 0\); add nodes"):
        Cluster(head.address)
    nodes.append(head.add_node(num_cpus=1, object_store_memory=STORE))
    evaluate(request, folder, resume=True)
    assert reproducible(folder) == reproducible(alone)
    counted = {path for path in before if path.exists()}
    assert counted and all(path.stat().st_mtime_ns == before[path] for path in counted)


def test_a_node_with_another_source_is_refused(head, nodes, small, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "fingerprint", lambda: fingerprint() | {"mujoco": "3.16.0"})
    request = Request(policy=str(PRETRAINED), suite=str(small), threads=1, cluster=head.address)
    with pytest.raises(ClusterError, match=r"has another mujoco \(3\.17\..*\) than this machine \(3\.16\.0\)"):
        evaluate(request, tmp_path / "run")
