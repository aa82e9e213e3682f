"""DreamWaQ (Nahrendra et al., "DreamWaQ: Learning Robust Quadrupedal Locomotion With Implicit Terrain Imagination via Deep Reinforcement
Learning", 2023).

A context estimator, a beta variational autoencoder: the encoder of the history gives the base's velocity and a Gaussian latent, a decoder
predicts the next frame from both. Its loss is the error of the velocity, that of the predicted frame, and beta times the latent's
divergence from the standard normal distribution. The actor sees a sample of the latent where it learns and the mean where it is deployed.

Adaptive bootstrapping: whether the actor is given the true or the estimated velocity is drawn for every sample. The estimate's
probability is 1 - tanh(deviation / mean) of the policy's return over the randomized worlds: as long as returns differ much, the policy
should not learn from an estimate that is no better. The returns are those of the last rollout, which need no episode to end.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from ...policy.networks.architectures import multilayer_perceptron
from ...policy.networks.estimators import VELOCITY
from ..configuration import TrainingConfiguration
from ..networks import Widths
from .estimation import EstimatorActor, EstimatorLosses, EstimatorPPO

_LEAST_LOG_VARIANCE, _LARGEST_LOG_VARIANCE = -10.0, 10.0


class DreamwaqActor(EstimatorActor):
    """The deployed network, the decoder, and how far the estimate of the velocity is trusted."""

    deployed = "dreamwaq"
    trust: torch.Tensor
    """Probability that the actor is given the estimated velocity, ()."""

    def __init__(self, configuration: TrainingConfiguration, widths: Widths) -> None:
        super().__init__(configuration, widths)
        network = configuration.network
        self.decoder = multilayer_perceptron((VELOCITY + network.latent_width, *network.teacher_hidden, widths.frame))
        self.register_buffer("trust", torch.zeros(()))

    def context(self, history: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the velocity (N, 3), means and logarithms of the variances of the latent, (N, L) each, from flat histories (N, H·F)."""
        width = self.student.latent_width
        encoded = self.student.encoder(history).float()
        velocity, mean, log_variance = encoded.split((VELOCITY, width, width), dim=-1)
        return velocity, mean, log_variance.clamp(_LEAST_LOG_VARIANCE, _LARGEST_LOG_VARIANCE)

    def acted_on(self, history: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
        """True or estimated velocity and a sample of the latent; see ``EstimatorActor``."""
        estimated, mean, log_variance = self.context(history)
        trusted = torch.rand_like(velocity[:, :1]) < self.trust
        latent = mean + torch.exp(0.5 * log_variance) * torch.randn_like(mean)
        return torch.cat((torch.where(trusted, estimated, velocity), latent), dim=-1)

    def helpers(self) -> list[nn.Parameter]:
        """See ``EstimatorActor``."""
        return list(self.decoder.parameters())


class DreamwaqLosses(EstimatorLosses):
    """Errors of the velocity and of the predicted frame, and the latent's divergence."""

    student_names = ("velocity", "reconstruction", "divergence")

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        samples = self.storage.num_steps * self.storage.num_envs * (2 if self.settings.symmetry == "augment" else 1)
        self.noise = torch.zeros(samples, self.storage.student_latent.shape[-1] - VELOCITY, device=self.device)
        """Noise of the latents' samples, new for each update: a recorded step draws no random numbers."""

    def prepare_student(self) -> None:
        """Draw new noise."""
        self.noise.normal_()

    def student(self, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """See ``Losses``."""
        history, following, velocity, goes_on = self.samples(rows)
        noise = self.noise[rows]
        if len(history) > len(rows):
            noise = torch.cat((noise, self.noise[rows + len(self.noise) // 2]))
        actor: Any = self.actor
        with self.autocast():
            estimated, mean, log_variance = actor.context(history)
            latent = mean + torch.exp(0.5 * log_variance) * noise
            predicted = actor.decoder(torch.cat((estimated, latent), dim=-1)).float()
        error = (estimated - velocity).square().mean()
        misses = (predicted - following[:, VELOCITY:]).square().mean(dim=-1)
        reconstruction = (misses * goes_on).sum() / goes_on.sum().clamp_min(1.0)
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1.0 - log_variance).mean()
        loss = error + reconstruction + self.settings.dreamwaq.beta * divergence
        return loss, torch.stack((error, reconstruction, divergence)).detach()


class Dreamwaq(EstimatorPPO):
    """PPO with a variational context estimator. See the module docstring."""

    actor_class, losses_class = DreamwaqActor, DreamwaqLosses

    @torch.no_grad()
    def compute_returns(self, obs: Any) -> None:
        """See ``PPO``; the rollout's returns decide how far its estimates are trusted in the next."""
        super().compute_returns(obs)
        returns = self.storage.returns
        spread = returns.std() / returns.mean().abs().clamp_min(1e-6)
        self.actor.trust.copy_(1.0 - torch.tanh(spread))
