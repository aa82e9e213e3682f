"""Writes the seeds of the policy parsers: ``python tests/fuzz/make_seeds.py``. They are committed; run it to add some."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import onnx
import torch
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.export.files import deploy_settings, stacked_contract
from gaitgauge.policy.native import ForeignFile, StoredNetwork, save_policy
from gaitgauge.policy.networks.architectures import CtsNetwork, MlpNetwork
from gaitgauge.robots import load_robot
from onnx import TensorProto, helper, numpy_helper
from torch import nn

SEEDS = Path(__file__).parent / "seeds"


class History(nn.Module):
    """A history inside, and a loop over it."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(45, 12)
        self.history = torch.zeros(1, 3, 45)

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
        self.history = torch.cat((self.history[:, 1:], observation.unsqueeze(1)), dim=1)
        kept: list[torch.Tensor] = []
        for step in range(self.history.size(1)):
            kept.append(torch.tanh(self.layer(self.history[:, step])))  # noqa: PERF401  (as TorchScript takes it)
        return torch.stack(kept).mean(dim=0), kept

    @torch.jit.export
    def reset(self) -> None:
        self.history.zero_()


def main() -> None:
    import yaml

    torch.manual_seed(0)
    robot = load_robot("go2")
    contract = standard_contract(robot)

    def place(name: str, file: str) -> Path:
        (SEEDS / name).mkdir(parents=True, exist_ok=True)
        return SEEDS / name / file

    small = {"frame_width": 45, "num_actions": 12, "hidden": [4]}
    mlp = StoredNetwork(architecture="mlp", arguments=small, state_dict=MlpNetwork(**small).state_dict())
    save_policy(place("policy-own", "mlp.gauge.pt"), contract, mlp)
    thin = {"latent_width": 2, "encoder_hidden": [2], "actor_hidden": [2], "history_length": 2}
    cts = StoredNetwork(architecture="cts", arguments=thin, state_dict=CtsNetwork(**thin).state_dict())
    save_policy(place("policy-own", "cts.gauge.pt"), contract, cts)

    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.save(torch.jit.script(History().eval()), buffer, _extra_files={"contract.json": contract.to_json()})
    place("policy-torchscript", "history.pt").write_bytes(buffer.getvalue())
    save_policy(
        place("policy-own", "foreign.gauge.pt"), contract, ForeignFile(kind="torchscript", data=buffer.getvalue())
    )

    weight = numpy_helper.from_array(torch.randn(45, 12).numpy(), "w")
    nodes = [helper.make_node("MatMul", ["obs", "w"], ["x"]), helper.make_node("Tanh", ["x"], ["actions"])]
    values = [helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, k]) for n, k in (("obs", 45), ("actions", 12))]
    graph = helper.make_graph(nodes, "policy", values[:1], values[1:], [weight])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.helper.set_model_props(model, {"contract": contract.to_json()})
    place("policy-onnx", "tanh.onnx").write_bytes(model.SerializeToString())

    layers = MlpNetwork(**small).state_dict()
    state = {name.replace("network.", "actor."): value for name, value in layers.items()}
    extra = {"obs_normalizer._mean": torch.zeros(1, 45), "obs_normalizer._std": torch.ones(1, 45)}
    checkpoint = {
        "model_state_dict": {**state, **extra},
        "optimizer_state_dict": {"state": {}},
        "iter": 1,
        "infos": None,
    }
    with place("policy-rsl-rl", "model_1.pt").open("wb") as file:
        torch.save(checkpoint, file)
    settings = yaml.safe_dump(deploy_settings(stacked_contract(contract, 5), robot), sort_keys=False)
    place("policy-deploy", "deploy.yaml").write_text(settings)
    place("policy-contract", "contract.json").write_text(contract.to_json())


if __name__ == "__main__":
    main()
