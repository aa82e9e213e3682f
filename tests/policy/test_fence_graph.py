"""ONNX files with operators, functions or weights that are none of a policy's: each ends in one sentence."""

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from foreign_programs import refused
from gaitgauge.policy.foreign.fence import child as fence_child
from gaitgauge.policy.loading import load_policy
from onnx import TensorProto, helper, numpy_helper


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


@pytest.mark.slow  # the same clock as that of test_fence_process.py
def test_a_loop_without_an_end(tmp_path, monkeypatch):
    monkeypatch.setattr(fence_child, "STEP_SECONDS", 0)  # 1 s, which the system counts from a process's start
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
    refused(graph_file(tmp_path / "policy.onnx", *nodes, weights=[WEIGHT, true]), "took over 0 s")
