"""A policy file that opens files is refused by every command, and the file does not exist afterwards."""

import io
import warnings
from pathlib import Path

import pytest
import torch
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import ForeignFile, save_policy
from torch import nn


class Base(nn.Module):
    def __init__(self, target: str) -> None:
        super().__init__()
        self.layer = nn.Linear(45, 12)
        self.target = target
        self.opened = torch.zeros(1)


class Plain(Base):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return self.layer(observation)


class InForward(Base):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return self.layer(observation) + torch.from_file(self.target, True, 64)[:1]


class InReset(Plain):
    @torch.jit.export
    def reset(self) -> None:
        self.opened = torch.from_file(self.target, True, 64)


class InSetstate(Plain):
    @torch.jit.export
    def __getstate__(self) -> tuple[str, bool]:
        return self.target, self.training

    @torch.jit.export
    def __setstate__(self, state: tuple[str, bool]) -> None:
        self.training = state[1]
        self.opened = torch.from_file(state[0], True, 64)


def write(path: Path, module: nn.Module) -> Path:
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.save(torch.jit.script(module.eval()), buffer)
    path.write_bytes(buffer.getvalue())
    return path


@pytest.mark.parametrize(
    ("kind", "inside"),
    [
        pytest.param(InForward, False, marks=pytest.mark.slow),
        pytest.param(InReset, False, marks=pytest.mark.slow),
        (InSetstate, False),
        (InForward, True),
        pytest.param(InReset, True, marks=pytest.mark.slow),
        pytest.param(InSetstate, True, marks=pytest.mark.slow),
    ],
)
def test_no_command_opens_the_file(run, refused, tmp_path, contract, kind, inside):
    victim = tmp_path / "victim"
    path = write(tmp_path / "policy.pt", kind(str(victim)))
    victim.unlink(missing_ok=True)
    if inside:
        save_policy(tmp_path / "own.gauge.pt", contract, ForeignFile(kind="torchscript", data=path.read_bytes()))
        path = tmp_path / "own.gauge.pt"
    commands = {
        "import": [path, tmp_path / "made.gauge.pt"],
        "evaluate": [path, "--suite", "demo"],
        "export": [path],
        "play": [path, "--viewer", "viser", "--port", "18080"],
        "consistency": [path, "--backends", "mujoco,mujoco@iterations=50", "--suite", "demo"],
        "latent": [path],
        "compare": [path, "pretrained", "--suite", "demo"],
        "trial": [path],
    }
    for command, arguments in commands.items():
        for trust in ([], ["--trust"]):
            message = refused(command, *arguments, *trust)
            assert ("--trust" if inside and not trust else "torch.from_file") in message, command
            assert not victim.exists(), command
    for trust in ([], ["--trust"]):  # weights alone are taken, whatever is trusted
        message = refused("train", "go2-flat", "--backend", "fake", "--device", "cpu", "--init-from", path, *trust)
        assert ("carries a program (torchscript), not weights" if inside else "is a program (torchscript)") in message
        assert not victim.exists()
    refused("compare", path, path)
    run_folder = tmp_path / "logs" / "rsl_rl" / "go2_flat" / "2026-01-01_00-00-00"
    run_folder.mkdir(parents=True)
    (run_folder / "model_1.pt").write_bytes(path.read_bytes())
    listed = run("list", "policies")
    assert listed.exit_code == 0 and "unusable" in listed.stdout
    assert not victim.exists()


def test_a_program_inside_is_run_only_when_asked(run, refused, tmp_path):
    path = write(tmp_path / "policy.pt", Plain(""))
    made = tmp_path / "made.gauge.pt"
    result = run("import", path, made)
    assert result.exit_code == 0 and "--trust" in result.output
    assert "--trust" in refused("import", made, tmp_path / "again.gauge.pt")
    assert run("import", made, tmp_path / "again.gauge.pt", "--trust").exit_code == 0
    observation = torch.randn(3, 45)
    same = load_policy(made, trust=True).session(3).act(observation)
    assert torch.equal(same, load_policy(path).session(3).act(observation))
