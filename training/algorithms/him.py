"""HIM (Long et al., "Hybrid Internal Model: Learning Agile Legged Locomotion with Simulated Robot Response", 2024), from its paper's
description.

The encoder of the history gives the base's velocity, by regression, and an embedding on the unit sphere, by contrast: it is to fall to
the same prototype as the embedding that a second encoder gives to the robot's next state, which is the response that the internal model
predicts. Both encoders and the prototypes learn by swapped prediction (Caron et al., "Unsupervised Learning of Visual Features by
Contrasting Cluster Assignments", 2020): each embedding's code, made equal in size over a minibatch by Sinkhorn-Knopp, is the other's
target. The next state is the velocity and the noise-free frame without the command, which is no response of the robot.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from torch.nn import functional

from ...policy.networks.architectures import multilayer_perceptron
from ...policy.networks.estimators import VELOCITY
from ..configuration import HimConfiguration, TrainingConfiguration
from ..networks import Widths
from .estimation import EstimatorActor, EstimatorLosses, EstimatorPPO


class HimActor(EstimatorActor):
    """The deployed network, the encoder of next states, and the prototypes."""

    deployed = "him"
    response: torch.Tensor

    def __init__(self, configuration: TrainingConfiguration, widths: Widths) -> None:
        super().__init__(configuration, widths)
        network = configuration.network
        kept = [i for i in range(VELOCITY + widths.frame) if i - VELOCITY not in widths.command_entries]
        self.register_buffer("response", torch.tensor(kept), persistent=False)
        self.target_encoder = multilayer_perceptron((len(kept), *network.teacher_hidden, network.latent_width))
        prototypes = torch.randn(configuration.algorithm.him.prototypes, network.latent_width)
        self.prototypes = nn.Parameter(functional.normalize(prototypes, dim=-1))

    def helpers(self) -> list[nn.Parameter]:
        """See ``EstimatorActor``."""
        return [*self.target_encoder.parameters(), self.prototypes]


class HimLosses(EstimatorLosses):
    """Error of the velocity, and swapped prediction of the embeddings."""

    student_names = ("velocity", "contrast")

    def student(self, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """See ``Losses``."""
        history, following, velocity, goes_on = self.samples(rows)
        actor: Any = self.actor
        with self.autocast():
            estimate = actor.student_latent(history)[0]
            target = actor.target_encoder(following[:, actor.response])
        error = (estimate[:, :VELOCITY].float() - velocity).square().mean()
        prototypes = functional.normalize(actor.prototypes, dim=-1)
        source = estimate[:, VELOCITY:].float() @ prototypes.t()
        scores = functional.normalize(target.float(), dim=-1) @ prototypes.t()
        contrast = swapped_prediction(source, scores, goes_on, self.settings.him)
        return error + contrast, torch.stack((error, contrast)).detach()


def swapped_prediction(
    source: torch.Tensor, target: torch.Tensor, counts: torch.Tensor, settings: HimConfiguration
) -> torch.Tensor:
    """Return the mean cross entropy of each side's prediction with the other side's code: the embeddings' cosines with the prototypes, (B,
    K), and those of the next states' embeddings. ``counts`` is 1 for samples that count, else 0, (B,).
    """
    codes = [sinkhorn(scores, counts, settings) for scores in (source, target)]
    predictions = [functional.log_softmax(scores / settings.temperature, dim=-1) for scores in (source, target)]
    crossed = codes[0] * predictions[1] + codes[1] * predictions[0]
    return -0.5 * (crossed.sum(dim=-1) * counts).sum() / counts.sum().clamp_min(1.0)


@torch.no_grad()
def sinkhorn(scores: torch.Tensor, counts: torch.Tensor, settings: HimConfiguration) -> torch.Tensor:
    """Return codes (B, K) that add up to one for each sample and, nearly, to B / K for each prototype: Sinkhorn-Knopp on exp(scores /
    sharpness) of cosines (B, K). ``counts`` is 1 for samples that count, else 0, (B,); the others do not take part and have codes of zero.
    """
    codes = torch.exp((scores - scores.max()) / settings.code_sharpness) * counts[:, None]
    for _ in range(settings.sinkhorn_iterations):
        codes = codes / codes.sum(dim=0, keepdim=True).clamp_min(1e-12)
        codes = codes / codes.sum(dim=1, keepdim=True).clamp_min(1e-12)
    return codes


class Him(EstimatorPPO):
    """PPO with a hybrid internal model. See the module docstring."""

    actor_class, losses_class = HimActor, HimLosses
