"""Play a log's targets through a robot: hung by its trunk or standing, in any engine, in lockstep with the recorded times.

Physics runs on an even grid. The target of a physics step is the mean of what the motors held during that step, a command
being held from its recorded time plus the delay until the next one; so delays need not be multiples of a step, and uneven
rows lose no time. Simulated series are read at the recorded times by linear interpolation.
"""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...backends.base import PhysicsOptions, Scene
from ...backends.registry import make_backend
from ...robots import JointParameters, Robot
from ...robots.anatomy.body_plan import lowest_point
from ...terrains.registry import make_terrain
from .log import Array, Log, LogError

TIMESTEP = 0.002
"""Length of a physics step [s], the suites' own."""
_ANVIL = 1e4
"""Mass [kg] and moment of inertia [kg·m²] of a held trunk: a leg's 40 N move it by less than a micrometre in a step."""
_REHANG = 1.0
"""Time after which a held trunk is put back to its place [s]."""
_BEGINNING = 0.03
"""Time from which the start's velocities are fitted [s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Simulated joints at the times of a log's rows, (T, J) each: position [rad], velocity [rad/s], motor torque [N·m]."""

    position: Array
    velocity: Array
    torque: Array


def held_targets(log: Log, delay: float | Array, steps: int, timestep: float = TIMESTEP) -> Array:
    """Return the mean target that acts in each physics step [rad], (steps, J).

    Args:
        delay: time from a command's row until it acts [s], one or (J,).
        steps: number of physics steps from the log's first row on.
    """
    area = np.zeros_like(log.target)
    np.cumsum(log.target[:-1] * np.diff(log.time)[:, None], axis=0, out=area[1:])
    edges = np.arange(steps + 1) * timestep

    def integral(at: Array, joint: int | slice) -> Array:
        row = np.clip(np.searchsorted(log.time, at, side="right") - 1, 0, None)
        held = log.target[row][:, joint]
        passed = at - log.time[row]
        found: Array = area[row][:, joint] + held * (passed[:, None] if held.ndim == 2 else passed)
        return found

    delays = np.broadcast_to(np.asarray(delay, dtype=np.float64), (log.target.shape[1],))
    if np.ptp(delays) == 0.0:
        return np.diff(integral(edges - delays[0], slice(None)), axis=0) / timestep
    columns = [np.diff(integral(edges - d, j)) / timestep for j, d in enumerate(delays)]
    return np.stack(columns, axis=1)


def beginning(log: Log) -> tuple[Array, Array]:
    """Return position [rad] and velocity [rad/s] of the joints at the first row, (J,) each, from a line through the first rows."""
    rows = (log.time < _BEGINNING) & log.fresh
    slope, start = np.polyfit(log.time[rows], log.position[rows], 1)
    return start, slope


def num_steps(log: Log, timestep: float = TIMESTEP) -> int:
    """Return the number of physics steps that reach the last row."""
    return int(np.ceil(log.time[-1] / timestep)) + 1


def at_rows(log: Log, series: Array, timestep: float = TIMESTEP) -> Array:
    """Return series on the grid, (…, steps + 1, J), at the times of the log's rows, (…, T, J)."""
    place = log.time / timestep
    step = np.clip(place.astype(np.int64), 0, series.shape[-2] - 2)
    share = (place - step)[:, None]
    found: Array = series[..., step, :] * (1.0 - share) + series[..., step + 1, :] * share
    return found


def acting_parameters(log: Log, parameters: JointParameters) -> JointParameters:
    """Return a set with the gains that act where the log's were sent."""
    return parameters.commanded(log.stiffness.tolist(), log.damping.tolist())


# ---- any engine --------------------------------------------------------------------------------------------------------


def play(
    log: Log, parameters: JointParameters, *, engine: str = "mujoco", device: str = "cpu", delay: float | None = None
) -> Motion:
    """Play a log's targets in an engine.

    Args:
        log: of a robot that hung or stood.
        parameters: the robot's constants; gains come from the log, times the set's factors.
        delay: time from a command until it acts [s]; None for the set's, 0 where it has none.

    Raises:
        BackendError: no such engine or device, or the engine cannot simulate the robot.
        LogError: the simulated robot diverged.
    """
    shift = delay if delay is not None else parameters.delay or 0.0
    targets = held_targets(log, shift, num_steps(log))  # the engine adds the set's offsets
    with tempfile.TemporaryDirectory(prefix="gaitgauge-rig-") as folder:
        robot = hang(log.robot, Path(folder)) if log.held != "standing" else log.robot
        rig = _EngineRig(robot, acting_parameters(log, parameters), engine, device, hung=log.held != "standing")
        try:
            series = rig.run(log, targets)
        finally:
            rig.close()
    if not np.isfinite(series).all():
        raise LogError(
            f"the replay of '{log.name}' in {engine} diverged; these parameters are not possible at 2 ms steps"
        )
    return Motion(**{name: at_rows(log, series[i]) for i, name in enumerate(("position", "velocity", "torque"))})


