"""Networks followed from an ONNX file's graph act as onnxruntime does on it, row by row; what is not understood is named."""

import io
import warnings
from dataclasses import replace

import numpy as np
import onnxruntime
import pytest
import torch
from gaitgauge.policy.contract import History, standard_contract
from gaitgauge.policy.foreign.batched_policy import RebuiltPolicy
from gaitgauge.policy.foreign.batched_program import NotUnderstoodError, ProgramSession
from gaitgauge.policy.foreign.onnx_program import onnx_program
from gaitgauge.policy.loading import load_policy
from onnx import TensorProto, helper, numpy_helper
from torch import nn

EPISODES = 5
CPU = torch.device("cpu")


def exported(module: nn.Module, width: int, *, dynamo: bool) -> bytes:
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        arguments = (module.eval(), (torch.zeros(1, width),), buffer)
        torch.onnx.export(*arguments, dynamo=dynamo, opset_version=18 if dynamo else 11, output_names=["actions"])
    return buffer.getvalue()


def compare(data: bytes, width: int, contract) -> None:
    """Both ways on random rows, the second time far from zero."""
    session = ProgramSession(onnx_program(data, width, source="file"), EPISODES, contract, CPU)
    runtime = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    names = [o.name for o in runtime.get_outputs()]
    wanted, given = "actions" if "actions" in names else names[0], runtime.get_inputs()[0].name
    for scale in (1.0, 5.0):
        rows = scale * torch.randn(EPISODES, width, generator=torch.Generator().manual_seed(2))
        expected = np.concatenate(
            [runtime.run([wanted], {given: row.numpy()})[0].reshape(1, -1) for row in rows.split(1)]
        )
        np.testing.assert_allclose(session.act(rows), expected, rtol=1e-5, atol=1e-5)


@pytest.fixture(scope="module")
def stacked(go2):
    return standard_contract(go2, history=History(length=5, order="term-major"))


