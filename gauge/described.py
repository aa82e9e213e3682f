"""Describe what a result says of its policy and of the feet: training physics, command limits, assumptions, contact."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..backends.base import PhysicsBackend, Support
from ..files.parsing import one_line, take
from ..policy.contract import ASSUMED, ASSUMPTIONS, PHYSICS, PolicyContract
from ..robots import Robot
from .result import CommandShares, Feet, TrainingPhysics
from .suite import Suite

UNSTATED = "the policy's file does not say in which physics it was trained and tuned"
_SLIDING, _TORSION = 3, 4
"""Contact dimensions without and with torsional friction."""


class _MalformedError(ValueError):
    """An entry of a policy's provenance that is none of this project's."""


def training_physics(contract: PolicyContract) -> TrainingPhysics:
    """Return the physics that a policy was trained and tuned with, from its file; empty, with a note, where the file does not say."""
    if (stated := contract.provenance.get(PHYSICS)) is None:
        return TrainingPhysics(note=UNSTATED)
    try:
        return take(TrainingPhysics, stated, PHYSICS, _MalformedError)
    except _MalformedError as problem:
        return TrainingPhysics(note=one_line(f"{UNSTATED}: {problem}"))


def assumptions(contract: PolicyContract) -> tuple[str, ...]:
    """Return sentences on what a policy's file does not say and was assumed."""
    listed, text = contract.provenance.get(ASSUMPTIONS), contract.provenance.get(ASSUMED)
    entries = list(listed) if isinstance(listed, list | tuple) else []
    return tuple(one_line(entry, 1000) for entry in [*entries, *([text] if text else [])][:100])


def command_shares(contract: PolicyContract, beyond: Mapping[Any, float] | None = None) -> CommandShares:
    """Return a policy's command limits and the shares of commands ``beyond`` them, by axis, where the suite counts them."""
    return CommandShares(limits=contract.command_limits, beyond=dict(beyond or {}))


def played_feet(suite: Suite, robot: Robot, backend: type[PhysicsBackend]) -> Feet:
    """Return the contact of the robot's feet as a suite and an engine play it.

    A contact has the larger dimension of foot and ground; an engine without torsional friction plays them all as sliding ones.
    """
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    feet, asked = [model.geom(name).id for name in robot.foot_geoms], suite.physics.foot_condim
    dimensions = {max(int(asked or model.geom_condim[foot]), _SLIDING) for foot in feet}
    if backend.capabilities()["foot_condim_6"].support is Support.NONE:
        dimensions = {_SLIDING}
    torsion = max(float(model.geom_friction[foot, 1]) for foot in feet)
    return Feet(
        dimension=tuple(sorted(dimensions)),  # type: ignore[arg-type]
        torsion=round(torsion, 9) if max(dimensions) >= _TORSION else 0.0,
    )
