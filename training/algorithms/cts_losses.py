"""The student's loss of concurrent teacher-student learning, and what its actor is given."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from .losses import Losses, load_balance
from .symmetry import half_replaced


class CtsLosses(Losses):
    """The teacher's latents are computed where the policy learns, since it learns with it; where the student learns, the teacher
    stands still and the student's targets are computed once.
    """

    student_names = ("latent", "load_balance", "largest_expert_share")

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        """Allocate; see ``Losses``."""
        super().__init__(*arguments, **settings)
        latents = self.storage.student_latent.flatten(0, 1)
        self.targets = torch.zeros_like(latents)
        """The teacher's latents on the student's samples, (T·Ns, L)."""
        if self.mirror is not None:
            self.mirrored_targets = torch.zeros_like(latents)

    def prepare_student(self) -> None:
        """The teacher's latents, before the student learns."""
        storage = self.storage
        privileged = storage.privileged[:, storage.split.num_teacher :].flatten(0, 1)
        self.fill(self.targets, lambda rows: self.actor.teacher_latent(privileged[rows]))
        if self.mirror is not None:
            mirrored = self.mirror.privileged
            self.fill(self.mirrored_targets, lambda rows: self.actor.teacher_latent(mirrored(privileged[rows])))

    def latents(self, privileged: Sequence[torch.Tensor], stored: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """Blocks: the teacher's, the student's, and their mirror images in the same order."""
        return [
            part
            for seen, latent in zip(privileged[::2], stored, strict=True)
            for part in (self.actor.teacher_latent(seen), latent)
        ]

    def student(self, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Latent error of rows of the flattened student-only buffers, plus the experts' load balancing loss; and
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
        error = (latent.float() - target).square().mean()
        if weights is None:
            return error, torch.stack((error, torch.zeros_like(error), torch.zeros_like(error))).detach()
        balance, largest = load_balance(weights)
        loss = error + self.settings.load_balance_coefficient * balance
        return loss, torch.stack((error, balance, largest)).detach()