class Mixture(nn.Module):
    """Eight experts that do not see the command, and one head: the published ONNX files."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(1)
        self.gate = nn.Sequential(nn.Linear(225, 24), nn.ELU(), nn.Linear(24, 8), nn.Softmax(dim=-1))
        self.trunk = nn.Sequential(nn.Linear(210, 24), nn.ELU(), nn.Linear(24, 8 * 16), nn.ELU())
        self.heads = nn.Conv1d(8 * 16, 8 * 32, kernel_size=1, groups=8)
        self.actor = nn.Sequential(nn.Linear(77, 24), nn.ELU(), nn.Linear(24, 12))
        self.register_buffer("seen", torch.tensor([i not in (6, 7, 8) for i in range(45)]))

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        terms = torch.split(obs, [5 * w for w in (3, 3, 3, 12, 12, 12)], dim=1)
        frames = torch.cat([t.view(-1, 5, t.shape[1] // 5) for t in terms], dim=2)
        blind = frames[:, :, self.seen].reshape(obs.shape[0], -1)
        experts = self.heads(self.trunk(blind).unsqueeze(-1)).squeeze(-1).reshape(-1, 8, 32)
        latent = torch.sum(self.gate(frames.flatten(1)).unsqueeze(-1) * experts, dim=1)
        return self.actor(torch.cat([nn.functional.normalize(latent, dim=-1), frames[:, -1]], dim=1))


@pytest.mark.parametrize("dynamo", [True, False], ids=["today's exporter", "the old exporter"])
def test_acts_as_onnxruntime_does(dynamo, stacked):
    compare(exported(Mixture(), 225, dynamo=dynamo), 225, stacked)


def test_an_exported_policy_is_rebuilt_and_acts_alike(tmp_path):
    from gaitgauge.policy.export.files import export_onnx

    own = load_policy("pretrained")
    export_onnx(own, tmp_path / "policy.onnx")
    policy = load_policy(tmp_path / "policy.onnx")
    assert isinstance(policy, RebuiltPolicy)


def graph(nodes: list, opset: int = 18, **constants: np.ndarray) -> bytes:
    made = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("obs", TensorProto.FLOAT, [1, 12])],
        [helper.make_tensor_value_info("actions", TensorProto.FLOAT, None)],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    return helper.make_model(made, opset_imports=[helper.make_opsetid("", opset)], ir_version=8).SerializeToString()


def node(kind: str, *inputs: str, out: str | list[str] = "actions", **attributes: object):
    return helper.make_node(kind, list(inputs), [out] if isinstance(out, str) else out, **attributes)


def numbers(*values: int) -> np.ndarray:
    return np.array(values, dtype=np.int64)


SMALL = np.linspace(-1.0, 1.0, 12, dtype=np.float32)
ONE = {
    name: [node(name, "obs")] for name in ("Abs", "Ceil", "Cos", "Elu", "Erf", "Exp", "Floor", "Identity", "LeakyRelu")
}
ONE |= {
    name: [node(name, "obs")] for name in ("Neg", "Relu", "Selu", "Sigmoid", "Sign", "Sin", "Softmax", "LogSoftmax")
}
ONE |= {
    name: [node(name, "obs")] for name in ("Softplus", "Softsign", "Tan", "Tanh", "HardSigmoid", "HardSwish", "Mish")
}
ONE |= {name: [node(name, "obs", "c")] for name in ("Add", "Sub", "Mul", "Div", "Max", "Min", "PRelu")}
ONE |= {name: [node(name, "obs", "c", out="b"), node("Cast", "b", to=1)] for name in ("Less", "Greater", "LessOrEqual")}
for name in (
    "ReduceL1",
    "ReduceL2",
    "ReduceLogSumExp",
    "ReduceMax",
    "ReduceMean",
    "ReduceMin",
    "ReduceSum",
    "ReduceSumSquare",
):
    ONE[name] = [node(name, *(["obs", "axis"]), out="r", keepdims=0), node("Add", "r", "c")]
MANY = {
    "alpha of Elu": [node("Elu", "obs", alpha=0.3)],
    "LpNormalization": [node("LpNormalization", "obs", axis=1, p=2)],
    "LayerNormalization": [node("LayerNormalization", "obs", "c", "c")],
    "Clip": [node("Clip", "obs", "low", "high")],
    "Clip above": [node("Clip", "obs", "", "high")],
    "Pow": [node("Pow", "obs", "two")],
    "Sqrt, Log, Reciprocal": [
        node("Mul", "obs", "obs", out="s"),
        node("Add", "s", "two", out="p"),
        node("Sqrt", "p", out="q"),
        node("Log", "q", out="l"),
        node("Reciprocal", "l"),
    ],
    "Where": [node("Greater", "obs", "c", out="b"), node("Where", "b", "obs", "c")],
    "Gemm with factors": [node("Gemm", "obs", "square", "c", alpha=0.5, beta=2.0)],
    "Gemm without offset": [node("Gemm", "obs", "square", transB=1)],
    "Gather and Concat": [node("Gather", "obs", "back", axis=1, out="g"), node("Concat", "g", "g", axis=1)],
    "Gather of one": [
        node("Gather", "obs", "one", axis=1, out="g"),
        node("Mul", "g", "c", out="m"),
        node("Reshape", "m", "row"),
    ],
    "Slice backwards": [node("Slice", "obs", "from", "to", "axes", "steps")],
    "Split": [node("Split", "obs", out=["a", "b", "d"], axis=1, num_outputs=3), node("Concat", "d", "a", "b", axis=1)],
    "Split by lengths": [node("Split", "obs", "parts", out=["a", "b"], axis=1), node("Concat", "b", "a", axis=1)],
    "Shapes": [
        node("Shape", "obs", out="s"),
        node("Gather", "s", "one", out="n"),
        node("Unsqueeze", "n", "zero", out="u"),
        node("Concat", "u", "ones", axis=0, out="w"),
        node("Reshape", "obs", "w", out="tall"),
        node("Transpose", "tall", perm=[1, 0]),
    ],
    "Expand and Squeeze": [
        node("Unsqueeze", "obs", "zero", out="u"),
        node("Expand", "u", "wide", out="e"),
        node("ReduceSum", "e", "zero", out="r"),
        node("Squeeze", "r", "zero"),
    ],
    "ConstantOfShape and Tile": [
        node("ConstantOfShape", "single", out="z"),
        node("Tile", "z", "twelve", out="t"),
        node("Add", "obs", "t"),
    ],
    "Flatten": [node("Unsqueeze", "obs", "zero", out="u"), node("Flatten", "u", axis=2)],
}
CONSTANTS = {
    "c": SMALL,
    "square": np.outer(SMALL, SMALL[::-1]).astype(np.float32),
    "low": np.array(-0.5, np.float32),
    "high": np.array(0.25, np.float32),
    "two": np.array(2.0, np.float32),
    "one": np.array(1, np.int64),
    "zero": numbers(0),
    "axis": numbers(1),
    "ones": numbers(1),
    "back": numbers(-1, 3, 5, 0, -6, 2),
    "row": numbers(1, -1),
    "from": numbers(-1),
    "to": numbers(-13),
    "axes": numbers(1),
    "steps": numbers(-1),
    "parts": numbers(5, 7),
    "wide": numbers(3, 1, 12),
    "single": numbers(1),
    "twelve": numbers(12),
}


def of_twelve_entries(contract):
    return replace(contract, observation=tuple(t for t in contract.observation if t.name == "joint_position"))


@pytest.mark.parametrize("name", [*ONE, *MANY])
def test_operators_act_as_onnxruntime_does(name, contract):
    compare(graph({**ONE, **MANY}[name], **CONSTANTS), 12, of_twelve_entries(contract))


@pytest.mark.parametrize(
    ("nodes", "reason"),
    [
        ([node("RandomNormalLike", "obs")], "RandomNormalLike"),
        ([node("If", "obs")], "'If'"),
        ([node("ArgMax", "obs", axis=1)], "ArgMax"),
        ([node("NonZero", "obs", out="n"), node("Cast", "n", to=1)], "depends on what it observes"),
        (
            [node("ConstantOfShape", "huge", out="h"), node("ReduceSum", "h", out="r"), node("Add", "obs", "r")],
            "memory",
        ),
    ],
    ids=["random", "if", "argmax", "chosen", "huge"],
)
def test_what_is_not_understood_is_named(nodes, reason):
    with pytest.raises(NotUnderstoodError, match=reason):
        onnx_program(graph(nodes, **CONSTANTS, huge=numbers(1 << 20, 1 << 20)), 12, source="file")
