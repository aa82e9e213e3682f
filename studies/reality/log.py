"""A robot's own recording of its joints: the data, and the checks that every log passes whatever file it came from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...files.parsing import one_line, shown
from ...robots import Robot

Array = NDArray[np.float64]
HELD = ("hung", "standing", "walking")
"""Ways in which a recorded robot was held: trunk fixed with free legs, standing on its feet, or moving about."""
MOST_BAD = 0.2
"""Largest share of rows that may be dropped; beyond it a log is refused."""
LONGEST_GAP = 0.5
"""Longest time without a row [s]."""
_APART = 0.06
"""Time over which velocities are added up before they are held against positions [s]: noise of positions counts less."""
_MOVING = 0.2
"""RMS velocity [rad/s] from which a joint's recorded velocities are held against its positions."""
_SPIKE = 0.25
"""Distance of a position from the middle of its two neighbours that no joint covers between three rows [rad]."""
_BEYOND = 0.5
"""Distance beyond a joint's range that a wrong zero explains [rad]."""
_LEAST_ROWS = 50


class LogError(ValueError):
    """A log that cannot be used; the message says what is wrong, where, and what to change."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Log:
    """A recording. T rows in rising time, J joints in the robot's order and with the model's signs."""

    name: str
    """File name."""
    robot: Robot
    time: Array
    """Time since the first row [s], (T,)."""
    target: Array
    """Position commands [rad], (T, J)."""
    position: Array
    """Measured positions [rad], (T, J)."""
    velocity: Array | None
    """Measured velocities [rad/s], (T, J); None where the log has none."""
    torque: Array | None
    """Torque measured or estimated by the motors [N·m], (T, J); None where the log has none. Never the motor law's."""
    stiffness: Array
    """kp that was sent to the motors [N·m/rad], (J,)."""
    damping: Array
    """kd that was sent to the motors [N·m·s/rad], (J,)."""
    held: str | None
    """One of ``HELD``; None where the log does not say."""
    quaternion: Array | None = None
    """Measured orientation of the base, wxyz, (T, 4)."""
    angular_velocity: Array | None = None
    """Measured angular velocity of the base, body frame [rad/s], (T, 3)."""
    fresh: NDArray[np.bool_]
    """Rows in which a position differs from the row before, (T,); the others repeat an old measurement."""
    found: Mapping[str, int]
    """Number of rows by kind of defect: ``unordered``, ``missing``, ``spikes``, ``repeated``, ``late``."""
    notes: tuple[str, ...] = ()
    """Sentences on how the file was read."""

    @property
    def period(self) -> float:
        """Return the median time between rows [s]."""
        return float(np.median(np.diff(self.time)))

    def cut(self, begin: float, end: float) -> Log:
        """Return the rows from ``begin`` to ``end`` [s], their time counted from the first of them; raise ``LogError`` for too few."""
        rows = (self.time >= begin) & (self.time <= end)
        if rows.sum() < _LEAST_ROWS:
            until = f"{end:g} s" if np.isfinite(end) else f"its end at {self.time[-1]:.2f} s"
            raise LogError(
                f"log '{self.name}' has {int(rows.sum())} rows from {begin:g} s to {until}; {_LEAST_ROWS} are needed"
            )
        series = ("time", "target", "position", "velocity", "torque", "quaternion", "angular_velocity", "fresh")
        parts: dict[str, Any] = {key: None if (value := getattr(self, key)) is None else value[rows] for key in series}
        found = {**self.found, **_counted(parts["time"], parts["fresh"])}  # dropped rows are those of the whole log
        return replace(self, **parts | {"time": parts["time"] - parts["time"][0], "found": found})

    def defects(self) -> str:
        """Return one sentence on the rows that were dropped or are not counted."""
        words = {
            "unordered": "out of order (sorted)",
            "missing": "with missing values (dropped)",
            "spikes": "with a jump (dropped)",
            "repeated": "repeating the last measurement (not counted)",
            "late": "late (kept)",
        }
        parts = [f"{count} {words[kind]}" for kind, count in self.found.items() if count]
        return f"{len(self.time)} rows in {self.time[-1]:.2f} s; " + (", ".join(parts) or "no defects")


