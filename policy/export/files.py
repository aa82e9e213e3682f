"""Exports of the project's own policies: TorchScript, ONNX and the ``deploy.yaml`` of the robot's C++ runtime.

Every export is compared with the policy it was made from before it gets its name, in place of a file that has it: an export
that acts differently is never left behind. Functions return the largest difference of an action to the policy's.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import onnx
import torch
import yaml

from ...files.writing import make_folder, replacing, same_file
from ...robots import Robot
from ..base import PROBE_EPISODES, Policy, PolicyError
from ..comparing import difference
from ..contract import HistoryOrder, ObservationTerm, PolicyContract
from ..foreign.deploy_yaml import deploy_contract
from ..foreign.fence.script import CONTRACT_FILE
from ..loading import load_policy
from ..native import NativePolicy
from ..networks.architectures import MlpNetwork
from ..observation import term_major_order
from ..observation_table import observation
from .modules import SCRIPTS, Explained, TermMajor

PARTS = ("torchscript", "onnx", "deploy")
"""Parts that ``export_policy`` writes."""
TOLERANCE = 1e-5
"""Largest difference of an action between an export and its policy."""
CHECK_STEPS = 16
WIDE = 100.0
"""Clip of the published controller's files where nothing is to be clipped [SI units, radians]: far beyond what a robot
measures, is commanded or may be sent.
"""
ONNX_OPSET, ONNX_IR_VERSION = 17, 8
"""Versions that onnxruntime 1.16 reads, which the published C++ controller prescribes on the robot."""


class ExportError(PolicyError):
    """A policy cannot be exported; the message says why."""


def export_torchscript(policy: Policy, path: str | Path) -> float:
    """Write a TorchScript file for one robot: one observation (1, F) in, the history inside, ``reset()`` to clear it.

    The output is that of the published training code, so that the file runs unchanged in the published evaluation:
    the actions alone for a perceptron, ``(actions, (None, latent))`` for a network with a latent, ``(actions, (gate weights,
    latent))`` for one with experts. The contract lies in the archive as ``contract.json``.

    Raises:
        ExportError: the policy is foreign or recurrent, the file cannot be written, or it acts differently.
    """
    network = _network(policy)
    contract = policy.contract
    history = torch.zeros(1, network.history_length, network.frame_width)
    start = torch.full_like(history, math.nan) if contract.history.start == "repeat" else history
    core = network if isinstance(network, MlpNetwork) else Explained(network)
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # torch announces TorchScript's retirement; the published evaluation and many deployments read nothing else.
        warnings.simplefilter("ignore", DeprecationWarning)
        traced = torch.jit.trace(core.eval(), history, check_trace=False)
        script = torch.jit.script(SCRIPTS[type(network)](traced, start).eval())
        torch.jit.save(script, buffer, _extra_files={CONTRACT_FILE: contract.to_json()})
    return _write_checked(policy, Path(path), buffer.getvalue(), partial(_largest_difference, policy))


def export_onnx(policy: Policy, path: str | Path) -> float:
    """Write a stateless ONNX file: ``obs`` (1, H·F), term by term and oldest first within a term, to ``actions`` (1,
    J).

    The metadata hold the contract in full precision under ``contract``, and what mjlab's runtime reads under its own
    names, where these can say it (see ``mjlab_metadata``).

    Raises:
        ExportError: the policy is foreign or recurrent, the file cannot be written, or it acts differently.
    """
    network = _network(policy)
    frames = network.history_length
    module = TermMajor(network, term_major_order(policy.contract, frames)).eval()
    contract = stacked_contract(policy.contract, frames)
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # torch announces the retirement of this exporter; its successor writes no opset below 18.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module,
            (torch.zeros(1, contract.observation_width),),
            buffer,  # type: ignore[arg-type]
            input_names=["obs"],
            output_names=["actions"],
            opset_version=ONNX_OPSET,
            dynamo=False,
        )
    model = onnx.load_model_from_string(buffer.getvalue())
    model.ir_version = ONNX_IR_VERSION
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, {"contract": contract.to_json(), **mjlab_metadata(contract)})
    return _write_checked(policy, Path(path), model.SerializeToString(), partial(_largest_difference, policy))


def export_deploy(policy: Policy, path: str | Path, robot: Robot, *, finite_clips: bool = False) -> float:
    """Write the ``deploy.yaml`` with which the robot's C++ runtime runs the ONNX file; it is read back and compared.

    The runtime fills the history with the first observation; ``first_steps`` says what that changes.

    With ``finite_clips``, what the contract does not clip is clipped to ``WIDE``.

    Raises:
        ExportError: the robot's own joint numbers are not known, or the file cannot say what the contract says.
    """
    contract = stacked_contract(policy.contract, _network(policy).history_length)
    settings = deploy_settings(contract, robot, finite_clips=finite_clips)
    text = yaml.safe_dump(settings, sort_keys=False, default_flow_style=None, width=120)
    expected = _with_wide_clips(contract) if finite_clips else contract

    def check(written: Path) -> float:
        wanted = replace(_spelled_out(expected), history=replace(contract.history, start="repeat"))
        if lines := difference(wanted, _spelled_out(deploy_contract(written, robot))):
            raise ExportError(f"a deploy.yaml cannot express this policy's contract: {lines.splitlines()[0]}")
        return 0.0

    return _write_checked(policy, Path(path), text.encode(), check)


def export_unitree(policy: Policy, folder: str | Path, robot: Robot) -> dict[Path, float]:
    """Write the folder that the published C++ controller is pointed at: ``exported/policy.onnx`` and ``params/deploy.yaml``.

    Raises:
        ExportError: see ``export_onnx`` and ``export_deploy``.
    """
    graph, deploy = Path(folder) / "exported" / "policy.onnx", Path(folder) / "params" / "deploy.yaml"
    for folder_of in (graph.parent, deploy.parent):
        make_folder(folder_of, ExportError)
    return {graph: export_onnx(policy, graph), deploy: export_deploy(policy, deploy, robot, finite_clips=True)}


def first_steps(policy: Policy) -> str | None:
    """Return one sentence on the C++ runtime's different start; None where it starts as the policy was trained."""
    frames = _network(policy).history_length
    if frames == 1 or policy.contract.history.start == "repeat":
        return None
    return (
        f"the policy was trained on a history that begins with zeros, the controller fills it with the first observation: "
        f"its first {frames - 1} actions differ from the gauge's, later ones are the same for the same observations"
    )


