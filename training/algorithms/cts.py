"""Concurrent teacher-student PPO (paper, method): CTS, MoE-CTS and MoE-NG, which differ by the student's encoder.

Most environments are driven by the teacher, which sees the true state, the others by the student, which sees the last few observations.
Both share one actor and one critic. Per iteration:

1. PPO on both groups. The policy gradient of teacher samples reaches the teacher encoder through the actor; the critic
   gets the latent detached, and so do actor and critic on student samples. Nothing of this trains the student encoder.
2. The student encoder learns the teacher's latent on its own samples, with its own optimizer; a Mixture of Experts is
   kept balanced by an auxiliary loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from tensordict import TensorDict

from ..configuration import TrainingConfiguration
from ..networks import CtsActor, CtsCritic, StudentActor, ValueNetwork, Widths, student_architecture
from .bootstrap import Bootstrap
from .losses import Losses, load_balance
from .ppo import PPO
from .symmetry import half_replaced


class CtsLosses(Losses):
    """Losses of CTS. The teacher's latents are computed anew while the policy learns, since the teacher learns with it; while the student
    learns, the teacher stands still, and its latents are computed once.
    """

    student_names = ("latent", "load_balance", "largest_expert_share")

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        latents = self.storage.student_latent.flatten(0, 1)
        self.targets = torch.zeros_like(latents)
        """The teacher's latents on the student's samples, (T·Ns, L)."""
        if self.mirror is not None:
            self.mirrored_targets = torch.zeros_like(latents)

    def prepare_student(self) -> None:
        """Compute the teacher's latents, before the student learns."""
        storage = self.storage
        privileged = storage.privileged[:, storage.split.num_teacher :].flatten(0, 1)
        self.fill(self.targets, lambda rows: self.actor.teacher_latent(privileged[rows]))
        if self.mirror is not None:
            mirrored = self.mirror.privileged
            self.fill(self.mirrored_targets, lambda rows: self.actor.teacher_latent(mirrored(privileged[rows])))

    def latents(self, privileged: Sequence[torch.Tensor], stored: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """Return the blocks of latents: the teacher's, the student's, and their mirror images in the same order."""
        return [
            part
            for seen, latent in zip(privileged[::2], stored, strict=True)
            for part in (self.actor.teacher_latent(seen), latent)
        ]

    def latent_error(self, latent: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the mean squared error of the student's latents (B, L), a scalar tensor."""
        return (latent - target).square().mean()

    def student(self, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the latent error of rows of the flattened student-only buffers, plus the experts' load balancing loss; and
        ``student_names``, (3,), detached.
        """
        history = self.storage.student_history.flatten(0, 1)[rows]
        target = self.targets[rows]
        if self.mirror is not None and self.settings.symmetry == "alternate":
            target = half_replaced(target, self.mirrored_targets[rows])
        elif self.mirror is not None:
            target = torch.cat((target, self.mirrored_targets[rows]))
        history = self.with_images(history, None if self.mirror is None else self.mirror.history)
        with self.autocast():
            latent, weights = self.actor.student_latent(history)
        error = self.latent_error(latent.float(), target)
        if weights is None:
            return error, torch.stack((error, torch.zeros_like(error), torch.zeros_like(error))).detach()
        balance, largest = load_balance(weights)
        loss = error + self.settings.load_balance_coefficient * balance
        return loss, torch.stack((error, balance, largest)).detach()


class CTS(PPO):
    """PPO with a concurrent student. See the module docstring."""

    losses_class = CtsLosses
    actor_class: ClassVar[type[CtsActor]] = CtsActor
    critic_class: ClassVar[Any] = CtsCritic
    has_teacher = True

    @classmethod
    def deployed(cls, configuration: TrainingConfiguration, widths: Widths) -> tuple[str, dict[str, Any]]:
        """Return name and arguments of the student in ``policy.networks``; ConfigurationError for settings that do not fit."""
        return student_architecture(configuration.network, widths)

    @classmethod
    def networks(cls, configuration: TrainingConfiguration, widths: Widths) -> tuple[StudentActor, ValueNetwork]:
        """See ``PPO``."""
        network, width = configuration.network, widths.privileged
        architecture, arguments = cls.deployed(configuration, widths)
        actor = cls.actor_class(network, privileged_width=width, architecture=architecture, arguments=arguments)
        return actor, cls.critic_class(network, privileged_width=width)

    def latents(
        self, obs: TensorDict, privileged: torch.Tensor, history: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """See ``PPO``; while a teacher is learned for a student, the student acts everywhere."""
        split, actor = self.storage.split, self.actor
        student = actor.student_latent(history)[0]
        if self.bootstrap is None:
            teacher = actor.teacher_latent(privileged[: split.num_teacher])
        else:
            teacher = actor.student_latent(obs["history"][split.order[: split.num_teacher]])[0]
        return torch.cat((teacher, student)), student

    def last_values(self, policy: torch.Tensor, privileged: torch.Tensor, history: torch.Tensor) -> torch.Tensor:
        """See ``PPO``."""
        student = self.actor.student_latent(history)[0]
        teacher = self.actor.teacher_latent(privileged[: self.storage.split.num_teacher])
        return self.values(torch.cat((teacher, student)), policy, privileged)

    def values(self, latent: torch.Tensor, policy: torch.Tensor, privileged: torch.Tensor) -> torch.Tensor:
        """Return values (N, 1) for latents (N, L), frames (N, F) and states (N, P), without gradients but the critic's own."""
        del policy
        return self.critic.value(latent, privileged)

    def without_meaning(self) -> tuple[str, ...]:
        """See ``PPO``."""
        return () if self.actor.architecture == "moe_cts" else ("load_balance", "largest_expert_share")

    def make_bootstrap(self, iterations: int) -> Bootstrap:
        """Return a learner of the teacher encoder, from the student's latents, and of the critic, from the values of the student's
        behaviour; afterwards the teacher acts about as the student does.
        """
        return Bootstrap(
            iterations,
            self.configuration,
            parameters=[*self.actor.teacher_encoder.parameters(), *self.critic.parameters()],
            losses=self._teacher_losses,
            names=("teacher_latent", "value"),
            joined=self.joined,
        )

    def _teacher_losses(self, teacher: torch.Tensor, student: torch.Tensor) -> torch.Tensor:
        """Return the latent error on the student's samples and value error on all, (2,)."""
        actor, storage, mirror = self.actor, self.storage, self.losses.mirror
        states = storage.privileged.flatten(0, 1)
        in_history = storage.student_rows(student)
        privileged = states[student]
        target = storage.student_latent.flatten(0, 1)[in_history]
        if mirror is not None:
            history = storage.student_history.flatten(0, 1)[in_history]
            privileged = torch.cat((privileged, mirror.privileged(privileged)))
            with torch.no_grad():
                target = torch.cat((target, actor.student_latent(mirror.history(history))[0]))
        latent = actor.teacher_latent(privileged)
        rows = torch.cat((teacher, student))
        with torch.no_grad():
            critic_latent = actor.teacher_latent(states[rows])
        values = self.values(critic_latent, storage.policy.flatten(0, 1)[rows], states[rows]).squeeze(-1)
        returns = storage.returns.flatten(0, 1)[rows]
        return torch.stack(((latent - target).square().mean(), (values - returns).square().mean()))
