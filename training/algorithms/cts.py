"""Concurrent teacher-student PPO (paper, method), on rsl_rl's PPO.

Most environments are driven by the teacher, which sees the true state, the others by the student, which sees the last
few observations. Both share one actor and one critic. Per iteration:

1. PPO on both groups. The policy gradient of teacher samples reaches the teacher encoder through the actor; the critic
   gets the latent detached, and so do actor and critic on student samples. Nothing of this trains the student encoder.
2. The student encoder learns the teacher's latent on its own samples, with its own optimizer; a Mixture of Experts is
   kept balanced by an auxiliary loss.

Because the student encoder stands still during 1 and the teacher encoder during 2, the student's latents are those of
the rollout and the teacher's targets are computed once. Nothing in the passes waits for the device.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.env import VecEnv
from rsl_rl.utils import reduce_gradients_in_buckets
from tensordict import TensorDict

from ..configuration import AlgorithmConfiguration, ConfigurationError, NetworkConfiguration
from ..networks import CtsActor, CtsCritic, student_architecture
from ..schedules import RampTable
from .bootstrap import Bootstrap
from .gradients import clip_gradients
from .graphs import GraphedStep
from .storage import EnvironmentSplit, StratifiedStorage
from .symmetry import Mirror, half_mirrored, half_replaced, passes, second_halves

POLICY_METRICS = ("value", "surrogate", "entropy", "kl", "symmetry", "gradient_norm", "skipped")
STUDENT_METRICS = ("latent", "load_balance", "largest_expert_share", "skipped")
GROUPS = ("policy", "history", "privileged")


class CTS(PPO):
    """PPO with a concurrent student. See the module docstring."""

    actor: CtsActor
    critic: CtsCritic
    storage: StratifiedStorage
    transition: StratifiedStorage.Transition

    def __init__(
        self,
        actor: CtsActor,
        critic: CtsCritic,
        storage: StratifiedStorage,
        *,
        configuration: AlgorithmConfiguration,
        mirror: Mirror | None = None,
        device: str = "cpu",
        multi_gpu_cfg: dict[str, int] | None = None,
    ) -> None:
        """Prepare optimizers and counters.

        Raises:
            ConfigurationError: symmetry is asked for but no mirror is given, or CUDA graphs where they cannot be used.
        """
        super().__init__(
            actor,
            critic,
            storage,
            num_learning_epochs=configuration.epochs,
            num_mini_batches=configuration.minibatches,
            clip_param=configuration.clip,
            gamma=configuration.discount,
            lam=configuration.gae_lambda,
            value_loss_coef=configuration.value_coefficient,
            entropy_coef=0.0,  # see ``follow``
            learning_rate=configuration.learning_rate,
            max_grad_norm=configuration.max_gradient_norm,
            use_clipped_value_loss=configuration.clip_value_loss,
            schedule="fixed" if configuration.desired_kl is None else "adaptive",
            desired_kl=configuration.desired_kl,
            device=device,
            multi_gpu_cfg=multi_gpu_cfg,
        )
        on_gpu = torch.device(device).type == "cuda"
        if configuration.symmetry != "none" and mirror is None:
            raise ConfigurationError(
                f"symmetry is {configuration.symmetry!r}, but the task gives no mirror maps; set it to 'none'."
            )
        if configuration.cuda_graphs and (not on_gpu or self.is_multi_gpu):
            raise ConfigurationError("cuda_graphs is on; it needs a single CUDA device.")
        self._graphs = on_gpu and not self.is_multi_gpu and configuration.cuda_graphs is not False
        self.configuration = configuration
        self.mirror = mirror.to(device) if mirror is not None and configuration.symmetry != "none" else None
        self.transition = StratifiedStorage.Transition()
        self.bootstrap: Bootstrap | None = None
        self._policy_parameters = [*actor.policy_parameters(), *critic.parameters()]
        self.optimizer = torch.optim.Adam(self._policy_parameters, lr=self._rate, fused=on_gpu, capturable=on_gpu)
        self.student_optimizer = torch.optim.Adam(
            actor.student_parameters(), lr=configuration.student_learning_rate, fused=on_gpu, capturable=on_gpu
        )
        self._entropy = RampTable([configuration.entropy_coefficient], device)
        self._entropy_coefficient = self._entropy.at(torch.zeros((), device=device))[0].clone()
        self._policy_metrics = torch.zeros(len(POLICY_METRICS), device=device)
        self._student_metrics = torch.zeros(len(STUDENT_METRICS), device=device)
        split = storage.split
        samples = storage.num_transitions_per_env * split.num_student
        latent_width = storage.student_latent.shape[-1]
        self._targets = torch.zeros(samples, latent_width, device=device)
        if self.mirror is not None:
            self._mirrored_latent = torch.zeros(samples, latent_width, device=device)
            self._mirrored_targets = torch.zeros(samples, latent_width, device=device)
        self._policy_loss: Callable[..., tuple[torch.Tensor, torch.Tensor]] = self._compute_policy_loss
        self._student_loss: Callable[..., tuple[torch.Tensor, torch.Tensor]] = self._compute_student_loss
        mode = configuration.compile_mode
        if mode == "auto":
            mode = "default" if on_gpu else "none"
        if mode != "none":
            self._policy_loss = torch.compile(self._compute_policy_loss, mode=mode)
            self._student_loss = torch.compile(self._compute_student_loss, mode=mode)
        self._prepare_steps()

    @staticmethod
    def construct_algorithm(obs: TensorDict, env: VecEnv, cfg: dict[str, Any], device: str) -> CTS:
        """Build networks, storage and algorithm for an environment; rsl_rl's runner calls this.

        Args:
            obs: observations with the groups ``policy`` (N, F), ``history`` (N, H·F) frame by frame, oldest first, and
                ``privileged`` (N, P).
            env: the environment.
            cfg: ``TrainingConfiguration.to_rsl_rl()``, with ``mirror`` and ``command_entries`` added where there are
                any.
            device: where to learn.

        Raises:
            ConfigurationError: an observation group is missing or has an impossible width.
        """
        configuration: AlgorithmConfiguration = cfg["algorithm"]["configuration"]
        network: NetworkConfiguration = cfg["network"]
        for group in GROUPS:
            if group not in obs or obs[group].dim() != 2:
                raise ConfigurationError(
                    f"The environment must give an observation group {group!r} of shape (environments, width)."
                )
        frame, history = obs["policy"].shape[-1], obs["history"].shape[-1]
        if history % frame:
            raise ConfigurationError(
                f"The history is {history} wide, which is not a multiple of the frame width {frame}."
            )
        torch.set_float32_matmul_precision("highest" if configuration.precision == "float32" else "high")
        architecture, arguments = student_architecture(
            network,
            frame_width=frame,
            num_actions=env.num_actions,
            history_length=history // frame,
            command_entries=cfg.get("command_entries", ()),
        )
        privileged = obs["privileged"].shape[-1]
        actor = CtsActor(network, privileged_width=privileged, architecture=architecture, arguments=arguments)
        critic = CtsCritic(network, privileged_width=privileged)
        split = EnvironmentSplit.build(env.num_envs, configuration.student_period, device)
        storage = StratifiedStorage(split, cfg["num_steps_per_env"], obs, env.num_actions, network.latent_width, device)
        return CTS(
            actor,
            critic,
            storage,
            configuration=configuration,
            mirror=cfg.get("mirror"),
            device=device,
            multi_gpu_cfg=cfg.get("multi_gpu"),
        )

    # The learning rate lives on the device, where the KL divergence is, so that adapting it needs no round trip.

    @property
    def learning_rate(self) -> float:
        """Present learning rate of the policy optimizer; reading it waits for the device."""
        return float(self._rate.item())

    @learning_rate.setter
    def learning_rate(self, value: float) -> None:
        if not hasattr(self, "_rate"):
            self._rate = torch.zeros((), device=self.device)
        self._rate.fill_(float(value))

    def follow(self, progress: torch.Tensor) -> None:
        """Take the settings of a fraction of the run, a scalar tensor, for the next update."""
        self._entropy_coefficient.copy_(self._entropy.at(progress)[0])

    def follow_student(self, iterations: int) -> None:
        """Spend the next iterations on a teacher and a critic for the present student (see ``bootstrap``)."""
        self.bootstrap = Bootstrap(self, iterations) if iterations > 0 else None

    # Rollout

    def act(self, obs: TensorDict) -> torch.Tensor:
        """Sample actions, (N, J) in environment order: the teacher's in its environments, the student's in the
        others.
        """
        split, step = self.storage.split, self.transition
        # Indexing copies, so an environment may reuse the memory of its observations.
        policy, privileged = obs["policy"][split.order], obs["privileged"][split.order]
        history = obs["history"][split.order[split.num_teacher :]]
        with self._autocast():
            student_latent = self.actor.student_latent(history)[0]
            if self.bootstrap is None:
                teacher_latent = self.actor.teacher_latent(privileged[: split.num_teacher])
            else:
                others = obs["history"][split.order[: split.num_teacher]]
                teacher_latent = self.actor.student_latent(others)[0]
            latent = torch.cat((teacher_latent, student_latent))
            mean = self.actor.action_mean(latent, policy).float()
            values = self.critic.value(latent, privileged).float()
        self.actor.distribution.update(mean)
        actions = self.actor.distribution.sample().detach()
        step.actions = actions
        step.values = values.detach()
        step.actions_log_prob = self.actor.distribution.log_prob(actions).detach()
        step.distribution_params = tuple(p.detach() for p in self.actor.distribution.params)
        step.observations = TensorDict({"policy": policy, "privileged": privileged}, batch_size=[policy.shape[0]])
        step.student_history = history
        step.student_latent = student_latent.detach().float()
        return actions[split.inverse]

    def process_env_step(
        self, obs: TensorDict, rewards: torch.Tensor, dones: torch.Tensor, extras: dict[str, Any]
    ) -> None:
        """Store the outcome of a step, given in environment order."""
        order = self.storage.split.order
        in_blocks = {"time_outs": extras["time_outs"].to(self.device)[order].float()} if "time_outs" in extras else {}
        super().process_env_step(obs, rewards[order], dones[order], in_blocks)

    def compute_returns(self, obs: TensorDict) -> None:
        """Returns and advantages; advantages are normalized over teacher and student samples together."""
        split = self.storage.split
        privileged = obs["privileged"][split.order]
        with torch.no_grad(), self._autocast():
            student = self.actor.student_latent(obs["history"][split.order[split.num_teacher :]])[0]
            latent = torch.cat((self.actor.teacher_latent(privileged[: split.num_teacher]), student))
            # rsl_rl's critic call takes named groups.
            super().compute_returns(
                TensorDict({"latent": latent, "privileged": privileged}, batch_size=[privileged.shape[0]])
            )
        self.storage.keep_advantages()

    # Update

    def update(self) -> dict[str, float]:
        """Run all passes over the rollout.

        Returns:
            Means over the minibatches, by name; ``skipped_minibatches`` counts those whose gradients were not finite
            and were dropped.
        """
        if self.bootstrap is not None:
            losses = self.bootstrap.update()
            if self.bootstrap.over:
                self.bootstrap = None
            return losses
        storage, settings, mirror = self.storage, self.configuration, self.mirror
        self._policy_metrics.zero_()
        self._student_metrics.zero_()
        teacher_rows, student_rows = storage.minibatch_rows(settings.minibatches)
        history = storage.student_history.flatten(0, 1)
        if mirror is not None:
            self._fill(self._mirrored_latent, lambda rows: self.actor.student_latent(mirror.history(history[rows]))[0])
        for turned in passes(settings.epochs, alternate=settings.symmetry == "alternate"):
            for teacher, student in zip(teacher_rows, student_rows, strict=True):
                self._policy_step(turned(teacher), turned(student))

        privileged = storage.observations["privileged"][:, storage.split.num_teacher :].flatten(0, 1)
        self._fill(self._targets, lambda rows: self.actor.teacher_latent(privileged[rows]))
        if mirror is not None:
            mirrored = mirror.privileged
            self._fill(self._mirrored_targets, lambda rows: self.actor.teacher_latent(mirrored(privileged[rows])))
        rows_in_history = storage.student_rows(student_rows)
        for turned in passes(settings.epochs, alternate=settings.symmetry == "alternate"):
            for student in rows_in_history:
                self._student_step(turned(student))
        storage.clear()
        return self._report()

    def _report(self) -> dict[str, float]:
        """Read the counters back, the update's only wait for the device."""
        total = self.configuration.epochs * self.configuration.minibatches
        sums = torch.cat((self._policy_metrics, self._student_metrics)).tolist()
        policy = dict(zip(POLICY_METRICS, sums[: len(POLICY_METRICS)], strict=True))
        student = dict(zip(STUDENT_METRICS, sums[len(POLICY_METRICS) :], strict=True))
        skipped = policy.pop("skipped") + student.pop("skipped")
        if self.mirror is None or self.configuration.symmetry == "alternate":  # no pair of images to compare
            del policy["symmetry"]
        if not self.has_experts:
            del student["load_balance"], student["largest_expert_share"]
        means = {name: value / total for name, value in (policy | student).items()}
        return means | {"skipped_minibatches": skipped}

    @property
    def has_experts(self) -> bool:
        """Whether the student encoder is a Mixture of Experts."""
        return self.actor.architecture == "moe_cts"

    def _fill(self, target: torch.Tensor, compute: Callable[[slice], torch.Tensor], chunk: int = 65_536) -> None:
        """Write ``compute(rows)`` into ``target`` chunk by chunk, without gradients."""
        with torch.no_grad(), self._autocast():
            for start in range(0, len(target), chunk):
                rows = slice(start, start + chunk)
                target[rows].copy_(compute(rows))

    def _prepare_steps(self) -> None:
        self._policy_step: Callable[[torch.Tensor, torch.Tensor], None] = self._run_policy_step
        self._student_step: Callable[[torch.Tensor], None] = self._run_student_step
        if self._graphs:
            self._policy_step = GraphedStep(self._run_policy_step)
            self._student_step = GraphedStep(self._run_student_step)

    def _autocast(self) -> AbstractContextManager[Any]:
        # The cache of cast weights would outlive the weights inside a captured graph.
        return torch.autocast(
            torch.device(self.device).type,
            dtype=torch.bfloat16,
            enabled=self.configuration.precision == "bfloat16",
            cache_enabled=not self._graphs,
        )

    def _run_policy_step(self, teacher_rows: torch.Tensor, student_rows: torch.Tensor) -> None:
        """One PPO step on one minibatch."""
        loss, metrics = self._policy_loss(teacher_rows, student_rows)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        kl = metrics[POLICY_METRICS.index("kl")]
        if self.is_multi_gpu:
            reduce_gradients_in_buckets(self._policy_parameters, self.gpu_world_size, self.grad_reduce_bucket_mb)
            kl = kl / self.gpu_world_size
            torch.distributed.all_reduce(kl)
        self._adapt_learning_rate(kl)
        if self.configuration.joint_gradient_clip:
            norm, skipped = clip_gradients(self._policy_parameters, self.max_grad_norm)
        else:
            norm, skipped = clip_gradients(self.actor.policy_parameters(), self.max_grad_norm)
            critic_norm, critic_skipped = clip_gradients(self.critic.parameters(), self.max_grad_norm)
            norm, skipped = torch.hypot(norm, critic_norm), torch.maximum(skipped, critic_skipped)
        self.optimizer.step()
        self._policy_metrics += torch.nan_to_num(torch.cat((metrics, torch.stack((norm, skipped)))), 0.0, 0.0, 0.0)

    def _compute_policy_loss(
        self, teacher_rows: torch.Tensor, student_rows: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """PPO loss and the first five of ``POLICY_METRICS``, (5,), detached.

        The surrogate is the mean over teacher samples plus the mean over student samples, so that the fewer student
        samples count as much; value loss and entropy are means over all.
        """
        storage, mirror, settings = self.storage, self.mirror, self.configuration
        groups = (teacher_rows, student_rows)
        frames = storage.observations["policy"].flatten(0, 1)
        states = storage.observations["privileged"].flatten(0, 1)
        student_latents = storage.student_latent.flatten(0, 1)
        in_history = storage.student_rows(student_rows)
        policy, privileged = [frames[rows] for rows in groups], [states[rows] for rows in groups]
        latent = student_latents[in_history]
        rows, copies = torch.cat(groups), 1
        alternate = mirror is not None and settings.symmetry == "alternate"
        if mirror is not None and alternate:
            policy = [half_mirrored(p, mirror.policy) for p in policy]
            privileged = [half_mirrored(p, mirror.privileged) for p in privileged]
            latent = half_replaced(latent, self._mirrored_latent[in_history])
        elif mirror is not None:
            # Blocks: teacher, student, and their mirror images in the same order.
            policy += [mirror.policy(p) for p in policy]
            privileged += [mirror.privileged(p) for p in privileged]
            copies = 2
        with self._autocast():
            latents = []
            for block in range(copies):
                student_latent = latent if block == 0 else self._mirrored_latent[in_history]
                latents += [self.actor.teacher_latent(privileged[2 * block]), student_latent]
            latent, states_in = torch.cat(latents), torch.cat(privileged)
            mean = self.actor.action_mean(latent, torch.cat(policy)).float()
            count = len(rows)
            if settings.symmetry == "loss":
                # The critic has nothing to learn from mirror images here.
                values = self.critic.value(latent[:count].detach(), states_in[:count]).float().squeeze(-1)
            else:
                values = self.critic.value(latent.detach(), states_in).float().squeeze(-1)

        def stored(buffer: torch.Tensor) -> torch.Tensor:
            return buffer.flatten(0, 1)[rows]

        actions, advantages = stored(storage.actions), stored(storage.advantages).squeeze(-1)
        old_log_prob, returns = stored(storage.actions_log_prob).squeeze(-1), stored(storage.returns).squeeze(-1)
        old_values = stored(storage.values).squeeze(-1)
        distribution = self.actor.distribution
        old = [stored(p) for p in storage.distribution_params]
        plain = mean[:count]
        if alternate:  # how far the policy has moved is seen where it acted
            *old, plain = (second_halves(p, len(teacher_rows)) for p in (*old, plain))
        distribution.update(plain)
        kl = distribution.kl_divergence(tuple(old), distribution.params).mean().detach()
        entropy = distribution.entropy.mean()
        symmetry = torch.zeros((), device=mean.device)
        if mirror is not None and alternate:
            distribution.update(mean)
            blocks = actions.split([len(teacher_rows), len(student_rows)])
            actions = torch.cat([half_mirrored(block, mirror.action) for block in blocks])
        elif mirror is not None:
            symmetry = (mean[count:] - mirror.action(mean[:count].detach())).square().mean()
        if settings.symmetry == "augment":
            # A mirrored sample counts as drawn from the mirrored policy, whose probability is that of the original.
            distribution.update(mean)
            actions = torch.cat((actions, mirror.action(actions)))  # type: ignore[union-attr]
            advantages, old_log_prob, returns, old_values = (
                x.repeat(2) for x in (advantages, old_log_prob, returns, old_values)
            )

        ratio = torch.exp(distribution.log_prob(actions) - old_log_prob)
        clipped = ratio.clamp(1.0 - settings.clip, 1.0 + settings.clip)
        surrogates = torch.maximum(-advantages * ratio, -advantages * clipped).view(-1, count)
        teachers = len(teacher_rows)
        surrogate = surrogates[:, :teachers].mean() + surrogates[:, teachers:].mean()
        errors = (values - returns).square()
        if settings.clip_value_loss:
            limited = old_values + (values - old_values).clamp(-settings.clip, settings.clip)
            errors = torch.maximum(errors, (limited - returns).square())
        value = errors.mean()
        loss = surrogate + settings.value_coefficient * value - self._entropy_coefficient * entropy
        if settings.symmetry == "loss":
            loss = loss + settings.symmetry_coefficient * symmetry
        return loss, torch.stack((value, surrogate, entropy, kl, symmetry)).detach()

    def _run_student_step(self, rows: torch.Tensor) -> None:
        """One step of the student encoder on one minibatch; ``rows`` index the student-only buffers."""
        loss, metrics = self._student_loss(rows)
        self.student_optimizer.zero_grad(set_to_none=True)
        loss.backward()
        parameters = self.actor.student_parameters()
        if self.is_multi_gpu:
            reduce_gradients_in_buckets(parameters, self.gpu_world_size, self.grad_reduce_bucket_mb)
        _, skipped = clip_gradients(parameters, self.max_grad_norm)
        self.student_optimizer.step()
        self._student_metrics += torch.nan_to_num(torch.cat((metrics, skipped[None])), 0.0, 0.0, 0.0)

    def _compute_student_loss(self, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Latent error, plus the experts' load balancing loss; and the first three of ``STUDENT_METRICS``, (3,),
        detached.
        """
        history = self.storage.student_history.flatten(0, 1)[rows]
        target = self._targets[rows]
        if self.mirror is not None and self.configuration.symmetry == "alternate":
            history = half_mirrored(history, self.mirror.history)
            target = half_replaced(target, self._mirrored_targets[rows])
        elif self.mirror is not None and self.configuration.symmetry == "augment":
            history = torch.cat((history, self.mirror.history(history)))
            target = torch.cat((target, self._mirrored_targets[rows]))
        with self._autocast():
            latent, weights = self.actor.student_latent(history)
        error = (latent.float() - target).square().mean()
        if weights is None:
            return error, torch.stack((error, torch.zeros_like(error), torch.zeros_like(error))).detach()
        share = weights.float().mean(dim=0)
        deviation = (share - 1.0 / len(share)).square()
        balance = deviation.sum() if self.configuration.load_balance == "sum" else deviation.mean()
        loss = error + self.configuration.load_balance_coefficient * balance
        return loss, torch.stack((error, balance, share.max())).detach()

    def _adapt_learning_rate(self, kl: torch.Tensor) -> None:
        """rsl_rl's rule, on the device: slower above twice the desired divergence, faster below half of it."""
        target = self.configuration.desired_kl
        if target is None:
            return
        low, high = self.configuration.learning_rate_range
        slower, faster = (self._rate / 1.5).clamp(min=low), (self._rate * 1.5).clamp(max=high)
        rate = torch.where(kl > 2.0 * target, slower, torch.where((kl < 0.5 * target) & (kl > 0.0), faster, self._rate))
        self._rate.copy_(rate)

    # Checkpoints

    def save(self) -> dict[str, Any]:
        """State of all networks and of both optimizers."""
        return super().save() | {"student_optimizer_state_dict": self.student_optimizer.state_dict()}

    def load(self, loaded_dict: dict[str, Any], load_cfg: dict[str, Any] | None, strict: bool) -> bool:
        """Take over what ``save`` returned; see rsl_rl's PPO for ``load_cfg``."""
        iteration = super().load(loaded_dict, load_cfg, strict)
        if load_cfg is None or load_cfg.get("optimizer"):
            self.student_optimizer.load_state_dict(loaded_dict["student_optimizer_state_dict"])
            # Loading replaced the rate's tensor by a copy.
            for group in self.optimizer.param_groups:
                group["lr"] = self._rate
        # Captured graphs refer to the replaced optimizer state.
        self._prepare_steps()
        return iteration

    def compile(self, mode: str | None = None) -> None:
        """Compilation is a setting of the algorithm's configuration; rsl_rl's switch must stay off.

        Raises:
            ConfigurationError: a mode is given.
        """
        if mode is not None:
            raise ConfigurationError("torch_compile_mode is rsl_rl's switch; set algorithm.compile_mode instead.")