def hang(robot: Robot, folder: Path) -> Robot:
    """Return the robot with a trunk so heavy that its legs cannot move it; its model is written into ``folder``."""
    import mujoco

    spec = mujoco.MjSpec.from_file(str(robot.mjcf))
    spec.meshdir = str((robot.mjcf.parent / spec.meshdir).resolve())
    spec.texturedir = str((robot.mjcf.parent / spec.texturedir).resolve())
    trunk = spec.body(robot.base_body)
    trunk.explicitinertial, trunk.mass = True, _ANVIL
    trunk.inertia, trunk.fullinertia = np.full(3, _ANVIL), np.full(6, np.nan)
    trunk.ipos, trunk.iquat = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    spec.compile()
    path = folder / "hung.xml"
    path.write_text(spec.to_xml(), encoding="utf-8")
    return replace(robot, mjcf=path)


class _EngineRig:
    """One robot in an engine, step by step."""

    def __init__(self, robot: Robot, parameters: JointParameters, engine: str, device: str, *, hung: bool) -> None:
        import mujoco

        physics = PhysicsOptions(
            timestep=TIMESTEP,
            substeps=1,
            self_collision=not hung,
            tolerance=0.0 if hung else 1e-8,  # the scale of the solver's tolerance is the trunk's
            iterations=8 if hung else 100,
        )
        scene = Scene(
            robot=robot,
            parameters=parameters,
            terrains=(make_terrain("flat", None),),
            terrain_index=(0,),
            physics=physics,
        )
        self.robot, self.hung = robot, hung
        self._backend: Any = make_backend(engine, scene, device=device)
        model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
        self._weight = float(model.body_mass.sum() * -model.opt.gravity[2])

    def close(self) -> None:
        self._backend.close()

    def run(self, log: Log, targets: Array) -> Array:
        """Return position, velocity and torque before the first and after each step, (3, steps + 1, J)."""
        import torch

        backend = self._backend

        def tensor(values: Any) -> torch.Tensor:
            return torch.as_tensor(np.asarray(values), dtype=backend.dtype, device=backend.device)[None]

        position, velocity = beginning(log)
        first = self._put(position, velocity, targets[0], log)
        series = np.zeros((3, len(targets) + 1, len(position)))
        commands = torch.as_tensor(targets, dtype=backend.dtype, device=backend.device)
        lift = tensor([0.0, 0.0, self._weight])
        every = round(_REHANG / TIMESTEP)
        if not self.hung:
            self._settle(first, commands[0], position)
        read = torch.zeros(3, len(position), dtype=backend.dtype, device=backend.device)
        rows = []
        for step in range(len(targets)):
            if self.hung and step % every == 0:
                if step:
                    state = backend.state
                    joints = (
                        state.joint_position[0].clone().cpu().numpy(),
                        state.joint_velocity[0].clone().cpu().numpy(),
                    )
                    self._put(*joints, targets[step - 1], log)
                backend.apply_force(lift)
            backend.step(commands[step : step + 1], substeps=1)
            state = backend.state
            read = torch.stack((state.joint_position[0], state.joint_velocity[0], state.joint_torque[0]))
            rows.append(read.clone())
        series[:, 0] = position, velocity, np.zeros(len(position))
        series[:, 1:] = torch.stack(rows, dim=1).cpu().numpy()
        series[2, 0] = series[2, 1]
        return series

    def _put(self, position: Array, velocity: Array, target: Array, log: Log) -> Any:
        """Put the robot into a pose: hung high above the ground, or on its feet."""
        from ...backends.base import ResetState

        backend = self._backend

        def tensor(values: Any) -> Any:
            import torch

            return torch.as_tensor(np.asarray(values, dtype=np.float64), dtype=backend.dtype, device=backend.device)[
                None
            ]

        upright = [1.0, 0.0, 0.0, 0.0] if log.quaternion is None else _level(log.quaternion[0])
        height = 5.0 if self.hung else _standing_height(self.robot, position, upright)
        start = ResetState(
            base_position=tensor([0.0, 0.0, height]),
            base_quaternion=tensor(upright),
            joint_position=tensor(position),
            joint_velocity=tensor(velocity if self.hung else np.zeros_like(velocity)),
            held_target=tensor(target),
        )
        backend.reset(start)
        return start

    def _settle(self, start: Any, target: Any, position: Array) -> None:
        """Let a standing robot come to rest under its first target."""
        for _ in range(round(0.5 / TIMESTEP)):
            self._backend.step(target[None], substeps=1)


