"""Share PPO on a rollout, then supervised learning of the deployed network's encoder on the same rollout, among all methods.

A method is a class derived from ``PPO``: its networks, the actor's inputs, and the losses (``losses.Losses``) of
the encoder. Nothing in the passes waits for the device.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Self

import torch
from tensordict import TensorDict

from ...backends.graphs import RecordedFunction
from ...policy.foreign.fence.archive import LARGEST_FILE
from ..configuration import AlgorithmConfiguration, ConfigurationError, TrainingConfiguration
from ..environment.schedules import RampTable
from ..networks import StudentActor, ValueNetwork, Widths
from ..processes import Processes
from .bootstrap import Bootstrap
from .losses import Losses
from .optimization import Learner, load_moments
from .storage import EnvironmentSplit, RolloutStorage
from .symmetry import Mirror, passes

MOST_WEIGHTS = LARGEST_FILE // 24
"""A checkpoint has each weight as it is and averaged, with two moments, and a part of them once more as the policy, at 4 bytes."""
GROUPS = ("policy", "history", "privileged")
Loss = Callable[..., tuple[torch.Tensor, torch.Tensor]]


class PPO:
    """The passes over a rollout, their optimizers and counters. See the module docstring."""

    losses_class: ClassVar[type[Losses]]
    """Losses of the method."""
    has_teacher: ClassVar[bool] = False
    """True if a teacher acts in some environments (``student_period``)."""
    estimated: ClassVar[int] = 0
    """Entries of the next state before its frame, the base's velocity, that an encoder estimates beside its latent; 0 for none."""

    def __init__(
        self,
        actor: StudentActor,
        critic: ValueNetwork,
        storage: RolloutStorage,
        *,
        configuration: AlgorithmConfiguration,
        mirror: Mirror | None = None,
        device: str = "cpu",
        processes: Processes | None = None,
    ) -> None:
        """Prepare optimizers and counters.

        Raises:
            ConfigurationError: symmetry is asked for but no mirror is given, or CUDA graphs without a CUDA device.
        """
        on_gpu = torch.device(device).type == "cuda"
        if configuration.symmetry != "none" and mirror is None:
            raise ConfigurationError(
                f"training.algorithm.symmetry is {configuration.symmetry!r}, but the task gives no mirror maps; set it to 'none'."
            )
        if configuration.cuda_graphs and not on_gpu:
            raise ConfigurationError("training.algorithm.cuda_graphs is on; it needs a CUDA device.")
        self.device = device
        self.actor: Any = actor.to(device)
        self.critic, self.storage = critic.to(device), storage
        self.configuration = configuration
        self.processes = processes or Processes()
        self.bootstrap: Bootstrap | None = None
        self.steps = 0
        """Minibatches of the last update, counted once in each pass over them."""
        self._graphs = on_gpu and configuration.cuda_graphs is not False
        self.losses: Any = self.losses_class(
            actor,
            critic,
            storage,
            settings=configuration,
            mirror=mirror.to(device) if mirror is not None and configuration.symmetry != "none" else None,
            cached_casts=not self._graphs,
        )
        # The learning rate lives on the device, where the KL divergence is, so that adapting it needs no round trip.
        self._rate = torch.tensor(configuration.learning_rate, device=device)
        learned, rate = [*actor.policy_parameters(), *critic.parameters()], configuration.student_learning_rate
        limit, fast = configuration.max_gradient_norm, {"fused": on_gpu, "capturable": on_gpu}
        self._policy = Learner(learned, self.losses.policy_names, limit, lr=self._rate, **fast)
        self._student = Learner(actor.student_parameters(), self.losses.student_names, limit, lr=rate, **fast)
        self.optimizer, self.student_optimizer = self._policy.optimizer, self._student.optimizer
        self._adapts = configuration.desired_kl is not None
        self._ramps = RampTable([configuration.entropy_coefficient, configuration.desired_kl or 0.0], device)
        self._desired_kl = torch.zeros((), device=device)
        self.follow(torch.zeros((), device=device))
        self._policy_loss, self._student_loss = self.losses.policy, self.losses.student
        mode = configuration.compile_mode
        if mode == "default" or (mode == "auto" and on_gpu):
            self._policy_loss, self._student_loss = torch.compile(self._policy_loss), torch.compile(self._student_loss)
        self._prepare_steps()

    @classmethod
    def build(
        cls,
        observations: TensorDict,
        configuration: TrainingConfiguration,
        *,
        num_actions: int,
        command_entries: tuple[int, ...] = (),
        mirror: Mirror | None = None,
        device: str = "cpu",
        processes: Processes | None = None,
    ) -> Self:
        """Build networks, storage and algorithm for an environment.

        Args:
            observations: the groups ``policy`` (N, F), ``history`` (N, H·F) frame by frame, oldest first, and ``privileged`` (N, P).
            num_actions: width J of an action.
            command_entries: entries of a frame that hold the command.

        Raises:
            ConfigurationError: an observation group is missing or has an impossible width, or the networks' settings do not fit.
        """
        for group in GROUPS:
            if group not in observations or observations[group].dim() != 2:
                raise ConfigurationError(
                    f"The environment must give an observation group {group!r} of shape (environments, width)."
                )
        frame, history, privileged = (observations[group].shape[-1] for group in GROUPS)
        if history % frame:
            raise ConfigurationError(
                f"The history is {history} wide, which is not a multiple of the frame width {frame}."
            )
        settings = configuration.algorithm
        torch.set_float32_matmul_precision("highest" if settings.precision == "float32" else "high")
        widths = Widths(
            environments=observations.batch_size[0],
            frame=frame,
            history=history // frame,
            privileged=privileged,
            actions=num_actions,
            command_entries=command_entries,
        )
        with torch.device("meta"):  # counted before they take memory
            weights = sum(p.numel() for module in cls.networks(configuration, widths) for p in module.parameters())
        if weights > MOST_WEIGHTS:
            raise ConfigurationError(
                f"The networks have {weights:,} weights; at most {MOST_WEIGHTS:,} fit into a checkpoint that can be read again. "
                "Make training.network.* smaller."
            )
        actor, critic = cls.networks(configuration, widths)
        period = settings.student_period if cls.has_teacher else 1
        storage = RolloutStorage(
            EnvironmentSplit.build(widths.environments, period, device),
            configuration.run.steps_per_iteration,
            widths,
            latent_width=cls.estimated + configuration.network.latent_width,
            next_state_width=cls.estimated + widths.frame if cls.estimated else 0,
            device=device,
        )
        return cls(actor, critic, storage, configuration=settings, mirror=mirror, device=device, processes=processes)

    @classmethod
    def networks(cls, configuration: TrainingConfiguration, widths: Widths) -> tuple[StudentActor, ValueNetwork]:
        """Return the method's actor and critic. Raises ConfigurationError: settings that do not fit."""
        raise NotImplementedError

    @property
    def learning_rate(self) -> float:
        """Return the present learning rate of the policy optimizer; reading it waits for the device."""
        return float(self._rate.item())

    @learning_rate.setter
    def learning_rate(self, value: float) -> None:
        self._rate.fill_(float(value))

    @property
    def action_std(self) -> torch.Tensor:
        """Return the standard deviation of the exploration noise, (J,)."""
        std: torch.Tensor = self.actor.output_std
        return std

    def follow(self, progress: torch.Tensor) -> None:
        """Take the settings of a fraction of the run, a scalar tensor, for the next update."""
        entropy, desired_kl = self._ramps.at(progress)
        self.losses.entropy_coefficient.copy_(entropy)
        self._desired_kl.copy_(desired_kl)

    def follow_student(self, iterations: int) -> None:
        """Spend the next iterations on the networks that a bare policy lacks, while it stands still (see ``bootstrap``)."""
        self.bootstrap = self.make_bootstrap(iterations) if iterations > 0 else None

    def make_bootstrap(self, iterations: int) -> Bootstrap:
        """Return the learner of the networks that a bare policy lacks."""
        raise NotImplementedError

    # Rollout

    @torch.no_grad()
    def act(self, obs: TensorDict) -> torch.Tensor:
        """Sample and store actions, (N, J) in environment order: a teacher's in its environments, the student's in the others."""
        actor = self.actor
        # Indexing copies, so an environment may reuse the memory of its observations.
        policy, privileged, history = self._in_blocks(obs)
        with self.losses.autocast():
            latent, student_latent = self.latents(obs, privileged, history)
            decision, weights = actor.decide(latent, policy)
            values = self.critic.value(latent, privileged, weights).float()
        actor.distribution.update(decision.float())
        action_mean, action_std = actor.distribution.params
        # Not ``distribution.sample()``: torch asks the device whether a deviation is negative, and waits for the answer.
        actions = action_mean + action_std * torch.randn_like(action_mean)
        self.storage.add(
            policy=policy,
            privileged=privileged,
            student_history=history,
            student_latent=student_latent,
            actions=actions,
            action_mean=action_mean,
            action_std=action_std,
            log_prob=actor.distribution.log_prob(actions),
            values=values.squeeze(-1),
        )
        return actions[self.storage.split.inverse]

    def _in_blocks(self, obs: TensorDict) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return frames (N, F) and states (N, P) in block order, and the students' histories (Ns, H·F)."""
        split = self.storage.split
        return (
            obs["policy"][split.order],
            obs["privileged"][split.order],
            obs["history"][split.order[split.num_teacher :]],
        )

    def latents(
        self, obs: TensorDict, privileged: torch.Tensor, history: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the actor's latents, (N, L) in block order, and the students' part of them, (Ns, L), as it is to be stored, from all
        groups in environment order, the states (N, P) in block order, and the students' histories (Ns, H·F).
        """
        raise NotImplementedError

    def store_outcome(self, rewards: torch.Tensor, dones: torch.Tensor, extras: Mapping[str, Any]) -> None:
        """Store the outcome of the actions, (N,) each in environment order. An episode that ends by ``time_outs`` is worth its last value
        beyond.
        """
        storage, order = self.storage, self.storage.split.order
        rewards = rewards[order]
        if "time_outs" in extras:
            time_outs = extras["time_outs"].to(self.device)[order].float()
            rewards = rewards + self.configuration.discount * (storage.values[storage.step] * time_outs)
        storage.add(rewards=rewards, dones=dones[order])
        storage.step += 1

    @torch.no_grad()
    def compute_returns(self, obs: TensorDict) -> None:
        """Compute returns and advantages; advantages are normalized over all samples together."""
        policy, privileged, history = self._in_blocks(obs)
        with self.losses.autocast():
            last_values = self.last_values(policy, privileged, history).float().squeeze(-1)
        settings = self.configuration
        self.storage.compute_returns(last_values, discount=settings.discount, gae_lambda=settings.gae_lambda)

    def last_values(self, policy: torch.Tensor, privileged: torch.Tensor, history: torch.Tensor) -> torch.Tensor:
        """Return values (N, 1) of the states after the rollout: frames (N, F) and states (N, P) in block order, the students' histories
        (Ns, H·F).
        """
        raise NotImplementedError

    # Update

    def update(self, stepped: Callable[[], None] = lambda: None) -> dict[str, float]:
        """Run all passes over the rollout and call ``stepped`` after every step. Return means over the minibatches, by name;
        ``skipped_minibatches`` counts those that were dropped because their gradients were not finite.
        """
        storage, settings = self.storage, self.configuration
        storage.step = self.steps = 0
        if (bootstrap := self.bootstrap) is not None:
            self.losses.prepare_student()
            self.pass_over(storage.minibatch_rows(settings.minibatches), bootstrap.step, stepped)
            losses = bootstrap.finish()
            self.bootstrap = None if bootstrap.over else bootstrap
            return losses
        self._policy.sums.zero_()
        self._student.sums.zero_()
        groups = storage.minibatch_rows(settings.minibatches)
        self.losses.prepare_policy()
        self.pass_over(groups, self._policy_step, stepped)
        self.losses.prepare_student()
        self.pass_over((storage.student_rows(groups[-1]),), self._student_step, stepped)
        return self._report()

    def pass_over(self, groups: Sequence[torch.Tensor], step: Callable[..., None], stepped: Callable[[], None]) -> None:
        """Take a step on every minibatch of rows, (M, B) for each group, once in each pass; call ``stepped`` after each."""
        for turned in passes(self.configuration.epochs, alternate=self.configuration.symmetry == "alternate"):
            for minibatch in zip(*groups, strict=True):
                step(*map(turned, minibatch))
                self.steps += 1
                stepped()

    def _report(self) -> dict[str, float]:
        """Read the counters back, the update's only wait for the device."""
        total = self.configuration.epochs * self.configuration.minibatches
        sums = torch.cat((self._policy.sums, self._student.sums)).tolist()
        count = len(self.losses.policy_names)
        policy = dict(zip((*self.losses.policy_names, "gradient_norm"), sums, strict=False))
        student = dict(zip(self.losses.student_names, sums[count + 2 :], strict=False))
        skipped = sums[count + 1] + sums[-1]
        if self.configuration.symmetry != "augment":  # no pair of images to compare
            del policy["symmetry"]
        for name in self.without_meaning():
            del student[name]
        means = {name: value / total for name, value in (policy | student).items()}
        return means | {"skipped_minibatches": skipped}

    def without_meaning(self) -> tuple[str, ...]:
        """Return figures of the student's loss that mean nothing with these networks."""
        return ()

    def _prepare_steps(self) -> None:
        """Make the steps on one minibatch: gradients, their mean over the processes, and the step along them."""
        kl = self._policy.gradients.extra[self.losses.policy_names.index("kl")]
        self._policy_step = self.joined(self._policy_loss, self._policy, lambda: self._adapt_learning_rate(kl))
        self._student_step = self.joined(self._student_loss, self._student)

    def joined(
        self, loss: Loss, learner: Learner, prepare: Callable[[], None] = lambda: None, *, graphs: bool = True
    ) -> Callable[..., None]:
        """Join two halves to one step: gradients of a loss of rows, and ``prepare`` and the step along them. Between several processes each
        half is a CUDA graph of its own, where there are any and ``graphs`` allows it: a message inside a graph could not be given up when
        a process is lost.
        """

        def compute(*rows: torch.Tensor) -> None:
            value, metrics = loss(*rows)
            learner.optimizer.zero_grad(set_to_none=True)
            value.backward()
            learner.gradients.gather()
            learner.gradients.extra.copy_(metrics)

        def apply() -> None:
            prepare()
            learner.step()

        def recorded(step: Callable[..., None]) -> Callable[..., None]:
            return RecordedFunction(step, self.device) if self._graphs and graphs else step

        def whole(*rows: torch.Tensor) -> None:
            compute(*rows)
            apply()

        if not self.processes.several:
            return recorded(whole)
        first, second = recorded(compute), recorded(apply)

        def shared(*rows: torch.Tensor) -> None:
            first(*rows)
            self.processes.average(learner.gradients.values)
            second()

        return shared

    def _adapt_learning_rate(self, kl: torch.Tensor) -> None:
        """Adapt the learning rate on the device as rsl_rl does: slower above twice the desired divergence, faster below half of it."""
        if not self._adapts:
            return
        low, high = self.configuration.learning_rate_range
        slower, faster = (self._rate / 1.5).clamp(min=low), (self._rate * 1.5).clamp(max=high)
        too_far, too_near = kl > 2.0 * self._desired_kl, (kl < 0.5 * self._desired_kl) & (kl > 0.0)
        self._rate.copy_(torch.where(too_far, slower, torch.where(too_near, faster, self._rate)))

    # Checkpoints

    def save(self) -> dict[str, Any]:
        """Return the state of all networks and of both optimizers, under rsl_rl's names, and of ``bootstrap`` while it lasts."""
        bare = {} if self.bootstrap is None else {"bootstrap": self.bootstrap.save()}
        return bare | {
            "actor_state_dict": self.actor.state_dict(),
            "critic_state_dict": self.critic.state_dict(),
            "optimizer_state_dict": self.optimizer.state_dict(),
            "student_optimizer_state_dict": self.student_optimizer.state_dict(),
        }

    def load(self, state: Mapping[str, Any], *, optimizers: bool = True) -> None:
        """Take over a state of ``save``. Raises RuntimeError, LookupError, ValueError, TypeError, AttributeError: it does not fit."""
        self.actor.load_state_dict(state["actor_state_dict"])
        self.critic.load_state_dict(state["critic_state_dict"])
        if optimizers:
            self.learning_rate = load_moments(self.optimizer, state["optimizer_state_dict"])
            load_moments(self.student_optimizer, state["student_optimizer_state_dict"])
            self.bootstrap = None
            if "bootstrap" in state:
                self.bootstrap = self.make_bootstrap(1)
                self.bootstrap.load(state["bootstrap"])
            # Loading replaced the rate's tensor by a copy.
            for group in self.optimizer.param_groups:
                group["lr"] = self._rate
        # Captured graphs refer to the replaced optimizer state.
        self._prepare_steps()

    def share(self) -> None:
        """Give all processes the networks of the first."""
        self.processes.copy_first([*self.actor.state_dict().values(), *self.critic.state_dict().values()])
