"""Workers on a cluster, without one: what is refused, what travels to a node, and that workers that die lose nothing."""

import itertools
import pickle
import shutil
import socket
import sys
import threading
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from gaitgauge.backends.registry import make_backend
from gaitgauge.gauge.evaluate import Request, evaluate, prepare
from gaitgauge.gauge.plan import plan_list
from gaitgauge.gauge.play import cluster, cluster_node
from gaitgauge.gauge.play.cluster import Cluster, ClusterError, check_address
from gaitgauge.gauge.play.cluster_node import Arrived, NodeWorker, fingerprint
from gaitgauge.gauge.play.dispatcher import Speculation, play
from gaitgauge.gauge.play.workers import Drop, Failed, Finished, InProcess, Job, Play, Progress, Stop, Worker
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import NativePolicy, StoredNetwork
from gaitgauge.policy.networks.architectures import MlpNetwork
from gaitgauge.robots import load_robot
from gaitgauge.robots.identity import packed
from scripted_gauge import GO2, MAXIMUM, Puppet, episode, short_suite

# ---- sentences --------------------------------------------------------------------------------------------------------


def test_a_machine_without_ray_is_told_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ClusterError, match=r"needs Ray, which is not installed; .*'gaitgauge\[cluster\]'"):
        prepare(Request(policy="pretrained", cluster="auto"))


@pytest.fixture
def with_ray(monkeypatch):
    """Something that passes for Ray where nothing of it is asked for."""
    monkeypatch.setitem(sys.modules, "ray", object())


@pytest.mark.parametrize(
    "address",
    [
        "",
        "local",
        "10.0.0.1",
        "10.0.0.1:port",
        "http://10.0.0.1:6379",
        "a b:1",
        "[1:6379",
        "h" * 254 + ":1",
        "h:\u0663",
        "a\x1b:1",
    ],
)
def test_what_is_no_address_is_said(with_ray, address):
    with pytest.raises(ClusterError, match=r"is no address of a Ray cluster; give auto .*HOST:PORT"):
        check_address(address)


@pytest.mark.parametrize("address", ["auto", "10.0.0.1:6379", "head-node.lab:6379", "[fe80::1]:6379", "ray://h:10001"])
def test_addresses(with_ray, address):
    check_address(address)


def test_another_engine_is_refused(with_ray):
    with pytest.raises(ClusterError, match="runs as several processes on CPUs, which backend 'fake' on 'cpu' does not"):
        prepare(Request(policy="pretrained", backend="fake", cluster="auto"))


@pytest.mark.parametrize("address", ["127.0.0.1:{}", "ray://127.0.0.1:{}", "127.0.0.1:99999"])
def test_an_address_where_nobody_listens_is_one_sentence(with_ray, address, tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = address.format(free.getsockname()[1])
    with pytest.raises(
        ClusterError, match=rf"no Ray cluster can be used at {address} \(.*\); start one with 'ray start"
    ):
        evaluate(Request(policy="pretrained", suite="demo", cluster=address), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (b"HTTP/1.1 200 OK\r\nContent-Length: 5\r\n\r\nhello", "something else than Ray answers there"),
        (b"-ERR unknown command\r\n", "something else than Ray answers there"),
        (b"", "something else than Ray answers there"),
        (None, "timed out"),
    ],
    ids=["web", "redis", "closes", "silent"],
)
@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_an_address_where_somebody_else_listens_is_one_sentence(with_ray, monkeypatch, scheme, words, reason):
    """Ray itself waits for a minute or more, or for ever."""
    monkeypatch.setattr(cluster, "_CONNECTING", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            connection, _ = server.accept()
            with connection:
                connection.recv(100)
                if words is None:
                    connection.recv(100)
                else:
                    connection.sendall(words)

        thread = threading.Thread(target=answer)
        thread.start()
        with pytest.raises(ClusterError, match=rf"no Ray cluster can be used at .* \({reason}\); start one"):
            Cluster(f"{scheme}127.0.0.1:{server.getsockname()[1]}")
        thread.join()


@pytest.mark.parametrize(
    "error", [AssertionError(), ImportError("no grpc"), KeyError("x"), Exception("[/x]\n\x1b[31m")]
)
def test_whatever_ray_raises_is_one_sentence(monkeypatch, error):
    def init(**_: object) -> None:
        raise error

    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(init=init))
    with pytest.raises(ClusterError, match=r"no Ray cluster can be used at auto \(.+\)") as caught:
        Cluster("auto")
    assert str(caught.value).isprintable()


# ---- what travels to a node -------------------------------------------------------------------------------------------


class Counting(torch.nn.Module):
    """Counts its steps, so that its own code has to be run."""

    steps: int

    def __init__(self) -> None:
        super().__init__()
        self.steps = 0
        self.layer = torch.nn.Linear(45, 12)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        self.steps += 1
        return 0.1 * self.layer(x) + 0.01 * float(self.steps % 7)

    @torch.jit.export
    def reset(self) -> None:
        self.steps = 0