def make_log(name: str, robot: Robot, columns: Mapping[str, Any], *, notes: Sequence[str] = ()) -> Log:
    """Check and clean a recording with columns in the robot's order.

    Args:
        name: of the file, for sentences.
        columns: ``time`` (T,), ``target`` and ``position`` (T, J), ``stiffness`` and ``damping`` (J,), and those of the other
            fields of ``Log`` that the file has.
        notes: sentences on how the file was read.

    Raises:
        LogError: too few rows, too many defects, wrong units, or joints that are not those of the robot.
    """
    source = f"log '{one_line(name)}'"
    time = np.asarray(columns["time"], dtype=np.float64)
    if len(time) < _LEAST_ROWS:
        rows = "no rows" if len(time) == 0 else f"{len(time)} row{'s' if len(time) > 1 else ''}"
        raise LogError(f"{source} has {rows}; at least {_LEAST_ROWS} are needed, 20 s are a good recording")
    series = {
        key: np.asarray(value, dtype=np.float64)
        for key in ("time", "target", "position", "velocity", "torque", "quaternion", "angular_velocity")
        if (value := columns.get(key)) is not None
    }
    series, found = _cleaned(series, source)
    for key in ("stiffness", "damping"):
        gains = np.asarray(columns[key], dtype=np.float64)
        if not np.isfinite(gains).all() or (gains < 0).any():
            raise LogError(
                f"{source}: {key} is {shown(gains.tolist())}; the gains that were sent must be numbers from 0 on"
            )
    position, time = series["position"], series["time"]
    fresh = np.append(True, (np.diff(position, axis=0) != 0).any(axis=1))
    steps = np.diff(time)
    found |= _counted(time, fresh)
    if fresh.mean() < 0.2:
        raise LogError(
            f"{source}: {found['repeated']} of {len(time)} rows repeat the row before; log no faster than the robot reports"
        )
    if (usual := float(np.median(steps))) > LONGEST_GAP:
        raise LogError(
            f"{source}: its rows are {usual:.3g} apart in time; the time must be in seconds, in rows of a few ms"
        )
    if (longest := int(steps.argmax())) >= 0 and steps[longest] > LONGEST_GAP:
        gap = f"no row for {steps[longest]:.2f} s after {time[longest] - time[0]:.2f} s"
        raise LogError(f"{source} has {gap}; cut the log there (--from, --to), {LONGEST_GAP:g} s are allowed")
    log = Log(
        name=name,
        robot=robot,
        time=time - time[0],
        target=series["target"],
        position=position,
        velocity=series.get("velocity"),
        torque=series.get("torque"),
        stiffness=np.asarray(columns["stiffness"], dtype=np.float64),
        damping=np.asarray(columns["damping"], dtype=np.float64),
        held=columns.get("held"),
        quaternion=series.get("quaternion"),
        angular_velocity=series.get("angular_velocity"),
        fresh=fresh,
        found=found,
        notes=tuple(notes),
    )
    _check_joints(log, source)
    _check_velocity(log, source)
    return log


def _counted(time: Array, fresh: NDArray[np.bool_]) -> dict[str, int]:
    """Return the number of rows that repeat the last measurement and of those that are late."""
    steps = np.diff(time)
    return {"repeated": int((~fresh).sum()), "late": int((steps > 1.75 * np.median(steps)).sum())}


