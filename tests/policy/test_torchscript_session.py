import io
import json
import os
import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from gaitgauge.policy.base import Interface, PolicyError
from gaitgauge.policy.batch_invariance import steady_session
from gaitgauge.policy.contract import History
from gaitgauge.policy.foreign.fence.script import check_script
from gaitgauge.policy.foreign.fenced_policy import FencedPolicy
from gaitgauge.policy.foreign.torchscript_session import BatchSession, CopiesSession, ScriptProgram, Wiring
from gaitgauge.policy.importing import import_policy
from gaitgauge.policy.loading import load_policy
from torch import nn

pytestmark = pytest.mark.usefixtures("programs_run_here")

EPISODES, RESET_STEP, RESET_ROW = 4, 6, 2


class WithHistory(nn.Module):
    """As CTS policies are exported: batch of one, the history in a plain attribute, zeroed by an exported method."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.encoder, self.actor = network.encoder, network.actor
        self.history = torch.zeros(1, 5, 45)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        self.history = torch.cat((self.history[:, 1:], observation.unsqueeze(1)), dim=1)
        latent = nn.functional.normalize(self.encoder(self.history.flatten(1)), dim=-1)
        return self.actor(torch.cat((latent, observation), dim=1))

    @torch.jit.export
    def reset(self) -> None:
        self.history.zero_()


class InPlaceBuffer(WithHistory):
    """The history is a registered buffer, written in place."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__(network)
        del self.history
        self.register_buffer("history", torch.zeros(1, 5, 45))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        self.history[:, :-1] = self.history[:, 1:].clone()
        self.history[:, -1] = observation
        latent = nn.functional.normalize(self.encoder(self.history.flatten(1)), dim=-1)
        return self.actor(torch.cat((latent, observation), dim=1))


class NormalizedOverBatch(WithHistory):
    """Divides by the norm of the whole tensor: right for a batch of one only."""

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        self.history = torch.cat((self.history[:, 1:], observation.unsqueeze(1)), dim=1)
        latent = self.encoder(self.history.flatten(1))
        return self.actor(torch.cat((latent / latent.norm(), observation), dim=1))


class FixedBatch(WithHistory):
    """Has the batch of one in its shapes."""

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        self.history = torch.cat((self.history[:, 1:], observation.view(1, 1, 45)), dim=1)
        latent = nn.functional.normalize(self.encoder(self.history.view(1, 225)), dim=-1)
        return self.actor(torch.cat((latent, observation), dim=1))


class Counting(WithHistory):
    """Fills its history with the first observation, told by a Python number that counts the steps; has no reset()."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__(network)
        self.steps = 0

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        if self.steps == 0:
            self.history = observation.unsqueeze(1).repeat(1, 5, 1)
        self.steps += 1
        self.history = torch.cat((self.history[:, 1:], observation.unsqueeze(1)), dim=1)
        latent = nn.functional.normalize(self.encoder(self.history.flatten(1)), dim=-1)
        return self.actor(torch.cat((latent, observation), dim=1))

    def reset(self) -> None:
        pass


class Recurrent(nn.Module):
    """An LSTM as rsl_rl exports it: the batch is the second axis of its states."""

    def __init__(self) -> None:
        super().__init__()
        self.rnn = nn.LSTM(45, 16)
        self.head = nn.Linear(16, 12)
        self.register_buffer("hidden_state", torch.zeros(1, 1, 16))
        self.register_buffer("cell_state", torch.zeros(1, 1, 16))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        output, (hidden, cell) = self.rnn(observation.unsqueeze(0), (self.hidden_state, self.cell_state))
        self.hidden_state[:] = hidden
        self.cell_state[:] = cell
        return self.head(output.squeeze(0))

    @torch.jit.export
    def reset_memory(self) -> None:
        self.hidden_state[:] = 0.0
        self.cell_state[:] = 0.0


class Nested(nn.Module):
    """Its history is inside a submodule."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.inner = WithHistory(network)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return self.inner(observation)

    @torch.jit.export
    def reset(self) -> None:
        self.inner.reset()


