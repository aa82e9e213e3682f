"""The two losses of concurrent teacher-student learning on minibatches of a rollout."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import torch

from ..configuration import AlgorithmConfiguration
from ..networks import CtsActor, CtsCritic
from .storage import RolloutStorage
from .symmetry import Mirror, half_mirrored, half_replaced, second_halves

POLICY_LOSSES = ("value", "surrogate", "entropy", "kl", "symmetry")
STUDENT_LOSSES = ("latent", "load_balance", "largest_expert_share")


class CtsLosses:
    """Computes losses from row indices; what both need beside the rollout is prepared once for each.

    Because the student encoder stands still while the policy learns and the teacher encoder while the student does, the
    student's latents are those of the rollout and the teacher's targets are computed once.
    """

    def __init__(
        self,
        actor: CtsActor,
        critic: CtsCritic,
        storage: RolloutStorage,
        *,
        settings: AlgorithmConfiguration,
        mirror: Mirror | None,
        cached_casts: bool,
    ) -> None:
        """Allocate.

        Args:
            actor: teacher encoder, student and exploration noise.
            critic: values.
            storage: the rollout.
            settings: of the algorithm.
            mirror: mirror maps on the storage's device, None without symmetry.
            cached_casts: whether weights in bfloat16 may be kept within a pass; they would outlive the weights in a CUDA graph.
        """
        self.actor, self.critic, self.storage, self.settings, self.mirror = actor, critic, storage, settings, mirror
        self._cached_casts = cached_casts
        device, latents = storage.student_latent.device, storage.student_latent.flatten(0, 1)
        self.entropy_coefficient = torch.zeros((), device=device)
        self.targets = torch.zeros_like(latents)
        """The teacher's latents on the student's samples, (T·Ns, L)."""
        if mirror is not None:
            self.mirrored_latent, self.mirrored_targets = torch.zeros_like(latents), torch.zeros_like(latents)

    def autocast(self) -> AbstractContextManager[Any]:
        """Matrix products in bfloat16, where that is the precision."""
        return torch.autocast(
            self.targets.device.type,
            dtype=torch.bfloat16,
            enabled=self.settings.precision == "bfloat16",
            cache_enabled=self._cached_casts,
        )

    def prepare_policy(self) -> None:
        """The student's latents of mirror images, before the policy learns."""
        if (mirror := self.mirror) is not None:
            history = self.storage.student_history.flatten(0, 1)
            self._fill(self.mirrored_latent, lambda rows: self.actor.student_latent(mirror.history(history[rows]))[0])

    def prepare_student(self) -> None:
        """The teacher's latents, before the student learns."""
        storage = self.storage
        privileged = storage.privileged[:, storage.split.num_teacher :].flatten(0, 1)
        self._fill(self.targets, lambda rows: self.actor.teacher_latent(privileged[rows]))
        if self.mirror is not None:
            mirrored = self.mirror.privileged
            self._fill(self.mirrored_targets, lambda rows: self.actor.teacher_latent(mirrored(privileged[rows])))

    def _fill(self, target: torch.Tensor, compute: Callable[[slice], torch.Tensor], chunk: int = 65_536) -> None:
        """Write ``compute(rows)`` into ``target`` chunk by chunk, without gradients."""
        with torch.no_grad(), self.autocast():
            for start in range(0, len(target), chunk):
                rows = slice(start, start + chunk)
                target[rows].copy_(compute(rows))

    def policy(self, teacher_rows: torch.Tensor, student_rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """PPO loss of rows of the flattened storage, and ``POLICY_LOSSES``, (5,), detached.

        The surrogate is the mean over teacher samples plus the mean over student samples, so that the fewer student
        samples count as much; value loss and entropy are means over all.
        """
        storage, mirror, settings = self.storage, self.mirror, self.settings
        groups, teachers = (teacher_rows, student_rows), len(teacher_rows)
        frames, states = storage.policy.flatten(0, 1), storage.privileged.flatten(0, 1)
        policy, privileged = [frames[rows] for rows in groups], [states[rows] for rows in groups]
        in_history = storage.student_rows(student_rows)
        latents = [storage.student_latent.flatten(0, 1)[in_history]]
        rows = torch.cat(groups)
        alternate, augment = (mirror is not None and settings.symmetry == mode for mode in ("alternate", "augment"))
        if mirror is not None and alternate:
            policy = [half_mirrored(p, mirror.policy) for p in policy]
            privileged = [half_mirrored(p, mirror.privileged) for p in privileged]
            latents = [half_replaced(latents[0], self.mirrored_latent[in_history])]
        elif mirror is not None:
            # Blocks: teacher, student, and their mirror images in the same order.
            policy += [mirror.policy(p) for p in policy]
            privileged += [mirror.privileged(p) for p in privileged]
            latents.append(self.mirrored_latent[in_history])
        with self.autocast():
            blocks = [
                part
                for seen, latent in zip(privileged[::2], latents, strict=True)
                for part in (self.actor.teacher_latent(seen), latent)
            ]
            latent = torch.cat(blocks)
            mean = self.actor.action_mean(latent, torch.cat(policy)).float()
            values = self.critic.value(latent.detach(), torch.cat(privileged)).float().squeeze(-1)

        def stored(buffer: torch.Tensor) -> torch.Tensor:
            return buffer.flatten(0, 1)[rows]

        actions, advantages, returns = stored(storage.actions), stored(storage.advantages), stored(storage.returns)
        old_log_prob, old_values = stored(storage.log_prob), stored(storage.values)
        old, plain = [stored(storage.action_mean), stored(storage.action_std)], mean[: len(rows)]
        if alternate:  # how far the policy has moved is seen where it acted
            *old, plain = (second_halves(p, teachers) for p in (*old, plain))
        distribution = self.actor.distribution
        distribution.update(plain)
        kl = distribution.kl_divergence(tuple(old), distribution.params).mean().detach()
        entropy = distribution.entropy.mean()
        asymmetry = torch.zeros((), device=mean.device)
        if mirror is not None and alternate:
            distribution.update(mean)
            actions = torch.cat(
                [half_mirrored(block, mirror.action) for block in actions.split([teachers, len(student_rows)])]
            )
        elif mirror is not None and augment:
            asymmetry = (mean[len(rows) :] - mirror.action(mean[: len(rows)].detach())).square().mean()
            # A mirrored sample counts as drawn from the mirrored policy, whose probability is that of the original.
            distribution.update(mean)
            actions = torch.cat((actions, mirror.action(actions)))
            advantages, old_log_prob, returns, old_values = (
                x.repeat(2) for x in (advantages, old_log_prob, returns, old_values)
            )
        ratio = torch.exp(distribution.log_prob(actions) - old_log_prob)
        clipped = ratio.clamp(1.0 - settings.clip, 1.0 + settings.clip)
        surrogates = torch.maximum(-advantages * ratio, -advantages * clipped).view(-1, len(rows))
        surrogate = surrogates[:, :teachers].mean() + surrogates[:, teachers:].mean()
        limited = old_values + (values - old_values).clamp(-settings.clip, settings.clip)
        value = torch.maximum((values - returns).square(), (limited - returns).square()).mean()
        loss = surrogate + settings.value_coefficient * value - self.entropy_coefficient * entropy
        return loss, torch.stack((value, surrogate, entropy, kl, asymmetry)).detach()

    def student(self, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Latent error of rows of the flattened student-only buffers, plus the experts' load balancing loss; and
        ``STUDENT_LOSSES``, (3,), detached.
        """
        history, target = self.storage.student_history.flatten(0, 1)[rows], self.targets[rows]
        if self.mirror is not None and self.settings.symmetry == "alternate":
            history = half_mirrored(history, self.mirror.history)
            target = half_replaced(target, self.mirrored_targets[rows])
        elif self.mirror is not None:
            history = torch.cat((history, self.mirror.history(history)))
            target = torch.cat((target, self.mirrored_targets[rows]))
        with self.autocast():
            latent, weights = self.actor.student_latent(history)
        error = (latent.float() - target).square().mean()
        if weights is None:
            return error, torch.stack((error, torch.zeros_like(error), torch.zeros_like(error))).detach()
        share = weights.float().mean(dim=0)
        balance = (share - 1.0 / len(share)).square().sum()
        loss = error + self.settings.load_balance_coefficient * balance
        return loss, torch.stack((error, balance, share.max())).detach()
