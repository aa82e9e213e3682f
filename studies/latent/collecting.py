"""Robots of one policy on every terrain and with every command, and what their encoder and experts said meanwhile.

A robot's start, noise and latency follow from its terrain, its command and its seed alone. Starts lie beside each other, so that
a robot that a probe is tried on takes another way over the same ground than those it was fitted to.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...backends.base import Randomization, Scene
from ...backends.registry import make_backend
from ...files.choices import cpu_threads
from ...gauge.episodes import Episode
from ...gauge.fit import check_fit
from ...gauge.motors import joint_parameters
from ...gauge.suite import Suite
from ...policy.base import Policy
from ...policy.latent_probe import watched_session
from ...robots import Robot
from ...robots.rotation import from_yaw, tilt
from ...terrains.base import Pose, Terrain
from ..walking import Walk
from .request import LatentRequest

COMMANDS = {
    "forward": (0.8, 0.0, 0.0),
    "backward": (-0.8, 0.0, 0.0),
    "left turn": (0.0, 0.0, 1.0),
    "right turn": (0.0, 0.0, -1.0),
}
"""The paper's commands: forward, lateral [m/s] and yaw [rad/s]."""
INTERVAL = 0.1
"""Time between two notes [s]."""
SPREAD = 0.25
"""Half width of what each robot's seed adds to its start along x and y [m]: a fraction of the terrains, which are 10 m wide."""


@dataclass(frozen=True, kw_only=True)
class Notes:
    """What was noted, a row for each robot and moment; robots that have fallen are not watched any longer."""

    latent: NDArray[np.float64] | None
    """What the actor was given of the history, (N, L); None without an encoder."""
    weights: NDArray[np.float64] | None
    """The experts' weights, (N, K); None without experts."""
    history: NDArray[np.float64]
    """What the network was given, (N, H·F)."""
    terrain: NDArray[np.int64]
    """Index into the terrains, (N,)."""
    command: NDArray[np.int64]
    """Index into ``COMMANDS``, (N,)."""
    robot: NDArray[np.int64]
    """Which of the robots of its terrain and command, (N,)."""
    time: NDArray[np.float64]
    """Since the command was given [s], (N,)."""
    falls: int
    """Robots that fell."""
    walkers: int
    """Robots in all."""


def collect(
    policy: Policy,
    robot: Robot,
    asked: LatentRequest,
    suite: Suite,
    terrains: tuple[Terrain, ...],
    told: Callable[[float], None] = lambda _: None,
) -> Notes:
    """Let a policy's robots walk, on the CPU, and note what its encoder and experts say.

    Args:
        told: hears after each control step which share of them is done.

    Raises:
        BackendError: the engine cannot do it.
        RobotError, SuiteError: the suite's physics does not suit the robot or the policy.
        PolicyError: the policy has neither encoder nor experts, or its output is not finite.
        ContractError: it is not for this robot.
    """
    check_fit(suite, robot, policy.contract, longest=INTERVAL)
    places = [(t, c, r) for t in range(len(terrains)) for c in range(len(COMMANDS)) for r in range(asked.robots)]
    scene = Scene(
        robot=robot,
        parameters=joint_parameters(suite, robot, policy.contract),
        terrains=terrains,
        terrain_index=tuple(t for t, _, _ in places),
        physics=suite.physics,
    )
    session, network = watched_session(policy, len(places))
    torch.set_num_threads(1)  # several would change the last bits of the policy's output
    period = scene.physics.control_period
    stands, steps, every = (round(s / period) for s in (asked.settling, asked.seconds, INTERVAL))
    up: list[torch.Tensor] = []
    seen: list[tuple[torch.Tensor | None, torch.Tensor | None, torch.Tensor]] = []
    with (
        closing(make_backend(asked.backend, scene, device="cpu", threads=cpu_threads(asked.threads))) as physics,
        torch.inference_mode(),
    ):
        episodes = [_episode(asked, terrains[t], list(COMMANDS)[c], r) for t, c, r in places]
        walk = Walk(policy, physics, suite.noise, episodes, steps=stands + steps, session=session)
        physics.randomize(Randomization(friction=walk.tensor([asked.friction] * len(places))))
        physics.reset(physics.standing())
        feet = (physics.state.foot_position_w - physics.state.base_position_w[:, None])[0, :, :2].double().numpy()
        starts = [start(terrains[t], episodes[i], feet) for i, (t, _, _) in enumerate(places)]
        walk.reset(
            walk.tensor([(*p.position[:2], p.position[2] + robot.stand_height) for p in starts]),
            from_yaw(walk.tensor([p.yaw for p in starts])),
        )
        command = walk.tensor(list(COMMANDS.values()))[torch.tensor([c for _, c, _ in places])]
        fallen = torch.zeros(len(places), dtype=torch.bool)
        for step in range(stands + steps):
            walk.step(command if step >= stands else torch.zeros_like(command))
            fallen = fallen | physics.state.diverged | (tilt(physics.state.base_quaternion_w) > suite.events.fall_tilt)
            if step >= stands and (step - stands + 1) % every == 0:
                up.append(~fallen)
                seen.append((network.latent, network.weights, network.history.flatten(1)))
            told((step + 1) / (stands + steps))
    keep = torch.cat(up).numpy()
    latents, weights, histories = zip(*seen, strict=True)
    index = np.tile(np.array(places, dtype=np.int64), (len(up), 1))[keep]
    return Notes(
        latent=None if latents[0] is None else _table(latents)[keep],
        weights=None if weights[0] is None else _table(weights)[keep],
        history=_table(histories)[keep],
        terrain=index[:, 0],
        command=index[:, 1],
        robot=index[:, 2],
        time=np.repeat((np.arange(len(up)) + 1) * every * period, len(places))[keep],
        falls=int(fallen.sum()),
        walkers=len(places),
    )


def start(terrain: Terrain, episode: Episode, feet: NDArray[np.float64]) -> Pose:
    """Where a robot starts: beside the start of quality episodes, by up to ``SPREAD`` along x and y, with no foot in the ground.

    Args:
        feet: of the standing robot, from its base, forward and left [m], (F, 2).
    """
    spawn = terrain.spawns["level_eval"]
    x, y = spawn.position[:2] + np.random.default_rng(zlib.crc32(episode.key.encode())).uniform(-SPREAD, SPREAD, 2)
    cos, sin = math.cos(spawn.yaw), math.sin(spawn.yaw)
    height = terrain.height(x + feet @ (cos, -sin), y + feet @ (sin, cos)).max()
    return Pose(position=(float(x), float(y), float(height)), yaw=spawn.yaw)


def _table(parts: Sequence[torch.Tensor]) -> NDArray[np.float64]:
    """Return the rows of all moments, one after another."""
    return torch.cat(tuple(parts)).double().numpy()


def _episode(asked: LatentRequest, terrain: Terrain, command: str, robot: int) -> Episode:
    """Return a robot's own episode, which gives it noise and latency of its own."""
    place: dict[str, Any] = {
        "terrain": terrain.name,
        "level": terrain.level,
        "friction": asked.friction,
        "payload": 0.0,
    }
    return Episode(**place, seed=asked.seed + robot, stage=f"latent {command}", goals=())
