"""Left-right mirror images of observations and actions of a legged robot.

Mirroring at the robot's sagittal plane (y to -y) keeps the x and z entries of a vector and flips its y entry; of an
axial vector such as an angular velocity it flips x and z and keeps y. Left legs change places with right legs, and
joints that turn about the x axis (hip abduction) change sign.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch

from ...policy.contract import PolicyContract
from ...robots.base import Robot
from ..environment_configuration import ObservationConfiguration
from ..height_scan import scan_pattern

# Name prefixes of the left legs and of their mirror images.
LEG_PAIRS: tuple[tuple[str, str], ...] = (("FL", "FR"), ("RL", "RR"), ("LF", "RF"), ("LH", "RH"), ("left_", "right_"))
# What the name of a joint about the x axis contains.
ABDUCTION_MARKS: tuple[str, ...] = ("hip", "HAA", "abduction", "hx")


class SymmetryError(ValueError):
    """The robot's names or poses do not tell what its mirror image is."""


@dataclass(frozen=True)
class MirrorMap:
    """A signed permutation of the entries of a vector; applied twice it gives the vector back."""

    index: torch.Tensor
    """Source entry of each entry, (D,) int64."""
    sign: torch.Tensor
    """Factor of each entry, (D,) float32."""

    def __call__(self, values: torch.Tensor) -> torch.Tensor:
        """Mirror ``values`` (..., D)."""
        return values.index_select(-1, self.index) * self.sign

    @property
    def width(self) -> int:
        """Number of entries D."""
        return self.index.numel()

    def to(self, device: torch.device | str) -> MirrorMap:
        """The same map on another device."""
        return MirrorMap(self.index.to(device), self.sign.to(device))

    @classmethod
    def signs(cls, *sign: float) -> MirrorMap:
        """Entries that stay in place."""
        return cls(torch.arange(len(sign)), torch.tensor(sign))

    @classmethod
    def joined(cls, maps: Sequence[MirrorMap]) -> MirrorMap:
        """The map of the concatenation of several vectors."""
        offsets = [0]
        for part in maps:
            offsets.append(offsets[-1] + part.width)
        index = torch.cat([part.index + offset for part, offset in zip(maps, offsets, strict=False)])
        return cls(index, torch.cat([part.sign for part in maps]))


VECTOR = MirrorMap.signs(1.0, -1.0, 1.0)
AXIAL_VECTOR = MirrorMap.signs(-1.0, 1.0, -1.0)
PLANAR_COMMAND = MirrorMap.signs(1.0, -1.0, -1.0)
"""Forward, lateral and yaw speed."""


def _mirrored_name(name: str) -> str:
    for left, right in LEG_PAIRS:
        for here, there in ((left, right), (right, left)):
            if name.startswith(here):
                return there + name[len(here) :]
    return name


def mirror_by_name(names: Sequence[str], flipped_marks: Sequence[str] = ()) -> MirrorMap:
    """Map that exchanges entries named for left and right legs.

    Args:
        names: name of each entry, legs as prefix (``FL_hip_joint``).
        flipped_marks: an entry whose name contains one of these changes sign.

    Raises:
        SymmetryError: an entry has no mirror image among the names.
    """
    position = {name: i for i, name in enumerate(names)}
    missing = [name for name in names if _mirrored_name(name) not in position]
    if missing:
        raise SymmetryError(
            f"No mirror image of {missing[0]!r} ({_mirrored_name(missing[0])!r}) among {', '.join(names)}."
        )
    index = torch.tensor([position[_mirrored_name(name)] for name in names])
    sign = torch.tensor([-1.0 if any(mark in name for mark in flipped_marks) else 1.0 for name in names])
    return MirrorMap(index, sign)


