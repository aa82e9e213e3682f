"""Beginning concurrent training with a student alone: a deployed policy has neither a teacher encoder nor a critic.

While it lasts, the student acts in all environments. The teacher encoder learns the student's latent from what the
teacher sees, the critic learns the values of the student's behaviour; student, actor and exploration noise stand still.
Afterwards the teacher acts about as the student does, and training goes on as if it had never been cut in two.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from .gradients import FlatGradients

if TYPE_CHECKING:
    from .cts import CTS


class Bootstrap:
    """Learns teacher encoder and critic from the student's behaviour, for a number of iterations."""

    def __init__(self, algorithm: CTS, iterations: int) -> None:
        """Prepare an optimizer of its own: the algorithm's starts fresh once the student is followed."""
        self._algorithm = algorithm
        self._left = iterations
        actor = algorithm.actor
        self._parameters = [*actor.teacher_encoder.parameters(), *algorithm.critic.parameters()]
        self._gradients = FlatGradients(self._parameters)
        self._optimizer = torch.optim.Adam(self._parameters, lr=1e-3)

    @property
    def over(self) -> bool:
        """Whether it has done its iterations."""
        return self._left <= 0

    def update(self) -> dict[str, float]:
        """All passes over one rollout.

        Returns:
            Means over the minibatches: ``teacher_latent``, the error of the teacher's latent, and ``value``.
        """
        algorithm = self._algorithm
        storage, settings = algorithm.storage, algorithm.configuration
        teacher_rows, student_rows = storage.minibatch_rows(settings.minibatches)
        sums = torch.zeros(2, device=teacher_rows.device)
        for _ in range(settings.epochs):
            for teacher, student in zip(teacher_rows, student_rows, strict=True):
                losses = self._losses(teacher, student)
                self._optimizer.zero_grad(set_to_none=True)
                losses.sum().backward()
                self._gradients.gather()
                algorithm.processes.average(self._gradients.values)
                torch.nn.utils.clip_grad_norm_(self._parameters, settings.max_gradient_norm)
                self._optimizer.step()
                sums += losses.detach()
        self._left -= 1
        latent, value = (sums / (settings.epochs * settings.minibatches)).tolist()
        return {"teacher_latent": latent, "value": value, "skipped_minibatches": 0.0}

    def _losses(self, teacher: torch.Tensor, student: torch.Tensor) -> torch.Tensor:
        """Latent error on the student's samples and value error on all, (2,)."""
        algorithm = self._algorithm
        actor, storage, mirror = algorithm.actor, algorithm.storage, algorithm.losses.mirror
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
        values = algorithm.critic.value(critic_latent, states[rows]).squeeze(-1)
        returns = storage.returns.flatten(0, 1)[rows]
        return torch.stack(((latent - target).square().mean(), (values - returns).square().mean()))
