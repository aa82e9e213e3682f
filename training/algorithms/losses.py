"""The loss of the policy that all methods share: PPO on minibatches of a rollout, with mirror images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any

import torch

from ..configuration import AlgorithmConfiguration
from ..networks import StudentActor, ValueNetwork
from .storage import RolloutStorage
from .symmetry import Mirror, MirrorMap, half_mirrored, half_replaced, second_halves

POLICY_LOSSES = ("value", "surrogate", "entropy", "kl", "symmetry")


class Losses:
    """Computes losses from row indices; tensors that both phases need beside the rollout are prepared once for each.

    First the policy learns while the student's encoder stands still, so that the student's latents are those of the rollout; then the
    encoder learns by supervision, which a method adds: ``prepare_student`` and ``student``.
    """

    policy_names: Sequence[str] = POLICY_LOSSES
    """Names of the figures that ``policy`` returns."""
    student_names: Sequence[str]
    """Names of the figures that ``student`` returns."""

    def __init__(
        self,
        actor: StudentActor,
        critic: ValueNetwork,
        storage: RolloutStorage,
        *,
        settings: AlgorithmConfiguration,
        mirror: Mirror | None,
        cached_casts: bool,
    ) -> None:
        """Allocate; the mirror maps are on the storage's device, None without symmetry. ``cached_casts`` keeps weights in bfloat16
        within a pass: they would outlive the weights in a CUDA graph.
        """
        self.actor: Any = actor
        self.critic, self.storage, self.settings, self.mirror = critic, storage, settings, mirror
        self._cached_casts = cached_casts
        self.device = storage.student_latent.device
        self.entropy_coefficient = torch.zeros((), device=self.device)
        if mirror is not None:
            self.mirrored_latent = torch.zeros_like(storage.student_latent.flatten(0, 1))

    def autocast(self) -> AbstractContextManager[Any]:
        """Return a context with matrix products in bfloat16, where that is the precision."""
        return torch.autocast(
            self.device.type,
            dtype=torch.bfloat16,
            enabled=self.settings.precision == "bfloat16",
            cache_enabled=self._cached_casts,
        )

    def prepare_policy(self) -> None:
        """Compute the student's latents of mirror images, before the policy learns."""
        if (mirror := self.mirror) is not None:
            history = self.storage.student_history.flatten(0, 1)
            self.fill(self.mirrored_latent, lambda rows: self.actor.student_latent(mirror.history(history[rows]))[0])

    def prepare_student(self) -> None:
        """Prepare the student's targets, before it learns; nothing where the rollout holds them."""

    def student(self, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the supervised loss of rows of the flattened student-only buffers, and ``student_names``, detached."""
        raise NotImplementedError

    def fill(self, target: torch.Tensor, compute: Callable[[slice], torch.Tensor], chunk: int = 65_536) -> None:
        """Write ``compute(rows)`` into ``target`` chunk by chunk, without gradients."""
        with torch.no_grad(), self.autocast():
            for start in range(0, len(target), chunk):
                rows = slice(start, start + chunk)
                target[rows].copy_(compute(rows))

    def latents(self, privileged: Sequence[torch.Tensor], stored: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """Return the actor's latents for each block of samples, in order, from states (B, P) of the rollout's groups, and of their mirror
        images where there are any, and from the student's stored latents, (B, L) each, of the last group of each of these.
        """
        del privileged
        return list(stored)

    def with_images(self, values: torch.Tensor, mapping: MirrorMap | None) -> torch.Tensor:
        """Return values (B, D) with the first half mirrored, or with their mirror images appended, as the symmetry asks for."""
        if mapping is None:
            return values
        if self.settings.symmetry == "alternate":
            return half_mirrored(values, mapping)
        return torch.cat((values, mapping(values)))

    def policy(self, *groups: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the PPO loss of rows of the flattened storage, and ``policy_names``, detached.

        The surrogate is the sum of the means over each group, so that the fewer student samples count as much as the teacher's; value
        loss and entropy are means over all.
        """
        storage, mirror, settings = self.storage, self.mirror, self.settings
        sizes = [len(rows) for rows in groups]
        frames, states = storage.policy.flatten(0, 1), storage.privileged.flatten(0, 1)
        policy, privileged = [frames[rows] for rows in groups], [states[rows] for rows in groups]
        in_history = storage.student_rows(groups[-1])
        latents = [storage.student_latent.flatten(0, 1)[in_history]]
        rows = torch.cat(groups)
        alternate, augment = (mirror is not None and settings.symmetry == mode for mode in ("alternate", "augment"))
        if mirror is not None and alternate:
            policy = [half_mirrored(p, mirror.policy) for p in policy]
            privileged = [half_mirrored(p, mirror.privileged) for p in privileged]
            latents = [half_replaced(latents[0], self.mirrored_latent[in_history])]
        elif mirror is not None:
            # Blocks: those of the groups, and their mirror images in the same order.
            policy += [mirror.policy(p) for p in policy]
            privileged += [mirror.privileged(p) for p in privileged]
            latents.append(self.mirrored_latent[in_history])
        with self.autocast():
            latent = torch.cat(self.latents(privileged, latents))
            decision, weights = self.actor.decide(latent, torch.cat(policy))
            values = self.critic.value(latent.detach(), torch.cat(privileged), weights).float().squeeze(-1)
        decision = decision.float()

        def stored(buffer: torch.Tensor) -> torch.Tensor:
            return buffer.flatten(0, 1)[rows]

        actions, advantages, returns = stored(storage.actions), stored(storage.advantages), stored(storage.returns)
        old_log_prob, old_values = stored(storage.log_prob), stored(storage.values)
        old, plain = [stored(storage.action_mean), stored(storage.action_std)], decision[: len(rows)]
        if alternate:  # how far the policy has moved is seen where it acted
            *old, plain = (second_halves(p, sizes) for p in (*old, plain))
        distribution = self.actor.distribution
        distribution.update(plain)
        kl = distribution.kl_divergence(tuple(old), distribution.params).mean().detach()
        entropy = distribution.entropy.mean()
        asymmetry = torch.zeros((), device=values.device)
        if mirror is not None and alternate:
            distribution.update(decision)
            actions = torch.cat([half_mirrored(block, mirror.action) for block in actions.split(sizes)])
        elif mirror is not None and augment:
            mean = distribution.deterministic_output(decision)
            asymmetry = (mean[len(rows) :] - mirror.action(mean[: len(rows)].detach())).square().mean()
            # A mirrored sample counts as drawn from the mirrored policy, with the original's probability.
            distribution.update(decision)
            actions = torch.cat((actions, mirror.action(actions)))
            advantages, old_log_prob, returns, old_values = (
                x.repeat(2) for x in (advantages, old_log_prob, returns, old_values)
            )
        ratio = torch.exp(distribution.log_prob(actions) - old_log_prob)
        clipped = ratio.clamp(1.0 - settings.clip, 1.0 + settings.clip)
        surrogates = torch.maximum(-advantages * ratio, -advantages * clipped).view(-1, len(rows))
        surrogate = torch.stack([block.mean() for block in surrogates.split(sizes, dim=1)]).sum()
        limited = old_values + (values - old_values).clamp(-settings.clip, settings.clip)
        value = torch.maximum((values - returns).square(), (limited - returns).square()).mean()
        loss = surrogate + settings.value_coefficient * value - self.entropy_coefficient * entropy
        metrics = torch.stack((value, surrogate, entropy, kl, asymmetry)).detach()
        return (loss, metrics) if weights is None else self.balanced(loss, metrics, weights)

    def balanced(
        self, loss: torch.Tensor, metrics: torch.Tensor, weights: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the policy's loss and figures with those of the weights (B, K) of an actor's experts."""
        del weights
        return loss, metrics


def load_balance(weights: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Load balancing loss of a mixture's weights (B, K), the squared distance of their means from equal shares (paper, load balancing
    loss), and the largest share.
    """
    share = weights.float().mean(dim=0)
    return (share - 1.0 / len(share)).square().sum(), share.max()
