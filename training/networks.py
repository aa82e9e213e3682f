"""Build the networks of a method, and those of concurrent teacher-student learning.

The student is the very network that is deployed: an architecture of ``policy.networks``; a teacher borrows its actor. Teacher encoder
and critic exist in training only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from rsl_rl.modules.distribution import Distribution, GaussianDistribution
from torch import nn
from torch.nn import functional

from ..policy.contract import PolicyContract
from ..policy.networks.architectures import ARCHITECTURES, ExpertMixture, multilayer_perceptron
from ..policy.networks.layers import linear
from .configuration import ConfigurationError, NetworkConfiguration, TrainingConfiguration


@dataclass(frozen=True, kw_only=True)
class Widths:
    """Sizes of an environment's observations and actions."""

    environments: int
    """Number of environments N."""
    frame: int
    """Width of a frame F."""
    history: int
    """Frames in a history H."""
    privileged: int
    """Width of the privileged state P."""
    actions: int
    """Width of an action J."""
    command_entries: tuple[int, ...]
    """Entries of a frame that hold the command."""

    def arguments(self, latent_width: int) -> dict[str, Any]:
        """Return the arguments, plain data, that all networks of ``policy.networks`` with an encoder have."""
        return {
            "frame_width": self.frame,
            "num_actions": self.actions,
            "history_length": self.history,
            "latent_width": latent_width,
        }


def command_entries(contract: PolicyContract) -> tuple[int, ...]:
    """Return the entries of an observation frame that hold the command."""
    start = 0
    for term, width in zip(contract.observation, contract.term_widths, strict=True):
        if term.name == "command":
            return tuple(range(start, start + width))
        start += width
    return ()


def plain_arguments(configuration: TrainingConfiguration, widths: Widths, reason: str) -> dict[str, Any]:
    """Return the arguments of a network of ``policy.networks`` with a plain encoder.

    Raises:
        ConfigurationError: another encoder is asked for; ``reason`` names the method's part that does not go with it.
    """
    network, method = configuration.network, configuration.algorithm.method
    if network.student_encoder != "mlp":
        raise ConfigurationError(
            f"training.network.student_encoder is {network.student_encoder!r}; the method {method!r} {reason} and takes 'mlp'."
        )
    return {**widths.arguments(network.latent_width), "encoder_hidden": list(network.student_hidden)}


def composed_arguments(configuration: TrainingConfiguration, widths: Widths) -> dict[str, Any]:
    """Return the arguments of a network of ``policy.composed``. Raises ConfigurationError: the student's encoder is no plain one."""
    network = configuration.network
    return {
        **plain_arguments(configuration, widths, "has its experts in the actor"),
        "num_experts": network.expert_count,
        "expert_width": network.expert_width,
        "trunk_hidden": list(network.actor_hidden),
        "gate_hidden": list(network.gate_hidden),
    }


def student_architecture(configuration: NetworkConfiguration, widths: Widths) -> tuple[str, dict[str, Any]]:
    """Name and arguments, plain data, of the deployed network in ``policy.networks``.

    Raises:
        ConfigurationError: ``moe_ng`` without a command in the frame, which its experts are not to see.
    """
    common = {**widths.arguments(configuration.latent_width), "actor_hidden": list(configuration.actor_hidden)}
    if configuration.student_encoder == "mlp":
        return "cts", {**common, "encoder_hidden": list(configuration.student_hidden)}
    blind = list(widths.command_entries) if configuration.student_encoder == "moe_ng" else []
    if configuration.student_encoder == "moe_ng" and not blind:
        raise ConfigurationError(
            "training.network.student_encoder is 'moe_ng', but the observation frame has no command to hide from the experts."
        )
    return "moe_cts", {
        **common,
        "num_experts": configuration.expert_count,
        "expert_width": configuration.expert_width,
        "trunk_hidden": list(configuration.student_hidden),
        "gate_hidden": list(configuration.gate_hidden),
        "expert_blind_to": blind,
    }


