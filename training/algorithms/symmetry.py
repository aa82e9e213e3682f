"""Left-right mirror images of observations and actions of a legged robot.

Mirroring at the robot's sagittal plane (y to -y) keeps the x and z entries of a vector and flips its y entry; of an
axial vector such as an angular velocity it flips x and z and keeps y. Left legs change places with right legs; which
joint is whose image, and which change sign, is read off the robot's model (``robots.anatomy.body_plan``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import torch

from ...policy.contract import ObservationTerm, PolicyContract
from ...policy.ground import scan_points
from ...policy.observation_table import HEIGHT_SCAN, observation
from ...robots.anatomy.body_plan import mirror_image
from ...robots.base import Robot
from ...terrains.height_scan import scan_pattern
from ..environment.configuration import ObservationConfiguration


class SymmetryError(ValueError):
    """Raised where the networks' inputs have no mirror image."""


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
    def joined(cls, maps: Sequence[MirrorMap]) -> MirrorMap:
        """The map of the concatenation of several vectors."""
        offsets = accumulate((part.width for part in maps), initial=0)
        index = torch.cat([part.index + offset for part, offset in zip(maps, offsets, strict=False)])
        return cls(index, torch.cat([part.sign for part in maps]))


VECTOR = MirrorMap(torch.arange(3), torch.tensor((1.0, -1.0, 1.0)))


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
        return Mirror(**{name: each.to(device) for name, each in vars(self).items()})


def build_mirror(observations: ObservationConfiguration, *, contract: PolicyContract, robot: Robot) -> Mirror:
    """Mirror maps for the training observations of a robot.

    The privileged vector is base linear velocity, the noise-free policy frame, contact force per foot, torque per
    joint, acceleration per joint and the height scan, in this order.

    Args:
        observations: gives the frames of the history and the points of the height scan.
        contract: gives the terms of the policy frame and the joint order.
        robot: gives the mirror images of joints and feet.

    Raises:
        RobotError: a joint or a foot has no mirror image in the contract's default pose.
        SymmetryError: there are observations of one's own, or the policy drives one joint of a pair.
    """
    if observations.own:
        raise SymmetryError(
            f"The mirror image of the observation '{observations.own[0].name}' is not known; set "
            "training.algorithm.symmetry=none."
        )
    # angles are relative to the contract's pose, in its order, with joints that the policy does not drive behind
    held = [name for name in robot.joint_names if name not in contract.joint_names]
    poses = dict(zip(robot.joint_names, robot.default_joint_position, strict=True))
    pose = (*contract.default_joint_position, *(poses[name] for name in held))
    names = (*contract.joint_names, *held)
    image = mirror_image(replace(robot, joint_names=names, default_joint_position=pose))
    driven = image.joint[: contract.num_joints]
    if max(driven) >= contract.num_joints:
        odd = next(name for name, found in zip(names, driven, strict=False) if found >= contract.num_joints)
        raise SymmetryError(
            f"The policy drives the joint '{odd}' and not its mirror image; drive both, or set training.algorithm.symmetry=none."
        )
    joints = MirrorMap(torch.tensor(driven), torch.tensor(image.sign[: contract.num_joints]))
    feet = MirrorMap(torch.tensor(image.foot), torch.ones(len(image.foot)))
    frame = MirrorMap.joined([_clocks(term, feet) or _image(term, joints) for term in contract.observation])
    # torques and accelerations of all joints, in the robot's order
    place = [names.index(name) for name in robot.joint_names]
    whole = MirrorMap(
        torch.tensor([place.index(image.joint[i]) for i in place]), torch.tensor([image.sign[i] for i in place])
    )
    scan = scan_pattern(observations.scan_length, observations.scan_width, observations.scan_spacing, "cpu")
    return Mirror(
        policy=frame,
        history=MirrorMap.joined([frame] * observations.history_length),
        privileged=MirrorMap.joined([VECTOR, frame, feet, whole, whole, mirror_points(scan)]),
        action=joints,
    )


def _clocks(term: ObservationTerm, feet: MirrorMap) -> MirrorMap | None:
    """Return the mirror map of a gait's clocks, one for each foot, that change places as the feet do; None for another term."""
    if term.name != "gait_phase":
        return None
    if len(term.offsets) != feet.width:
        raise SymmetryError(
            f"The gait has {len(term.offsets)} clocks for {feet.width} feet, and its mirror image is not known; give one for each, or "
            "set training.algorithm.symmetry=none."
        )
    return MirrorMap.joined([feet] * len(term.waves))


def _image(term: ObservationTerm, joints: MirrorMap) -> MirrorMap:
    """Return the mirror map of one observation. Raises SymmetryError: its mirror image is not known."""
    seen = observation(term.name)
    if term.name == HEIGHT_SCAN:
        return mirror_points(scan_points(term))
    if seen.mirror is None:
        raise SymmetryError(
            f"The mirror image of the observation '{seen.name}' is not known; give it mirror, or set "
            "training.algorithm.symmetry=none."
        )
    if seen.mirror == "joints":
        return joints
    source = seen.mirror_source or range(len(seen.mirror))
    return MirrorMap(torch.tensor(tuple(source)), torch.tensor(seen.mirror))


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


def second_halves(rows: torch.Tensor, sizes: Sequence[int]) -> torch.Tensor:
    """Return the rows that ``half_mirrored`` leaves as they are, of blocks of these sizes one after the other."""
    return torch.cat([block[len(block) // 2 :] for block in rows.split(list(sizes))])
