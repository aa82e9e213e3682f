"""Reads the actor of a bare rsl_rl checkpoint, of versions 1 to 5 and of legged_gym.

==================  ====================================================  =========================================
version             weights                                               normaliser
==================  ====================================================  =========================================
1, 2, legged_gym    ``model_state_dict``: ``actor.*``, ``student.*``,     ``obs_norm_state_dict`` beside it
                    ``memory_a.rnn.*``, ``memory_s.rnn.*``
3                   the same                                              ``actor_obs_normalizer.*`` inside
4, 5                ``actor_state_dict``, ``student_state_dict``:         ``obs_normalizer.*`` inside
                    ``mlp.*``, ``rnn.*``
==================  ====================================================  =========================================
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from ...files.parsing import parse_yaml, read_text
from ...robots.base import Robot
from ..base import PolicyError
from ..comparing import other_width
from ..contract import ContractError, PolicyContract, standard_contract
from ..native import StoredNetwork
from ..networks.layers import ACTIVATIONS

_WEIGHTS = ("actor_state_dict", "student_state_dict", "model_state_dict")
_ACTORS = ("actor", "student", "mlp")
_MEMORIES = r"(memory_a\.rnn|memory_s\.rnn|rnn\.rnn|rnn)\.((?:weight|bias)_[ih]h_l\d+)"
_NORMALIZERS = ("actor_obs_normalizer.", "student_obs_normalizer.", "obs_normalizer.")
_STRANGE = ("cnn", "estimator", "actor_cnn", "encoder.", "perception")
_OTHER_NAMES = {"swish": "silu", "lrelu": "leaky_relu"}
NORMALIZER_OFFSET = 0.01
"""Added to the standard deviation by rsl_rl before it divides."""


def checkpoint_network(
    entries: Mapping[str, Any], robot: Robot, *, path: Path, contract: PolicyContract | None = None
) -> tuple[PolicyContract, StoredNetwork] | None:
    """Return the network and contract of a bare rsl_rl checkpoint, None if it is not one.

    Understood are perceptrons, recurrent actors (LSTM, GRU) and distilled students, each with or without input normalisation,
    and a student of concurrent teacher-student training (``student_encoder``). The activation is the one in
    ``params/agent.yaml`` beside it, else ELU.

    Args:
        contract: its description; None for the standard one.

    Raises:
        PolicyError: it is one, but of another kind, of another width than its contract, or with missing or malformed entries.
    """
    try:
        return _checkpoint_network(entries, robot, path, contract)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, RuntimeError, OverflowError) as error:
        if isinstance(error, (PolicyError, ContractError)):
            raise
        raise PolicyError(
            f"'{path}' is an rsl_rl checkpoint with a missing or malformed entry ({type(error).__name__}: {error})"
        ) from error


def _checkpoint_network(
    entries: Mapping[str, Any], robot: Robot, path: Path, contract: PolicyContract | None
) -> tuple[PolicyContract, StoredNetwork] | None:
    weights = next((w for k in _WEIGHTS if isinstance(w := entries.get(k), Mapping) and w), None)
    if weights is None and entries and all(isinstance(v, torch.Tensor) for v in entries.values()):
        raise PolicyError(
            f"'{path}' holds weights alone ('{next(iter(entries))}' …), not the network that they belong to; give the training's "
            "checkpoint (model_<iteration>.pt), or export the policy as TorchScript or ONNX"
        )
    if not isinstance(weights, Mapping) or not all(isinstance(v, torch.Tensor) for v in weights.values()):
        return None
    actor = next((found for name in _ACTORS if (found := _layers(weights, name, "network"))), {})
    encoder = _layers(weights, "student_encoder", "encoder")
    memory = {f"rnn.{m[2]}": v for k, v in weights.items() if (m := re.fullmatch(_MEMORIES, k))}
    strange = [k for k in weights if k.startswith(_STRANGE)]
    if not actor or strange:
        raise PolicyError(
            f"'{path}' is an rsl_rl checkpoint without a plain or recurrent perceptron as its actor "
            f"(it has '{(strange or list(weights) or ['nothing'])[0]}')"
        )
    activation = _activation(path)
    described = contract is not None
    contract = contract or standard_contract(
        robot,
        provenance={
            "adapter": "rsl_rl checkpoint",
            "file": path.name,
            "assumed": f"standard observation, {activation}",
        },
    )
    frame, widths = contract.observation_width, _widths(actor)
    arguments: dict[str, Any] = {"frame_width": frame, "num_actions": contract.num_joints, "activation": activation}
    if encoder:
        encoder_widths = _widths(encoder)
        arguments.update(
            history_length=encoder_widths[0] // frame,
            latent_width=encoder_widths[-1],
            encoder_hidden=encoder_widths[1:-1],
            actor_hidden=widths[1:-1],
        )
        state = encoder | {k.replace("network.", "actor.", 1): v for k, v in actor.items()}
        return contract, StoredNetwork(architecture="cts", arguments=arguments, state_dict=state)
    inputs = memory["rnn.weight_ih_l0"].shape[1] if memory else widths[0]
    if inputs != frame or widths[-1] != contract.num_joints:
        told = (
            other_width(contract, inputs)
            if described
            else f"without a contract only {frame} and {contract.num_joints} are understood; give one with --contract "
            "(gaitgauge contract new)"
        )
        raise PolicyError(f"'{path}' has an actor of {inputs} inputs and {widths[-1]} outputs; {told}")
    arguments.update(hidden=widths[1:-1])
    if (normalizer := _normalizer(entries, weights, inputs, path)) is not None:
        arguments.update(normalize=True)
        actor["mean"], actor["deviation"] = normalizer
    if not memory:
        return contract, StoredNetwork(architecture="mlp", arguments=arguments, state_dict=actor)
    width = memory["rnn.weight_hh_l0"].shape[1]
    gates = memory["rnn.weight_ih_l0"].shape[0] // width
    layers = sum(name.startswith("rnn.weight_ih") for name in memory)
    arguments.update(cell={3: "gru", 4: "lstm"}[gates], memory_width=width, layers=layers)
    return contract, StoredNetwork(architecture="recurrent", arguments=arguments, state_dict=actor | memory)


def _normalizer(
    entries: Mapping[str, Any], weights: Mapping[str, torch.Tensor], width: int, path: Path
) -> tuple[torch.Tensor, torch.Tensor] | None:
    """Return mean and divisor (1, F) of the input normalisation, inside the weights or beside them; None where there is none."""
    found = next(({k: weights[p + k] for k in ("_mean", "_std")} for p in _NORMALIZERS if p + "_mean" in weights), None)
    apart = entries.get("obs_norm_state_dict")
    if found is None and isinstance(apart, Mapping) and apart:
        found = dict(apart)
    if found is None:
        return None
    if found["_mean"].numel() != width:
        raise PolicyError(
            f"'{path}' normalises {found['_mean'].numel()} values and its actor takes {width}; it is not a file that rsl_rl writes"
        )
    return found["_mean"].reshape(1, -1), found["_std"].reshape(1, -1) + NORMALIZER_OFFSET


def _layers(weights: Mapping[str, torch.Tensor], name: str, ours: str) -> dict[str, torch.Tensor]:
    """Return the layers of the perceptron of this name, called ``ours``."""
    found = {k: v for k, v in weights.items() if re.match(rf"{name}\.\d+\.(weight|bias)$", k)}
    return {f"{ours}.{k.split('.', 1)[1]}": v for k, v in found.items()}


def _widths(layers: Mapping[str, torch.Tensor]) -> list[int]:
    """Return the widths of a perceptron from its weights, input first."""
    weights = sorted(
        ((int(k.split(".")[1]), v) for k, v in layers.items() if k.endswith("weight")), key=lambda pair: pair[0]
    )
    return [weights[0][1].shape[1], *(w.shape[0] for _, w in weights)]


def _activation(path: Path) -> str:
    """Return the activation that the training configuration beside a checkpoint names, ELU if there is none."""
    settings = path.parent / "params" / "agent.yaml"
    if not settings.is_file():
        return "elu"
    data = parse_yaml(read_text(settings, "training configuration", PolicyError), f"'{settings}'", PolicyError)
    data = data if isinstance(data, Mapping) else {}
    tables = (table for key in ("student", "actor", "policy") if isinstance(table := data.get(key), Mapping))
    named = str(next((t["activation"] for t in tables if t.get("activation")), "elu")).lower()
    activation = _OTHER_NAMES.get(named, named)
    if activation not in ACTIVATIONS:
        raise PolicyError(
            f"'{settings}' names the activation '{named}'; understood are {', '.join((*ACTIVATIONS, *_OTHER_NAMES))}"
        )
    return activation