class StudentActor(nn.Module):
    """The deployed network, called student in every method, with its exploration noise; methods add parts for training."""

    noise: ClassVar[type[Distribution]] = GaussianDistribution

    def __init__(self, configuration: NetworkConfiguration, *, architecture: str, arguments: dict[str, Any]) -> None:
        """Build noise and student, of an architecture in ``policy.networks.ARCHITECTURES``; ConfigurationError if it is not there."""
        super().__init__()
        if architecture not in ARCHITECTURES:
            raise ConfigurationError(
                f"the deployed network is a {architecture!r}; allowed are {', '.join(ARCHITECTURES)}, which policies are played with"
            )
        self.architecture, self.arguments = architecture, arguments
        self.student: Any = ARCHITECTURES[architecture](**arguments)
        self.distribution: Any = self.noise(
            int(arguments["num_actions"]),
            init_std=configuration.initial_std,  # type: ignore[call-arg]
            std_range=(configuration.minimum_std, 1e6),  # type: ignore[call-arg]
        )
        self._frames = (int(arguments["history_length"]), int(arguments["frame_width"]))

    def student_latent(self, history: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Return latents (N, L) and gate weights of the encoder (N, K), None without experts, from flat histories (N, H·F), oldest frame
        first.
        """
        raise NotImplementedError

    def decide(self, latent: torch.Tensor, policy: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Return the parameters of the action distribution, and the weights of the actor's experts (N, K) where it has any, for latents
        (N, L) and current frames (N, F).
        """
        return self.action_mean(latent, policy), None

    def action_mean(self, latent: torch.Tensor, policy: torch.Tensor) -> torch.Tensor:
        """Return the mean actions (N, J) for latents (N, L) and current frames (N, F)."""
        return last_in_float32(self.student.actor, torch.cat((latent, policy), dim=-1))

    @property
    def output_std(self) -> torch.Tensor:
        """Return the present standard deviation of the exploration noise, (J,)."""
        std: torch.Tensor = self.distribution.std_param.detach().clamp(*self.distribution.std_range)
        return std

    def policy_parameters(self) -> list[nn.Parameter]:
        """Return the parameters that reinforcement learning trains."""
        return [*self.student.actor.parameters(), *self.distribution.parameters()]

    def student_parameters(self) -> list[nn.Parameter]:
        """Return the parameters that supervision trains: the encoder, and its helpers in training."""
        return list(self.student.encoder.parameters())


class CtsActor(StudentActor):
    """Teacher encoder, student network (encoder and the shared actor) and exploration noise."""

    def __init__(self, configuration: NetworkConfiguration, *, privileged_width: int, **student: Any) -> None:
        """Build all parts; ``privileged_width`` is that of the teacher's input, ``student`` are arguments of ``StudentActor``."""
        teacher = multilayer_perceptron((privileged_width, *configuration.teacher_hidden, configuration.latent_width))
        super().__init__(configuration, **student)
        self.teacher_encoder = teacher

    def teacher_latent(self, privileged: torch.Tensor) -> torch.Tensor:
        """Return unit latents (N, L) from privileged observations (N, P)."""
        return functional.normalize(self.teacher_encoder(privileged), dim=-1)

    def student_latent(self, history: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Return unit latents (N, L) and gate weights (N, K), None without experts; see ``StudentActor``."""
        frames = history.unflatten(-1, self._frames)
        if isinstance(self.student.encoder, ExpertMixture):
            latent, weights = self.student.encoder(frames)
            return functional.normalize(latent, dim=-1), weights
        return functional.normalize(self.student.encoder(frames.flatten(1)), dim=-1), None

    def policy_parameters(self) -> list[nn.Parameter]:
        """Return the parameters that reinforcement learning trains: teacher encoder, actor and exploration noise."""
        return [*self.teacher_encoder.parameters(), *super().policy_parameters()]


class ComposedActor(CtsActor):
    """Teacher encoder, and a student with an actor composed of experts: AC-MoE and MCP."""

    def composed(self, latent: torch.Tensor, policy: torch.Tensor) -> tuple[Sequence[torch.Tensor], torch.Tensor]:
        """Return the actor's output and the weights of its experts (N, K), for latents (N, L) and frames (N, F), in float32: probability
        ratios depend on small differences of actions.
        """
        with torch.autocast(latent.device.type, enabled=False):
            values = torch.cat((latent.float(), policy), dim=-1)
            weights = self.student.actor.weigh(values)
            return self.student.actor(values, weights), weights

    def action_mean(self, latent: torch.Tensor, policy: torch.Tensor) -> torch.Tensor:
        """See ``StudentActor``."""
        return self.composed(latent, policy)[0][0]


class ValueNetwork(nn.Module):
    """Values for a latent, a privileged observation and the weights of the actor's experts; a method uses those that it needs."""

    def value(
        self, latent: torch.Tensor, privileged: torch.Tensor, weights: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Return values (N, 1) for detached latents (N, L), privileged observations (N, P) and weights (N, K)."""
        raise NotImplementedError


class CtsCritic(ValueNetwork):
    """A perceptron on ``[latent, privileged]``; callers pass the latent detached, so that values never train the encoders."""

    def __init__(self, configuration: NetworkConfiguration, *, privileged_width: int) -> None:
        super().__init__()
        widths = (configuration.latent_width + privileged_width, *configuration.critic_hidden, 1)
        self.mlp = multilayer_perceptron(widths)

    def value(
        self, latent: torch.Tensor, privileged: torch.Tensor, weights: torch.Tensor | None = None
    ) -> torch.Tensor:
        """See ``ValueNetwork``."""
        del weights
        return last_in_float32(self.mlp, torch.cat((latent, privileged), dim=-1))


def last_in_float32(layers: nn.Sequential, values: torch.Tensor) -> torch.Tensor:
    """Apply a perceptron, its last layer in float32 in every precision: an action in bfloat16 is off by hundredths of the exploration
    noise, and probability ratios depend on such differences.
    """
    *hidden, last = layers
    for layer in hidden:
        values = linear(values, layer.weight, layer.bias) if isinstance(layer, nn.Linear) else layer(values)
    with torch.autocast(values.device.type, enabled=False):
        return last(values.float())
