"""Survey the MuJoCo model of a legged robot without a description: base, legs, feet, a pose to stand in, motors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..files.parsing import one_line
from .body_plan import lowest_point, sideways_and_swinging, stretched_length
from .checking import solid
from .feet import add_foot, shank_end
from .limbs import joint_chain
from .loading import RobotError

if TYPE_CHECKING:
    import mujoco

_BEND = 0.8
"""Distance from hip to foot of a standing leg over that of a stretched one: 0.73 for the Go2, 0.85 for ANYmal C."""
_BEHIND = 0.1
"""Offset of a standing foot from its hip, away from the knee, over leg length: under load knees yield and hips follow."""
_WIDEST = 2.8
"""Largest joint angle of a pose [rad]."""
_STIFFNESS, _TORQUE, _DAMPING, _ARMATURE = 0.3, 0.4, 1.0 / 40.0, 1.5e-4
"""Stiffness [N·m/rad], torque limit [N·m] and armature [kg·m²] over weight times leg length, and damping over stiffness. The Go2
has 0.31, 0.37, 1.6e-4 and 0.025, ANYmal C 0.26, 0.26, and 0.025."""

_FULL_SPEED, _NO_LOAD_SPEED = 5.8, 12.8
"""Motor speeds times leg length [m/s]: those of the Go2."""
GRAVITY = 9.81

Remarked = tuple[Any, str]
"""A value and its origin."""


@dataclass(frozen=True, kw_only=True)
class Leg:
    """One leg, in MuJoCo's numbers."""

    joints: tuple[int, ...]
    """From the base outwards."""
    foot: int
    """Geom."""