def export_policy(
    policy: Policy, folder: str | Path, robot: Robot, parts: Collection[str] = PARTS
) -> dict[Path, float]:
    """Write ``policy.pt`` (TorchScript), ``policy.onnx`` and ``deploy.yaml`` into a folder, or some of these ``PARTS``.

    Raises:
        ExportError: see the three exports.
    """
    target = Path(folder)
    make_folder(target, ExportError)
    exports: dict[str, tuple[Path, Callable[[Policy, Path], float]]] = {
        "torchscript": (target / "policy.pt", export_torchscript),
        "onnx": (target / "policy.onnx", export_onnx),
        "deploy": (target / "deploy.yaml", partial(export_deploy, robot=robot)),
    }
    return {path: export(policy, path) for part, (path, export) in exports.items() if part in parts}


def stacked_contract(contract: PolicyContract, frames: int) -> PolicyContract:
    """Return the contract of a network that is handed its whole history, term by term."""
    order: HistoryOrder = "term-major" if frames > 1 else "frame-major"
    return replace(contract, history=replace(contract.history, length=frames, order=order))


def mjlab_metadata(contract: PolicyContract) -> dict[str, str]:
    """Return metadata under mjlab's names. Lists are joined by commas; a term with a scale per entry joins them by semicolons.

    mjlab clips a whole term to one magnitude, and does it before scaling; nothing is returned for a contract that needs more than
    that, or has an observation without a name or a layout that it cannot say, so that its runtime refuses the file.
    """

    def numbers(values: tuple[float, ...]) -> str:
        return ",".join(repr(v) for v in values)

    terms = contract.observation
    limits = [_limit_before_scaling(term) for term in terms]
    names = [observation(term.name).foreign_names[:1] for term in terms]
    further = (
        contract.velocity_joints
        or contract.scan_points
        or contract.action_offset
        or contract.layout
        or contract.memory
        or any(t.reference or t.values for t in terms)
    )
    if None in limits or () in names or further:
        return {}
    return {
        "run_path": str(contract.provenance.get("run", "")),
        "joint_names": ",".join(contract.joint_names),
        "joint_stiffness": numbers(contract.stiffness),
        "joint_damping": numbers(contract.damping),
        "default_joint_pos": numbers(contract.default_joint_position),
        "command_names": "twist",
        "observation_names": ",".join(name for (name,) in names),
        "observation_terms_scale": ",".join(";".join(repr(s) for s in term.scale) for term in terms),
        "observation_terms_clip": ",".join(f"-{limit!r};{limit!r}" for limit in limits),
        "observation_terms_history_length": ",".join([str(contract.history.length)] * len(terms)),
        "observation_terms_flatten_history_dim": ",".join(["True"] * len(terms)),
        "action_scale": numbers(contract.action_scale),
    }