@pytest.fixture
def elsewhere(tmp_path) -> tuple[Path, Path]:
    """A TorchScript policy and a robot in files of their own."""
    torch.manual_seed(0)
    torch.jit.save(torch.jit.script(Counting().eval()), str(tmp_path / "policy.pt"))
    shutil.copytree(GO2.mjcf.parent, tmp_path / "robot")
    return tmp_path / "policy.pt", tmp_path / "robot"


def job_of(policy: Path, robot: Path) -> Job:
    loaded = load_robot(robot)
    return Job(
        suite=short_suite("gaitgauge-1"),
        policy=load_policy(policy, loaded),
        robot=loaded,
        places=(("flat", 0),),
        worlds=8,
        build=_build,
    )


def _build(scene, *, threads):
    return make_backend("mujoco", scene, threads=threads)


def exchanged(node: NodeWorker, *messages: Play | Stop) -> list:
    return pickle.loads(node.exchange(messages))


def test_a_node_plays_the_same_without_the_files(elsewhere):
    walk = episode(MAXIMUM, seed=3)
    job = job_of(*elsewhere)
    here = Worker(job)
    here.take(Play([walk]))
    expected = []
    while not expected:
        expected = here.rollout.advance()
    here.rollout.backend.close()

    shipment = pickle.dumps((job, packed(job.robot)))
    for path in elsewhere:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    node = NodeWorker("10.0.0.7", fingerprint(), shipment)
    arrived, idle = exchanged(node)
    assert isinstance(arrived, Arrived)
    assert (idle.room, idle.played, idle.stopped) == (8, 0, False)
    heard = exchanged(node, Play([walk]))
    while not isinstance(heard[0], Finished):
        heard = exchanged(node)
    finished, progress = heard
    assert finished.record.episode == walk
    assert finished.record.samples.tobytes() == expected[0].samples.tobytes()
    assert finished.record.summary() == expected[0].summary()
    assert (progress.played, progress.room) == (1, 8)
    (last,) = exchanged(node, Stop())
    assert isinstance(last, Progress) and last.stopped


def test_a_node_with_other_versions_is_refused():
    other = {**fingerprint(), "mujoco": "3.16.0"}
    sentence = NodeWorker("10.0.0.7", other, b"").exchange([])
    assert sentence == (
        f"node 10.0.0.7 of the Ray cluster has another mujoco ({fingerprint()['mujoco']}) than this machine (3.16.0), so that "
        "results would mix; install the same on all nodes"
    )
    plugin = {**fingerprint(), "gaitgauge.robots:spot": "spot:robot (spot 1.0)"}
    assert "another gaitgauge.robots:spot (not there)" in NodeWorker("10.0.0.7", plugin, b"").exchange([])
    assert "another source of gaitgauge" in NodeWorker(
        "n", {**fingerprint(), "source of gaitgauge": "0"}, b""
    ).exchange([])


def test_what_goes_wrong_on_a_node_is_told():
    (failed,) = exchanged(NodeWorker("n", fingerprint(), b"nothing"))
    assert isinstance(failed, Failed) and isinstance(failed.error, pickle.UnpicklingError)


def test_the_class_of_the_actors_travels_without_this_module(monkeypatch):
    node = cluster._actor_class()(fingerprint(), b"nothing")
    monkeypatch.setitem(
        sys.modules, "ray", type("Ray", (), {"util": type("U", (), {"get_node_ip_address": lambda: "n"})})
    )
    monkeypatch.setitem(sys.modules, "gaitgauge.gauge.play.cluster_node", None)
    assert node.exchange([]).startswith("node n of the Ray cluster lacks this gaitgauge (")


# ---- workers come and go, without Ray ---------------------------------------------------------------------------------


class RayError(Exception):
    pass


class FakeRay:
    """Actors in this process. ``fate`` says of an actor's number and call what comes of it: ``""``, ``dies`` or ``waits``."""

    exceptions = SimpleNamespace(RayError=RayError, RayTaskError=type("RayTaskError", (RayError,), {}))
    util = SimpleNamespace(get_node_ip_address=lambda: "10.0.0.7")

    def __init__(self, fate):
        self.fate, self.made, self.killed = fate, 0, 0

    def remote(self, **options):
        assert options == {"num_cpus": 1, "max_restarts": 0}
        return lambda kind: SimpleNamespace(remote=lambda *arguments: self._actor(kind(*arguments)))

    def _actor(self, real):
        number, calls = self.made, itertools.count()
        self.made += 1
        return SimpleNamespace(
            exchange=SimpleNamespace(remote=lambda messages: (number, next(calls), lambda: real.exchange(messages)))
        )

    def put(self, value):
        return value

    def wait(self, refs, *, num_returns=1, timeout):
        assert refs
        ready = [ref for ref in refs if self.fate(*ref[:2]) != "waits"]
        return ready[:num_returns], []

    def get(self, ref):
        if self.fate(*ref[:2]) == "dies":
            raise RayError("The actor died. And more.")
        return ref[2]()

    def kill(self, actor):
        self.killed += 1

    def nodes(self):
        return [{"Alive": True, "Resources": {"CPU": 2.0}}, {"Alive": False, "Resources": {"CPU": 8.0}}]


