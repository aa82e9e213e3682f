"""Makes the contract of a policy that comes without any description, from its width, and says what was assumed.

Every reader notes in the contract's provenance where it took the facts from and what it had to assume.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...robots.base import Robot
from ..base import PolicyError
from ..contract import (
    History,
    HistoryOrder,
    PolicyContract,
    standard_contract,
)
from .presets import fitting_presets

AT_ONCE = 1.0
"""Time after standing within which a fall says that the policy is run wrongly [s]."""
LONGEST_HISTORY = 20
GUESSES = ("ONNX", "TorchScript", "rsl_rl checkpoint")
"""Adapters that take the whole observation for granted."""


def contract_for_width(
    width: int, robot: Robot, *, order: HistoryOrder, provenance: Mapping[str, Any], source: str
) -> PolicyContract:
    """Return the standard contract with as many frames, 1 to ``LONGEST_HISTORY``, as an input holds; else raise ``PolicyError``."""
    frame = standard_contract(robot).frame_width
    frames, rest = divmod(width, frame)
    if rest or not 1 <= frames <= LONGEST_HISTORY:
        fitting = ", ".join(fitting_presets(robot, width))
        raise PolicyError(
            f"'{source}' takes {width} values, which is no multiple of the standard observation's {frame}; "
            "give a contract.toml that describes its observation (gaitgauge contract new)"
            + (f", or with --contract the preset of the code that trained it: {fitting}" if fitting else "")
        )
    history = History(length=frames, order=order if frames > 1 else "frame-major")
    assumed = f"{frames} frame(s) of the standard observation of {frame} entries, {history.order}; gains of the robot"
    return standard_contract(robot, history=history, provenance={**provenance, "assumed": assumed})


def assumptions(contract: PolicyContract) -> str | None:
    """Return the assumptions about a policy that lacks a contract, or parts of one, as one sentence; None where there are none."""
    if "assumed" not in contract.provenance:
        return None
    if contract.provenance.get("adapter", GUESSES[0]) not in GUESSES:
        return f"assumed: {contract.provenance['assumed']}"
    scales = ", ".join(f"{t.name} × {', '.join(f'{s:g}' for s in t.scale)}" for t in contract.observation)
    joints = ", ".join(name.removesuffix("_joint") for name in contract.joint_names)
    gains = " and ".join(
        f"{letter} {min(v):g}" + (f" to {max(v):g}" if min(v) != max(v) else "")
        for letter, v in (("kp", contract.stiffness), ("kd", contract.damping))
    )
    history = contract.history
    frames = (
        "the current frame alone"
        if history.length == 1
        else f"{history.length} frames, {history.order}, starting with {history.start}"
    )
    return (
        f"taken for granted ({contract.provenance['assumed']}): history {frames}; joints {joints}; observation {scales}; "
        f"action scale {min(contract.action_scale):g} rad, gains {gains}; where this is wrong the robot falls: "
        "give a description with --contract, or put a contract.toml or deploy.yaml beside the file"
    )


def described(contract: PolicyContract) -> str | None:
    """Return where a policy's description was read, and what was assumed, for a sentence that begins with the policy's name.

    None for a contract of the project's own, or of a policy that was imported with one that leaves nothing open.
    """
    assumed, adapter = assumptions(contract), contract.provenance.get("adapter")
    if adapter in GUESSES:
        return f"does not say how it is to be run; {assumed}"
    if adapter is None or (adapter == "contract.toml" and assumed is None and "imported_from" in contract.provenance):
        return None
    file = contract.provenance.get("file")
    if adapter == "zoo" or adapter.startswith("preset "):
        where = f"the zoo's {file}" if adapter == "zoo" else f"the {adapter}"
        return "; ".join(filter(None, (f"is run as {where} says", assumed, contract.provenance.get("remark"))))
    source = f"'{file}'" if adapter in (None, file) or "metadata" in adapter else f"'{file}' ({adapter})"
    return f"is run as {'its metadata say' if 'metadata' in adapter else source + ' says'}" + (
        f"; {assumed}" if assumed else ""
    )


def doubt(contract: PolicyContract) -> str:
    """Return advice for a robot that falls within ``AT_ONCE`` of standing, with the assumptions about its policy."""
    taken = assumptions(contract)
    return "'gaitgauge doctor POLICY' tries what may be wrong" + (f"; {taken}" if taken else "")
