"""Control steps that are recorded once and replayed: what a CUDA graph would do, done on the CPU operation by operation."""

import logging
from dataclasses import replace

import pytest
import torch
from gaitgauge.gauge.play import control_step, recording
from gaitgauge.gauge.play.recording import StepRecording
from gaitgauge.gauge.play.rollout import Rollout
from gaitgauge.policy.base import PolicyError
from gaitgauge_fake_engine import FakeBackend, FakeScript
from scripted_gauge import (
    DIAGONAL,
    MAXIMUM,
    TARGET,
    Puppet,
    ScriptedPolicy,
    episode,
    fake,
    ground,
    moving,
    run,
    scene,
    short_suite,
    to_the_end,
)
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

REFERENCE, OWN = "robogauge-1.1", "gaitgauge-1"
WAITS = ("_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "lift_fresh", "equal")
"""Operations that wait for the device, or bring numbers from the host."""


class Tape:
    """Stands for ``torch.cuda.CUDAGraph``: the operations of a function, on the very tensors that it used."""

    made = 0

    def __init__(self):
        self.operations = []
        Tape.made += 1

    def replay(self):
        for function, arguments, options, results in self.operations:
            again = function(*arguments, **options)
            for old, new in zip(tree_leaves(results), tree_leaves(again), strict=True):
                if isinstance(old, torch.Tensor) and old.data_ptr() != new.data_ptr():
                    old.copy_(new)


class Recorder(TorchDispatchMode):
    """Stands for ``torch.cuda.graph``: nothing has happened once it ends."""

    def __init__(self, tape, **settings):
        super().__init__()
        self.tape, self.before = tape, []

    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        options = options or {}
        name, overload = function.__name__.split(".")
        assert name not in WAITS, f"{function} while recording"
        assert not (name == "where" and "Scalar" in overload), f"{function} brings a number from the host"
        if name in ("index", "index_put_", "index_put"):
            assert all(i is None or i.dtype != torch.bool for i in arguments[1]), f"{function} counts"
        written = [
            value
            for value, argument in zip(arguments, function._schema.arguments, strict=False)
            if argument.alias_info is not None and argument.alias_info.is_write
        ]
        self.before += [(tensor, tensor.clone()) for tensor in written]
        results = function(*arguments, **options)
        self.tape.operations.append((function, arguments, options, results))
        return results

    def __exit__(self, *error):
        super().__exit__(*error)
        for tensor, value in reversed(self.before):
            tensor.copy_(value)


@pytest.fixture
def tapes(monkeypatch):
    """Recording on the CPU, where a rollout is asked to capture."""
    Tape.made = 0
    monkeypatch.setattr(
        control_step, "StepRecording", lambda device, *, enabled: StepRecording(device, enabled=capturing[-1])
    )
    monkeypatch.setattr(torch.cuda, "CUDAGraph", Tape)
    monkeypatch.setattr(torch.cuda, "graph", Recorder)
    return Tape


capturing = [False]


def play(name, *, interval, record=False, script=None, act=None, worlds=5):
    """Records of walks and crossings whose actions depend on all that is observed."""
    suite = short_suite(name)
    suite = replace(suite, metrics=replace(suite.metrics, interval=2))
    episodes = [
        *(episode(DIAGONAL, MAXIMUM, seed=seed, friction=0.2 + 0.2 * seed) for seed in range(3)),
        *(episode(TARGET, stage="search", seed=seed) for seed in range(3)),
    ]
    policy = ScriptedPolicy(act or gait)
    backend = fake(suite, script or FakeScript(motion=swaying), worlds=worlds, terrain=ground((0.25, 0.0, 0.4)))
    capturing.append(record)
    return sorted(run(suite, backend, episodes, policy, poll_interval=interval), key=lambda r: r.episode)


def gait(observation):
    """All that is observed decides about the actions, the command most of all."""
    joints = observation[:, 9:21] + 0.5 * observation[:, 21:33] + 0.1 * observation[:, 33:45]
    return torch.tanh(joints + observation[:, 6:9].repeat(1, 4))


def swaying(backend):
    """A motion that depends on friction, targets and time; the slippery one falls, the others reach the target or not."""
    friction, time = torch.nan_to_num(backend.randomized.friction, nan=0.5), backend.state.time
    lead = (backend.targets - backend.default_pose)[:, 0]
    linear = torch.stack((4.0 * lead, 0.1 * torch.sin(9.0 * friction * time), 0.0 * time), dim=1)
    angular = torch.stack((40.0 * (friction < 0.3) * time.ge(0.06), 0.0 * time, 0.2 * friction), dim=1)
    return linear * time.ge(0.05)[:, None], angular


def assert_equal(records, others):
    assert len(records) == len(others) > 0
    for one, other in zip(records, others, strict=True):
        assert one.summary() == other.summary()
        assert one.samples.tobytes() == other.samples.tobytes()


@pytest.mark.parametrize("name", [pytest.param(REFERENCE, marks=pytest.mark.slow), OWN])
def test_replayed_steps_give_the_same_records(name, tapes):
    script = FakeScript(motion=swaying, penetration_time=torch.tensor([0.1, 1e9, 0.16, 1e9, 0.2]))
    plain = play(name, interval=4, script=script)
    assert len({r.samples.tobytes() for r in plain if r.episode.stage == "eval"}) == 3
    assert len({r.control_steps for r in plain if r.episode.stage == "search"}) == (3 if name == REFERENCE else 2)
    assert tapes.made == 0
    assert_equal(plain, play(name, interval=4, script=script, record=True))
    assert 3 <= tapes.made <= 9


def test_replayed_steps_push_at_the_same_time_with_the_same_force(tapes, monkeypatch):
    """The force is worked out in a recorded step, and handed to the engine outside of it."""
    log = []

    def apply_force(self, force_w):
        log.append(force_w.tolist())

    monkeypatch.setattr(Puppet, "apply_force", apply_force)
    suite = short_suite(OWN)
    push = replace(suite.push, after=(0.04, 0.04), duration=0.04)
    logs = []
    for record in (False, True):
        capturing.append(record)
        log.clear()
        backend = fake(replace(suite, push=push), worlds=7)
        run(replace(suite, push=push), backend, [episode(MAXIMUM)], poll_interval=2)
        logs.append(list(log))
    assert logs[0] == logs[1]
    assert sum(any(map(any, forces)) for forces in logs[0]) == 2


@pytest.mark.parametrize("interval", [pytest.param(2, marks=pytest.mark.slow), 4])
def test_steps_that_cannot_be_recorded_are_played_as_they_are(interval, tapes, monkeypatch, caplog):
    class Refusing(Recorder):
        def __exit__(self, *error):
            super().__exit__(*error)
            raise RuntimeError("operation not permitted when stream is capturing\nand so on")

    monkeypatch.setattr(torch.cuda, "graph", Refusing)
    with caplog.at_level(logging.WARNING):
        records = play(REFERENCE, interval=interval, record=True)
    assert_equal(play(REFERENCE, interval=interval), records)
    assert tapes.made == 1
    assert [r.message for r in caplog.records] == [
        "control steps are not recorded as CUDA graphs, which makes them slower: '_observe' cannot be: "
        "operation not permitted when stream is capturing"
    ]


def test_memory_that_moves_is_recorded_anew_for_some_time_only(tapes, monkeypatch, caplog):
    monkeypatch.setattr(recording, "_MOST_RECORDINGS", 3)
    steps, total = StepRecording("cpu", enabled=True), torch.zeros(1)

    def count():
        total.add_(1)

    with caplog.at_level(logging.WARNING):
        for size in range(10):
            steps.prepare([torch.zeros(size)])
            steps.run(count)
    assert float(total) == 10
    assert not steps.enabled
    assert "its memory moved 3 times" in caplog.text


@pytest.mark.parametrize("interval", [1, 3, 10])
@pytest.mark.parametrize("record", [False, True])
def test_an_action_that_is_no_number_is_named_at_the_next_poll(interval, record, tapes):
    def act(observation):
        action = torch.zeros(len(observation), 12)
        action[:, 3] = torch.where(observation[:, 6].abs() > 0, torch.nan, 0.0)
        return action

    with pytest.raises(
        PolicyError,
        match=r"returned nan for a finite observation at control step 2 of target_pos_velocity, sub-command 1, ",
    ):
        play(
            REFERENCE,
            interval=interval,
            record=record and interval != 1,
            act=act,
            script=FakeScript(motion=moving()),
        )


@pytest.mark.gpu
@pytest.mark.parametrize("name", [REFERENCE, OWN])
def test_a_gpu_replays_what_it_recorded(name):
    """An engine without physics, so that nothing but recording can make a difference."""
    suite = short_suite(name)
    suite = replace(suite, metrics=replace(suite.metrics, interval=2))
    worlds = scene(suite, 5, ground((0.25, 0.0, 0.4)))

    def outcome(capture):
        backend = FakeBackend(worlds, device="cuda", script=FakeScript(motion=swaying))
        rollout = Rollout(suite, ScriptedPolicy(gait), backend, lambda e: 0, poll_interval=4, capture=capture)
        rollout.play([episode(DIAGONAL, MAXIMUM), *(episode(TARGET, stage="search", seed=s) for s in range(3))])
        records = to_the_end(rollout)
        assert rollout.captured == capture
        return sorted(records, key=lambda r: r.episode)

    assert_equal(outcome(False), outcome(True))
