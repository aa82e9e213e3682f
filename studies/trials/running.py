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
from numpy.typing import NDArray

from ...backends.base import PhysicsBackend, PhysicsState, Randomization, Scene
from ...backends.registry import make_backend
from ...gauge.episodes import Episode
from ...gauge.fit import check_fit
from ...gauge.motors import joint_parameters
from ...gauge.suite import load_suite
from ...policy.base import Policy
from ...robots import Robot
from ...robots.anatomy.body_plan import base_mass
from ...robots.rotation import from_heading, from_yaw, rotate_inverse, tilt
from ..walking import Walk
from .scenario import Force, Ground, Scenario, ScenarioError
from .timeline import Timeline

SMOOTHING = 0.1
"""Time over which forward speeds are averaged [s]."""
PATH_INTERVAL = 0.1
"""Time between two places of a path that is kept [s]."""
_TOUCH = 1.0
"""Force of the ground on the trunk that counts as lying on it [N]."""
_DIRECTIONS = {"left": (0.0, 1.0), "right": (0.0, -1.0), "forward": (1.0, 0.0), "backward": (-1.0, 0.0)}

Make = Callable[[Scene], PhysicsBackend]
"""Builds the worlds of a scene."""
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
    """Outcome of one robot."""

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

    Raises:
        BackendError: the engine cannot do what the scenario asks for.
        ContractError, PolicyError: the policy is not for this robot, or its output is not finite.
        RobotError: the robot lacks the joint parameters of the scenario's suite.
        SuiteError: the policy's control period is not that of the scenario's suite, or too long.
    """
    each = [(scenario, seed) for seed in seeds]
    return run_each(policy, robot, each, backend=backend, device=device, threads=threads, watch=watch)


def run_each(
    policy: Policy,
    robot: Robot,
    trials: Sequence[tuple[Scenario, int]],
    *,
    backend: str | Make = "mujoco",
    device: str = "cpu",
    threads: int = 1,
    watch: Watch | None = None,
) -> list[Trial]:
    """Send robots through scenarios of their own, side by side. Each has the outcome that ``run_scenario`` gives it.

    Args:
        trials: scenario and seed of each robot; suite, limits of torque and tilt of a fall are the same in all.
        backend: engine, or a function that builds the worlds of a scene.

    Raises:
        ScenarioError: scenarios that cannot be played together; else as ``run_scenario``.
    """
    scene = make_scene([scenario for scenario, _ in trials], robot, policy)
    if torch.device(device).type == "cpu":
        torch.set_num_threads(1)  # several would change the last bits of the policy's output
    worlds = (
        make_backend(backend, scene, device=device, threads=threads) if isinstance(backend, str) else backend(scene)
    )
    with closing(worlds) as physics, torch.inference_mode():
        return _Run(policy, trials, physics).play(watch)


def make_scene(scenarios: Sequence[Scenario], robot: Robot, policy: Policy) -> Scene:
    """Return the worlds of some scenarios, one for each. Raises as ``run_each``."""
    first = scenarios[0]
    for other in scenarios:
        for rule in ("suite", "torque_speed_limit", "failure"):
            if getattr(other, rule) != getattr(first, rule):
                raise ScenarioError(
                    f"scenarios '{first.name}' and '{other.name}' differ in {rule} and cannot be played side by side; play one "
                    "after the other"
                )
    suite = load_suite(first.suite)
    check_fit(suite, robot, policy.contract, longest=min(SMOOTHING, PATH_INTERVAL))
    grounds: dict[Ground, Scenario] = {}
    for scenario in scenarios:
        grounds.setdefault(scenario.ground, scenario)
    palette = list(grounds)
    return Scene(
        robot=robot,
        parameters=joint_parameters(suite, robot, policy.contract),
        terrains=tuple(scenario.terrain() for scenario in grounds.values()),
        terrain_index=tuple(palette.index(scenario.ground) for scenario in scenarios),
        physics=replace(
            suite.physics,
            torque_limits=suite.physics.torque_limits or first.torque_speed_limit,
            torque_speed_limit=first.torque_speed_limit,
            watch_tilt=first.failure.tilt,
            watch_penetration=None,
        ),
    )


class _Run:
    """Trials at work, one for each world."""

    def __init__(self, policy: Policy, trials: Sequence[tuple[Scenario, int]], physics: PhysicsBackend) -> None:
        self._scenarios, self._seeds = [scenario for scenario, _ in trials], [seed for _, seed in trials]
        self._physics, self._failure = physics, self._scenarios[0].failure
        self._period, self._timestep = physics.scene.physics.control_period, physics.scene.physics.timestep
        self._steps = max(math.ceil(s.seconds / self._period) + len(s.commands) for s in self._scenarios)
        episodes = [
            Episode(
                terrain=scenario.name,
                level=0,
                friction=scenario.friction,
                payload=0.0 if scenario.payload is None else scenario.payload.kilograms,
                seed=seed,
                stage="trial",
                goals=(),
            )
            for scenario, seed in trials
        ]
        noise = load_suite(self._scenarios[0].suite).noise
        late = [None if s.latency is None else round(s.latency / self._timestep) for s in self._scenarios]
        self._walk = Walk(policy, physics, noise, episodes, steps=self._steps, latency=late)
        drawn = [draws(scenario, seed) for scenario, seed in trials]
        self._offsets = np.array([offset for offset, _ in drawn])
        self._pulls = [pulls for _, pulls in drawn]
        tensor = self._walk.tensor
        most = max(map(len, self._pulls), default=0)
        padded = [[*pulls, *[_NO_PULL] * (most - len(pulls))] for pulls in self._pulls]
        shape = (len(trials), most)
        self._begin = tensor([[p.begin for p in row] for row in padded]).view(shape)
        self._end = self._begin + tensor([[p.seconds for p in row] for row in padded]).view(shape)
        self._pull = tensor([[[p.newtons * d for d in p.direction] for p in row] for row in padded]).view(*shape, 2)

    def play(self, watch: Watch | None) -> list[Trial]:
        """Until every trial is over."""
        physics, walk, failure = self._physics, self._walk, self._failure
        count = len(self._seeds)
        frictions = self._frictions()
        physics.randomize(replace(self._payloads(), friction=walk.tensor(frictions[0])))
        self._to_start()
        timeline = Timeline(self._scenarios, self._period, physics.state.base_position_w)
        active = torch.ones(count, dtype=torch.bool, device=physics.device)
        lying = walk.tensor([0.0] * count)
        rows: list[tuple[torch.Tensor, ...]] = []
        for step in range(self._steps):
            state = physics.state
            command = timeline.next(state)
            active = active & ~timeline.over
            if not bool(active.any()):
                break
            if step and (frictions[step] != frictions[step - 1]).any():
                changed = torch.from_numpy(frictions[step] != frictions[step - 1]).to(physics.device)
                physics.randomize(Randomization(friction=walk.tensor(frictions[step])[changed]), changed)
            if self._begin.shape[1]:
                physics.apply_force(self._force(step * self._period, state))
            walk.step(command, active)
            state = physics.state
            touches = state.trunk_contact_force_w.norm(dim=1) > _TOUCH
            lying = torch.where(touches, lying + self._period, 0.0)
            fell = (state.tilt_substep > 0) | state.diverged
            if failure.lying is not False:
                fell |= lying >= failure.lying - 1e-9
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

    def _frictions(self) -> NDArray[np.float64]:
        """Return the friction of each world in every control step, (T, N)."""
        table = np.tile([scenario.friction for scenario in self._scenarios], (self._steps, 1))
        for world, scenario in enumerate(self._scenarios):
            for patch in scenario.patches:
                begin, end = (round(t / self._period) for t in (patch.begin, patch.begin + patch.seconds))
                table[begin:end, world] = patch.friction
        return table

    def _payloads(self) -> Randomization:
        """Return what the payloads change; nothing where no scenario has one."""
        loads = [scenario.payload for scenario in self._scenarios]
        if not any(loads):
            return Randomization()
        own, tensor = base_mass(self._physics.scene.robot), self._walk.tensor
        masses = [0.0 if load is None else load.kilograms for load in loads]
        places = [(0.0, 0.0, 0.0) if load is None else load.place for load in loads]
        shifts = [[m / (m + own) * along for along in place] for m, place in zip(masses, places, strict=True)]
        return Randomization(base_mass_offset=tensor(masses), base_com_offset=tensor(shifts))

    def _to_start(self) -> None:
        """Put the robots on the ground."""
        scene = self._physics.scene
        starts = np.array([(s.start.x, s.start.y, s.start.yaw) for s in self._scenarios]) + self._offsets
        x, y, yaw = starts.T
        ground = [float(scene.terrains[t].height(x[i], y[i])) for i, t in enumerate(scene.terrain_index)]
        z = np.array(ground) + scene.robot.stand_height
        self._walk.reset(self._walk.tensor(np.stack((x, y, z), axis=1)), from_yaw(self._walk.tensor(yaw)))

    def _force(self, time: float, state: PhysicsState) -> torch.Tensor:
        """External force on every base at a time [s] after the start, world frame [N], (N, 3)."""
        acts = (time >= self._begin) & (time < self._end)
        forward, left = (self._pull * acts[..., None]).sum(dim=1).unbind(-1)
        return from_heading(state.base_quaternion_w, forward, left)

    def _trial(self, i: int, diverged: bool, *columns: Any) -> Trial:
        """What came of a robot, from what was noted of it step by step."""
        active, moving, fell, forward, told, tilts, position = columns
        scenario, period = self._scenarios[i], self._period
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
