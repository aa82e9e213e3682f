"""Share the parts of DreamWaQ and HIM: PPO with an estimator.

One network acts everywhere, on the current frame and on an encoder's estimate from the history: the base's velocity and a latent. The
critic sees the true state. PPO trains actor and critic with the estimates that the rollout acted on; nothing of it reaches the encoder.
Afterwards the encoder learns from the true velocity and from the state one step later, on the same rollout. Samples at the end of an
episode have no next state and count for the velocity alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from tensordict import TensorDict
from torch import nn

from ...policy.networks.architectures import multilayer_perceptron
from ...policy.networks.estimators import VELOCITY
from ..configuration import ConfigurationError, NetworkConfiguration, TrainingConfiguration
from ..networks import StudentActor, ValueNetwork, Widths, last_in_float32, plain_arguments
from .bootstrap import Bootstrap
from .losses import Losses
from .ppo import PPO
from .symmetry import VECTOR, MirrorMap


class EstimatorActor(StudentActor):
    """A network that acts on its estimate, with exploration noise; methods add helpers of the encoder."""

    deployed: ClassVar[str]
    """Name of the deployed network in ``policy.networks``."""

    def __init__(self, configuration: TrainingConfiguration, widths: Widths) -> None:
        """Build the deployed network; methods add the encoder's helpers.

        Raises:
            ConfigurationError: the encoder is no plain one, or the privileged state does not begin with velocity and frame.
        """
        arguments = plain_arguments(configuration, widths, "has one encoder")
        if widths.privileged < VELOCITY + widths.frame:
            raise ConfigurationError(
                f"The privileged observation is {widths.privileged} wide; the method {configuration.algorithm.method!r} needs the "
                f"base's velocity and the frame without noise at its beginning, {VELOCITY + widths.frame} entries."
            )
        arguments["actor_hidden"] = list(configuration.network.actor_hidden)
        super().__init__(configuration.network, architecture=self.deployed, arguments=arguments)

    def frames(self, history: torch.Tensor) -> torch.Tensor:
        """Return frames (N, H, F) of flat histories (N, H·F)."""
        return history.unflatten(-1, self._frames)

    def student_latent(self, history: torch.Tensor) -> tuple[torch.Tensor, None]:
        """Return estimates (N, 3 + L), as they are deployed; see ``StudentActor``."""
        estimate: torch.Tensor = self.student.encode(self.frames(history))[0]
        return estimate, None

    def acted_on(self, history: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
        """Return estimates (N, 3 + L) as the rollout acts on them, where the true velocity is (N, 3)."""
        del velocity
        return self.student_latent(history)[0]

    def helpers(self) -> list[nn.Parameter]:
        """Return parameters that exist in training only: the encoder learns with them."""
        raise NotImplementedError

    def student_parameters(self) -> list[nn.Parameter]:
        """See ``StudentActor``."""
        return [*super().student_parameters(), *self.helpers()]


class StateCritic(ValueNetwork):
    """A perceptron on the privileged observation."""

    def __init__(self, configuration: NetworkConfiguration, *, privileged_width: int) -> None:
        super().__init__()
        self.mlp = multilayer_perceptron((privileged_width, *configuration.critic_hidden, 1))

    def value(
        self, latent: torch.Tensor, privileged: torch.Tensor, weights: torch.Tensor | None = None
    ) -> torch.Tensor:
        """See ``ValueNetwork``."""
        del latent, weights
        return last_in_float32(self.mlp, privileged)


class EstimatorLosses(Losses):
    """Histories, true velocities, next states, and a mask of the samples that have one: the data of an estimator."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        # Made once: nothing may travel to the device in a recorded step.
        self.velocity_map = VECTOR.to(self.device)
        self.next_state_map = None if self.mirror is None else MirrorMap.joined([self.velocity_map, self.mirror.policy])

    def prepare_policy(self) -> None:
        """Compute the latents on which the rollout would have acted in mirror images."""
        if (mirror := self.mirror) is not None:
            history, velocity = self.storage.student_history.flatten(0, 1), self.velocities()
            self.fill(
                self.mirrored_latent,
                lambda rows: self.actor.acted_on(mirror.history(history[rows]), self.velocity_map(velocity[rows])),
            )

    def velocities(self) -> torch.Tensor:
        """True velocity of the base of every sample, (T·N, 3)."""
        return self.storage.privileged[..., :VELOCITY].flatten(0, 1)

    def samples(self, rows: torch.Tensor) -> Sequence[torch.Tensor]:
        """Return samples of the rollout, mirrored as the symmetry asks for: histories (B, H·F), states one step later, velocity and frame
        (B, 3 + F), the present velocity (B, 3), and 1 where the episode went on, (B,).
        """
        storage, mirror = self.storage, self.mirror
        history = storage.student_history.flatten(0, 1)[rows]
        following, velocity = storage.next_state.flatten(0, 1)[rows], self.velocities()[rows]
        goes_on = 1.0 - storage.dones.flatten(0, 1)[rows]
        if mirror is None:
            return history, following, velocity, goes_on
        if self.settings.symmetry == "augment":
            goes_on = goes_on.repeat(2)
        return (
            self.with_images(history, mirror.history),
            self.with_images(following, self.next_state_map),
            self.with_images(velocity, self.velocity_map),
            goes_on,
        )


class EstimatorPPO(PPO):
    """PPO of an actor with an estimator. See the module docstring."""

    estimated = VELOCITY
    actor_class: ClassVar[Any]
    """The method's ``EstimatorActor``, made of a ``TrainingConfiguration`` and ``Widths``."""

    @classmethod
    def networks(cls, configuration: TrainingConfiguration, widths: Widths) -> tuple[StudentActor, ValueNetwork]:
        """See ``PPO``."""
        critic = StateCritic(configuration.network, privileged_width=widths.privileged)
        return cls.actor_class(configuration, widths), critic

    def latents(
        self, obs: TensorDict, privileged: torch.Tensor, history: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """See ``PPO``; the state is also the one after the step before."""
        del obs
        if self.storage.step > 0:
            self._store_next(self.storage.step - 1, privileged)
        estimate = self.actor.acted_on(history, privileged[:, :VELOCITY]).float()
        return estimate, estimate

    def last_values(self, policy: torch.Tensor, privileged: torch.Tensor, history: torch.Tensor) -> torch.Tensor:
        """See ``PPO``; the state is also the one after the last step."""
        del policy
        self._store_next(self.storage.num_steps - 1, privileged)
        return self.critic.value(history, privileged)

    def _store_next(self, step: int, privileged: torch.Tensor) -> None:
        following = self.storage.next_state[step]
        following.copy_(privileged[:, : following.shape[1]])

    def make_bootstrap(self, iterations: int) -> Bootstrap:
        """Return a learner of the critic, from the values of the policy's behaviour, and of the encoder's helpers."""
        return Bootstrap(
            iterations,
            self.configuration,
            parameters=[*self.critic.parameters(), *self.actor.helpers()],
            losses=self._bare_losses,
            names=("value", "estimation"),
            joined=self.joined,
        )

    def _bare_losses(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the value error and the encoder's loss, (2,)."""
        states = self.storage.privileged.flatten(0, 1)[rows]
        error = self.critic.value(states, states).squeeze(-1) - self.storage.returns.flatten(0, 1)[rows]
        return torch.stack((error.square().mean(), self.losses.student(rows)[0]))
