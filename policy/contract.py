"""The policy contract: everything that must agree between a policy and the loop that runs it.

It travels with every checkpoint and export in full precision, its hash with every result.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

SCHEMA_VERSION = 1

# Width of each observation term for a robot with J joints; None stands for J.
TERM_WIDTH: Mapping[str, int | None] = {
    "base_linear_velocity_b": 3,
    "base_angular_velocity_b": 3,
    "projected_gravity_b": 3,
    "command": 3,
    "joint_position": None,
    "joint_velocity": None,
    "last_action": None,
}


class ContractError(ValueError):
    """A contract is malformed, or does not fit the robot, suite or policy at hand."""


@dataclass(frozen=True, kw_only=True)
class ObservationTerm:
    """One block of the observation vector. ``joint_position`` is relative to the default pose; ``last_action`` is the raw output."""

    name: str
    """A key of ``TERM_WIDTH``."""
    scale: tuple[float, ...]
    """Factor per entry; one entry stands for all."""
    clip: float | None = None
    """Largest magnitude after scaling, None for no clipping."""


@dataclass(frozen=True, kw_only=True)
class History:
    """Past observations that the network expects in its input. A network that keeps its own history has length 1 here."""

    length: int = 1
    """Number of frames, the current one included."""
    order: str = "frame-major"
    """``frame-major``: whole frames, oldest first; ``term-major``: all frames of the first term, oldest first, then the next term."""
    start: str = "zeros"
    """What fills the frames before the first one: ``zeros``, or ``repeat`` for copies of the first frame."""


@dataclass(frozen=True, kw_only=True)
class PolicyContract:
    """Joint order, poses, scales and timing of a policy. The target of joint j is ``default + action_scale * action``."""

    robot: str
    """Robot registry name."""
    joint_names: tuple[str, ...]
    """Joints in the policy's own order, for observations and actions."""
    default_joint_position: tuple[float, ...]
    """[rad], in the policy's joint order."""
    action_scale: tuple[float, ...]
    """[rad] per unit of network output, per joint."""
    action_clip: float | None = None
    """Largest magnitude of the raw action, None for no clipping."""
    stiffness: tuple[float, ...]
    """Motor kp the policy was made for [N·m/rad]."""
    damping: tuple[float, ...]
    """Motor kd the policy was made for [N·m·s/rad]."""
    control_period: float
    """[s]."""
    observation: tuple[ObservationTerm, ...]
    history: History = History()
    command_limits: tuple[float, float, float]
    """Largest forward, lateral [m/s] and yaw [rad/s] command the policy was made for."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """Where the policy comes from (training run, file, adapter); not part of the hash."""
    schema_version: int = SCHEMA_VERSION

    @property
    def frame_width(self) -> int:
        """Width of one observation frame."""
        return sum(TERM_WIDTH[t.name] or len(self.joint_names) for t in self.observation)

    @property
    def observation_width(self) -> int:
        """Width of the network's input."""
        return self.frame_width * self.history.length

    def to_dict(self) -> dict[str, Any]:
        """Plain data, ready for JSON."""
        return asdict(self)

    @property
    def hash(self) -> str:
        """SHA-256 over everything but the provenance, hexadecimal."""
        data = self.to_dict()
        del data["provenance"]
        return hashlib.sha256(json.dumps(data, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
