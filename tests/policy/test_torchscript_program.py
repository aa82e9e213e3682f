"""Networks followed from a TorchScript file's code act as the file does, each robot for itself; what is not understood is named."""

import io
import zipfile
from itertools import pairwise

import pytest
import torch
from foreign_programs import script
from gaitgauge.policy.foreign.batched_program import NotUnderstoodError, ProgramSession
from gaitgauge.policy.foreign.torchscript_program import torchscript_program
from torch import nn

EPISODES = 5


def layers(*widths: int, last: nn.Module | None = None) -> nn.Sequential:
    made: list[nn.Module] = []
    for a, b in pairwise(widths):
        made += [nn.Linear(a, b), nn.ELU()]
    return nn.Sequential(*made[:-1], *([last] if last else []))


class Published(nn.Module):
    """As the published policies: a history inside, written for one robot, and two entries of the output."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(1)
        self.history = torch.zeros(1, 5, 45)
        self.normalizer = nn.Identity()
        self.actor = layers(32 + 45, 24, 12)

    def remember(self, x: torch.Tensor) -> torch.Tensor:
        self.history = torch.cat([self.history[:, 1:], x.unsqueeze(1)], dim=1)
        return self.history.flatten(1)

    @torch.jit.export
    def reset(self) -> None:
        self.history = torch.zeros_like(self.history)


class SharedHead(Published):
    """Eight experts with one head that do not see the command: the files that can be had."""

    def __init__(self) -> None:
        super().__init__()
        self.gate = layers(225, 24, 8, last=nn.Softmax(dim=-1))
        self.trunk = nn.Sequential(layers(210, 24, 8 * 16), nn.ELU())
        self.head = nn.Linear(16, 32)
        self.register_buffer("seen", torch.tensor([i not in (6, 7, 8) for i in range(45)]), persistent=False)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
        x = self.normalizer(x)
        history = self.remember(x)
        blind = self.history.reshape(1, 5, -1)[:, :, self.seen].reshape(1, -1)
        weights = self.gate(history)
        experts = self.head(self.trunk(blind).view(1, 8, 16))
        latent = nn.functional.normalize(torch.sum(weights.unsqueeze(-1) * experts, dim=1), p=2.0, dim=-1)
        return self.actor(torch.cat([latent, x], dim=1)), (weights, latent)


class GroupedHeads(Published):
    """A head for each expert, written as a convolution with groups: the published training code of today."""

    def __init__(self) -> None:
        super().__init__()
        self.gate = layers(225, 24, 8, last=nn.Softmax(dim=-1))
        self.trunk = nn.Sequential(layers(225, 24, 8 * 16), nn.ELU())
        self.heads = nn.Conv1d(8 * 16, 8 * 32, kernel_size=1, groups=8)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
        history = self.remember(x)
        weights = self.gate(history)
        experts = self.heads(self.trunk(history).unsqueeze(-1)).squeeze(-1).reshape(-1, 8, 32)
        latent = nn.functional.normalize(torch.sum(weights.unsqueeze(-1) * experts, dim=1), p=2.0, dim=-1)
        return self.actor(torch.cat([latent, x], dim=1)), (weights, latent)


class ListOfExperts(Published):
    """Each expert a network of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.gate = layers(225, 24, 3, last=nn.Softmax(dim=-1))
        self.experts = nn.ModuleList([layers(225, 24, 32) for _ in range(3)])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        history = self.remember(x)
        outputs = [expert(history) for expert in self.experts]
        latent = torch.sum(self.gate(history).unsqueeze(-1) * torch.stack(outputs, dim=1), dim=1)
        return self.actor(torch.cat([latent / latent.norm(2, dim=-1, keepdim=True), x], dim=1))


class Loop(Published):
    """Goes through its frames in a loop, with a layer norm and a clipped output."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(45)
        self.narrow = nn.Linear(45, 32)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        self.remember(x)
        latent = torch.zeros(1, 32)
        for frame in range(self.history.shape[1]):
            latent = torch.tanh(self.narrow(self.norm(self.history[:, frame])) + 0.5 * latent)
        if x.size(0) != 1:
            raise ValueError("one robot")
        return self.actor(torch.cat([latent, x], dim=1)).clamp(-0.1, 0.1)


class Squeezed(Published):
    """Its action has no axis for the robot."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        self.remember(x)
        return self.actor(torch.cat([self.history.mean(dim=1)[:, :32], x], dim=1)).squeeze(0)