def _puppets(scene, *, threads):
    return Puppet(scene)


@pytest.fixture(scope="module")
def puppet_job() -> Job:
    arguments = {"frame_width": 45, "num_actions": 12, "hidden": [8]}
    network = StoredNetwork(architecture="mlp", arguments=arguments, state_dict=MlpNetwork(**arguments).state_dict())
    policy = NativePolicy(standard_contract(GO2), network, path="small")
    return Job(
        suite=short_suite("gaitgauge-1"), policy=policy, robot=GO2, places=(("flat", 0),), worlds=8, build=_puppets
    )


@pytest.fixture
def fake(monkeypatch, puppet_job):
    """Starts workers on actors of a given fate."""
    monkeypatch.setattr(cluster, "_knock", lambda address: None)
    monkeypatch.setattr(cluster, "_ARRIVING", 0.0)
    monkeypatch.setattr(cluster, "_PAUSE", 0.0)

    def start(fate, count=2):
        ray = FakeRay(fate)
        monkeypatch.setitem(sys.modules, "ray", ray)
        return cluster.ClusterWorkers(ray, "10.0.0.1:6379", puppet_job, count)

    return start


WALKS = [episode(MAXIMUM, seed=seed) for seed in range(4)]


def played(workers, walks=tuple(WALKS)) -> dict:
    records, kept = {}, []
    play([partial(plan_list, walks)], records, kept.append, workers, speculation=Speculation())
    workers.close()
    assert len(kept) == len(records) == len(walks), "an episode was played twice"
    return {e: (r.summary(), r.samples.tobytes()) for e, r in records.items()}


@pytest.fixture(scope="module")
def expected(puppet_job) -> dict:
    return played(InProcess(puppet_job))


def _lives(actor, call):
    return ""


FATES = {
    "the first dies at work": lambda actor, call: "dies" if (actor, call) == (0, 2) else "",
    "the second never comes": lambda actor, call: "waits" if actor == 1 else "",
    "the first dies and nobody takes its place": lambda actor, call: (
        "dies" if (actor, call) == (0, 1) else "waits" if actor == 2 else ""
    ),
    "the first dies and Ray goes on starting others on its node": lambda actor, call: (
        "dies" if (actor, call) == (0, 1) or 2 <= actor < 20 else ""
    ),
    "both die now and then": lambda actor, call: "dies" if call == 2 + actor and actor < 5 else "",
}


@pytest.mark.parametrize("fate", FATES)
def test_nothing_is_lost_and_nothing_differs(fake, expected, fate, caplog):
    workers = fake(FATES[fate])
    assert played(workers) == expected
    assert ("was lost (The actor died); what it had is played again" in caplog.text) == ("die" in fate)
    assert (workers._ray.made > 2) == ("die" in fate)


def test_a_worker_that_comes_late_is_sent_nothing_before(fake):
    walks, asked = [episode(MAXIMUM, seed=seed) for seed in range(40)], itertools.count()
    workers = fake(lambda actor, call: "waits" if actor == 1 and next(asked) < 12 else "")
    seat = workers._seats[1]
    workers.send(1, Drop([]))
    assert not seat.there and seat.outbox == []
    played(workers, walks)


def test_a_worker_that_dies_before_it_comes_is_not_sent_anything(fake, expected, monkeypatch):
    monkeypatch.setattr(cluster, "_PAUSE", 0.5)
    assert played(fake(lambda actor, call: "dies" if (actor, call) == (1, 0) else "")) == expected


@pytest.mark.parametrize(("call", "times"), [(0, 61), (1, 4)])
def test_a_worker_that_dies_again_and_again_ends_the_run(fake, call, times):
    with pytest.raises(
        ClusterError, match=rf"died {times} times in a row \(The actor died\); what had finished is kept: .*--threads"
    ):
        played(fake(lambda actor, now: "dies" if now == call else "", count=1))


def test_a_head_node_out_of_reach_ends_the_run(fake, monkeypatch):
    monkeypatch.setattr(cluster, "_LISTENING", 0.0)
    monkeypatch.setattr(cluster, "_HEADLESS", 0.0)
    workers = fake(_lives)

    def nobody(address):
        raise ConnectionRefusedError(address)

    monkeypatch.setattr(cluster, "_knock", nobody)
    with pytest.raises(ClusterError, match=r"head node of the Ray cluster \(10.0.0.1:6379\) has been out of reach for"):
        played(workers)
    workers.close()


def test_different_processors_are_said_once(fake, monkeypatch, caplog):
    kinds = itertools.cycle(["A", "B", "C"])
    monkeypatch.setattr(cluster_node, "processor", lambda: next(kinds))
    monkeypatch.setattr(cluster, "_ARRIVING", 60.0)
    workers = fake(_lives, count=3)
    assert workers.processors == {"A", "B", "C"}
    assert caplog.text.count("different processors (A, B)") == 1