class Plain(nn.Module):
    """No memory at all."""

    def __init__(self, width: int = 45, outputs: int = 12) -> None:
        super().__init__()
        self.layer = nn.Linear(width, outputs)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return torch.tanh(self.layer(observation))


def save(module: nn.Module, path, **extra_files: str):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.save(torch.jit.script(module), str(path), _extra_files=extra_files)
    return path


def modules(network) -> dict[str, nn.Module]:
    torch.manual_seed(5)
    return {
        "history": WithHistory(network),
        "in place": InPlaceBuffer(network),
        "nested": Nested(network),
        "recurrent": Recurrent(),
        "plain": Plain(),
        "normalized": NormalizedOverBatch(network),
        "fixed": FixedBatch(network),
        "counting": Counting(network),
    }


TOGETHER = ("history", "in place", "nested", "plain", "recurrent")
"""Files with code that takes all episodes at once."""
KINDS = (*TOGETHER, "normalized", "fixed", "counting")


def unfenced(path, contract) -> ScriptProgram:
    """Return the program of a file in this process."""
    script = check_script(path.read_bytes(), source="policy")
    program = ScriptProgram(script.data, "policy")
    program.prepare(Interface.of(contract), script.attributes)
    return program


@pytest.fixture(scope="module")
def loaded(tmp_path_factory, cts_network):
    """A file of each kind and its policy; each is written and loaded once."""
    folder = tmp_path_factory.mktemp("modules")

    @cache
    def load(name):
        path = save(modules(cts_network)[name], folder / f"{name}.pt")
        return path, load_policy(path)

    return load


@pytest.mark.parametrize("name", KINDS)
def test_batch_equals_single_modules(loaded, observations, name, run):
    """The reference is the exported module itself, loaded anew for each episode and for each reset."""
    path, policy = loaded(name)
    own = unfenced(path, policy.contract).session(EPISODES)
    assert isinstance(policy, FencedPolicy)
    assert policy.row_by_row == (name not in TOGETHER)
    assert isinstance(own, BatchSession if name in TOGETHER else CopiesSession)
    played = [run(session, observations) for session in (policy.session(EPISODES), own)]
    with warnings.catch_warnings(), torch.no_grad(), torch.jit.optimized_execution(False):
        warnings.simplefilter("ignore", DeprecationWarning)
        for row in range(EPISODES):
            module = torch.jit.load(str(path))
            for step in range(len(observations)):
                if row == RESET_ROW and step == RESET_STEP:
                    module = torch.jit.load(str(path))
                expected = module(observations[step, row : row + 1])
                for actions in played:
                    np.testing.assert_allclose(actions[step, row], expected[0], atol=1e-5)


@pytest.mark.parametrize(
    ("name", "warned"), [("history", False), ("fixed", True), pytest.param("counting", True, marks=pytest.mark.slow)]
)
def test_a_warning_comes_once_where_a_file_plays_row_by_row(tmp_path, cts_network, caplog, name, warned):
    path = save(modules(cts_network)[name], tmp_path / "policy.pt")
    policy = load_policy(path)
    load_policy(path)
    steady_session(policy, EPISODES)
    messages = [record.getMessage() for record in caplog.records if "slow" in record.getMessage()]
    assert len(messages) == int(warned)
    assert not warned or (policy.path in messages[0] and "gaitgauge import" in messages[0])


@pytest.mark.parametrize("name", ["history", "recurrent", "fixed", "counting"])
def test_reset_rows_and_repeat(loaded, observations, name, run):
    _, policy = loaded(name)
    session = policy.session(EPISODES)
    first = run(session, observations)
    assert torch.equal(run(session, observations), first)
    assert torch.equal(run(policy.session(EPISODES), observations), first)
    session.reset()
    undisturbed = torch.stack([session.act(o) for o in observations])
    others = torch.arange(EPISODES) != RESET_ROW
    assert torch.equal(undisturbed[:, others], first[:, others])
    assert not torch.equal(undisturbed[RESET_STEP, RESET_ROW], first[RESET_STEP, RESET_ROW])


