"""From physics to the network's input and back: the one observation builder that both training and the gauge use."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from ..backends.base import PhysicsState
from ..robots.base import Robot
from .contract import RESTING, ContractError, ObservationTerm, PolicyContract, check_robot, held_joints
from .ground import Ground, HeightScan
from .observation_table import ACTION_BEFORE_LAST, HEIGHT_SCAN, OBSERVATIONS, Observation, observation


class ObservationBuilder:
    """Builds the observations of N episodes as a policy's contract asks for them, and turns its actions into joint
    targets.

    Everything stays on one device, has static shapes and never waits for it, so that the steps can be captured in a
    CUDA graph. Rows do not influence each other.
    """

    def __init__(
        self,
        contract: PolicyContract,
        robot: Robot,
        num_episodes: int,
        device: torch.device | str = "cpu",
        ground: Ground | None = None,
    ) -> None:
        """Prepare buffers and index maps.

        Args:
            ground: what a ``height_scan`` reads; None for policies without one.

        Raises:
            ContractError: the policy is not for this robot, or sees the ground where there is none.
        """
        index = check_robot(contract, robot)
        self.contract, self.num_episodes, self.device = contract, num_episodes, torch.device(device)
        self._observations = [observation(term.name) for term in contract.observation]
        # a noise stream also draws for what this policy does not observe
        self._noisy = {each.name for each in OBSERVATIONS.values() if each.noise is not None}
        widths = contract.term_widths
        # An identity map is left out: indexing costs a kernel per term and step.
        every = tuple(range(robot.num_joints))
        self._robot_joint = None if index == every else self._tensor(index, torch.int64)
        # where each of the robot's joints finds its target: among those of the policy, or behind them among those held
        held = held_joints(contract, robot)
        listed = (*index, *(robot.joint_names.index(joint.name) for joint in held))
        found = tuple(listed.index(j) for j in every)
        self._policy_joint = None if index == every else self._tensor(found, torch.int64)
        self._held = self._tensor([joint.position for joint in held]).expand(num_episodes, -1) if held else None
        self._default = self._tensor(contract.default_joint_position)
        self._offset = self._tensor(contract.action_offset or contract.default_joint_position)
        self._action_scale = self._tensor(contract.action_scale)
        self._target_range = None if contract.target_range is None else self._tensor(contract.target_range).T
        self._scale = torch.cat(
            [self._tensor(t.scale).expand(w) for t, w in zip(contract.observation, widths, strict=True)]
        )
        limits = [self._tensor(_clip(t)).expand(w) for t, w in zip(contract.observation, widths, strict=True)]
        self._limit = None if all(t.clip is None for t in contract.observation) else torch.cat(limits)
        self._references = [self._reference(term) for term in contract.observation]
        self._values = [self._tensor(t.values).expand(num_episodes, -1) for t in contract.observation]
        self._scans: dict[int, HeightScan] = {}
        for i, term in enumerate(contract.observation):
            if term.name == HEIGHT_SCAN:
                if ground is None:
                    raise ContractError(
                        "the policy observes the ground (height_scan), which nothing shows it here; take a policy without it"
                    )
                self._scans[i] = HeightScan(term, ground, num_episodes, contract.control_period)
        self._clock_offsets = [self._tensor(t.offsets) for t in contract.observation]
        self.clocks = torch.zeros(num_episodes, len(contract.observation), device=self.device)
        remembered = any(term.name == ACTION_BEFORE_LAST for term in contract.observation)
        self._shown = torch.zeros(num_episodes, len(index), device=self.device) if remembered else None
        places = tuple(place for places in contract.inputs.values() for place in places)
        as_kept = places == tuple(range(contract.frames * contract.frame_width))
        self._places = None if as_kept else self._tensor(places, torch.int64)
        self._frames = torch.zeros(num_episodes, contract.frames, contract.frame_width, device=self.device)
        self._fresh = torch.ones(num_episodes, dtype=torch.bool, device=self.device)

    def _tensor(self, values: object, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        return torch.tensor(values, dtype=dtype, device=self.device)

    def _reference(self, term: ObservationTerm) -> torch.Tensor | None:
        """Return what is subtracted from a term, joints in the policy's order."""
        if term.reference is not None:
            return self._tensor(term.reference) if any(term.reference) else None
        return self._default if observation(term.name).about_default_pose else None

    def reset(self, episodes: torch.Tensor | None = None) -> None:
        """Forget the past frames of the masked episodes, (N,) bool, None for all; their gait clocks begin anew."""
        for scan in self._scans.values():
            scan.reset(episodes)
        if self._shown is not None:
            self._shown.zero_() if episodes is None else self._shown.masked_fill_(episodes[:, None], 0.0)
        if episodes is None:
            self._frames.zero_()
            self.clocks.zero_()
            self._fresh.fill_(True)
        else:
            self._frames.masked_fill_(episodes[:, None, None], 0.0)
            self.clocks.masked_fill_(episodes[:, None], 0.0)
            self._fresh.logical_or_(episodes)

    def by_name(self) -> dict[str, torch.Tensor]:
        """Return what terms of later frames take from earlier ones, beside the gait clocks; the tensors themselves, by name."""
        found = {f"scan_{i}_{name}": kept for i, scan in self._scans.items() for name, kept in scan.by_name().items()}
        return found if self._shown is None else found | {"shown": self._shown}

    def build(
        self,
        state: PhysicsState,
        command: torch.Tensor,
        last_action: torch.Tensor,
        noise: Mapping[str, torch.Tensor] | None = None,
    ) -> torch.Tensor:
        """Return observations of all episodes. With a history, each call adds one frame to it: call once per control step.

        Commands are not clipped here: which limits hold depends on the terrain, and the caller knows them.

        Args:
            state: the true state; it is not changed.
            command: forward, lateral [m/s] and yaw [rad/s] speed, (N, 3).
            last_action: raw network output of the step before, zeros after a reset, (N, J) in the policy's joint order.
            noise: added to the measured quantities before scaling, in their own units, by name of the observation term;
                joints in the robot's order. A history keeps its frames' noise.

        Returns:
            (N, ``contract.observation_width``) float32, a fresh tensor.

        Raises:
            ContractError: noise for something that is not measured.
            ObservationError: an observation of a plug-in fails.
        """
        noise = noise or {}
        if not noise.keys() <= self._noisy:
            _refuse_noise(noise.keys() - self._noisy)
        if self.contract.action_clip is not None:
            last_action = torch.clamp(last_action, -self.contract.action_clip, self.contract.action_clip)
        blocks = [
            self._value(i, each, state, command, last_action, noise.get(each.name))
            for i, each in enumerate(self._observations)
        ]
        frame = torch.cat(blocks, dim=-1).to(torch.float32) * self._scale
        if self._shown is not None:
            self._shown.copy_(last_action)
        if self._limit is not None:
            frame = torch.clamp(frame, -self._limit, self._limit)
        return self._with_history(frame) if self.contract.frames > 1 else self._in_order(frame)

    def _value(
        self,
        number: int,
        made: Observation,
        state: PhysicsState,
        command: torch.Tensor,
        last_action: torch.Tensor,
        noise: torch.Tensor | None,
    ) -> torch.Tensor:
        """Return one term in physical units, joints in the policy's order."""
        if made.name == "gait_phase":
            return self._phase(number, command)
        if made.name == "constant":
            return self._values[number]
        if made.name == ACTION_BEFORE_LAST and self._shown is not None:
            return self._shown
        value = self._scans[number](state) if number in self._scans else made.build(state, command, last_action)
        if made.name == "command" and self.contract.observation[number].values:
            value = torch.cat((value, self._values[number].to(value.dtype)), dim=1)
        if noise is not None:
            value = value + noise
        if made.width is None and not made.policy_order and self._robot_joint is not None:
            value = value[:, self._robot_joint]
        reference = self._references[number]
        return value if reference is None else value - reference

    def _phase(self, number: int, command: torch.Tensor) -> torch.Tensor:
        """Return the waves of a gait's clocks, (N, W), and let the clocks go on by one control period."""
        term = self.contract.observation[number]
        assert term.period is not None  # of the term's own check
        clock, resting = self.clocks[:, number], command.norm(dim=1) < RESTING
        cycles = (clock * (self.contract.control_period / term.period))[:, None] + self._clock_offsets[number]
        if term.at_rest == "half":
            cycles = torch.where(resting[:, None], 0.5, cycles)
        angle = 2.0 * torch.pi * torch.remainder(cycles, 1.0)
        found = torch.cat([torch.sin(angle) if wave == "sin" else torch.cos(angle) for wave in term.waves], dim=1)
        clock.add_((~resting).to(clock.dtype) if term.at_rest in ("holds", "half") else 1.0)
        if term.at_rest == "half":
            clock.masked_fill_(resting, 0.0)
        return found.masked_fill(resting[:, None], 0.0) if term.at_rest == "zeros" else found

    def _in_order(self, frames: torch.Tensor) -> torch.Tensor:
        """Return the network's inputs of frames (N, H·F), oldest first."""
        return frames if self._places is None else frames.index_select(1, self._places)

    def _with_history(self, frame: torch.Tensor) -> torch.Tensor:
        frames = torch.cat((self._frames[:, 1:], frame[:, None]), dim=1)
        if self.contract.history.start == "repeat":
            frames = torch.where(self._fresh[:, None, None], frame[:, None].expand_as(frames), frames)
        self._frames.copy_(frames)
        self._fresh.fill_(False)
        return self._in_order(frames.flatten(1))

    def targets(self, action: torch.Tensor) -> torch.Tensor:
        """Return all joints' targets [rad, rad/s] in the robot's order, (N, J), of raw actions in the policy's order; NaN stays NaN.

        Joints that the policy does not drive are held at the pose of its contract, or of the robot's variant.
        """
        if self.contract.action_clip is not None:
            action = torch.clamp(action, -self.contract.action_clip, self.contract.action_clip)
        target = self._offset + self._action_scale * action
        if self._target_range is not None:
            target = torch.clamp(target, self._target_range[0], self._target_range[1])
        if self._held is not None:
            target = torch.cat((target, self._held[: len(target)].to(target.dtype)), dim=1)
        return target if self._policy_joint is None else target[:, self._policy_joint]


def term_major_order(contract: PolicyContract, frames: int) -> torch.Tensor:
    """Return the position in a term-major history of each entry of the frame-major one, (frames * F,) int64; both oldest first."""
    entries = torch.arange(frames * contract.frame_width)
    blocks = entries.split([frames * width for width in contract.term_widths])
    return torch.cat([block.view(frames, -1) for block in blocks], dim=1).flatten()


def _refuse_noise(names: set[str]) -> None:
    noisy = ", ".join(each.name for each in OBSERVATIONS.values() if each.noise is not None)
    raise ContractError(f"no noise can be added to '{', '.join(sorted(names))}'; choose from: {noisy}")


def _clip(term: ObservationTerm) -> tuple[float, ...]:
    if term.clip is None:
        return (float("inf"),)
    return term.clip if isinstance(term.clip, tuple) else (term.clip,)
