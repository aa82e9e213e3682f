"""TorchScript that opens files, or would be stronger than the fence, is refused by name before anything is loaded."""

import io
from contextlib import suppress
from pathlib import Path

import pytest
import torch
from foreign_programs import Plain, refused, script
from gaitgauge.policy.base import PolicyError
from gaitgauge.policy.foreign.fence.archive import packed, read_archive
from gaitgauge.policy.foreign.fence.script import check_script
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import ForeignFile, save_policy
from torch import nn

TARGET = "/tmp/a file that no policy may write"


class Base(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(45, 12)
        self.target = TARGET
        self.opened = torch.zeros(1)


class InForward(Base):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        opened = torch.from_file(self.target, True, 64)
        return self.layer(observation) + opened[:1]


class InReset(Base):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return self.layer(observation)

    @torch.jit.export
    def reset(self) -> None:
        self.opened = torch.from_file(self.target, True, 64)


class InSetstate(Base):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return self.layer(observation)

    @torch.jit.export
    def __getstate__(self) -> tuple[str, bool]:
        return self.target, self.training

    @torch.jit.export
    def __setstate__(self, state: tuple[str, bool]) -> None:
        self.target = state[0]
        self.training = state[1]
        self.opened = torch.from_file(state[0], True, 64)


class Saving(Base):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        torch.save(observation, self.target)
        return self.layer(observation)


HOSTILE = {"forward": InForward, "reset": InReset, "setstate": InSetstate, "save": Saving}


def hostile(place: str, target: Path) -> bytes:
    """A TorchScript file that opens ``target``; the file that torch needs to write it is gone again."""
    module = HOSTILE[place]()
    module.target = str(target)
    try:
        return script(module)
    except RuntimeError:  # torch.save cannot be compiled: the code is written by hand
        data = read_archive(script(InForward()), source="")
        name = next(n for n in data if n.startswith("code/") and b"from_file" in data[n])
        data[name] = data[name].replace(b"torch.from_file(target, True, 64)", b"torch.save(observation, target)")
        return packed(data)
    finally:
        target.unlink(missing_ok=True)


@pytest.mark.parametrize("place", HOSTILE)
def test_a_program_that_opens_a_file_is_refused_by_name(tmp_path, contract, place):
    target = tmp_path / "victim"
    alone, inside = tmp_path / "policy.pt", tmp_path / "policy.gauge.pt"
    alone.write_bytes(hostile(place, target))
    save_policy(inside, contract, ForeignFile(kind="torchscript", data=alone.read_bytes()))
    for path, trust in ((alone, False), (alone, True), (inside, True)):
        refused(path, r"torch\.(from_file|save)", trust=trust)
        assert not target.exists()
    refused(inside, "--trust")
    assert not target.exists()


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("x = ops.aten.from_file(self.target, True, 64)", "ops.aten.from_file"),
        ("x = ops.aten.save(observation, self.target)", "ops.aten.save"),
        ("x = observation.from_file(self.target, True, 64)", "from_file"),
        ("x = torch.from_file", "torch.from_file"),
        ("torch = observation\n    x = torch.from_file(self.target)", "variable named torch"),
        ("__torch__ = observation\n    x = __torch__.save(self.target)", "variable named __torch__"),
        ("x = fork(self.forward, observation)", "fork"),
        ("x = ops.quantized.add(observation, observation, 1.0, 0)", "ops.quantized.add"),
        ("x = ops.load_library(self.target)", "ops.load_library"),
        ("x = __torch__.torch.classes.profiling.SourceStats()", "__torch__.torch.classes"),
        ("x = getattr(torch, 'from_' + 'file')(self.target)", "what it computed"),
        ("x = [observation][0].set_(observation)", "set_"),
        ("x = observation.resize_([100, 100])", "resize_"),
        ("x = observation.as_strided([100, 100], [1, 1])", "as_strided"),
        (
            "x = ops.aten.native_batch_norm(observation, None, None, observation, observation, True, 0.1, 0.1)",
            "native_batch",
        ),
        ("x = torch.upsample_bilinear2d(observation, [4, 4], False, 1e-30, 1e-30)", "upsample_bilinear2d"),
        ("f = observation.as_strided\n    x = f([100, 100], [1, 1])", r"f\(\)"),
        ("f = getattr(torch, 'from_file')\n    x = f(self.target, True, 64)", r"f\(\)"),
        ("f = getattr(observation, 'resize_')\n    x = f([100, 100])", r"f\(\)"),
        ("f = __torch__.a\n    f = observation.resize_\n    x = f([100, 100])", r"f\(\)"),
        ("f = __torch__.a\n    for f in [observation.resize_]:\n      x = f([100, 100])", r"f\(\)"),
        ("observation = __torch__.a\n    x = observation([100, 100])", r"observation\(\)"),
        ("import os", "import os"),
        ("x = open(self.target)", "open"),
        ("x = eval(self.target)", "eval"),
        ("x = lambda y: y", "Lambda"),
        ("x = 'a' if True else (yield)", "Yield"),
        ("x = b'a'", "text"),
        ("x = 1  # \u00e9", "characters"),
        ("x = 1 \\\n + 2", "characters"),
        ("x = " + "(" * 5000 + ")" * 5000, "read|nested"),
        ("x = " + "-" * 20_000 + "1", "read|nested"),
    ],
)
def test_other_ways_to_say_it(line, named):
    records = read_archive(script(Plain()), source="")
    name = next(n for n in records if n.endswith(".py") and b"class Plain" in records[n])
    text = records[name].decode()
    at = text.index("    ", text.index("-> Tensor"))
    records[name] = (text[:at] + f"    {line}\n" + text[at:]).encode()
    with pytest.raises(PolicyError, match=named):
        check_script(packed(records), source="policy")


