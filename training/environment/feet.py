"""Compute what the feet do: contact, time in the air, clearance, tilt of the soles, distance, and the steps that a gait clock asks for."""

from __future__ import annotations

import math

import torch

from ...backends.base import PhysicsState
from ...policy.contract import RESTING
from ...robots.anatomy.body_plan import body_plan, default_pose, sole_geoms
from ...robots.anatomy.limbs import joint_chain
from ...robots.anatomy.roles import anatomy
from ...robots.base import Robot
from ...robots.rotation import projected_gravity
from ..configuration import ConfigurationError
from .configuration import GaitConfiguration
from .memory import EnvironmentMemory
from .reward_configuration import RewardConfiguration
from .step_inputs import FootInputs


class FootReader:
    """Computes ``FootInputs``; everything that never changes is on the device."""

    def __init__(
        self,
        rewards: RewardConfiguration,
        gait: GaitConfiguration,
        *,
        robot: Robot,
        period: float,
        device: torch.device,
    ) -> None:
        """Prepare constants; ``period`` is the control period [s]. Raises ConfigurationError: not one clock for each foot."""
        self._force, self._gait, self._period = rewards.foot_contact_force, gait, period
        plan = body_plan(robot)
        self._standing = torch.from_numpy(plan.foot_position[:, 2] + plan.standing_height).float().to(device)
        sides: dict[str, list[int]] = {"left": [], "right": []}
        for leg in sorted(anatomy(robot).legs, key=lambda leg: leg.name):
            sides[leg.side].append(leg.foot)
        self._pairs = torch.tensor([sides["left"], sides["right"]], device=device)
        self._soles = _Soles(robot, device)
        check_clocks(gait, robot)
        self._offsets = torch.tensor(gait.offsets if gait.period else [0.5], device=device)

    def __call__(
        self, state: PhysicsState, memory: EnvironmentMemory, foot_height: torch.Tensor, heading_xy: torch.Tensor
    ) -> FootInputs:
        """Return the feet's state from the physics, the memory of before the step, the heights of the feet's centres over the ground below
        them [m], (N, F), and the robots' headings, (N, 2).
        """
        contact = state.foot_contact_force_w.norm(dim=-1) > self._force
        left, right = state.foot_position_w[:, self._pairs, :2].unbind(1)
        away = left - right
        apart = away[..., 1] * heading_xy[:, None, 0] - away[..., 0] * heading_xy[:, None, 1]
        swing, wanted = self._steps(memory)
        return FootInputs(
            contact=contact,
            air_time=(memory.foot_air_time + self._period).masked_fill(contact, 0.0),
            contact_time=(memory.foot_contact_time + self._period).masked_fill(~contact, 0.0),
            clearance=foot_height - self._standing,
            tilt=self._soles.tilt(state),
            apart=apart.amin(dim=1),
            swing=swing,
            wanted_clearance=wanted,
        )

    def _steps(self, memory: EnvironmentMemory) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the feet that the clock wants in the air, and how high. A clock of 0 is the middle of a step, one of 0.5 stands."""
        if self._gait.period is None:
            return torch.zeros_like(memory.foot_air_time, dtype=torch.bool), torch.zeros_like(memory.foot_air_time)
        cycles = memory.clocks.amax(dim=1, keepdim=True) * (self._period / self._gait.period) + self._offsets
        cycles = torch.where(memory.command.norm(dim=1, keepdim=True) < RESTING, 0.5, cycles)
        share = (torch.remainder(cycles + 0.5, 1.0) - 0.5).abs() * (2.0 / self._gait.swing_share)
        swing = share < 1.0
        height = self._gait.swing_height * torch.cos(0.5 * math.pi * share).square()
        return swing, torch.where(swing, height, 0.0)


def check_clocks(gait: GaitConfiguration, robot: Robot) -> None:
    """Raise ``ConfigurationError`` unless a gait has one clock for each foot."""
    if gait.period is not None and len(gait.offsets) != len(robot.foot_names):
        raise ConfigurationError(
            f"environment.gait.offsets has {len(gait.offsets)} entries; robot '{robot.name}' has {len(robot.foot_names)} feet "
            f"and needs one for each: {', '.join(robot.foot_names)}"
        )


class _Soles:
    """Turns the soles' normals with the joints: engines report no orientation of a foot.

    With joint axes of the standing pose in the base's frame, a foot's rotation from that pose is the product of the rotations about
    them by the joints' angles from it, from the base outwards.
    """

    def __init__(self, robot: Robot, device: torch.device) -> None:
        model, data = default_pose(robot)
        base = model.body(robot.base_body).id
        order = {model.joint(name).id: i for i, name in enumerate(robot.joint_names)}
        chains = [joint_chain(model, int(model.geom_bodyid[sole[0]]), base) for sole in sole_geoms(model, robot)]
        deepest = max(map(len, chains))
        # shorter chains begin with rotations about nothing
        padded = [[None] * (deepest - len(chain)) + chain for chain in chains]
        self._index = torch.tensor([[0 if j is None else order[j] for j in chain] for chain in padded], device=device)
        axes = [[[0.0] * 3 if j is None else data.xaxis[j].tolist() for j in chain] for chain in padded]
        self._axis = torch.tensor(axes, dtype=torch.float32, device=device)
        self._level = torch.tensor(robot.default_joint_position, device=device)[self._index]
        self._up = torch.tensor([0.0, 0.0, 1.0], device=device)

    def tilt(self, state: PhysicsState) -> torch.Tensor:
        """Return ``FootInputs.tilt``."""
        angle = (state.joint_position[:, self._index] - self._level)[..., None]
        cosine, sine = torch.cos(angle), torch.sin(angle)
        normal = self._up.expand(*angle.shape[:2], 3)
        for place in range(self._index.shape[1] - 1, -1, -1):
            axis = self._axis[:, place].expand_as(normal)
            across = torch.linalg.cross(axis, normal)
            turned = across * sine[:, :, place] + torch.linalg.cross(axis, across) * (1.0 - cosine[:, :, place])
            normal = normal + turned
        upright = (normal * projected_gravity(state.base_quaternion_w)[:, None]).sum(dim=-1)
        return 1.0 - upright.square()