class AskingForItsDevice(Published):
    """Calculates otherwise on a GPU, as networks of this project do where they are scripted, not traced."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        self.remember(x)
        latent = self.history.mean(dim=1)[:, :32]
        if latent.is_cuda or not x.is_cpu:
            latent = latent.half().float()
        return self.actor(torch.cat([latent, x], dim=1))


@pytest.mark.parametrize(
    "module",
    [SharedHead, GroupedHeads, ListOfExperts, Loop, Squeezed, AskingForItsDevice],
    ids=lambda module: module.__name__,
)
def test_acts_as_the_file(module, contract, run):
    data = script(module())
    observations = torch.randn(10, EPISODES, 45, generator=torch.Generator().manual_seed(2))
    session = ProgramSession(torchscript_program(data, 45, source="file"), EPISODES, contract, torch.device("cpu"))
    actions = run(session, observations)
    with torch.no_grad():
        for row in range(EPISODES):
            original = torch.jit.load(io.BytesIO(data))
            for step, observation in enumerate(observations):
                if row == 2 and step == 6:
                    original.reset()
                output = original(observation[row : row + 1])
                expected = output[0] if isinstance(output, tuple) else output
                assert torch.allclose(actions[step, row], expected.reshape(-1), atol=1e-6)


@pytest.mark.parametrize("module", [SharedHead, GroupedHeads, Loop], ids=lambda module: module.__name__)
def test_all_of_it_moves_to_another_device(module, contract):
    """The device without numbers stands for a GPU: whatever stayed behind would be refused."""
    elsewhere = torch.device("meta")
    session = ProgramSession(torchscript_program(script(module()), 45, source="file"), EPISODES, contract, elsewhere)
    session.reset(torch.zeros(EPISODES, dtype=torch.bool, device=elsewhere))
    action = session.act(torch.zeros(EPISODES, 45, device=elsewhere))
    assert action.shape == (EPISODES, 12) and action.device == elsewhere


def test_no_robot_influences_another(contract, run):
    program = torchscript_program(script(GroupedHeads()), 45, source="file")
    observations = torch.randn(10, EPISODES, 45, generator=torch.Generator().manual_seed(2))
    poisoned = observations.clone()
    poisoned[3:, 1] = float("nan")
    clean, dirty = (
        run(ProgramSession(program, EPISODES, contract, torch.device("cpu")), o) for o in (observations, poisoned)
    )
    others = torch.arange(EPISODES) != 1
    assert torch.equal(clean[:, others], dirty[:, others]) and dirty[4:, 1].isnan().all()


class Branching(Published):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if x[0, 0] > 100.0:
            return torch.ones(1, 12)
        return self.actor(torch.cat([x[:, :32], x], dim=1))


class Counting(Published):
    def __init__(self) -> None:
        super().__init__()
        self.steps = 0

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        self.steps += 1
        return self.actor(torch.cat([x[:, :32], x], dim=1)) * self.steps


class Random(Published):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.actor(torch.cat([x[:, :32], x], dim=1)) + torch.rand(1, 12)


class Writing(Published):
    path: str

    def __init__(self, path: str) -> None:
        super().__init__()
        self.path = path

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.actor(torch.cat([x[:, :32], x], dim=1)) + torch.from_file(self.path, True, 12)


class Restoring(Published):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.actor(torch.cat([x[:, :32], x], dim=1))

    @torch.jit.export
    def __getstate__(self) -> tuple[torch.Tensor, bool]:
        return self.history, self.training

    @torch.jit.export
    def __setstate__(self, state: tuple[torch.Tensor, bool]) -> None:
        self.history = state[0]
        self.training = state[1]


class Endless(Published):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        for _ in range(1 << 60):
            x = x + 1.0
        return self.actor(torch.cat([x[:, :32], x], dim=1))


class Huge(Published):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        wide = torch.zeros(1 << 20, 1 << 20).sum()
        return self.actor(torch.cat([x[:, :32], x], dim=1)) + wide


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (Branching, "depends on what it observes"),
        (Counting, "changes 'steps'"),
        (Random, "'rand'"),
        (lambda: Writing("written"), "'from_file'"),
        (Restoring, "restores itself"),
        (Endless, "too long|more memory or time"),
        (Huge, "memory"),
    ],
    ids=["branching", "counting", "random", "writing", "restoring", "endless", "huge"],
)
def test_what_is_not_understood_is_named_and_not_run(make, reason, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "gaitgauge.policy.foreign.batched_program.MOST_OPERATORS", 500
    )  # of those here, one alone calls as many
    with pytest.raises(NotUnderstoodError, match=reason):
        torchscript_program(script(make()), 45, source="file")
    assert not any(tmp_path.iterdir())


def test_an_archive_that_holds_something_else_is_not_read():
    changed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(script(SharedHead()))) as archive, zipfile.ZipFile(changed, "w") as target:
        for name in archive.namelist():
            content = b"cos\nsystem\n(X\x04\0\0\0truetR." if name.endswith("/data.pkl") else archive.read(name)
            target.writestr(name, content)
    with pytest.raises(NotUnderstoodError, match=r"os\.system"):
        torchscript_program(changed.getvalue(), 45, source="file")