@pytest.mark.parametrize("name", ["code/__torch__.PY", "CODE/__torch__.py"])
@pytest.mark.parametrize("alone", [True, False])
def test_torch_finds_no_code_that_was_not_read(tmp_path, name, alone):
    """torch asks an archive for names in any case."""
    target = tmp_path / "victim"
    records = read_archive(hostile("setstate", target), source="")
    code = next(n for n in records if n.endswith(".py") and b"from_file" in records[n])
    content = records[code]
    if alone:
        del records[code]
    else:
        records[code] = content.replace(b"torch.from_file", b"torch.zeros").replace(b", True, 64", b"")
    records[name.replace("__torch__", code[len("code/") : -len(".py")])] = content
    path = tmp_path / "policy.pt"
    path.write_bytes(packed(records))
    with pytest.raises(PolicyError):
        load_policy(path)
    with suppress(PolicyError, RuntimeError):  # and what is handed on to torch, outside of any process of its own
        torch.jit.load(io.BytesIO(check_script(packed(records), source="policy").data))
    assert not target.exists()


def test_a_method_of_its_own_lets_no_operator_through():
    """A class with a method ``set_`` does not make ``set_`` of a tensor a call of its own."""
    records = read_archive(script(Plain()), source="")
    name = next(n for n in records if n.endswith(".py") and b"class Plain" in records[n])
    records[name] += b"  def set_(self: __torch__.Plain, x: Tensor) -> Tensor:\n    return (x).set_(x)\n"
    with pytest.raises(PolicyError, match="set_"):
        check_script(packed(records), source="policy")


def test_an_archive_with_a_call_in_its_data_is_refused(tmp_path):
    records = read_archive(script(Plain()), source="")
    records["data.pkl"] = b"cos\nsystem\n(X\x04\0\0\0truetR."
    (tmp_path / "policy.pt").write_bytes(packed(records))
    refused(tmp_path / "policy.pt", r"os\.system")


class SlowWithMemory(nn.Module):
    """A few bytes of numbers that one operator multiplies to 268 MB on its way, three times, slow on any machine."""

    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(45, 12)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        wide = observation[:, :1].expand(-1, 8192)
        product = torch.zeros(())
        for _ in range(3):
            product = product + torch.einsum("ai,aj,i,j->", wide, wide, wide[0], wide[0])
        return self.layer(observation) + product * 0.0


class Packed(nn.Module):
    """torch believes ``batch_sizes`` and reads beyond the memory of the sequence."""

    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(45, 12)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        sizes = torch.ones(1, dtype=torch.int64).expand(6)
        weights = [torch.ones(12, 4), torch.ones(12, 3), torch.ones(12), torch.ones(12)]
        states = [torch.zeros(1, 6, 3), torch.zeros(1, 6, 3)]
        out = torch.lstm(torch.ones(6, 4), sizes, states, weights, True, 1, 0.0, False, False)[0]
        return self.layer(observation) + out.sum() * 0.0


class PackedInSetstate(Packed):
    @torch.jit.export
    def __getstate__(self):
        return 3

    @torch.jit.export
    def __setstate__(self, state: int):
        self.training = bool((self.helper() > 0.0).item())

    def helper(self) -> torch.Tensor:
        sizes = torch.ones(1, dtype=torch.int64).expand(6)
        weights = [torch.ones(12, 4), torch.ones(12, 3), torch.ones(12), torch.ones(12)]
        states = [torch.zeros(1, 6, 3), torch.zeros(1, 6, 3)]
        return torch.lstm(torch.ones(6, 4), sizes, states, weights, True, 1, 0.0, False, False)[0].sum()


@pytest.mark.parametrize(
    ("module", "words"),
    [
        (SlowWithMemory, r"computes \d+\.\d s for one action of one robot; a policy may take 0\.1 s"),
        (Packed, "was not loaded: its code uses aten::lstm with packed sequences"),
        (PackedInSetstate, r"uses lstm\(\) with packed sequences while it is loaded"),
    ],
)
def test_memory_inside_an_operator_and_packed_sequences_are_refused(tmp_path, module, words):
    (tmp_path / "policy.pt").write_bytes(script(module()))
    refused(tmp_path / "policy.pt", words)
