"""Makes small policies of other projects, and plays them beside their own networks on observations made by hand."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
import yaml
from gaitgauge.backends.base import PhysicsState
from gaitgauge.policy.native import FilePolicy
from gaitgauge.policy.observation import ObservationBuilder
from gaitgauge.robots import Robot, load_robot
from onnx import TensorProto, helper, numpy_helper
from test_observation import make_state
from torch import nn

GO2 = load_robot("go2")
EPISODES, STEPS, RESET_AT = 6, 9, 5
DEFAULT = np.array(GO2.default_joint_position)


@dataclass(frozen=True)
class Step:
    """What a robot measures at one control step, joints in the robot's order, as float64 arrays (N, …)."""

    turning: np.ndarray
    gravity: np.ndarray
    command: np.ndarray
    joints: np.ndarray
    speeds: np.ndarray
    state: PhysicsState


def steps() -> list[Step]:
    """Random measurements, other ones at each step; some commands are zero."""
    found = []
    for number in range(STEPS):
        state = make_state(number)
        command = np.random.default_rng(number).normal(size=(EPISODES, 3))
        command[number % EPISODES] = 0.0
        w, x, y, z = state.base_quaternion_w.numpy().T
        gravity = np.stack((2 * (w * y - x * z), -2 * (y * z + w * x), 2 * (x * x + y * y) - 1), axis=1)
        turning, joints = state.base_angular_velocity_b.numpy(), state.joint_position.numpy()
        found.append(Step(turning, gravity, command, joints, state.joint_velocity.numpy(), state))
    return found


Frame = Callable[[Step, np.ndarray, int], Sequence[np.ndarray]]
"""Terms of a frame from a step, the last action (N, J), and the control steps since the reset."""


def standard(step: Step, last: np.ndarray, age: int) -> list[np.ndarray]:
    """The terms of the standard observation, all scales 1."""
    return [step.turning, step.gravity, step.command, step.joints - DEFAULT, step.speeds, last]


def check(
    policy: FilePolicy,
    frame: Frame,
    stack: Callable[[list], np.ndarray],
    run: Callable,
    clip: float = np.inf,
    tolerance: float = 2e-3,
    robot: Robot = GO2,
) -> None:
    """Play the policy on all steps, with a reset on the way, and compare with ``run`` on inputs that ``stack`` makes of frames.

    Args:
        frame: terms of the present frame.
        stack: the network's input of all frames since the reset, each a list of terms, oldest first.
        run: actions (N, J) of the file's own network for that input, given also whether this is the first step.
        clip: of the last action.
    """
    builder, session = ObservationBuilder(policy.contract, robot, EPISODES), policy.session(EPISODES)
    last, frames = torch.zeros(EPISODES, policy.contract.num_joints), []
    for number, step in enumerate(steps()):
        if number in (0, RESET_AT):
            builder.reset()
            session.reset()
            last, frames = torch.zeros_like(last), []
        shown = last.numpy().clip(-clip, clip)
        frames.append([np.asarray(v, np.float32) for v in frame(step, shown, len(frames))])
        expected = run(torch.from_numpy(stack(frames)), len(frames) == 1)
        last = session.act(builder.build(step.state, torch.from_numpy(step.command).float(), last))
        np.testing.assert_allclose(last.numpy(), expected.detach().numpy(), atol=tolerance, rtol=tolerance)


def newest(frames: list) -> np.ndarray:
    return np.concatenate(frames[-1], axis=1)


def last_frames(frames: list, length: int) -> list:
    """The last frames, with zeros for those before the first one."""
    zeros = [np.zeros_like(term) for term in frames[0]]
    return [zeros] * (length - len(frames)) + frames[-length:]


def frame_major(frames: list, length: int) -> np.ndarray:
    return np.concatenate([term for frame in last_frames(frames, length) for term in frame], axis=1)


def term_major(frames: list, length: int, *, newest_first: bool = False) -> np.ndarray:
    kept = last_frames(frames, length)[:: -1 if newest_first else 1]
    return np.concatenate([frame[i] for i in range(len(kept[0])) for frame in kept], axis=1)


def network(inputs: int, outputs: int = 12, *, width: int = 16) -> nn.Sequential:
    torch.manual_seed(inputs)
    return nn.Sequential(nn.Linear(inputs, width), nn.ELU(), nn.Linear(width, outputs)).requires_grad_(False)


def script(path: Path, module: nn.Module) -> Path:
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.save(torch.jit.script(module.eval()), buffer)
    path.write_bytes(buffer.getvalue())
    return path


def described(folder: Path, text: str) -> None:
    (folder / "contract.toml").write_text(text)


