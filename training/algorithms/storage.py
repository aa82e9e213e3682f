"""Rollout storage with teacher and student environments in two blocks."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict


@dataclass(frozen=True)
class EnvironmentSplit:
    """Which environments belong to the teacher and which to the student.

    Environment i is a student's if i is a multiple of ``period`` (so every contiguous range of environments, and with
    it every kind of terrain, holds both). Blocks: rows ``[0, num_teacher)`` are the teacher's, the rest the student's.
    """

    num_teacher: int
    num_student: int
    order: torch.Tensor
    """Environment index of each block row, (N,) int64."""
    inverse: torch.Tensor
    """Block row of each environment, (N,) int64."""

    @classmethod
    def build(cls, num_envs: int, period: int, device: torch.device | str) -> EnvironmentSplit:
        """Split ``num_envs`` environments.

        Raises:
            ValueError: too few environments for at least one of each.
        """
        if num_envs < 2:
            raise ValueError(
                f"{num_envs} environment(s) cannot be split into teacher and student; use at least {period}."
            )
        index = torch.arange(num_envs, device=device)
        student = index % period == 0
        order = torch.cat((index[~student], index[student]))
        inverse = torch.empty_like(order)
        inverse[order] = index
        num_student = (num_envs + period - 1) // period
        return cls(num_teacher=num_envs - num_student, num_student=num_student, order=order, inverse=inverse)


class StratifiedStorage(RolloutStorage):
    """rsl_rl's storage, its environment axis in block order, with what the student needs beside.

    Histories are kept for student rows only: the teacher never looks at them, and they are the widest group. Student
    latents are kept because the student encoder does not change before the PPO passes are over, so they need not be
    computed again in every minibatch. Minibatches are row indices into the flattened storage; nothing is copied until
    a minibatch is used.
    """

    advantages: torch.Tensor

    class Transition(RolloutStorage.Transition):
        """One step of all environments, in block order."""

        def __init__(self) -> None:
            super().__init__()
            self.student_history: torch.Tensor | None = None
            self.student_latent: torch.Tensor | None = None

    def __init__(
        self,
        split: EnvironmentSplit,
        num_steps: int,
        observations: TensorDict,
        num_actions: int,
        latent_width: int,
        device: torch.device | str,
    ) -> None:
        """Allocate for ``num_steps`` steps of the groups ``policy``, ``privileged`` and (student rows) ``history``."""
        num_envs = split.num_teacher + split.num_student
        kept = TensorDict({k: observations[k] for k in ("policy", "privileged")}, batch_size=[num_envs])
        super().__init__("rl", num_envs, num_steps, kept, [num_actions], str(device))
        self.split = split
        history_width = observations["history"].shape[-1]
        self.student_history = torch.zeros(num_steps, split.num_student, history_width, device=device)
        self.student_latent = torch.zeros(num_steps, split.num_student, latent_width, device=device)
        # Allocated here and not at the first transition: those happen in inference mode, which would make them
        # unusable elsewhere.
        self.distribution_params = tuple(torch.zeros(num_steps, num_envs, num_actions, device=device) for _ in range(2))
        self._advantages: torch.Tensor = torch.zeros(num_steps, num_envs, 1, device=device)

    def add_transition(self, transition: RolloutStorage.Transition) -> None:
        """Store one step given in block order."""
        assert isinstance(transition, StratifiedStorage.Transition)
        assert transition.student_history is not None and transition.student_latent is not None
        if self.step < self.num_transitions_per_env:
            self.student_history[self.step].copy_(transition.student_history)
            self.student_latent[self.step].copy_(transition.student_latent)
        super().add_transition(transition)

    def keep_advantages(self) -> None:
        """Copy advantages, which rsl_rl allocates anew every iteration, into memory that stays where it is (CUDA
        graphs rely on it).
        """
        computed: torch.Tensor = self.advantages
        self._advantages.copy_(computed)
        self.advantages = self._advantages

    def minibatch_rows(self, num_minibatches: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw one random stratified partition of the rollout.

        Returns:
            Teacher rows (M, T·Nt // M) and student rows (M, T·Ns // M), int64, both into the storage flattened over
            time and block-ordered environments; what does not divide evenly is left out.

        Raises:
            ValueError: there are fewer student or teacher samples than minibatches.
        """
        steps, teachers, students = self.num_transitions_per_env, self.split.num_teacher, self.split.num_student
        if steps * min(teachers, students) < num_minibatches:
            raise ValueError(
                f"{steps} steps of {teachers} teacher and {students} student environments do not fill "
                f"{num_minibatches} minibatches; "
                "use more environments or fewer minibatches."
            )

        def draw(count: int, first: int) -> torch.Tensor:
            size = steps * count // num_minibatches
            shuffled = torch.randperm(steps * count, device=self.split.order.device)[: size * num_minibatches]
            rows = shuffled // count * self.num_envs + shuffled % count + first
            return rows.view(num_minibatches, size)

        return draw(teachers, 0), draw(students, teachers)

    def student_rows(self, rows: torch.Tensor) -> torch.Tensor:
        """Rows of the flattened student-only buffers that belong to student rows of the flattened storage."""
        return rows // self.num_envs * self.split.num_student + rows % self.num_envs - self.split.num_teacher
