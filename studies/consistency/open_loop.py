"""Open loop: the same joint targets from the same state in every engine, with no policy to steer the difference away.

Three tests run side by side in three worlds on flat ground: ``air``, a chirp on every joint during a free fall, where only masses,
inertias and the joint law act; ``stand``, the standing pose held, where contacts carry the weight; ``walk``, targets that the policy
gave while it walked in the reference engine.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...backends.base import PhysicsBackend, PhysicsState, Randomization, Scene
from ...gauge.motors import joint_parameters
from ...gauge.suite import Suite
from ...policy.base import Policy
from ...policy.contract import PolicyContract
from ...policy.ground import Ground
from ...policy.observation import ObservationBuilder
from ...robots import Robot
from ...terrains.registry import make_terrain
from .models import finite
from .variants import Variant

Array = NDArray[np.float64]

TESTS = ("air", "stand", "walk")
DURATION = 4.0
"""Length of every test [s]."""
AIR_TIME = 2.0
"""Length of the part of ``air`` that is compared [s]."""
AIR_HEIGHT = 30.0
"""Height from which the robot falls [m]; after ``AIR_TIME`` it still has ten below it."""
CHIRP = (0.5, 4.0)
"""First and last frequency of the chirp [Hz]."""
CHIRP_AMPLITUDE = 0.2
"""[rad]."""
REST = 1.0
"""Length of the end of ``stand`` over which the ground force is averaged [s]."""
WALK_SHARE = 0.25
"""Commanded forward speed of ``walk`` as a share of the suite's limit on flat ground."""
_POINTS = 100
"""Points of a curve in the results, at most."""
MARKS = (0.01, 0.1)
"""Distances of the base [m]; the time of the first excess of each is reported."""


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """What one engine made of the targets, after every control step. T steps, the tests in the order of ``TESTS``."""

    position: Array
    """Base [m], (T, 3, 3)."""
    quaternion: Array
    """Base, wxyz, (T, 3, 4)."""
    joints: Array
    """[rad], (T, 3, J)."""
    ground_force: Array
    """Vertical force of the ground [N], (T, 3)."""
    energy: Array
    """Kinetic and potential energy of the whole robot [J], (T, 3)."""


def open_loop_scene(suite: Suite, robot: Robot, contract: PolicyContract) -> Scene:
    """Flat ground, one world for each test; motors as the suite plays a policy of this contract.

    Raises:
        ContractError: the policy is not for this robot.
    """
    return Scene(
        robot=robot,
        parameters=joint_parameters(suite, robot, contract),
        terrains=(make_terrain("flat"),),
        terrain_index=(0,) * len(TESTS),
        physics=suite.physics,
    )


class EnergyMeter:
    """Mechanical energy from a state, by one formula for all engines: that of the robot's MuJoCo model.

    Kinetic energy is ½ q̇ᵀ M(q) q̇ with the rotors' inertia in M; potential energy is Σ m g z over the bodies.
    """

    def __init__(self, scene: Scene) -> None:
        import mujoco

        from ...backends.mujoco.model import robot_spec

        self._mujoco = mujoco
        self._model = robot_spec(scene).compile()
        self._model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
        self._data = mujoco.MjData(self._model)
        names = scene.robot.joint_names
        self._at = np.array([self._model.joint(n).qposadr[0] for n in names])
        self._dofs = np.array([self._model.joint(n).dofadr[0] for n in names])

    def measure(self, state: PhysicsState) -> Array:
        """Energy of every world [J], (N,)."""
        places = (state.base_position_w, state.base_quaternion_w, state.joint_position)
        speeds = (state.base_linear_velocity_w, state.base_angular_velocity_b, state.joint_velocity)
        parts, data = [_numbers(part) for part in (*places, *speeds)], self._data
        energy = np.full(len(parts[0]), np.nan)
        for world, values in enumerate(zip(*parts, strict=True)):
            if not np.isfinite(np.concatenate(values)).all():
                continue
            data.qpos[0:3], data.qpos[3:7], data.qpos[self._at] = values[:3]
            data.qvel[0:3], data.qvel[3:6], data.qvel[self._dofs] = values[3:]
            self._mujoco.mj_forward(self._model, data)
            energy[world] = data.energy.sum()
        return energy


def record_targets(
    variant: Variant, *, suite: Suite, robot: Robot, policy: Policy, friction: float, threads: int = 1
) -> Array:
    """Targets of every test, (T, 3, J) [rad]; those of ``walk`` come from the policy walking in ``variant``, without noise.

    Raises:
        BackendError: the engine cannot do what the tests need.
    """
    scene = open_loop_scene(suite, robot, policy.contract)
    steps = round(DURATION / scene.physics.control_period)
    with closing(variant.worlds(scene, threads=threads)) as backend, torch.inference_mode():
        walk = _walk(backend, suite, policy, friction, steps)
    pose = np.asarray(robot.default_joint_position)
    time = np.arange(steps) * scene.physics.control_period
    # linear chirp: the phase is the integral of a frequency that grows evenly
    sweep = np.sin(2.0 * np.pi * (CHIRP[0] * time + 0.5 * (CHIRP[1] - CHIRP[0]) * time**2 / AIR_TIME))
    signs = np.where(np.arange(robot.num_joints) % 2, 1.0, -1.0)
    air = pose + CHIRP_AMPLITUDE * sweep[:, None] * signs
    return np.stack([air, np.tile(pose, (steps, 1)), walk], axis=1)