UNIT = """observation = [
  { name = "base_angular_velocity_b" }, { name = "projected_gravity_b" }, { name = "command" },
  { name = "joint_position" }, { name = "joint_velocity" }, { name = "last_action" },
]
"""


def simply(module: nn.Module) -> Callable:
    return lambda inputs, first: module(inputs)


class TwoArguments(nn.Module):
    """A network on the present frame and on a history."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder, self.actor = network(225, 8), network(53)

    def forward(self, obs: torch.Tensor, hist: torch.Tensor) -> torch.Tensor:
        return self.actor(torch.cat((obs, self.encoder(hist)), dim=-1))


def tensors(module: nn.Module, prefix: str, dtype: Any = np.float32) -> list[onnx.TensorProto]:
    """The weights of two linear layers, named ``<prefix>w0`` …"""
    layers = [layer for layer in module if isinstance(layer, nn.Linear)]
    pairs = [
        (f"{prefix}{kind}{i}", value)
        for i, n in enumerate(layers)
        for kind, value in (("w", n.weight.T), ("b", n.bias))
    ]
    return [numpy_helper.from_array(np.ascontiguousarray(v.numpy().astype(dtype)), name) for name, v in pairs]


def layers_of(prefix: str, source: str, target: str) -> list[onnx.NodeProto]:
    """The nodes of a perceptron of two layers."""
    return [
        helper.make_node("MatMul", [source, f"{prefix}w0"], [f"{prefix}1"]),
        helper.make_node("Add", [f"{prefix}1", f"{prefix}b0"], [f"{prefix}2"]),
        helper.make_node("Elu", [f"{prefix}2"], [f"{prefix}3"]),
        helper.make_node("MatMul", [f"{prefix}3", f"{prefix}w1"], [f"{prefix}4"]),
        helper.make_node("Add", [f"{prefix}4", f"{prefix}b1"], [target]),
    ]


def save_onnx(
    path: Path, nodes: list, inputs: dict, outputs: dict, weights: list, kind: int = TensorProto.FLOAT
) -> Path:
    def infos(named: dict) -> list:
        return [helper.make_tensor_value_info(name, kind, shape) for name, shape in named.items()]

    graph = helper.make_graph(nodes, "policy", infos(inputs), infos(outputs), weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    path.write_bytes(model.SerializeToString())
    return path


ISAAC = tuple(f"{leg}_{kind}_joint" for kind in ("hip", "thigh", "calf") for leg in ("FL", "FR", "RL", "RR"))
"""Joints of the Go2 as Isaac Lab lists them."""
SDK_OF_ISAAC = [3, 0, 9, 6, 4, 1, 10, 7, 5, 2, 11, 8]
STANDING = [0.1, -0.1, 0.1, -0.1, 0.8, 0.8, 1.0, 1.0, -1.5, -1.5, -1.5, -1.5]
IN_ISAAC = [GO2.joint_names.index(name) for name in ISAAC]


def isaac(step: Step, last: np.ndarray, age: int) -> list[np.ndarray]:
    """Terms of Isaac Lab's order, as its velocity task scales them in a deploy.yaml."""
    joints = step.joints[:, IN_ISAAC] - STANDING
    return [0.2 * step.turning, step.gravity, step.command, joints, 0.05 * step.speeds[:, IN_ISAAC], last]


def deploy(**changes: Any) -> str:
    """A deploy.yaml as unitree_rl_lab writes it."""
    scales = {"base_ang_vel": 0.2, "joint_vel_rel": 0.05}
    names = ("base_ang_vel", "projected_gravity", "velocity_commands", "joint_pos_rel", "joint_vel_rel", "last_action")
    terms = {n: {"params": {}, "clip": [-100, 100], "scale": scales.get(n, 1.0), "history_length": 1} for n in names}
    action = {"clip": None, "joint_names": [".*"], "scale": 0.25, "offset": STANDING, "joint_ids": None}
    ranges = {"lin_vel_x": [-1.0, 1.0], "lin_vel_y": [-0.4, 0.4], "ang_vel_z": [-1.0, 1.0], "heading": None}
    data = {
        "joint_ids_map": SDK_OF_ISAAC,
        "step_dt": 0.02,
        "stiffness": [25.0] * 12,
        "damping": [0.5] * 12,
        "default_joint_pos": STANDING,
        "commands": {"base_velocity": {"ranges": ranges}},
        "actions": {"JointPositionAction": action | changes.get("action", {})} | changes.get("actions", {}),
        "observations": terms | changes.get("terms", {}),
    }
    return yaml.safe_dump(data, sort_keys=False)
