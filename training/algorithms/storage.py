"""Rollout storage with teacher and student environments in two blocks."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..configuration import ConfigurationError
from ..networks import Widths


def split_sizes(num_envs: int, period: int) -> tuple[int, int]:
    """Return the numbers of the teacher's and of the student's environments; the student has every ``period``-th one.

    Raises:
        ConfigurationError: too few environments for at least one of each.
    """
    if period > 1 and num_envs < 2:
        raise ConfigurationError(
            f"{num_envs} environment cannot be split into teacher and student; give --num-envs (environment.num_envs) 2 or more"
        )
    students = (num_envs + period - 1) // period
    return num_envs - students, students


def check_minibatches(num_minibatches: int, *, steps: int, teachers: int, students: int) -> None:
    """Refuse to divide a rollout into more minibatches than there are samples of the teacher or the student.

    Raises:
        ConfigurationError: there are more.
    """
    if (most := steps * min(teachers or students, students)) < num_minibatches:
        named = f"{teachers} teacher and {students} student" if teachers else f"{students}"
        raise ConfigurationError(
            f"{steps} steps of {named} environments do not fill {num_minibatches} minibatches; give "
            f"training.algorithm.minibatches={most} or fewer, or more --num-envs or training.run.steps_per_iteration"
        )


@dataclass(frozen=True)
class EnvironmentSplit:
    """Environments of the teacher and of the student.

    Environment i is a student's if i is a multiple of ``period`` (so every contiguous range of environments, and with it every kind of
    terrain, holds both); with a period of 1 all are. Blocks: rows ``[0, num_teacher)`` are the teacher's, the rest the student's.
    """

    num_teacher: int
    num_student: int
    order: torch.Tensor
    """Environment index of each block row, (N,) int64."""
    inverse: torch.Tensor
    """Block row of each environment, (N,) int64."""

    @classmethod
    def build(cls, num_envs: int, period: int, device: torch.device | str) -> EnvironmentSplit:
        """Split ``num_envs`` environments. Raises ConfigurationError: too few environments for at least one of each."""
        num_teacher, num_student = split_sizes(num_envs, period)
        index = torch.arange(num_envs, device=device)
        student = index % period == 0
        order = torch.cat((index[~student], index[student]))
        inverse = torch.empty_like(order)
        inverse[order] = index
        return cls(num_teacher=num_teacher, num_student=num_student, order=order, inverse=inverse)


class RolloutStorage:
    """One rollout: T steps of N environments in block order, in memory that stays where it is (CUDA graphs rely on it).

    Histories are kept for student rows only: the teacher never looks at them, and they are the widest group. Student latents are kept
    because the student encoder does not change before the PPO passes are over, so they need not be computed again in every minibatch.
    Minibatches are row indices into the flattened storage; nothing is copied until a minibatch is used.
    """

    def __init__(
        self,
        split: EnvironmentSplit,
        num_steps: int,
        widths: Widths,
        *,
        latent_width: int,
        next_state_width: int,
        device: torch.device | str,
    ) -> None:

        def zeros(envs: int, *width: int) -> torch.Tensor:
            return torch.zeros(num_steps, envs, *width, device=device)

        self.split, self.num_steps, self.num_envs = split, num_steps, split.num_teacher + split.num_student
        self.step = 0
        """Steps stored so far."""
        self.policy = zeros(self.num_envs, widths.frame)
        self.privileged = zeros(self.num_envs, widths.privileged)
        self.student_history = zeros(split.num_student, widths.history * widths.frame)
        self.student_latent = zeros(split.num_student, latent_width)
        self.actions, self.action_mean, self.action_std = (zeros(self.num_envs, widths.actions) for _ in range(3))
        self.log_prob, self.values, self.returns, self.advantages = (zeros(self.num_envs) for _ in range(4))
        self.rewards, self.dones = zeros(self.num_envs), zeros(self.num_envs)
        self.next_state = zeros(split.num_student, next_state_width)
        """Targets of the students' predicted next state, for methods that predict one."""

    def add(self, **entries: torch.Tensor) -> None:
        """Store entries of the present step by name, each (rows, …) in block order."""
        for name, value in entries.items():
            getattr(self, name)[self.step].copy_(value)

    def compute_returns(self, last_values: torch.Tensor, *, discount: float, gae_lambda: float) -> None:
        """Estimate advantages (Schulman et al., 2016, generalized advantage estimation), normalized over all samples, from the values of
        the states after the last step, (N,).
        """
        advantage, following = torch.zeros_like(last_values), last_values
        for step in reversed(range(self.num_steps)):
            discounted = (1.0 - self.dones[step]) * discount
            error = self.rewards[step] + discounted * following - self.values[step]
            advantage = error + discounted * gae_lambda * advantage
            self.returns[step] = advantage + self.values[step]
            following = self.values[step]
        advantages = self.returns - self.values
        self.advantages.copy_((advantages - advantages.mean()) / (advantages.std() + 1e-8))

    def minibatch_rows(self, num_minibatches: int) -> tuple[torch.Tensor, ...]:
        """Draw one random stratified partition of the rollout.

        Returns:
            Teacher rows (M, T·Nt // M), where there is a teacher, and student rows (M, T·Ns // M), int64, both into the
            storage flattened over time and block-ordered environments; the remainder of the division is left out.

        Raises:
            ConfigurationError: there are fewer student or teacher samples than minibatches.
        """
        steps, teachers, students = self.num_steps, self.split.num_teacher, self.split.num_student
        check_minibatches(num_minibatches, steps=steps, teachers=teachers, students=students)

        def draw(count: int, first: int) -> torch.Tensor:
            size = steps * count // num_minibatches
            shuffled = torch.randperm(steps * count, device=self.split.order.device)[: size * num_minibatches]
            return (shuffled // count * self.num_envs + shuffled % count + first).view(num_minibatches, size)

        return tuple(draw(count, first) for count, first in ((teachers, 0), (students, teachers)) if count)

    def student_rows(self, rows: torch.Tensor) -> torch.Tensor:
        """Return rows of the flattened student-only buffers that belong to student rows of the flattened storage."""
        return rows // self.num_envs * self.split.num_student + rows % self.num_envs - self.split.num_teacher