def _walk(backend: PhysicsBackend, suite: Suite, policy: Policy, friction: float, steps: int) -> Array:
    """Let the policy walk in the last world and note its targets."""
    _begin(backend, friction)
    count, last = backend.num_worlds, len(TESTS) - 1
    where = torch.tensor(backend.scene.terrain_index, device=backend.device)
    ground = Ground.of(policy.contract, backend.scene.terrains, where)
    builder = ObservationBuilder(policy.contract, backend.scene.robot, count, backend.device, ground)
    session = policy.session(count, device=str(backend.device))
    builder.reset()
    session.reset()
    command = torch.zeros(count, 3, device=backend.device, dtype=backend.dtype)
    command[:, 0] = WALK_SHARE * suite.commands.flat[0]
    action = torch.zeros(count, policy.contract.num_joints, device=backend.device)
    targets = []
    for _ in range(steps):
        action = session.act(builder.build(backend.state, command, action))
        target = builder.targets(action).to(backend.dtype)
        targets.append(target[last].double().cpu().numpy().copy())
        backend.step(target)
    return np.stack(targets)


def _begin(backend: PhysicsBackend, friction: float) -> None:
    """The state from which every test starts: the standing pose, held; ``air`` starts high up."""
    coefficient = torch.full((backend.num_worlds,), friction, device=backend.device, dtype=backend.dtype)
    backend.randomize(Randomization(friction=coefficient))
    start = backend.standing()
    position = start.base_position.clone()
    position[0, 2] = AIR_HEIGHT
    backend.reset(replace(start, base_position=position))


def replay(
    variant: Variant,
    targets: Array,
    *,
    suite: Suite,
    robot: Robot,
    contract: PolicyContract,
    friction: float,
    threads: int = 1,
) -> tuple[Trajectory, Mapping[str, list[float]] | None]:
    """Play targets (T, 3, J) in an engine.

    Args:
        contract: of the policy that the targets are for.

    Returns:
        What came of them, and what the engine says of its model (``PhysicsBackend.describe``).

    Raises:
        BackendError: the engine cannot do what the tests need.
    """
    scene = open_loop_scene(suite, robot, contract)
    meter = EnergyMeter(scene)
    rows: list[tuple[Array, ...]] = []
    with closing(variant.worlds(scene, threads=threads)) as backend, torch.inference_mode():
        _begin(backend, friction)
        description = backend.describe()
        for target in targets:
            backend.step(torch.tensor(target, device=backend.device, dtype=backend.dtype))
            state = backend.state
            pose = map(_numbers, (state.base_position_w, state.base_quaternion_w, state.joint_position))
            rows.append((*pose, _numbers(state.ground_force_w)[:, 2], meter.measure(state)))
    names = (field.name for field in fields(Trajectory))
    return Trajectory(**dict(zip(names, map(np.stack, zip(*rows, strict=True)), strict=True))), description


def _numbers(tensor: torch.Tensor) -> Array:
    return tensor.detach().cpu().double().numpy().copy()


def angle_between(first: Array, second: Array) -> Array:
    """Angle of the turn between quaternions wxyz (…, 4) [rad], (…)."""
    a = first / np.linalg.norm(first, axis=-1, keepdims=True)
    b = second / np.linalg.norm(second, axis=-1, keepdims=True)
    b = np.where((a * b).sum(-1, keepdims=True) < 0.0, -b, b)
    # keeps its precision at small angles, where arccos loses it
    return 4.0 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))


def compare_trajectories(
    reference: Trajectory, compared: Trajectory, *, period: float, weight: float
) -> dict[str, Any]:
    """Differences of two engines over time.

    Args:
        period: control period [s].
        weight: of the robot [N].

    Returns:
        Plain data for each test: curves over ``time`` (``position`` [m], ``angle`` [rad], ``joints`` root mean square [rad],
        ``energy`` [J], compared less reference), their values at the end and largest magnitudes, and for each of ``MARKS`` the
        time at which the bases are that far apart, None for never. ``support`` is the mean vertical ground force at rest over
        the weight.
    """
    result: dict[str, Any] = {}
    for i, test in enumerate(TESTS):
        steps = len(reference.position) if test != "air" else min(len(reference.position), round(AIR_TIME / period))
        time = period * np.arange(1, steps + 1)
        at = slice(0, steps)
        position = np.linalg.norm(compared.position[at, i] - reference.position[at, i], axis=-1)
        curves = {
            "position": position,
            "angle": angle_between(reference.quaternion[at, i], compared.quaternion[at, i]),
            "joints": np.sqrt(((compared.joints[at, i] - reference.joints[at, i]) ** 2).mean(-1)),
            "energy": compared.energy[at, i] - reference.energy[at, i],
        }
        thin = np.unique(np.linspace(0, steps - 1, min(_POINTS, steps)).round().astype(int))
        result[test] = {
            "time": [float(t) for t in time[thin]],
            "curves": {name: [finite(v) for v in curve[thin]] for name, curve in curves.items()},
            "end": {name: finite(curve[-1]) for name, curve in curves.items()},
            "largest": {name: finite(np.abs(curve).max()) for name, curve in curves.items()},
            "apart": {f"{mark:g}": _first(time, ~(position <= mark)) for mark in MARKS},
        }
        if test == "stand":
            rest = slice(max(0, steps - round(REST / period)), steps)
            result[test]["support"] = [finite(t.ground_force[rest, i].mean() / weight) for t in (reference, compared)]
    return result


def _first(time: NDArray[np.floating], over: NDArray[np.bool_]) -> float | None:
    """First time at which a condition holds."""
    return float(time[int(over.argmax())]) if over.any() else None
