"""Robots go through a scenario side by side: commands, pulls, and what came of each.

A robot's start, pulls, noise and latency follow from the scenario's name and its seed alone; neither other robots nor threads
change what happens to it.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from ...backends.base import PhysicsBackend, PhysicsState, Randomization, Scene
from ...backends.registry import make_backend
from ...gauge.episodes import Episode
from ...gauge.fit import check_fit
from ...gauge.motors import joint_parameters
from ...gauge.suite import load_suite
from ...policy.base import Policy
from ...robots import Robot
from ...robots.rotation import from_heading, from_yaw, rotate_inverse, tilt
from ..walking import Walk
from .scenario import Force, Scenario
from .timeline import Timeline

SMOOTHING = 0.1
"""Time over which forward speeds are averaged [s]."""
PATH_INTERVAL = 0.1
"""Time between two places of a path that is kept [s]."""
_TOUCH = 1.0
"""Force of the ground on the trunk that counts as lying on it [N]."""
_DIRECTIONS = {"left": (0.0, 1.0), "right": (0.0, -1.0), "forward": (1.0, 0.0), "backward": (-1.0, 0.0)}

Watch = Callable[[PhysicsState, torch.Tensor], None]
"""Called after every control step with the state and with whether each robot was told to move in it, (N,) bool."""


@dataclass(frozen=True, kw_only=True)
class Pull:
    """A pull as it was drawn."""

    begin: float
    """[s] after the start."""
    seconds: float
    newtons: float
    direction: tuple[float, float]
    """Forward and left, in the robot's heading."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """What came of one robot."""

    seed: int
    outcome: str
    """``success``, ``fell`` (the physics diverged, too: ``diverged``), or ``missed``: upright, but not what success asks for."""
    diverged: bool
    seconds: float
    """Until it fell or its commands were over [s]."""
    reached: float | None
    """When it came beyond ``success.beyond`` [s] after its first command to move; None if it did not, or need not."""
    progress: float | None
    """Share of the way to ``success.beyond`` that it got at most; None where there is no such place."""
    mean_speed: float | None
    """Way to ``success.beyond`` over the time it took [m/s]."""
    peak_speed: float
    """Largest forward speed, a mean over 0.1 s [m/s]."""
    speed_time: float | None
    """When it came to ``success.speed`` [s] after its first command to move; None if it did not, or need not."""
    tracking_error: float | None
    """Mean distance of the forward speed from the commanded one [m/s], while told to move; from ``speed_time`` on where there
    is one to be had, else from the first such command."""
    pulls: tuple[Pull, ...]
    path: tuple[tuple[float, float, float, float], ...]
    """Base position [m] and tilt [rad] every 0.1 s: x, y, z, tilt."""


def draws(scenario: Scenario, seed: int) -> tuple[tuple[float, float, float], tuple[Pull, ...]]:
    """What a seed draws: the start's offset in x, y [m] and heading [rad], and the pulls."""
    random = np.random.default_rng([zlib.crc32(scenario.name.encode()), seed])
    x, y, yaw = (float(random.uniform(-half, half)) for half in scenario.start.spread)
    return (x, y, yaw), tuple(pull for force in scenario.forces for pull in _pulls(force, scenario.seconds, random))


def _pulls(force: Force, end: float, random: np.random.Generator) -> list[Pull]:
    found: list[Pull] = []
    begin = float(random.uniform(*force.begin))
    while begin < end:
        side = float(random.choice((-1.0, 1.0)))
        found.append(
            Pull(
                begin=begin,
                seconds=float(random.uniform(*force.seconds)),
                newtons=float(random.uniform(*force.newtons)),
                direction=(0.0, side) if force.direction == "side" else _DIRECTIONS[force.direction],
            )
        )
        if force.every is None:
            break
        begin += force.every
    return found