def test_rows_do_not_influence_each_other(loaded, observations, run):
    _, policy = loaded("history")
    poisoned = observations.clone()
    poisoned[3:, 1] = float("inf")
    others = torch.arange(EPISODES) != 1
    a, b = run(policy.session(EPISODES), observations), run(policy.session(EPISODES), poisoned)
    assert torch.equal(a[:, others], b[:, others])


def test_torchscript_and_native_agree(loaded, cts_file, observations, run):
    _, foreign = loaded("history")
    own = load_policy(cts_file)
    np.testing.assert_allclose(
        run(foreign.session(EPISODES), observations), run(own.session(EPISODES), observations), atol=1e-5
    )
    assert foreign.contract.hash == own.contract.hash


class BesideNone(WithHistory):
    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, tuple[None, torch.Tensor]]:
        self.history = torch.cat((self.history[:, 1:], observation.unsqueeze(1)), dim=1)
        latent = nn.functional.normalize(self.encoder(self.history.flatten(1)), dim=-1)
        return self.actor(torch.cat((latent, observation), dim=1)), (None, latent)


class BesideWeightsAndLatent(WithHistory):
    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
        self.history = torch.cat((self.history[:, 1:], observation.unsqueeze(1)), dim=1)
        latent = nn.functional.normalize(self.encoder(self.history.flatten(1)), dim=-1)
        return self.actor(torch.cat((latent, observation), dim=1)), (torch.softmax(latent, dim=1), latent)


class BesideSqueezedWeights(WithHistory):
    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        self.history = torch.cat((self.history[:, 1:], observation.unsqueeze(1)), dim=1)
        latent = nn.functional.normalize(self.encoder(self.history.flatten(1)), dim=-1)
        return self.actor(torch.cat((latent, observation), dim=1)), torch.softmax(latent, dim=1).squeeze(0)


class BesideThree(WithHistory):
    def forward(
        self, observation: torch.Tensor
    ) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
        self.history = torch.cat((self.history[:, 1:], observation.unsqueeze(1)), dim=1)
        latent = nn.functional.normalize(self.encoder(self.history.flatten(1)), dim=-1)
        return self.actor(torch.cat((latent, observation), dim=1)), (latent, latent, latent)


class InList(WithHistory):
    def forward(self, observation: torch.Tensor) -> list[torch.Tensor]:
        self.history = torch.cat((self.history[:, 1:], observation.unsqueeze(1)), dim=1)
        latent = nn.functional.normalize(self.encoder(self.history.flatten(1)), dim=-1)
        return [self.actor(torch.cat((latent, observation), dim=1)), latent]


@pytest.mark.parametrize(
    "variant",
    [
        BesideNone,
        BesideWeightsAndLatent,
        pytest.param(BesideSqueezedWeights, marks=pytest.mark.slow),
        pytest.param(BesideThree, marks=pytest.mark.slow),
        InList,
    ],
    ids=lambda v: v.__name__,
)
def test_actions_are_first_in_every_kind_of_output(tmp_path, cts_network, cts_file, observations, variant, run):
    policy = load_policy(save(variant(cts_network), tmp_path / "policy.pt"))
    assert isinstance(policy, FencedPolicy)
    expected = run(load_policy(cts_file).session(EPISODES), observations)
    np.testing.assert_allclose(run(policy.session(EPISODES), observations), expected, atol=1e-5)


def test_input_width_tells_the_history(tmp_path):
    policy = load_policy(save(Plain(225), tmp_path / "policy.pt"))
    assert policy.contract.history == History(length=5, order="frame-major", start="zeros")
    assert policy.contract.observation_width == 225
    assert load_policy(save(Plain(45), tmp_path / "one.pt")).contract.history == History()


@pytest.mark.parametrize("sidecar", ["policy.contract.json", "contract.json"])
def test_sidecar_contract_decides(tmp_path, contract, sidecar):
    path = save(Plain(225), tmp_path / "policy.pt")
    described = replace(contract, control_period=0.01, history=History(length=5, order="term-major", start="repeat"))
    (tmp_path / sidecar).write_text(described.to_json())
    assert load_policy(path).contract == described
    (tmp_path / sidecar).write_text(json.dumps({"robot": "go2"}))
    with pytest.raises(PolicyError, match=sidecar):
        load_policy(path)


