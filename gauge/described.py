"""Describe what a result says of its policy and of the feet: training physics, command limits, assumptions, contact."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from ..backends.base import PhysicsBackend, Support
from ..files.parsing import one_line, take
from ..policy.contract import ASSUMED, ASSUMPTIONS, PHYSICS, PolicyContract, kind_of_observations
from ..policy.native import FilePolicy
from ..policy.robot_of import without_copy
from ..robots import Robot
from .motors import gains_note, joint_parameters
from .result import CommandShares, Feet, Motors, PolicyName, TrainingPhysics
from .suite import Suite
from .suited import shares_beyond
from .totals import number

UNSTATED = "the policy's file does not say in which physics it was trained and tuned"
_SLIDING, _TORSION = 3, 4
"""Contact dimensions without and with torsional friction."""


@dataclass(frozen=True, kw_only=True)
class Description:
    """Statements of a result on policy, robot and physics, without a figure of the play."""

    policy: PolicyName
    robot: str
    motors: Motors
    training: TrainingPhysics
    commands: CommandShares
    feet: Feet
    solver: Mapping[str, Any]


def describe(
    suite: Suite, robot: Robot, policy: FilePolicy, engine: type[PhysicsBackend], terrains: Collection[str]
) -> Description:
    """Return what a result says of a policy as a suite and an engine play it on a robot; ``terrains``: all that are played."""
    contract = policy.contract
    motors = joint_parameters(suite, robot, contract)
    return Description(
        policy=PolicyName(
            path=policy.path,
            contract_hash=contract.hash,
            file_sha256=policy.file_sha256,
            observations=tuple(term.name for term in contract.observation),
            kind_of_observations=kind_of_observations(contract),
            provenance=without_copy(contract.provenance),
            assumptions=assumptions(contract),
        ),
        robot=robot.name,
        motors=Motors(stiffness=motors.stiffness, damping=motors.damping, note=gains_note(suite, robot, contract)),
        training=training_physics(contract),
        commands=command_shares(suite, contract, terrains),
        feet=played_feet(suite, robot, engine),
        solver=dict(engine.solver_settings(suite.physics)),
    )


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


def command_shares(suite: Suite, contract: PolicyContract, terrains: Collection[str]) -> CommandShares:
    """Return a policy's command limits and the shares of a suite's commands on some terrains that are beyond them."""
    limits = contract.command_limits
    shares = {axis: number(share) for axis, share in shares_beyond(suite, terrains, limits).items()}
    return CommandShares(limits=limits, beyond=dict(shares))


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
