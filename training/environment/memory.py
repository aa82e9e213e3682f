"""Everything the training environment remembers from step to step, in one place, so that saving it is saving all of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import torch

from .step_inputs import StepInputs

EPISODE = (
    "farthest",
    "commanded_way",
    "commanded_farthest",
    "issued",
    "shortfall",
    "turn_error",
    "action",
    "previous_action",
    "joint_velocity",
    "joint_acceleration",
    "joint_torque",
    "foot_force",
    "foot_air_time",
    "foot_contact_time",
    "episode_rewards",
    "episode_steps",
)
SUMS = ("finished_rewards", "finished_steps", "finished_ends", "metric_sums", "metric_steps")


def _block(
    numbers: Callable[..., torch.Tensor], *shape: int, names: Sequence[str], widths: Sequence[int | None]
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Return a tensor, and views of its neighbouring columns by name; a width of None is a column without an axis of its own."""
    columns = [1 if width is None else width for width in widths]
    whole = numbers(*shape, sum(columns))
    parts = whole.split(columns, dim=-1)
    views = [part.squeeze(-1) if width is None else part for part, width in zip(parts, widths, strict=True)]
    return whole, dict(zip(names, views, strict=True))


@dataclass(kw_only=True)
class EnvironmentMemory:
    """Tensors that steps change in place; they are never replaced, since a captured step holds on to them.

    N worlds, J joints, A of them driven by the policy, F feet, T reward terms, E ways to end an episode, M metrics.
    """

    step: torch.Tensor
    """Environment steps taken in the run, scalar int64."""
    episode_length: torch.Tensor
    """Control steps of the present episode, (N,) int64."""
    level: torch.Tensor
    """Level of the tile, (N,) int64."""
    terrain_index: torch.Tensor
    """Terrain of the present episode, (N,) int64."""
    moves_level: torch.Tensor
    """True if the present episode counts for the curriculum, (N,) bool."""
    farthest: torch.Tensor
    """Largest distance from the tile's middle in this episode, larger of |x| and |y| [m], (N,)."""
    commanded_way: torch.Tensor
    """Position to which the commands of this episode would have led, at the commanded headings [m], (N, 2)."""
    commanded_farthest: torch.Tensor
    """Largest distance of ``commanded_way`` from its start [m], (N,)."""
    command: torch.Tensor
    """Present command, (N, 3)."""
    commanded_heading: torch.Tensor
    """Heading that the commands ask for: the robot's own when the command was drawn, turned by the yaw rates commanded since; unit vector
    in the world's xy plane, (N, 2)."""
    command_steps: torch.Tensor
    """Control steps until the next draw, (N,) int64."""
    command_extreme: torch.Tensor
    """True for extreme commands, (N,) bool."""
    holds_heading: torch.Tensor
    """True for straight commands, which leave the commanded heading as it is, (N,) bool."""
    issued: torch.Tensor
    """Sum of the linear commands issued in this episode [m/s], (N, 2)."""
    shortfall: torch.Tensor
    """Share of the commanded speed that is missing of late, an exponential average, (N,)."""
    turn_error: torch.Tensor
    """Commanded less actual yaw rate of late [rad/s], an exponential average since the command was drawn, (N,)."""
    action: torch.Tensor
    """Raw action of the last step, (N, A)."""
    previous_action: torch.Tensor
    """Raw action of the step before, (N, A)."""
    joint_velocity: torch.Tensor
    """Joint velocities after the last step [rad/s], (N, J)."""
    joint_acceleration: torch.Tensor
    """Change of the joint velocities over the last step [rad/s²], (N, J)."""
    joint_torque: torch.Tensor
    """Torques of the last step [N·m], (N, J)."""
    foot_force: torch.Tensor
    """Norm of each foot's contact force after the last step [N], (N, F)."""
    foot_air_time: torch.Tensor
    """Time since each foot left the ground [s], (N, F); zero where no reward asks for it."""
    foot_contact_time: torch.Tensor
    """Time since each foot touched the ground [s], (N, F); zero where no reward asks for it."""
    clocks: torch.Tensor
    """Control steps that the gait clock of each observation term has run, (N, terms); (N, 0) without a clock."""
    just_reset: torch.Tensor
    """Worlds at the first step of an episode, (N,) bool."""
    history: torch.Tensor
    """Last frames with their noise, oldest first, (N, H, frame width)."""
    push_phase: torch.Tensor
    """Offset of each world's push clock, control steps, (N,) int64."""
    episode_rewards: torch.Tensor
    """Weighted rewards of the present episode by term, (N, T)."""
    episode_steps: torch.Tensor
    """Control steps over which these are added up, (N,): fewer than ``episode_length``, which begins at random in a run."""
    finished_rewards: torch.Tensor
    """Weighted rewards of the episodes finished since the last log, (T,)."""
    finished_steps: torch.Tensor
    """Their control steps, scalar."""
    finished_ends: torch.Tensor
    """Number of ends by reason, (E,)."""
    metric_sums: torch.Tensor
    """Sums over worlds and steps since the last log, (M,)."""
    metric_steps: torch.Tensor
    """World steps summed in ``metric_sums``, scalar."""
    last_log: torch.Tensor
    """Values logged last, kept where nothing new can be said, (T + E + M,)."""
    diverged_total: torch.Tensor
    """Diverged worlds that were reset in the run, scalar int64."""

    episode: torch.Tensor
    """The numbers that are zero when an episode begins, one row for each world, (N, …): ``EPISODE`` are its columns, so that one kernel
    clears them all."""
    sums: torch.Tensor
    """All sums since the last log in one row: ``SUMS`` are its columns."""

    @classmethod
    def allocate(
        cls,
        num_envs: int,
        *,
        joints: int,
        actions: int,
        feet: int,
        history: int,
        frame: int,
        terms: int,
        ends: int,
        metrics: int,
        clocks: int = 0,
        device: torch.device | str,
    ) -> EnvironmentMemory:
        """Return zeros of the right shapes."""
        numbers = partial(torch.zeros, device=device)
        counts = partial(numbers, dtype=torch.int64)
        flags = partial(numbers, num_envs, dtype=torch.bool)
        widths = (None, 2, None, 2, None, None, actions, actions, joints, joints, joints, feet, feet, feet, terms, None)
        episode, columns = _block(numbers, num_envs, names=EPISODE, widths=widths)
        sums, totals = _block(numbers, names=SUMS, widths=(terms, None, ends, metrics, None))
        return cls(
            episode=episode,
            sums=sums,
            **columns,
            **totals,
            step=counts(()),
            episode_length=counts(num_envs),
            level=counts(num_envs),
            terrain_index=counts(num_envs),
            moves_level=flags(),
            command=numbers(num_envs, 3),
            commanded_heading=numbers(num_envs, 2),
            command_steps=counts(num_envs),
            command_extreme=flags(),
            holds_heading=flags(),
            clocks=numbers(num_envs, clocks),
            just_reset=flags(),
            history=numbers(num_envs, history, frame),
            push_phase=counts(num_envs),
            last_log=numbers(terms + ends + metrics),
            diverged_total=counts(()),
        )

    def turn_commanded_heading(self, period: float) -> None:
        """Turn it by the present command's yaw rate over a control period [s]."""
        angle = (self.command[:, 2] * period).masked_fill(self.holds_heading, 0.0)
        cos, sin = torch.cos(angle), torch.sin(angle)
        x, y = self.commanded_heading.unbind(1)
        self.commanded_heading.copy_(torch.stack((cos * x - sin * y, sin * x + cos * y), dim=1))

    def remember(self, inputs: StepInputs) -> None:
        """Keep the tensors that the next step compares itself with."""
        self.previous_action.copy_(self.action)
        self.action.copy_(inputs.action)
        self.joint_acceleration.copy_(inputs.joint_acceleration)
        self.joint_velocity.copy_(inputs.joint_velocity)
        self.joint_torque.copy_(inputs.joint_torque)
        self.foot_force.copy_(inputs.state.foot_contact_force_w.norm(dim=-1))
        if inputs.feet is not None:
            self.foot_air_time.copy_(inputs.feet.air_time)
            self.foot_contact_time.copy_(inputs.feet.contact_time)

    def begin_episode(self, worlds: torch.Tensor) -> None:
        """Clear the tensors of one episode in the masked worlds, (N,) bool."""
        self.episode.masked_fill_(worlds[:, None], 0.0)
        self.episode_length.masked_fill_(worlds, 0)
        if self.clocks.shape[1]:
            self.clocks.masked_fill_(worlds[:, None], 0.0)
        self.command_extreme.masked_fill_(worlds, False)
        self.just_reset.copy_(worlds)

    def by_name(self) -> dict[str, torch.Tensor]:
        """Return all tensors except views, the columns of others."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("episode", "sums")}


def copied(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return copies by name."""
    return {name: value.clone() for name, value in tensors.items()}


def restore(saved: Mapping[str, Any], present: Mapping[str, torch.Tensor]) -> None:
    """Copy saved tensors into present ones. Raises ValueError: a tensor is missing or has another shape."""
    for name, value in fitting(saved, present).items():
        present[name].copy_(value)


def fitting(saved: Mapping[str, Any], present: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return saved tensors by the names of present ones, each with the type and on the device of that one.

    Raises:
        ValueError: one is missing, is no tensor or has another shape.
    """
    found = {}
    for name, own in present.items():
        value = saved.get(name)
        if not isinstance(value, torch.Tensor) or value.shape != own.shape:
            what = f"has shape {tuple(value.shape)}" if isinstance(value, torch.Tensor) else "is missing"
            raise ValueError(
                f"the saved environment does not fit: '{name}' {what}, this environment needs {tuple(own.shape)}; "
                "resume with the run's own configuration"
            )
        found[name] = value.to(own.device, own.dtype)
    return found
