"""A tiny deterministic environment with the observation groups of the real one, and a configuration to match."""

from __future__ import annotations

import torch
from gaitgauge.policy.contract import PolicyContract, standard_contract
from gaitgauge.robots import load_robot
from gaitgauge.training.algorithms.symmetry import Mirror, build_mirror
from gaitgauge.training.configuration import (
    AlgorithmConfiguration,
    NetworkConfiguration,
    RunConfiguration,
    TrainingConfiguration,
)
from gaitgauge.training.environment.configuration import ObservationConfiguration
from rsl_rl.env import VecEnv
from tensordict import TensorDict

# Several test runs share few cores, and PyTorch's threads wait for each other.
torch.set_num_threads(1)

FRAME, HISTORY, PRIVILEGED, ACTIONS = 45, 5, 263, 12
COMMAND = slice(6, 9)


class ToyEnv(VecEnv):
    """The first three actions should equal a command that is held for an episode; the rest should be small.

    It draws from its own generator, so its state is all that a checkpoint needs. It overwrites its observation
    buffers in place, as an environment on zero-copy physics would.
    """

    def __init__(self, num_envs: int = 8, max_episode_length: int = 20, seed: int = 0) -> None:
        self.num_envs, self.num_actions, self.max_episode_length = num_envs, ACTIONS, max_episode_length
        self.device, self.cfg = "cpu", {}
        self.episode_length_buf = torch.zeros(num_envs, dtype=torch.long)
        self.generator = torch.Generator().manual_seed(seed)
        self.command = self._draw(3)
        self.history = torch.zeros(num_envs, HISTORY, FRAME)
        self.privileged = torch.zeros(num_envs, PRIVILEGED)
        self.poison: int | None = None
        self._observe(torch.zeros(num_envs, ACTIONS))

    def _draw(self, width: int) -> torch.Tensor:
        return torch.rand(self.num_envs, width, generator=self.generator) * 2.0 - 1.0

    def _observe(self, actions: torch.Tensor) -> None:
        frame = torch.zeros(self.num_envs, FRAME)
        frame[:, COMMAND] = self.command
        frame[:, :3] = 0.1 * self._draw(3)
        frame[:, 33:] = actions
        self.history[:, :-1] = self.history[:, 1:].clone()
        self.history[:, -1] = frame
        self.privileged[:, 3:48] = frame
        self.privileged[:, 100:] = torch.tanh(self.command.sum(dim=1, keepdim=True))

    def get_observations(self) -> TensorDict:
        groups = {"policy": self.history[:, -1], "history": self.history.flatten(1), "privileged": self.privileged}
        return TensorDict(groups, batch_size=[self.num_envs])

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        self.episode_length_buf += 1
        miss = (actions[:, :3] - self.command).square().mean(dim=1)
        reward = 1.0 - miss - 0.01 * actions[:, 3:].square().mean(dim=1)
        time_outs = self.episode_length_buf >= self.max_episode_length
        fell = self._draw(1).squeeze(1) > 0.98
        dones = time_outs | fell
        self.episode_length_buf.masked_fill_(dones, 0)
        self.command = torch.where(dones[:, None], self._draw(3), self.command)
        self.history.masked_fill_(dones[:, None, None], 0.0)
        self._observe(actions.clamp(-3.0, 3.0))
        if self.poison is not None:
            reward[self.poison] = float("nan")
            self.privileged[self.poison, 0] = float("nan")
        extras = {"time_outs": time_outs, "log": {"Metrics/reward": reward.mean(), "level": 1.0}}
        return self.get_observations(), reward, dones, extras

    def state_dict(self) -> dict:
        names = ("episode_length_buf", "command", "history", "privileged")
        return {n: getattr(self, n).clone() for n in names} | {"generator": self.generator.get_state()}

    def load_state_dict(self, state: dict) -> None:
        for name in ("episode_length_buf", "command", "history", "privileged"):
            setattr(self, name, state[name].clone())
        self.generator.set_state(state["generator"])


def toy_contract() -> PolicyContract:
    return standard_contract(load_robot("go2"))


def toy_mirror() -> Mirror:
    return build_mirror(ObservationConfiguration(), contract=toy_contract(), robot=load_robot("go2"))


def toy_configuration(
    *, encoder: str = "moe", steps: int = 8, algorithm: dict | None = None, run: dict | None = None
) -> TrainingConfiguration:
    network = NetworkConfiguration(
        latent_width=8,
        teacher_hidden=(32,),
        student_encoder=encoder,
        student_hidden=(32,),
        expert_count=4,
        expert_width=16,
        gate_hidden=(16,),
        actor_hidden=(32,),
        critic_hidden=(32,),
    )
    return TrainingConfiguration(
        network=network,
        algorithm=AlgorithmConfiguration(**({"epochs": 2, "minibatches": 2} | (algorithm or {}))),
        run=RunConfiguration(**({"steps_per_iteration": steps, "gauge_interval": 0} | (run or {}))),
    )