def mirror_points(points: torch.Tensor) -> MirrorMap:
    """Map of values at points (P, 2), the x and y positions of a height scan: each takes the value at its mirror image.

    Raises:
        SymmetryError: a point has no mirror image among them.
    """
    images = points.cpu() * torch.tensor([1.0, -1.0])
    distance, index = torch.cdist(images, points.cpu(), compute_mode="donot_use_mm_for_euclid_dist").min(dim=1)
    if bool((distance > 1e-4).any()):
        raise SymmetryError(f"The height scan's point {points[int(distance.argmax())].tolist()} has no mirror image.")
    return MirrorMap(index, torch.ones(len(points)))


@dataclass(frozen=True, kw_only=True)
class Mirror:
    """Mirror maps of all observation groups and of the action."""

    policy: MirrorMap
    history: MirrorMap
    privileged: MirrorMap
    action: MirrorMap

    def to(self, device: torch.device | str) -> Mirror:
        """The same maps on another device."""
        return Mirror(
            policy=self.policy.to(device),
            history=self.history.to(device),
            privileged=self.privileged.to(device),
            action=self.action.to(device),
        )


def build_mirror(observations: ObservationConfiguration, *, contract: PolicyContract, robot: Robot) -> Mirror:
    """Mirror maps for the training observations of a robot.

    The privileged vector is base linear velocity, the noise-free policy frame, contact force per foot, torque per
    joint, acceleration per joint and the height scan, in this order.

    Args:
        observations: gives the frames of the history and the points of the height scan.
        contract: gives the terms of the policy frame and the joint order.
        robot: gives the foot names.

    Raises:
        SymmetryError: names do not pair up, the default pose is not its own mirror image, or there are observations of
            one's own.
    """
    if observations.own:
        raise SymmetryError(
            f"The mirror image of the observation '{observations.own[0].name}' is not known; set "
            "training.algorithm.symmetry=none."
        )
    joints = mirror_by_name(contract.joint_names, ABDUCTION_MARKS)
    pose = torch.tensor(contract.default_joint_position)
    if not torch.allclose(joints(pose), pose, atol=1e-6):
        raise SymmetryError(
            "The default pose is not its own mirror image, so joint positions relative to it cannot be mirrored: "
            f"{contract.default_joint_position}."
        )
    terms = {
        "base_linear_velocity_b": VECTOR,
        "base_angular_velocity_b": AXIAL_VECTOR,
        "projected_gravity_b": VECTOR,
        "command": PLANAR_COMMAND,
        "joint_position": joints,
        "joint_velocity": joints,
        "last_action": joints,
    }
    frame = MirrorMap.joined([terms[term.name] for term in contract.observation])
    feet = mirror_by_name(robot.foot_names)
    scan = scan_pattern(observations.scan_length, observations.scan_width, observations.scan_spacing, "cpu")
    return Mirror(
        policy=frame,
        history=MirrorMap.joined([frame] * observations.history_length),
        privileged=MirrorMap.joined([VECTOR, frame, feet, joints, joints, mirror_points(scan)]),
        action=joints,
    )


def passes(count: int, *, alternate: bool) -> Iterator[Callable[[torch.Tensor], torch.Tensor]]:
    """For each pass over the minibatches, the order in which it takes a minibatch's rows (B,): if half of them are mirrored, the
    other half comes first in every second pass.
    """
    for number in range(count):
        yield (lambda rows: rows.roll(len(rows) // 2)) if alternate and number % 2 else (lambda rows: rows)


def half_mirrored(rows: torch.Tensor, mapping: MirrorMap) -> torch.Tensor:
    """Rows (B, D) with the first half of them mirrored."""
    half = len(rows) // 2
    return torch.cat((mapping(rows[:half]), rows[half:]))


def half_replaced(rows: torch.Tensor, images: torch.Tensor) -> torch.Tensor:
    """Rows (B, D) with the first half of them taken from ``images`` (B, D)."""
    half = len(rows) // 2
    return torch.cat((images[:half], rows[half:]))


def second_halves(rows: torch.Tensor, first: int) -> torch.Tensor:
    """What ``half_mirrored`` leaves as it is of two blocks one after the other, the first of which has ``first`` rows."""
    return torch.cat([block[len(block) // 2 :] for block in (rows[:first], rows[first:])])