def _cleaned(series: dict[str, Array], source: str) -> tuple[dict[str, Array], dict[str, int]]:
    """Sort rows by time and drop those with missing values or with a jump; return the rest and the counts."""
    time = series["time"]
    known = np.isfinite(time)
    for key in ("target", "position", "velocity", "torque", "quaternion", "angular_velocity"):
        if key in series:
            known &= np.isfinite(series[key]).all(axis=1)
    missing, rows = int((~known).sum()), len(time)
    if missing > MOST_BAD * rows:
        raise LogError(
            f"{source}: {missing} of {rows} rows have values that are missing or no numbers; at most {MOST_BAD:.0%} may"
        )
    series = {key: value[known] for key, value in series.items()}
    order = np.argsort(series["time"], kind="stable")
    unordered = int((np.diff(series["time"]) <= 0).sum())
    if unordered > MOST_BAD * rows:
        raise LogError(
            f"{source}: the time does not rise in {unordered} of {rows} rows; it must be in seconds and rise with each row"
        )
    series = {key: value[order] for key, value in series.items()}
    distinct = np.append(True, np.diff(series["time"]) > 0)
    series = {key: value[distinct] for key, value in series.items()}
    position = series["position"]
    middle = (position[:-2] + position[2:]) / 2
    near = np.abs(position[2:] - position[:-2]) < _SPIKE
    jump = np.zeros(len(position), dtype=bool)
    jump[1:-1] = ((np.abs(position[1:-1] - middle) > _SPIKE) & near).any(axis=1)
    spikes = int(jump.sum())
    if spikes > MOST_BAD * rows:
        raise LogError(f"{source}: positions jump in {spikes} of {rows} rows; at most {MOST_BAD:.0%} may")
    return {key: value[~jump] for key, value in series.items()}, {
        "unordered": unordered,
        "missing": missing,
        "spikes": spikes,
    }


def _check_joints(log: Log, source: str) -> None:
    """Refuse positions that the joints cannot have: degrees, columns under the wrong name, a wrong sign."""
    ranges = joint_ranges(log.robot)
    for j, joint in enumerate(log.robot.joint_names):
        low, high = ranges[j]
        middle = float(np.median(log.position[:, j]))
        if low - _BEYOND <= middle <= high + _BEYOND:
            continue
        where = f"{joint} stands at {middle:.2f}, outside of its range of {low:.2f} to {high:.2f} rad"
        if np.abs(np.median(log.position, axis=0)).max() > 4 * np.pi:
            raise LogError(f"{source}: {where}; the positions look like degrees and must be radians")
        if low - _BEYOND <= -middle <= high + _BEYOND:
            raise LogError(
                f"{source}: {where}; its sign looks reversed, or its column belongs to another joint (signs in --map)"
            )
        raise LogError(f"{source}: {where}; the columns do not belong to these joint_names, or it is another robot")
    if np.abs(log.target).max() > 4 * np.pi:
        raise LogError(f"{source}: a target is {np.abs(log.target).max():.1f}; targets must be radians")
    error = log.position[:, :, None] - log.target[:, None, :]
    apart = np.sqrt((error**2).mean(axis=0))  # of each position from each target
    own, best = np.diagonal(apart), apart.argmin(axis=1)
    for j, joint in enumerate(log.robot.joint_names):
        if own[j] > 0.1 and apart[j, best[j]] < 0.5 * own[j]:
            raise LogError(
                f"{source}: {joint} follows the target of {log.robot.joint_names[best[j]]}; "
                "targets and positions are in different orders (joints and target_joints in --map)"
            )


def _check_velocity(log: Log, source: str) -> None:
    """Refuse velocities that are not the change of their positions: degrees, a wrong sign, columns under the wrong name."""
    if log.velocity is None:
        return
    every = max(round(_APART / log.period), 1)
    time, position = log.time[::every], log.position[::every]
    area = np.zeros_like(log.velocity)
    np.cumsum((log.velocity[1:] + log.velocity[:-1]) / 2 * np.diff(log.time)[:, None], axis=0, out=area[1:])
    moved, said = np.diff(position, axis=0), np.diff(area[::every], axis=0)
    power = (moved**2).mean(axis=0)
    share = (moved * said).mean(axis=0) / power.clip(1e-12)
    moving = power > (_MOVING * np.median(np.diff(time))) ** 2
    wrong = np.flatnonzero(moving & ~((share > 0.5) & (share < 1.6)))
    if len(wrong):
        j = int(wrong[0])
        hint = (
            "they look like degrees and must be rad/s"
            if 30.0 < abs(share[j]) < 90.0
            else ("their sign or their column is wrong (signs in --map)" if share[j] < 0.5 else "they must be rad/s")
        )
        raise LogError(
            f"{source}: velocities of {log.robot.joint_names[j]} are {share[j]:.2g} times the change of its positions; {hint}"
        )


