"""Programs that never end, give what is no action, or ask for all memory: each ends in one sentence, in a process of its own."""

import os
import signal
import sys
import time
import warnings
from pathlib import Path

import pytest
import torch
from foreign_programs import Plain, refused, script
from gaitgauge.policy.base import Interface, PolicyError
from gaitgauge.policy.foreign.fence import child as fence_child
from gaitgauge.policy.foreign.fenced_policy import FencedPolicy, FencedSession
from gaitgauge.policy.foreign.torchscript_session import BatchSession, ScriptProgram
from gaitgauge.policy.loading import load_policy
from torch import nn


def test_linear_layers_with_weights_of_eight_bits_are_run(tmp_path):
    torch.manual_seed(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        module = torch.ao.quantization.quantize_dynamic(
            nn.Sequential(nn.Linear(45, 12)), {nn.Linear}, dtype=torch.qint8
        )
    path = tmp_path / "policy.pt"
    path.write_bytes(script(module))
    observation = torch.randn(1, 45)
    assert torch.equal(load_policy(path).session(1).act(observation), module(observation))


class Sparse(Plain):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return torch.zeros(1, 12).to_sparse()


class Meta(Plain):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return torch.zeros(1, 12, device="meta")


class Complex(Plain):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return torch.complex(self.layer(observation), self.layer(observation))


class Quantized(Plain):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return torch.quantize_per_tensor(self.layer(observation), 0.1, 0, torch.qint8)


class Text(Plain):
    def forward(self, observation: torch.Tensor) -> str:
        return "left leg first"


class Huge(Plain):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return torch.zeros(2147483648, 12).sum(0, keepdim=True) + self.layer(observation)


class Deep(Plain):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        texts = ["x"]
        for _ in range(60):
            texts.extend(texts)
        return self.layer(observation) + float(len(texts))


class WrongSizes(Plain):
    """Gives an LSTM fewer hidden states than rows: some implementations write outside of memory then."""

    def __init__(self) -> None:
        super().__init__()
        self.weights = [torch.ones(8, 2), torch.ones(8, 2), torch.ones(8), torch.ones(8)]

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        state = [torch.zeros(1, 1, 2), torch.zeros(1, 1, 2)]
        out = torch.lstm(torch.ones(3, 50, 2), state, self.weights, True, 1, 0.0, False, False, False)
        return self.layer(observation) + out[0].sum()


class Raising(Plain):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        if observation.size(0) > 0:
            raise RuntimeError("left\x1b[31m\nleg")
        return self.layer(observation)


@pytest.mark.parametrize(
    ("module", "named"),
    [
        (Sparse, "sparse"),
        (Meta, "meta"),
        (Complex, "complex"),
        (Quantized, "quantize"),
        (Text, "str"),
        (Huge, "memory|allocate"),
        pytest.param(Deep, "memory|alloc|crashed|took over", marks=pytest.mark.slow),
        (Raising, "leg"),
        (WrongSizes, "shape"),
    ],
)
def test_what_is_no_action_ends_in_one_sentence(tmp_path, module, named):
    path = tmp_path / "policy.pt"
    path.write_bytes(script(module()))
    assert refused(path, named).isprintable()


class Endless(Plain):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        while bool(observation.sum() > -1e9):
            observation = observation + 1.0
        return self.layer(observation)


class EndlessLoading(Plain):
    @torch.jit.export
    def __getstate__(self) -> tuple[int, bool]:
        return 0, self.training

    @torch.jit.export
    def __setstate__(self, state: tuple[int, bool]) -> None:
        self.training = state[1]
        number = state[0]
        while number >= 0:
            number += 1


class LaterEndless(Plain):
    """Only from its hundredth step on, after all that loading tries."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("steps", torch.zeros(1, 1))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        self.steps = self.steps + 1.0
        while bool(self.steps.max() > 100.0):
            observation = observation + 1.0
        return self.layer(observation)


@pytest.mark.parametrize("module", [Endless, pytest.param(EndlessLoading, marks=pytest.mark.slow)])
def test_a_program_without_an_end_is_ended(tmp_path, monkeypatch, module):
    monkeypatch.setattr(fence_child, "STEP_SECONDS", 0)  # 1 s, which the system counts from a process's start
    path = tmp_path / "policy.pt"
    path.write_bytes(script(module()))
    refused(path, "took over 0 s")


@pytest.mark.slow
def test_a_program_that_finds_no_end_later_is_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(fence_child, "STEP_SECONDS", 1)
    path = tmp_path / "policy.pt"
    path.write_bytes(script(LaterEndless()))
    session = load_policy(path).session(4)
    with pytest.raises(PolicyError, match="took over 1 s"):
        for _ in range(101):
            session.act(torch.zeros(4, 45))
    with pytest.raises(PolicyError):  # and stays away
        session.act(torch.zeros(4, 45))


def test_ctrl_c_ends_a_program_without_an_end(tmp_path):
    path = tmp_path / "policy.pt"
    path.write_bytes(script(Endless()))
    if not (owner := os.fork()):
        # a shell that runs the tests in the background has the signal ignored, and so would Python
        signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            load_policy(path)
        except KeyboardInterrupt:
            os._exit(2)
        finally:
            os._exit(1)
    children = Path(f"/proc/{owner}/task/{owner}/children")
    until = time.monotonic() + (30.0 if children.exists() else 2.0)
    while time.monotonic() < until and not (children.exists() and children.read_text()):
        time.sleep(0.02)
    ended = 0
    while not ended and time.monotonic() < until:  # Python ignores one that comes while it forks
        time.sleep(0.1)
        os.kill(owner, signal.SIGINT)
        ended, status = os.waitpid(owner, os.WNOHANG)
    assert ended and os.waitstatus_to_exitcode(status) == 2


def test_the_process_ends_with_its_policy(tmp_path, contract):
    path = tmp_path / "policy.pt"
    path.write_bytes(script(LaterEndless()))
    policy = load_policy(path)
    session = policy.session(2)
    number = policy._child._process.pid
    os.kill(number, 0)
    del policy
    session.act(torch.zeros(2, 45))
    del session
    with pytest.raises(ProcessLookupError):
        os.kill(number, 0)


class Remembering(Plain):
    """Acts on what it was given a step ago, which it keeps without a copy."""

    def __init__(self) -> None:
        super().__init__()
        self.last = torch.zeros(1, 45)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        action = self.layer(self.last)
        self.last = observation
        return action


@pytest.fixture
def program(tmp_path) -> FencedPolicy:
    path = tmp_path / "policy.pt"
    path.write_bytes(script(Remembering()))
    policy = load_policy(path)
    assert isinstance(policy, FencedPolicy)
    return policy


def test_a_program_may_keep_what_it_is_given(program):
    session, observations = program.session(3), torch.randn(4, 3, 45)
    actions = [session.act(observation) for observation in observations]
    expected = [program.session(3).act(torch.zeros(3, 45))]  # what it remembers at first
    for observation in observations[:3]:
        other = program.session(3)
        other.act(observation)
        expected.append(other.act(torch.zeros(3, 45)))
    assert torch.allclose(torch.stack(actions), torch.stack(expected), atol=1e-6)


def test_sessions_of_one_program_do_not_meet(program):
    small, large = program.session(2), program.session(5)
    kept = small.act(torch.zeros(2, 45))
    before = kept.clone()
    large.act(torch.randn(5, 45))
    large.reset(torch.tensor([True, False, True, False, True]))
    large.act(torch.randn(5, 45))
    assert torch.equal(kept, before) and torch.equal(small.act(torch.zeros(2, 45)), before)


def test_more_numbers_than_there_is_room_for(program, monkeypatch):
    monkeypatch.setattr(fence_child, "_ROOM", 24 * 4 * (45 + 12) + 24)
    assert program.session(24).act(torch.zeros(24, 45)).shape == (24, 12)
    with pytest.raises(PolicyError, match="those of 25 episodes are more"):
        program.session(25)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="only where processes are forked")
def test_a_copy_of_its_owner_does_not_ask_it(program):
    session = program.session(1)
    process = os.fork()
    if process == 0:
        try:
            session.act(torch.zeros(1, 45))
        except PolicyError as error:
            os._exit(7 if "load it in the one that asks" in str(error) else 1)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == 7
    assert session.act(torch.zeros(1, 45)).shape == (1, 12)


class Changing(Plain):
    """Changes what it remembers in place."""

    def __init__(self) -> None:
        super().__init__()
        self.seen = torch.zeros(1, 45)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        self.seen.mul_(0.5).add_(observation)
        return self.layer(self.seen)


@pytest.mark.parametrize("module", [Remembering, Changing])
@pytest.mark.parametrize("inference", [True, False])
def test_a_program_acts_to_the_last_bit_as_in_its_owner(contract, module, inference):
    data = script(module())
    child, here = fence_child.Child(ScriptProgram, data, source="policy"), ScriptProgram(data, "policy")
    details = {"interface": Interface.of(contract).to_dict(), "attributes": ["last", "seen"]}
    assert child.ask("prepare", **details) == here.answer({"do": "prepare", **details})
    assert isinstance(here.session(5), BatchSession)
    fenced, alone = FencedSession(child, 5, contract, "policy", device=torch.device("cpu")), here.session(5)
    with torch.inference_mode(inference):
        for step, observation in enumerate(torch.randn(8, 5, 45)):
            if step % 3 == 2:
                fenced.reset(torch.arange(5) % 2 == 0)
                alone.reset(torch.arange(5) % 2 == 0)
            assert torch.equal(fenced.act(observation), alone.act(observation))


class Choosy(Plain):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        if bool(observation.max() > 100.0):
            raise RuntimeError("left leg")
        return self.layer(observation)


def test_a_step_that_fails_is_one_sentence_and_the_next_one_is_played(tmp_path):
    path = tmp_path / "policy.pt"
    path.write_bytes(script(Choosy()))
    session = load_policy(path).session(2)
    action = session.act(torch.zeros(2, 45))
    for _ in range(2):
        with pytest.raises(PolicyError, match="left leg"):
            session.act(torch.full((2, 45), 200.0))
        assert torch.equal(session.act(torch.zeros(2, 45)), action)


def test_a_process_that_is_killed_is_missed(program, monkeypatch):
    monkeypatch.setattr(fence_child, "_LOOK_SECONDS", 0.05)
    session = program.session(2)
    os.kill(program._child._process.pid, signal.SIGKILL)
    for named in ("SIGKILL", "policy.pt"):
        with pytest.raises(PolicyError, match=named):
            session.act(torch.zeros(2, 45))


one_core = pytest.mark.skipif(sys.platform != "linux", reason="only Linux says on which core a process runs")


@one_core
def test_a_program_shares_its_owners_core_and_leaves_it_free(program, monkeypatch):
    monkeypatch.setattr(fence_child, "_LOOK_SECONDS", 0.05)
    session, child = program.session(2), program._child._process.pid
    cores = os.sched_getaffinity(0)
    try:
        for core in sorted(cores)[:2]:
            os.sched_setaffinity(0, {core})
            session.act(torch.zeros(2, 45))
            assert os.sched_getaffinity(child) == {core} == os.sched_getaffinity(0)
    finally:
        os.sched_setaffinity(0, cores)
    session.act(torch.zeros(2, 45))
    assert os.sched_getaffinity(0) == cores and len(os.sched_getaffinity(child)) == 1
    os.kill(child, signal.SIGKILL)
    with pytest.raises(PolicyError, match="SIGKILL"):
        session.act(torch.zeros(2, 45))
    assert os.sched_getaffinity(0) == cores


@one_core
def test_where_cores_cannot_be_chosen_a_program_runs_on_any(program, monkeypatch):
    def forbidden(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    expected = program.session(2).act(torch.zeros(2, 45))
    other = load_policy(program.path)
    monkeypatch.setattr(os, "sched_setaffinity", forbidden)
    assert torch.equal(other.session(2).act(torch.zeros(2, 45)), expected)
    assert os.sched_getaffinity(other._child._process.pid) == os.sched_getaffinity(0)


def test_a_step_is_not_waited_for_without_an_end(tmp_path, monkeypatch):
    path = tmp_path / "policy.pt"
    path.write_bytes(script(LaterEndless()))
    session = load_policy(path).session(4)
    monkeypatch.setattr(fence_child, "_WALL_SECONDS", 1)
    with pytest.raises(PolicyError, match="took over 1 s for one step"):
        for _ in range(101):
            session.act(torch.zeros(4, 45))


def test_no_semaphores_are_one_sentence(tmp_path, monkeypatch):
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(fence_child.CONTEXT, "Semaphore", full)
    path = tmp_path / "policy.pt"
    path.write_bytes(script(Plain()))
    refused(path, "No space left on device; two semaphores need room in /dev/shm")
