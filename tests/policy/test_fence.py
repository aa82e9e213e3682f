"""Programs of somebody else's that open files, never end, or give what is no action: each ends in one sentence."""

import io
import os
import signal
import subprocess
import sys
import time
import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from gaitgauge.policy.base import PolicyError
from gaitgauge.policy.fence import child as fence_child
from gaitgauge.policy.fence.archive import packed, read_archive
from gaitgauge.policy.fence.script import check_script
from gaitgauge.policy.fenced import FencedPolicy
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import ForeignFile, save_policy
from onnx import TensorProto, helper, numpy_helper
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


def script(module: nn.Module) -> bytes:
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.save(torch.jit.script(module.eval()), buffer)
    return buffer.getvalue()


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


def refused(path: Path, named: str, **options: bool) -> str:
    with pytest.raises(PolicyError, match=named) as caught:
        load_policy(path, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


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


class Plain(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(45, 12)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return self.layer(observation)


def test_a_method_of_its_own_lets_no_operator_through():
    """A class with a method ``set_`` does not make ``set_`` of a tensor a call of its own."""
    records = read_archive(script(Plain()), source="")
    name = next(n for n in records if n.endswith(".py") and b"class Plain" in records[n])
    records[name] += b"  def set_(self: __torch__.Plain, x: Tensor) -> Tensor:\n    return (x).set_(x)\n"
    with pytest.raises(PolicyError, match="set_"):
        check_script(packed(records), source="policy")


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
    monkeypatch.setattr(fence_child, "STEP_SECONDS", 1)
    path = tmp_path / "policy.pt"
    path.write_bytes(script(module()))
    refused(path, "took over 1 s")


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
    # a shell that runs the tests in the background has the signal ignored, and so would Python
    heard = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    ready = "from gaitgauge.policy import fenced, loading; print('ready', flush=True)"
    code = f"{heard}; {ready}; loading.load_policy({str(path)!r})"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        until = time.monotonic() + (30.0 if children.exists() else 2.0)
        while time.monotonic() < until and not (children.exists() and children.read_text()):
            time.sleep(0.02)
        errors = b""
        for _ in range(8):  # Python ignores one that comes while it forks
            time.sleep(0.3)
            process.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                _, errors = process.communicate(timeout=1.0)
                break
    assert b"KeyboardInterrupt" in errors


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
def program(tmp_path, monkeypatch) -> FencedPolicy:
    """A program that is run although its network could be rebuilt."""
    monkeypatch.setattr("gaitgauge.policy.loading.rebuilt", lambda policy: policy)
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


# ---- ONNX -----------------------------------------------------------------------------------------------------------


def graph_file(path: Path, *nodes: onnx.NodeProto, weights=(), output=TensorProto.FLOAT, opsets=()) -> Path:
    inputs = [helper.make_tensor_value_info("obs", TensorProto.FLOAT, ["n", 45])]
    outputs = [helper.make_tensor_value_info("actions", output, ["n", 12])]
    graph = helper.make_graph(list(nodes), "policy", inputs, outputs, list(weights))
    imports = [helper.make_opsetid("", 17), *(helper.make_opsetid(*o) for o in opsets)]
    model = helper.make_model(graph, opset_imports=imports, ir_version=8)
    path.write_bytes(model.SerializeToString())
    return path


WEIGHT = numpy_helper.from_array(np.zeros((45, 12), np.float32), "w")
PRODUCT = helper.make_node("MatMul", ["obs", "w"], ["actions"])


@pytest.mark.parametrize(
    ("node", "named"),
    [
        (helper.make_node("Nose", ["obs"], ["x"], domain="com.example"), "com.example.Nose"),
        (helper.make_node("ImageDecoder", ["obs"], ["x"]), "ImageDecoder"),
        (helper.make_node("PythonOp", ["obs"], ["x"], domain="com.microsoft"), "com.microsoft.PythonOp"),
    ],
)
@pytest.mark.parametrize("deep", [False, True])
def test_operators_beyond_the_list_are_refused_by_name(tmp_path, node, named, deep):
    if deep:
        inner = helper.make_graph([node], "inner", [], [helper.make_tensor_value_info("x", TensorProto.FLOAT, None)])
        node = helper.make_node("If", ["obs"], ["x"], then_branch=inner, else_branch=inner)
    refused(graph_file(tmp_path / "policy.onnx", node, PRODUCT, weights=[WEIGHT]), named)


def outside(location: str, **more: int) -> TensorProto:
    tensor = TensorProto(name="w", dims=[45, 12], data_type=TensorProto.FLOAT, data_location=TensorProto.EXTERNAL)
    for key, value in {"location": location, **more}.items():
        tensor.external_data.add(key=key, value=str(value))
    return tensor


def with_function(path: Path, function: onnx.FunctionProto) -> Path:
    """A file that uses a function of its own in the place of its last operator."""
    node = helper.make_node(function.name, ["product"], ["actions"], domain=function.domain)
    product = helper.make_node("MatMul", ["obs", "w"], ["product"])
    opsets = [(function.domain, 1)] if function.domain else []
    graph_file(path, product, node, weights=[WEIGHT], opsets=opsets)
    model = onnx.load(path)
    model.functions.append(function)
    path.write_bytes(model.SerializeToString())
    return path


@pytest.mark.parametrize(
    ("domain", "name"),
    [("com.microsoft", "Inverse"), ("ai.onnx.ml", "Normalizer"), ("com.ms.internal.nhwc", "Conv"), ("", "Neg")],
)
def test_a_function_does_not_lend_its_name_to_an_operator(tmp_path, domain, name):
    """onnxruntime takes its own operator, where it has one of a function's name."""
    body = [helper.make_node("Neg", ["x"], ["y"])]
    function = helper.make_function(domain, name, ["x"], ["y"], body, [helper.make_opsetid("", 17)])
    refused(with_function(tmp_path / "policy.onnx", function), f"defines {name}")


def test_functions_of_its_own_are_run(tmp_path):
    body = [helper.make_node("Neg", ["x"], ["y"])]
    function = helper.make_function("own", "F", ["x"], ["y"], body, [helper.make_opsetid("", 17)])
    session = load_policy(with_function(tmp_path / "policy.onnx", function)).session(2)
    assert torch.equal(session.act(torch.ones(2, 45)), torch.zeros(2, 12))


def test_graphs_that_a_function_has_by_default_are_read(tmp_path):
    value = helper.make_tensor_value_info("z", TensorProto.FLOAT, None)
    constant = helper.make_node("Constant", [], ["one"], value=numpy_helper.from_array(np.ones((12, 12), np.float32)))
    hidden = helper.make_graph(
        [constant, helper.make_node("Inverse", ["one"], ["z"], domain="com.microsoft")], "g", [], [value]
    )
    harmless = helper.make_graph([helper.make_node("Identity", ["x"], ["z"])], "g", [], [value])
    condition = helper.make_node("Constant", [], ["c"], value=numpy_helper.from_array(np.array(True)))
    choice = helper.make_node("If", ["c"], ["y"], else_branch=harmless)
    choice.attribute.append(
        onnx.AttributeProto(name="then_branch", ref_attr_name="body", type=onnx.AttributeProto.GRAPH)
    )
    sets = [helper.make_opsetid("", 17), helper.make_opsetid("com.microsoft", 1)]
    function = helper.make_function("own", "F", ["x"], ["y"], [condition, choice], sets)
    function.attribute_proto.append(helper.make_attribute("body", hidden))
    refused(with_function(tmp_path / "policy.onnx", function), "com.microsoft.Inverse")


def test_weights_outside_the_folder(tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    (tmp_path / "secret").write_bytes(bytes(45 * 12 * 4))
    (folder / "link").symlink_to(tmp_path / "secret")
    (folder / "loop").symlink_to(folder / "loop")
    for location in ("../secret", str(tmp_path / "secret"), "link", "", "none", "a\0b", "x" * 300, "loop", "/dev/zero"):
        refused(graph_file(folder / "policy.onnx", PRODUCT, weights=[outside(location)]), "folder|lacks")
    (folder / "w").write_bytes(bytes(45 * 12 * 4))
    graph_file(folder / "policy.onnx", PRODUCT, weights=[outside("w")])
    load_policy(folder / "policy.onnx")
    for more in ({"offset": 8}, {"length": 10**12}, {"offset": -4}, {"length": "x"}):
        refused(
            graph_file(folder / "policy.onnx", PRODUCT, weights=[outside("w", **more)]),
            "lacks|no offset|no length|not a usable",
        )


def test_weights_in_a_sparse_file_of_any_size(tmp_path):
    with (tmp_path / "w").open("wb") as file:
        file.truncate(2**40)
    refused(graph_file(tmp_path / "policy.onnx", PRODUCT, weights=[outside("w")]), "512 MiB")


def test_a_constant_of_any_size(tmp_path):
    shape = numpy_helper.from_array(np.array([2**31, 45], np.int64), "shape")
    nodes = [
        helper.make_node("ConstantOfShape", ["shape"], ["large"]),
        helper.make_node("ReduceMax", ["large"], ["most"], axes=[0], keepdims=1),
        helper.make_node("Add", ["obs", "most"], ["sum"]),
        helper.make_node("MatMul", ["sum", "w"], ["actions"]),
    ]
    refused(graph_file(tmp_path / "policy.onnx", *nodes, weights=[WEIGHT, shape]), "policy.onnx")


def test_text_as_action(tmp_path):
    node = helper.make_node("Cast", ["product"], ["actions"], to=TensorProto.STRING)
    product = helper.make_node("MatMul", ["obs", "w"], ["product"])
    refused(graph_file(tmp_path / "policy.onnx", product, node, weights=[WEIGHT], output=TensorProto.STRING), "object")


def test_a_loop_without_an_end(tmp_path, monkeypatch):
    monkeypatch.setattr(fence_child, "STEP_SECONDS", 1)
    value, truth = helper.make_tensor_value_info, TensorProto.BOOL
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["on"]), helper.make_node("Identity", ["v"], ["v2"])],
        "body",
        [value("i", TensorProto.INT64, []), value("go", truth, []), value("v", TensorProto.FLOAT, None)],
        [value("on", truth, []), value("v2", TensorProto.FLOAT, None)],
    )
    true = numpy_helper.from_array(np.array(True), "true")
    nodes = [
        helper.make_node("Loop", ["", "true", "obs"], ["looped"], body=body),
        helper.make_node("MatMul", ["looped", "w"], ["actions"]),
    ]
    refused(graph_file(tmp_path / "policy.onnx", *nodes, weights=[WEIGHT, true]), "took over 1 s")