def joint_ranges(robot: Robot) -> Array:
    """Return the lower and upper limit of each joint [rad], (J, 2); infinite where the model has none."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    joints = [model.joint(name) for name in robot.joint_names]
    return np.array([joint.range if model.jnt_limited[joint.id] else (-np.inf, np.inf) for joint in joints])


def free_legs_torque(
    robot: Robot, position: Array, velocity: Array | None = None, acceleration: Array | None = None
) -> Array:
    """Return the torque that moves or holds free legs under an upright, fixed trunk, without rotors and friction [N·m], (T, J).

    Args:
        position: of the joints [rad], (T, J).
        velocity, acceleration: [rad/s, rad/s²], (T, J); None for legs at rest.
    """
    import mujoco

    model, data = _posed(robot, position[0])
    places = [int(model.joint(joint).qposadr[0]) for joint in robot.joint_names]
    columns = [int(model.joint(joint).dofadr[0]) for joint in robot.joint_names]
    found = np.empty_like(position)
    for row in range(len(position)):
        data.qpos[places] = position[row]
        data.qvel[columns] = 0.0 if velocity is None else velocity[row]
        data.qacc[columns] = 0.0 if acceleration is None else acceleration[row]
        mujoco.mj_inverse(model, data)
        found[row] = data.qfrc_inverse[columns]
    return found


def carried_share(robot: Robot, position: Array, torque: Array) -> float:
    """Return the share of a robot's weight that its feet carry if its joints hold such torques beyond those of free legs.

    Args:
        position: of the joints under an upright trunk [rad], (J,).
        torque: [N·m], (J,).
    """
    import mujoco

    model, data = _posed(robot, position)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    columns = [int(model.joint(joint).dofadr[0]) for joint in robot.joint_names]
    rows = np.zeros((3 * len(robot.foot_geoms), len(columns)))
    for i, foot in enumerate(robot.foot_geoms):
        jacobian = np.zeros((3, model.nv))
        geom = model.geom(foot).id
        mujoco.mj_jac(model, data, jacobian, None, data.geom_xpos[geom], int(model.geom_bodyid[geom]))
        rows[3 * i : 3 * i + 3] = jacobian[:, columns]
    forces = np.linalg.lstsq(-rows.T, torque, rcond=1e-3)[0]  # of the ground on the feet
    return float(forces[2::3].sum() / (model.body_mass.sum() * -model.opt.gravity[2]))


def _posed(robot: Robot, position: Array) -> tuple[Any, Any]:
    """Return a robot's model without contacts, friction and rotors, and its data at a pose."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    model.dof_frictionloss[:] = model.dof_damping[:] = model.dof_armature[:] = 0.0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT.value
    data = mujoco.MjData(model)
    for joint, angle in zip(robot.joint_names, position, strict=True):
        data.qpos[model.joint(joint).qposadr[0]] = angle
    return model, data


def save_log(log: Log, path: Any) -> None:
    """Write a log in the project's own format (``docs/reference/logs.md``), compressed."""
    from ...files.writing import replacing

    keys = ("velocity", "torque", "quaternion", "angular_velocity", "held")
    optional: dict[str, Any] = {key: value for key in keys if (value := getattr(log, key)) is not None}
    with replacing(path, LogError, ending=".npz") as partial:
        np.savez_compressed(
            partial,
            format=np.array("gaitgauge log 1"),
            robot=np.array(log.robot.name),
            joint_names=np.array(log.robot.joint_names),
            time=log.time,
            target=log.target,
            position=log.position,
            stiffness=log.stiffness,
            damping=log.damping,
            **optional,
        )