def _limit_before_scaling(term: ObservationTerm) -> float | None:
    """Return the magnitude of a term's clip before scaling, infinity for no clip; None if its entries have different ones."""
    if term.clip is None:
        return math.inf
    width = max(len(_every(term.clip, 1)), len(term.scale))
    pairs = zip(_every(term.clip, width), _every(term.scale, width), strict=True)
    limits = [clip / abs(scale) for clip, scale in pairs if scale]  # a term scaled by zero is zero, clipped or not
    largest = max(limits, default=math.inf)
    return largest if math.isclose(min(limits, default=math.inf), largest) else None


def deploy_settings(contract: PolicyContract, robot: Robot, *, finite_clips: bool = False) -> dict[str, Any]:
    """Return the table of a ``deploy.yaml``; gains in the order of the robot's SDK, all else in the policy's.

    With ``finite_clips``, what the contract does not clip is clipped to ``WIDE``.

    Raises:
        ExportError: the SDK's joint order is not known for this robot.
    """
    numbered = robot.sdk_joint_names
    if numbered is None:
        raise ExportError(
            f"a deploy.yaml numbers joints as the maker's SDK does, which the description of robot '{robot.name}' does not "
            "say; add sdk_joint_names to its robot.toml"
        )
    if held := [name for name in numbered if name not in contract.joint_names]:
        raise ExportError(
            f"a deploy.yaml's controller drives every joint, and this policy leaves {len(held)} to be held, as '{held[0]}'; leave "
            "deploy.yaml out"
        )
    sdk = [numbered.index(name) for name in contract.joint_names]
    policy = [contract.joint_names.index(name) for name in numbered]
    clipped = any(term.clip is not None for term in contract.observation)
    unclipped = WIDE if finite_clips else None
    observations: dict[str, Any] = {"scale_first": True} if clipped else {}

    def clips(limit: float | None) -> list[float] | None:
        return None if limit is None else [-limit, limit]

    for term, width in zip(contract.observation, contract.term_widths, strict=True):
        if isinstance(term.clip, tuple):
            raise ExportError(
                f"a deploy.yaml has one clip for all entries of an observation; '{term.name}' has {len(term.clip)}"
            )
        names = observation(term.name).foreign_names
        if observation(term.name).exteroceptive:
            raise ExportError(
                f"a deploy.yaml's controller has no map of the ground, which '{term.name}' needs; leave deploy.yaml out"
            )
        if not names:
            raise ExportError(
                f"a deploy.yaml has no name for the observation '{term.name}'; give it foreign_names, or leave deploy.yaml out"
            )
        observations[names[0]] = {
            "params": {"command_name": "base_velocity"} if term.name == "command" else {},
            "clip": clips(term.clip or unclipped),
            "scale": list(term.scale) if len(term.scale) == width else list(term.scale) * width,
            "history_length": contract.history.length,
        }
    targets: list[Any] = [list(r) for r in contract.target_range or ()]
    targets = targets or [clips(unclipped) for _ in contract.joint_names]
    limits = zip(("lin_vel_x", "lin_vel_y", "ang_vel_z"), contract.command_limits, strict=True)
    return {
        "joint_ids_map": sdk,
        "step_dt": contract.control_period,
        "stiffness": [contract.stiffness[i] for i in policy],
        "damping": [contract.damping[i] for i in policy],
        "default_joint_pos": list(contract.default_joint_position),
        "commands": {
            "base_velocity": {"ranges": {name: [-limit, limit] for name, limit in limits} | {"heading": None}}
        },
        "actions": _actions(contract, targets if contract.target_range or finite_clips else None),
        "observations": observations,
    }