def test_contract_inside_the_archive(tmp_path, contract):
    described = replace(contract, control_period=0.01)
    path = save(Plain(45), tmp_path / "policy.pt", **{"contract.json": described.to_json()})
    assert load_policy(path).contract == described


class Words(nn.Module):
    def forward(self, observation: torch.Tensor) -> str:
        return "forward"


@pytest.mark.parametrize(
    ("module", "named"),
    [
        (Plain(44), "widths"),
        (Plain(45, 11), r"\(1, 11\)"),
        (Words(), "str"),
        (nn.Identity(), r"\(1, 45\)"),
    ],
    ids=["input", "output", "words", "identity"],
)
def test_wrong_widths_end_in_one_sentence(tmp_path, module, named):
    with pytest.raises(PolicyError, match=named) as caught:
        load_policy(save(module, tmp_path / "policy.pt"))
    assert "\n" not in str(caught.value)


def test_nan_is_handed_on(tmp_path):
    module = Plain()
    nn.init.constant_(module.layer.weight, float("nan"))
    action = load_policy(save(module, tmp_path / "policy.pt")).session(2).act(torch.zeros(2, 45))
    assert action.isnan().all()


def test_wrong_batch_is_refused(loaded):
    for name in ("history", "fixed"):
        session = loaded(name)[1].session(3)
        with pytest.raises(PolicyError, match=r"\(3, 45\)"):
            session.act(torch.zeros(2, 45))


@pytest.mark.parametrize("name", ["history", pytest.param("counting", marks=pytest.mark.slow)])
def test_import_keeps_actions_and_needs_no_sidecar(tmp_path, contract, cts_network, observations, name, run):
    (tmp_path / "source").mkdir()
    path = save(modules(cts_network)[name], tmp_path / "source" / "policy.pt")
    described = replace(contract, control_period=0.01)
    (tmp_path / "source" / "contract.json").write_text(described.to_json())
    stored = import_policy(path, tmp_path / "own.gauge.pt").contract
    own = load_policy(tmp_path / "own.gauge.pt", trust=True)
    assert own.contract == stored
    assert own.contract.hash == described.hash
    assert torch.equal(run(own.session(EPISODES), observations), run(load_policy(path).session(EPISODES), observations))


@pytest.mark.skipif(
    "GAITGAUGE_PUBLIC_CTS" not in os.environ, reason="needs the published CTS weights as a NumPy archive"
)
def test_published_policy_acts_as_published(tmp_path, contract):
    from gaitgauge.policy.native import StoredNetwork, save_policy
    from gaitgauge.policy.networks.architectures import CtsNetwork

    with np.load(os.environ["GAITGAUGE_PUBLIC_CTS"]) as archive:
        state = {k.replace("student_encoder", "encoder"): torch.from_numpy(archive[k]) for k in archive if "/" not in k}
        frames, expected = archive["sample/observations"], archive["sample/actions"]
    save_policy(tmp_path / "own.pt", contract, StoredNetwork(architecture="cts", arguments={}, state_dict=state))
    network = CtsNetwork()
    network.load_state_dict(state)
    for path in (tmp_path / "own.pt", save(WithHistory(network), tmp_path / "jit.pt")):
        session = load_policy(path).session(1)
        actions = np.concatenate([session.act(torch.from_numpy(f[None])) for f in frames])
        np.testing.assert_allclose(actions, expected, atol=1e-5)


def test_copies_are_made_of_the_fresh_module(tmp_path, contract, cts_network):
    """A module that is used after its session was made must not leak into that session's resets."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.save(torch.jit.script(WithHistory(cts_network)), buffer)
        module = torch.jit.load(io.BytesIO(buffer.getvalue()))
    session = CopiesSession(
        module, 1, Interface.of(contract), "policy", Wiring(widths=(45,), order=(0,), dtype=torch.float32)
    )
    observation = torch.ones(1, 45)
    first = session.act(observation)
    module(observation)
    session.reset()
    assert torch.equal(session.act(observation), first)