class Survey:
    """A model under survey. Names and feet that a description needs are added to its spec."""

    def __init__(self, path: Path, spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
        """Find the base and the legs; raise ``RobotError`` for anything but one legged robot on a free base."""
        import mujoco

        self.mujoco, self.path, self.spec, self.model = mujoco, path, spec, model
        self.data = mujoco.MjData(model)
        self.renamed = False
        self.added_feet = 0
        free = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
        if len(free) != 1:
            first = model.body(1).name if model.nbody > 1 else ""
            raise self._error(f"has {len(free)} free joints; give its base, '{first}', and nothing else a <freejoint/>")
        if (model.geom_bodyid == 0).any():
            name = model.geom(int(np.flatnonzero(model.geom_bodyid == 0)[0])).name
            raise self._error(f"has a geom '{name}' in its worldbody, such as a floor; it must hold the robot alone")
        self.base = int(model.jnt_bodyid[free[0]])
        self.hinges = [j for j in range(model.njnt) if j != free[0]]
        other = [j for j in self.hinges if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_HINGE]
        if other:
            raise self._error(f"has the joint '{model.joint(other[0]).name}', which is no hinge")
        unnamed = [j for j in self.hinges if not model.joint(j).name]
        if unnamed:
            raise self._error(f"has {len(unnamed)} joints without a name; name them")
        self.place({})
        self.legs = self._with_feet(self._find_legs())

    def _error(self, problem: str) -> RobotError:
        return RobotError(f"'{one_line(self.path)}' {problem}")

    # ---- legs -------------------------------------------------------------------------------------------------------

    def _find_legs(self) -> list[Leg]:
        """Find the legs: chains of two joints or more that end in a shape that meets the ground; front left first."""
        model, legs = self.model, []
        moving = {int(b) for b in model.jnt_bodyid[self.hinges]}
        for tip in sorted(moving):
            below = {tip}
            for body in range(tip + 1, model.nbody):  # parents come first
                if int(model.body_parentid[body]) in below:
                    below.add(body)
            if moving & below != {tip}:
                continue
            chain = joint_chain(model, tip, self.base)
            shapes = [g for g in range(model.ngeom) if int(model.geom_bodyid[g]) in below and solid(model, g)]
            if len(chain) < 2 or not shapes:
                continue
            round_ones = [g for g in shapes if model.geom_type[g] == self.mujoco.mjtGeom.mjGEOM_SPHERE] or shapes
            knee = self.data.xanchor[chain[-1]]
            foot = max(round_ones, key=lambda g: float(np.linalg.norm(self.data.geom_xpos[g] - knee)))
            legs.append(Leg(joints=tuple(chain), foot=foot))
        if len(legs) < 2:
            raise self._error(f"has {len(legs)} legs, which end in shapes that meet the ground; at least 2 are needed")
        hips = {leg.foot: self.data.xanchor[leg.joints[0]] for leg in legs}
        middle = np.mean([hip[0] for hip in hips.values()])
        return sorted(legs, key=lambda leg: (bool(hips[leg.foot][0] < middle - 1e-3), -hips[leg.foot][1]))

    def _with_feet(self, legs: list[Leg]) -> list[Leg]:
        """Return the legs, with a sphere added for a foot to each leg that ends in a whole shank."""
        # ids are lost once a geom is added
        geoms, bodies = ({e.id: e for e in kind} for kind in (self.spec.geoms, self.spec.bodies))
        names: dict[int, str] = {}
        for leg in legs:
            end = shank_end(self.model, self.data, leg.foot, self.data.xanchor[leg.joints[-1]])
            if end is not None:
                body = int(self.model.geom_bodyid[leg.foot])
                bodies[body].name = bodies[body].name or f"body_{body}"
                names[leg.foot] = self._free_name(bodies[body].name, "foot")
                add_foot(bodies[body], names[leg.foot], end, geoms[leg.foot])
        if not names:
            return legs
        self.renamed, self.added_feet = True, len(names)
        old, self.model = self.model, self.spec.compile()
        self.data = self.mujoco.MjData(self.model)
        self.place({})
        # a body's own shapes keep their order, and added shapes follow them
        moved = self.model.body_geomadr - old.body_geomadr
        feet = {leg.foot: leg.foot + int(moved[old.geom_bodyid[leg.foot]]) for leg in legs}
        feet |= {foot: self.model.geom(name).id for foot, name in names.items()}
        return [replace(leg, foot=feet[leg.foot]) for leg in legs]

    def leg_length(self, leg: Leg) -> float:
        """Return the length of a stretched leg [m], without the link that swings it sideways."""
        return stretched_length(self.data, self._swinging(leg), self.data.geom_xpos[leg.foot])

    def _swinging(self, leg: Leg) -> list[int]:
        return sideways_and_swinging(self.data, leg.joints)[1]

    # ---- pose -------------------------------------------------------------------------------------------------------

    def default_pose(self) -> tuple[dict[int, float], str]:
        """Return an angle for each hinge, and its origin: a keyframe, or bent knees with the feet below the hips."""
        model = self.model
        for key in range(model.nkey):
            name = model.key(key).name
            if key == model.nkey - 1 or any(word in name.lower() for word in ("home", "stand", "default")):
                angles = {j: float(model.key_qpos[key, model.jnt_qposadr[j]]) for j in self.hinges}
                return self._within(angles), f"of the model's keyframe '{name or key}'"
        angles = self._within(dict.fromkeys(self.hinges, 0.0))
        for leg in self.legs:
            angles |= self._bent(leg, angles)
        return angles, "guessed: knees bent, feet below the hips, a little behind them where knees are behind"

    def _within(self, angles: dict[int, float]) -> dict[int, float]:
        return {j: float(np.clip(angle, *self._bounds(j))) for j, angle in angles.items()}

    def _bounds(self, joint: int) -> tuple[float, float]:
        low, high = self.model.jnt_range[joint] if self.model.jnt_limited[joint] else (-_WIDEST, _WIDEST)
        return float(max(low, -_WIDEST)), float(min(high, _WIDEST))

    def _bent(self, leg: Leg, pose: dict[int, float]) -> dict[int, float]:
        """Return the leg's angles with the foot below the hip, and the knee behind rather than in front."""
        swinging = self._swinging(leg)
        if len(swinging) < 2:
            return {}
        hip, knee = swinging[:2]

        grid = np.linspace(*self._bounds(knee), 181)
        across = self.data.xaxis[hip].copy()
        lengths = []
        for angle in grid:
            foot = self._reach(leg, {**pose, knee: float(angle)}, pose[hip])
            lengths.append(float(np.linalg.norm(foot - across * (foot @ across))))
        stretched = int(np.argmax(lengths))
        wanted = _BEND * lengths[stretched]
        found: list[tuple[float, bool, dict[int, float]]] = []
        for side in (range(stretched + 1), range(stretched, len(grid))):
            nearest = min(side, key=lambda i: abs(lengths[i] - wanted))
            bent = float(grid[nearest])
            for in_front, aside in ((False, -_BEHIND), (True, _BEHIND)):
                reach = partial(self._reach, leg, {**pose, knee: bent})
                swing, apart = self._below(hip, reach, aside * lengths[stretched])
                reach(swing)
                if in_front == bool(self.data.xanchor[knee][0] > self.data.xanchor[hip][0]):
                    break
            found.append((round(apart + abs(lengths[nearest] - wanted), 2), in_front, {knee: bent, hip: swing}))
        # a leg that cannot bend so, or a foot that cannot come below its hip, is worse than a knee in front
        return min(found, key=lambda each: each[:2])[2]

    def _reach(self, leg: Leg, pose: dict[int, float], swing: float) -> NDArray[np.float64]:
        """Return the vector from a leg's swinging hip, at an angle, to its foot [m], (3,)."""
        hip = self._swinging(leg)[0]
        self.place({**pose, hip: swing})
        return self.data.geom_xpos[leg.foot] - self.data.xanchor[hip]

    def _below(self, hip: int, reach: Callable[[float], NDArray[np.float64]], aside: float) -> tuple[float, float]:
        """Return the hip's angle that puts the foot below it and ``aside`` before it [m], and the distance that remains [m]."""
        low, high = self._bounds(hip)
        found = (0.5 * (low + high), np.inf)
        for _ in range(3):  # finer each time
            feet = [(float(angle), reach(float(angle))) for angle in np.linspace(low, high, 101)]
            below = [(angle, abs(float(foot[0]) - aside)) for angle, foot in feet if foot[2] < 0.0]
            found = min([found, *below], key=lambda each: each[1])
            step = (high - low) / 50
            low, high = max(found[0] - step, low), min(found[0] + step, high)
        return found

    def place(self, pose: dict[int, float]) -> None:
        """Put the robot into a pose, its base level at the origin."""
        start = int(self.model.jnt_qposadr[self.model.body_jntadr[self.base]])
        self.data.qpos[start : start + 7] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
        for joint, angle in pose.items():
            self.data.qpos[self.model.jnt_qposadr[joint]] = angle
        self.mujoco.mj_kinematics(self.model, self.data)

    def depth(self) -> float:
        """Return the depth of the placed robot's lowest shape below its base [m]."""
        return -min(lowest_point(self.model, self.data, g) for g in range(self.model.ngeom) if solid(self.model, g))

    def feet_depth(self) -> float:
        """Return the depth of the placed robot's lowest foot below its base [m]."""
        return -min(lowest_point(self.model, self.data, leg.foot) for leg in self.legs)

    # ---- names ------------------------------------------------------------------------------------------------------

    def geom_name(self, geom: int, kind: str) -> str:
        """Return a geom's name; a geom without one gets it here."""
        element = next(g for g in self.spec.geoms if g.id == geom)
        if not element.name:
            element.name = self._free_name(self.body_name(int(self.model.geom_bodyid[geom])), kind)
            self.renamed = True
        return element.name

    def _free_name(self, body: str, kind: str) -> str:
        """Return an unused name for a geom of a body."""
        taken = {g.name for g in self.spec.geoms}
        return next(n for i in range(1, 10_000) if (n := f"{body}_{kind}" + (f"_{i}" if i > 1 else "")) not in taken)

    def body_name(self, body: int) -> str:
        """Return a body's name; a body without one gets it here."""
        element = next(b for b in self.spec.bodies if b.id == body)
        if not element.name:
            element.name = f"body_{body}"
            self.renamed = True
        return element.name

    def colliding_bodies(self) -> list[str]:
        """Return the bodies with a shape, not a foot, that meets the ground, the base first."""
        feet = {leg.foot for leg in self.legs}
        shapes = [g for g in range(self.model.ngeom) if solid(self.model, g) and g not in feet]
        bodies = {int(self.model.geom_bodyid[g]) for g in shapes}
        return [self.body_name(b) for b in sorted(bodies | {self.base}, key=lambda b: (b != self.base, b))]

    def trunk(self) -> int:
        """Return the largest shape of the base that meets the ground; raise ``RobotError`` where there is none."""
        own = [g for g in range(self.model.ngeom) if self.model.geom_bodyid[g] == self.base and solid(self.model, g)]
        if not own:
            base = self.model.body(self.base).name
            raise self._error(f"has no shape on its base '{base}' that meets the ground; give it a geom with contype 1")
        return max(own, key=lambda g: float(np.prod(self.model.geom_aabb[g, 3:])))

    # ---- motors -----------------------------------------------------------------------------------------------------

    def motors(self, joints: list[int], length: float, stiffer: float = 1.0) -> dict[str, Remarked]:
        """Return constants of the joints, in the given order, by the keys of ``JointParameters``.

        Args:
            length: of the legs [m].
            stiffer: factor of a guessed stiffness.
        """
        model = self.model
        strength = GRAVITY * float(model.body_mass.sum()) * length
        motor_of = {
            int(model.actuator_trnid[a, 0]): a
            for a in range(model.nu)
            if model.actuator_trntype[a] == self.mujoco.mjtTrn.mjTRN_JOINT
        }
        dofs = model.jnt_dofadr[joints]
        servos = [motor_of.get(j) for j in joints]
        gains = [self._gains(a) for a in servos]
        kp, kd = [k for k, _ in gains], [d for _, d in gains]
        position = all(
            a is not None and k > 0.0 and model.actuator_biasprm[a, 1] == -model.actuator_gainprm[a, 0]
            for a, k in zip(servos, kp, strict=True)
        )
        sizes, by_length = "guessed from weight and leg length", "guessed from leg length"
        stiffness: Remarked = (_round(stiffer * _STIFFNESS * strength), sizes)
        if position:
            stiffness = (kp, "of the model's position actuators")
        damping: Remarked = (_round(_DAMPING * float(np.mean(stiffness[0]))), "guessed: a fortieth of the stiffness")
        if position and min(kd) > 0.0:
            damping = (kd, "of the model's position actuators")
        limits = [self._torque_limit(j, a) for j, a in zip(joints, servos, strict=True)]
        torque: Remarked = (_round(_TORQUE * strength), sizes) if None in limits else (limits, "of the model")
        armature: Remarked = (model.dof_armature[dofs].tolist(), "of the model")
        if not model.dof_armature[dofs].all():
            armature = (_round(_ARMATURE * strength), f"{sizes}: rotor inertia, which the model lacks")
        return {
            "stiffness": stiffness,
            "damping": damping,
            "torque_limit": torque,
            "armature": armature,
            "joint_damping": (model.dof_damping[dofs].tolist(), "of the model"),
            "friction_loss": (model.dof_frictionloss[dofs].tolist(), "of the model"),
            "full_torque_speed": (_round(_FULL_SPEED / length), f"{by_length}: up to here the torque is there"),
            "no_load_speed": (_round(_NO_LOAD_SPEED / length), f"{by_length}: from here the motor drives no more"),
        }

    def _gains(self, actuator: int | None) -> tuple[float, float]:
        """Return stiffness and damping that a position servo gives its joint: the gear multiplies the measured angle and the torque."""
        if actuator is None:
            return 0.0, 0.0
        squared = float(self.model.actuator_gear[actuator, 0]) ** 2
        kp, kd = self.model.actuator_gainprm[actuator, 0], -self.model.actuator_biasprm[actuator, 2]
        return squared * float(kp), squared * float(kd)

    def _torque_limit(self, joint: int, actuator: int | None) -> float | None:
        model = self.model
        if model.jnt_actfrclimited[joint]:
            return float(np.abs(model.jnt_actfrcrange[joint]).max())
        if actuator is None:
            return None
        gear = abs(float(model.actuator_gear[actuator, 0]))
        if model.actuator_forcelimited[actuator]:
            return gear * float(np.abs(model.actuator_forcerange[actuator]).max())
        motor = model.actuator_biastype[actuator] == self.mujoco.mjtBias.mjBIAS_NONE
        if motor and model.actuator_ctrllimited[actuator]:
            gain = float(model.actuator_gainprm[actuator, 0])
            return gear * gain * float(np.abs(model.actuator_ctrlrange[actuator]).max())
        return None


def _round(value: float) -> float:
    """Round to two digits: a guess has no more."""
    return float(f"{value:.2g}")