def _actions(contract: PolicyContract, targets: list[Any] | None) -> dict[str, Any]:
    """Return the actions of a ``deploy.yaml``; ``targets``: lowest and highest target of each joint. ``ExportError``: wheels come first."""
    names, wheels = list(contract.joint_names), contract.velocity_joints
    if not wheels:
        groups: dict[str, list[str] | None] = {"JointPositionAction": None}
    else:
        groups = {
            "JointPositionAction": [n for n in names if n not in wheels],
            "JointVelocityAction": [n for n in names if n in wheels],
        }
        if [n for group in groups.values() for n in group or ()] != names:
            raise ExportError(
                "a deploy.yaml drives legs first and wheels last; this policy's joints stand in another order"
            )

    def entry(group: list[str] | None) -> dict[str, Any]:
        ids = range(len(names)) if group is None else [names.index(n) for n in group]
        return {
            "clip": None if targets is None else [targets[i] for i in ids],
            "joint_names": group or [".*"],
            "scale": [contract.action_scale[i] for i in ids],
            "offset": [contract.default_joint_position[i] for i in ids],
            "joint_ids": None if group is None else list(ids),
        }

    return {kind: entry(group) for kind, group in groups.items()}


def _spelled_out(contract: PolicyContract) -> PolicyContract:
    """Return the same contract with a scale and a clip for every single entry, so that two can be compared."""
    terms = tuple(
        replace(term, scale=_every(term.scale, width), clip=term.clip and _every(term.clip, width))
        for term, width in zip(contract.observation, contract.term_widths, strict=True)
    )
    return replace(contract, observation=terms)


def _every(values: float | tuple[float, ...], width: int) -> tuple[float, ...]:
    """Return a value for every entry of a term."""
    listed = values if isinstance(values, tuple) else (values,)
    return listed * width if len(listed) == 1 else listed


def _with_wide_clips(contract: PolicyContract) -> PolicyContract:
    """Return the contract with the clips that ``deploy_settings`` writes where there are none."""
    clipped = any(term.clip is not None for term in contract.observation)
    terms = tuple(
        t if t.clip is not None else replace(t, clip=WIDE if clipped else tuple(WIDE * abs(s) for s in t.scale))
        for t in contract.observation
    )
    return replace(
        contract, observation=terms, target_range=contract.target_range or ((-WIDE, WIDE),) * contract.num_joints
    )


def _network(policy: Policy) -> Any:
    if not isinstance(policy, NativePolicy):
        raise ExportError(
            f"'{policy.path}' is an exported file already; export a checkpoint of the project's own format"
        )
    if type(policy.network) not in SCRIPTS:
        raise ExportError(f"no export is known for the network {type(policy.network).__name__} of '{policy.path}'")
    return policy.network


def _largest_difference(policy: Policy, written: Path) -> float:
    """Run both on the same random observations, with a reset on the way, as the gauge would run them.

    The export plays for as many robots as loading recorded it for; all of them see the same.
    """
    exported = load_policy(written)
    contract, stacked = policy.contract, exported.contract
    frames = stacked.history.length
    order = term_major_order(contract, frames)
    ours, theirs = policy.session(1), exported.session(PROBE_EPISODES)
    generator = torch.Generator().manual_seed(0)
    history = torch.zeros(1, frames, contract.frame_width)
    repeat = contract.history.start == "repeat"
    largest = 0.0
    for step in range(CHECK_STEPS):
        frame = torch.randn(1, contract.frame_width, generator=generator)
        if step in (0, CHECK_STEPS // 2):
            ours.reset()
            theirs.reset()
            history = frame.expand_as(history) if repeat else torch.zeros_like(history)
        history = torch.cat((history[:, 1:], frame[:, None]), dim=1)
        given = torch.empty(PROBE_EPISODES, history.numel())
        given[:, order] = history.flatten(1)
        theirs_now = theirs.act(given if frames > 1 else frame.expand(PROBE_EPISODES, -1))
        largest = max(largest, float((ours.act(frame) - theirs_now).abs().max()))
    if not largest <= TOLERANCE:
        raise ExportError(
            f"the export of '{policy.path}' differs from it by {largest:.2g} in an action; {TOLERANCE:g} is allowed"
        )
    return largest


def _write_checked(policy: Policy, path: Path, data: bytes, check: Callable[[Path], float]) -> float:
    """Write beside the destination, check, and only then give it its name, which is not that of the policy."""
    if same_file(path, policy.path):
        raise ExportError(f"'{path}' is the policy that is to be exported; choose another folder (--out)")
    with replacing(path, ExportError) as partial:
        partial.write_bytes(data)
        return check(partial)