def run_scenario(
    policy: Policy,
    robot: Robot,
    scenario: Scenario,
    seeds: Sequence[int],
    *,
    backend: str = "mujoco",
    device: str = "cpu",
    threads: int = 1,
    watch: Watch | None = None,
) -> list[Trial]:
    """Send a robot through a scenario for each seed.

    Args:
        seeds: one for each trial.
        threads: CPU threads; results do not depend on them.

    Raises:
        BackendError: the engine cannot do what the scenario asks for.
        ContractError, PolicyError: the policy is not for this robot, or its output is not finite.
        RobotError: the robot lacks the joint parameters of the scenario's suite.
        SuiteError: the policy's control period is not that of the scenario's suite, or too long.
    """
    scene = make_scene(scenario, robot, policy, len(seeds))
    if torch.device(device).type == "cpu":
        torch.set_num_threads(1)  # several would change the last bits of the policy's output
    with closing(make_backend(backend, scene, device=device, threads=threads)) as physics, torch.inference_mode():
        return _Run(policy, scenario, seeds, physics).play(watch)


def make_scene(scenario: Scenario, robot: Robot, policy: Policy, count: int) -> Scene:
    """The worlds of ``count`` trials. Raises as ``run_scenario``."""
    suite = load_suite(scenario.suite)
    check_fit(suite, robot, policy.contract, longest=min(SMOOTHING, PATH_INTERVAL))
    return Scene(
        robot=robot,
        parameters=joint_parameters(suite, robot, policy.contract),
        terrains=(scenario.terrain(),),
        terrain_index=(0,) * count,
        physics=replace(
            suite.physics,
            torque_limits=suite.physics.torque_limits or scenario.torque_speed_limit,
            torque_speed_limit=scenario.torque_speed_limit,
            watch_tilt=scenario.failure.tilt,
            watch_penetration=None,
        ),
    )