def _level(quaternion: Array) -> Array:
    """Return an orientation, wxyz, without its heading."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_quat(quaternion, scalar_first=True)
    yaw = turn.as_euler("ZYX")[0]
    found: Array = (Rotation.from_euler("z", -yaw) * turn).as_quat(scalar_first=True)
    return found


def _standing_height(robot: Robot, position: Array, quaternion: Any) -> float:
    """Return the height of the base at which the lowest foot touches the ground [m]."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    data = mujoco.MjData(model)
    data.qpos[3:7] = quaternion
    for joint, angle in zip(robot.joint_names, position, strict=True):
        data.qpos[model.joint(joint).qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    feet = [model.geom(name).id for name in robot.foot_geoms]
    return float(data.qpos[2]) - min(lowest_point(model, data, foot) for foot in feet)


# ---- many parameter sets at once ------------------------------------------------------------------------------------------


class FixedRig:
    """Legs on a fixed trunk in MuJoCo: the model of the engine ``mujoco`` without its free joint, many sets at once on threads."""

    def __init__(self, robot: Robot, parameters: JointParameters, *, threads: int = 2) -> None:
        """Build the model with a set's constants; ``run`` replaces those that vary.

        Raises:
            BackendError: the robot's model lacks a joint.
        """
        import mujoco
        from mujoco import rollout

        from ...backends.mujoco.model import robot_spec

        physics = PhysicsOptions(timestep=TIMESTEP, substeps=1, self_collision=False)
        spec = robot_spec(Scene(robot=robot, parameters=parameters, terrains=(), terrain_index=(), physics=physics))
        for joint in list(spec.joints):
            if joint.type == mujoco.mjtJoint.mjJNT_FREE:
                spec.delete(joint)
        for sensor in list(spec.sensors):
            spec.delete(sensor)
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT.value
        self.robot, self.model = robot, spec.compile()
        if self.model.nq != robot.num_joints:
            raise LogError(
                f"robot '{robot.name}' has {self.model.nq} joints in its model but {robot.num_joints} in robot.toml"
            )
        names = [self.model.joint(i).name for i in range(self.model.njnt)]
        self._place = np.array([names.index(name) for name in robot.joint_names])
        self.trees = self.model.dof_treeid[self._place]
        """Number of each joint's kinematic tree, (J,): joints of different legs do not feel each other."""
        self._datas = [mujoco.MjData(self.model) for _ in range(max(threads, 1))]
        self._rollout = rollout.Rollout(nthread=threads if threads > 1 else 0)

    def close(self) -> None:
        """End the threads."""
        self._rollout.close()

    def run(self, sets: Sequence[JointParameters], targets: Array, starts: Sequence[tuple[Array, Array]]) -> Array:
        """Return position [rad], velocity [rad/s] and motor torque [N·m] on the grid, (3, S, steps + 1, J).

        Args:
            sets: S sets; their gains act as they are (``acting_parameters``).
            targets: [rad], (S, steps, J), offsets included.
            starts: position and velocity at the first step for each set, (J,) each.
        """
        place, joints = self._place, len(self._place)
        models, begin = [], np.zeros((len(sets), 1 + 2 * joints))
        for i, (constants, (position, velocity)) in enumerate(zip(sets, starts, strict=True)):
            model = copy.copy(self.model)
            model.dof_armature[place] = constants.armature
            model.dof_damping[place] = constants.joint_damping
            model.dof_frictionloss[place] = constants.friction_loss
            model.actuator_gainprm[:, 0] = constants.stiffness
            model.actuator_biasprm[:, 1] = -model.actuator_gainprm[:, 0]
            model.actuator_biasprm[:, 2] = -np.asarray(constants.damping)
            models.append(model)
            begin[i, 1 + place], begin[i, 1 + joints + place] = position, velocity
        state, _ = self._rollout.rollout(models, self._datas, begin, np.ascontiguousarray(targets))
        whole = np.concatenate([begin[:, None], state[:, :, : 1 + 2 * joints]], axis=1)
        series = np.empty((3, len(sets), whole.shape[1], joints))
        series[0], series[1] = whole[:, :, 1 + place], whole[:, :, 1 + joints + place]
        for i, constants in enumerate(sets):
            error = targets[i] - series[0, i, :-1]
            limit = np.asarray(constants.torque_limit)
            torque = np.asarray(constants.stiffness) * error - np.asarray(constants.damping) * series[1, i, :-1]
            series[2, i, 1:] = np.clip(torque, -limit, limit)
        series[2, :, 0] = series[2, :, 1]
        return series
