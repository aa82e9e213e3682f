"""Policies that estimate the base's velocity and a latent from the history, and act on both: DreamWaQ and HIM."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from .layers import EncoderNetwork, multilayer_perceptron, unit

VELOCITY = 3
"""Entries of an estimate that are the base's velocity, its first, in the scale of the training's privileged observation."""


class _EstimatorNetwork(EncoderNetwork):
    """An encoder of the history, and an actor on the estimate and the current frame.

    State dict: ``encoder.<layer>.*`` and ``actor.<layer>.*``; the actor's input is velocity, latent, then the current frame.
    """

    latents = 1
    """Width of the encoder's output beside the velocity, in widths of the latent."""

    def __init__(
        self,
        *,
        frame_width: int = 45,
        num_actions: int = 12,
        history_length: int = 5,
        latent_width: int = 16,
        encoder_hidden: Sequence[int] = (128, 64),
        actor_hidden: Sequence[int] = (512, 256, 128),
        activation: str = "elu",
    ) -> None:
        inputs, outputs = frame_width * history_length, VELOCITY + self.latents * latent_width
        encoder = multilayer_perceptron((inputs, *encoder_hidden, outputs), activation=activation)
        widths = (VELOCITY + latent_width + frame_width, *actor_hidden, num_actions)
        actor = multilayer_perceptron(widths, activation=activation)
        super().__init__(encoder, actor, history_length=history_length, frame_width=frame_width)
        self.latent_width = latent_width


class DreamwaqNetwork(_EstimatorNetwork):
    """A variational estimator (Nahrendra et al., "DreamWaQ", 2023): the latent is the mean of its distribution. The encoder's
    outputs are velocity, means, and logarithms of variances, which only training uses.
    """

    latents = 2

    def encode(self, history: torch.Tensor) -> tuple[torch.Tensor, None]:
        """Return the velocity and mean of the latent, (N, 3 + L), for ``history`` (N, H, F); there are no experts."""
        return self.encoder(history.flatten(1))[:, : VELOCITY + self.latent_width], None


class HimNetwork(_EstimatorNetwork):
    """A hybrid internal model (Long et al., "Hybrid Internal Model", 2024): velocity and an embedding on the unit sphere."""

    def encode(self, history: torch.Tensor) -> tuple[torch.Tensor, None]:
        """Return the velocity and embedding, (N, 3 + L), for ``history`` (N, H, F); there are no experts."""
        encoded = self.encoder(history.flatten(1))
        return torch.cat((encoded[:, :VELOCITY], unit(encoded[:, VELOCITY:])), dim=-1), None