class _Run:
    """The trials of one scenario at work."""

    def __init__(self, policy: Policy, scenario: Scenario, seeds: Sequence[int], physics: PhysicsBackend) -> None:
        self._scenario, self._seeds, self._physics = scenario, seeds, physics
        self._period = physics.scene.physics.control_period
        self._steps = math.ceil(scenario.seconds / self._period) + len(scenario.commands)
        episodes = [
            Episode(
                terrain=scenario.name,
                level=0,
                friction=scenario.friction,
                payload=0.0,
                seed=seed,
                stage="trial",
                goals=(),
            )
            for seed in seeds
        ]
        self._walk = Walk(policy, physics, load_suite(scenario.suite).noise, episodes, steps=self._steps)
        drawn = [draws(scenario, seed) for seed in seeds]
        self._offsets = np.array([offset for offset, _ in drawn])
        self._pulls = [pulls for _, pulls in drawn]
        tensor = self._walk.tensor
        most = max(map(len, self._pulls), default=0)
        padded = [[*pulls, *[_NO_PULL] * (most - len(pulls))] for pulls in self._pulls]
        shape = (len(seeds), most)
        self._begin = tensor([[p.begin for p in row] for row in padded]).view(shape)
        self._end = self._begin + tensor([[p.seconds for p in row] for row in padded]).view(shape)
        self._pull = tensor([[[p.newtons * d for d in p.direction] for p in row] for row in padded]).view(*shape, 2)

    def play(self, watch: Watch | None) -> list[Trial]:
        """Until every trial is over."""
        scenario, physics, walk = self._scenario, self._physics, self._walk
        count = len(self._seeds)
        physics.randomize(Randomization(friction=walk.tensor([scenario.friction] * count)))
        self._to_start()
        timeline = Timeline(scenario, self._period, self._line, physics.state.base_position_w)
        active = torch.ones(count, dtype=torch.bool, device=physics.device)
        lying = walk.tensor([0.0] * count)
        rows: list[tuple[torch.Tensor, ...]] = []
        for step in range(self._steps):
            state = physics.state
            command = timeline.next(state)
            active = active & ~timeline.over
            if not bool(active.any()):
                break
            if scenario.forces:
                physics.apply_force(self._force(step * self._period, state))
            walk.step(command, active)
            state = physics.state
            touches = state.trunk_contact_force_w.norm(dim=1) > _TOUCH
            lying = torch.where(touches, lying + self._period, 0.0)
            fell = (state.tilt_substep > 0) | state.diverged
            if scenario.failure.lying is not False:
                fell |= lying >= scenario.failure.lying - 1e-9
            moving = active & command.any(dim=1)
            if watch is not None:
                watch(state, moving)
            forward = rotate_inverse(state.base_quaternion_w, state.base_linear_velocity_w)[:, 0]
            row = (active, moving, fell & active, forward, command[:, 0], tilt(state.base_quaternion_w))
            rows.append(tuple(x.clone() for x in (*row, state.base_position_w)))
            active = active & ~fell
        diverged = physics.state.diverged.tolist()
        columns = [np.stack(c) for c in zip(*(tuple(x.cpu().numpy() for x in row) for row in rows), strict=True)]
        return [self._trial(i, diverged[i], *(c[:, i] for c in columns)) for i in range(count)]

    def _to_start(self) -> None:
        """Put the robots on the ground."""
        start, scene = self._scenario.start, self._physics.scene
        x, y = start.x + self._offsets[:, 0], start.y + self._offsets[:, 1]
        z = scene.terrains[0].height(x, y) + scene.robot.stand_height
        yaw = self._walk.tensor(start.yaw + self._offsets[:, 2])
        self._line = (start.x, start.y, start.yaw)
        self._walk.reset(self._walk.tensor(np.stack((x, y, z), axis=1)), from_yaw(yaw))

    def _force(self, time: float, state: PhysicsState) -> torch.Tensor:
        """External force on every base at a time [s] after the start, world frame [N], (N, 3)."""
        acts = (time >= self._begin) & (time < self._end)
        forward, left = (self._pull * acts[..., None]).sum(dim=1).unbind(-1)
        return from_heading(state.base_quaternion_w, forward, left)

    def _trial(self, i: int, diverged: bool, *columns: Any) -> Trial:
        """What came of a robot, from what was noted of it step by step."""
        active, moving, fell, forward, told, tilts, position = columns
        scenario, period = self._scenario, self._period
        last = max(int(active.sum()) - diverged, 1)  # from its first step on; what diverged is no place any more
        moving, forward, told, position = moving[:last], forward[:last], told[:last], position[:last]
        began = int(moving.argmax()) if moving.any() else 0
        speed = smoothed(forward, round(SMOOTHING / period))
        success, x = scenario.success, position[:, 0]
        at = None if success.beyond is None else _first(x >= success.beyond)
        fast = None if success.speed is None else _first(moving & (speed >= success.speed))
        counted = moving & (np.arange(last) >= (fast or 0))
        came = (success.beyond is None or at is not None) and (success.speed is None or fast is not None)
        begin = float(scenario.start.x + self._offsets[i, 0])
        stride = round(PATH_INTERVAL / period)
        return Trial(
            seed=self._seeds[i],
            outcome="fell" if fell.any() else "success" if came else "missed",
            diverged=bool(diverged),
            seconds=round(last * period, 6),
            reached=None if at is None else round((at - began + 1) * period, 6),
            progress=None
            if success.beyond is None
            else min(max((float(x.max()) - begin) / (success.beyond - begin), 0.0), 1.0),
            mean_speed=None if at is None else (float(x[at]) - begin) / ((at - began + 1) * period),
            peak_speed=float(speed.max()),
            speed_time=None if fast is None else round((fast - began + 1) * period, 6),
            tracking_error=float(np.abs(speed - told)[counted].mean()) if counted.any() else None,
            pulls=self._pulls[i],
            path=tuple(_place(position[j], tilts[j]) for j in range(0, last, stride)),
        )


_NO_PULL = Pull(begin=0.0, seconds=0.0, newtons=0.0, direction=(0.0, 0.0))


def _place(position: Any, leaning: Any) -> tuple[float, float, float, float]:
    x, y, z = (round(float(v), 4) for v in position)
    return x, y, z, round(float(leaning), 4)


def smoothed(values: Any, window: int) -> Any:
    """Mean over the last ``window`` values; before the first there were zeros, (T,) to (T,)."""
    return np.convolve(values, np.full(window, 1.0 / window))[: len(values)]


def _first(mask: Any) -> int | None:
    """Index of the first true entry, None for none."""
    return int(mask.argmax()) if mask.any() else None
