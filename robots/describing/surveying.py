"""Survey the MuJoCo model of a legged robot without a description: its base, which limbs are legs, their feet, names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...files.parsing import did_you_mean, one_line
from ..anatomy.body_plan import lowest_point, stretched_length
from ..anatomy.feet import add_foot, copy_geom, shank_end
from ..anatomy.limbs import is_wheel, joint_chain, joint_roles, moving_tips, pitch_joints
from ..anatomy.roles import plan_of
from ..checks.checking import solid
from ..loading import RobotError
from ..physical import is_visual_mesh

if TYPE_CHECKING:
    import mujoco

GRAVITY = 9.81
_LOWEST = 0.75
"""Depth of a leg's end below the base over that of the lowest limb's: an arm that hangs beside the trunk ends higher."""
_SOLE = 0.02
"""Height above the lowest point of a foot within which a shape belongs to its sole [m]."""


@dataclass(frozen=True, kw_only=True)
class Answers:
    """Answers of a user to what the model does not tell; empty where none was given."""

    legs: tuple[str, ...] = ()
    """A body, a joint or a shape of each leg."""
    feet: tuple[str, ...] = ()
    """Shapes that meet the ground, or bodies, for all their shapes."""
    keyframe: str | None = None
    """Keyframe of the standing pose, by name or number."""
    pose: Mapping[str, float] = field(default_factory=dict)
    """Angles of the standing pose [rad], by names of joints or whole words of them; the other joints keep theirs."""


@dataclass(frozen=True, kw_only=True)
class Leg:
    """One leg, in MuJoCo's numbers."""

    joints: tuple[int, ...]
    """From the base outwards, without a wheel's."""
    feet: tuple[int, ...]
    """Geoms of the foot, all of one body."""


@dataclass(frozen=True, kw_only=True)
class _Limb:
    """A limb: what hangs on the base, from it to an end."""

    tip: int
    """The last body that a joint moves."""
    joints: tuple[int, ...]
    shapes: tuple[int, ...]
    """Geoms of the last body, and of what is fixed to it, that meet the ground."""
    depth: float
    """Of the limb's end below the base [m]."""


class Survey:
    """A model under survey. Names and feet that a description needs are added to its spec."""

    def __init__(self, path: Path, spec: mujoco.MjSpec, model: mujoco.MjModel, answers: Answers | None = None) -> None:
        """Find the base and the legs; raise ``RobotError`` for anything but one legged robot on a free base."""
        import mujoco

        self.mujoco, self.path, self.spec, self.model = mujoco, path, spec, model
        self.answers = answers or Answers()
        self.data = mujoco.MjData(model)
        self.renamed = False
        self.added_feet = 0
        self.mends: list[str] = []
        free = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
        if not free:
            first = model.body(1).name if model.nbody > 1 else ""
            raise self._error(f"has a fixed base: no joint is free; give its body '{first}' a <freejoint/>")
        if len(free) > 1:
            bodies = " and ".join(f"'{model.body(int(model.jnt_bodyid[j])).name}'" for j in free)
            raise self._error(f"has {len(free)} free joints, of {bodies}; keep the one of the robot's base")
        self.base = int(model.jnt_bodyid[free[0]])
        self.hinges = [j for j in range(model.njnt) if j != free[0]]
        other = [j for j in self.hinges if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_HINGE]
        if other:
            raise self._error(f"has the joint '{model.joint(other[0]).name}', which is no hinge; fix it or take it out")
        for joint in self.hinges:
            if not model.joint(joint).name:
                name = f"{self.body_name(int(model.jnt_bodyid[joint]))}_joint"
                next(j for j in spec.joints if j.id == joint).name, self.renamed = name, True
        self._give_trunk()
        if self.renamed:
            self._compile()
        self.place({})
        self.legs = self._with_feet(self._sorted([self._leg(limb) for limb in self._leg_limbs()]))
        chains = [leg.joints for leg in self.legs]
        self.roles = joint_roles(self.model, self.base, chains, [leg.feet[0] for leg in self.legs])
        self.plan = plan_of(len(self.legs), self.roles.values(), f"'{one_line(path)}'")

    def _error(self, problem: str) -> RobotError:
        return RobotError(f"'{one_line(self.path)}' {problem}")

    def _compile(self) -> None:
        self.model = self.spec.compile()
        self.data = self.mujoco.MjData(self.model)
        self.place({})

    def _give_trunk(self) -> None:
        """Add a sphere to a base without a shape that meets the ground: half as large as a ball of its mass and inertia."""
        model, base = self.model, self.base
        if any(solid(model, int(g)) for g in np.flatnonzero(model.geom_bodyid == base)):
            return
        radius = 0.5 * float(np.sqrt(2.5 * model.body_inertia[base].mean() / max(float(model.body_mass[base]), 1e-9)))
        element = next(b for b in self.spec.bodies if b.id == base)
        element.name = element.name or f"body_{base}"
        name, radius = self._free_name(element.name, "trunk"), max(round(radius, 3), 0.02)
        element.add_geom(
            name=name,
            type=self.mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[radius, 0.0, 0.0],
            pos=model.body_ipos[base].round(4).tolist(),
            mass=0.0,
            group=3,
            contype=1,
            conaffinity=1,
        )
        self.renamed = True
        self.mends.append(
            f"{self.path.name}: the base '{element.name}' has no shape that meets the ground: given a sphere of {radius:g} m, '{name}'"
        )

    def repeat(self, full: mujoco.MjSpec) -> None:
        """Give names and added shapes to another spec of the same file, mended in the same way, with all its visual meshes."""
        for theirs, ours in zip(full.bodies, self.spec.bodies, strict=True):
            theirs.name = ours.name
            for joint, named in zip(theirs.joints, ours.joints, strict=True):
                joint.name = named.name
            physical = [geom for geom in theirs.geoms if not is_visual_mesh(theirs, geom)]
            for geom, named in zip(physical, ours.geoms, strict=False):
                geom.name = named.name
            for added in list(ours.geoms)[len(physical) :]:
                copy_geom(theirs, added)

    # ---- legs -------------------------------------------------------------------------------------------------------

    def _limbs(self) -> list[_Limb]:
        model, found = self.model, []
        for tip in moving_tips(model, self.base):
            below = {tip}
            for body in range(tip + 1, model.nbody):  # parents come first
                if int(model.body_parentid[body]) in below:
                    below.add(body)
            shapes = [g for g in range(model.ngeom) if int(model.geom_bodyid[g]) in below]
            ends = [lowest_point(model, self.data, g) for g in shapes] or [float(self.data.xpos[tip, 2])]
            found.append(
                _Limb(
                    tip=tip,
                    joints=tuple(joint_chain(model, tip, self.base)),
                    shapes=tuple(g for g in shapes if solid(model, g)),
                    depth=-min(ends),
                )
            )
        return found

    def _leg_limbs(self) -> list[_Limb]:
        """Return the limbs that are legs: those that are named, else those that end lowest; raise ``RobotError`` for faulty ones."""
        limbs = self._limbs()
        if not limbs:
            raise self._error("has no limbs: no joint moves a body against its base")
        if self.answers.legs:
            legs = [self._limb_of(name, limbs) for name in self.answers.legs]
        elif self.answers.feet:
            legs = [self._limb_of(name, limbs) for name in self.answers.feet]
        else:
            deepest = max(limb.depth for limb in limbs)
            legs = [limb for limb in limbs if deepest > 0.0 and limb.depth >= _LOWEST * deepest]
        legs = list({limb.tip: limb for limb in legs}.values())
        told = ", ".join(f"'{self.model.body(limb.tip).name or limb.tip}'" for limb in legs)
        name = {limb.tip: self.model.body(limb.tip).name or str(limb.tip) for limb in limbs}
        if len(legs) not in (2, 4, 6):
            others = ", ".join(f"'{name[limb.tip]}'" for limb in limbs if limb not in legs)
            rest = f", and not {others}" if others else ""
            raise self._error(
                f"has {len(legs)} leg{'s' if len(legs) > 1 else ''}, which end lowest: {told}{rest}; a robot has 2, 4 or 6: name a body, a "
                "joint or a shape of each leg (--legs a,b)"
            )
        bare = [limb for limb in legs if not limb.shapes]
        if bare:
            raise self._error(
                f"has no feet: its leg ends in '{name[bare[0].tip]}', where no shape meets the ground; give that a geom with contype 1, "
                "or name the limbs that are legs (--legs a,b)"
            )
        short = [limb for limb in legs if len(limb.joints) < 2]
        if short:
            raise self._error(
                f"has a leg of one joint, '{self.model.joint(short[0].joints[0]).name}'; a leg has two or more: name the limbs that are "
                "legs (--legs a,b)"
            )
        return legs

    def _limb_of(self, name: str, limbs: Sequence[_Limb]) -> _Limb:
        """Return the only limb that a body, a joint or a geom of this name belongs to."""
        model = self.model
        bodies = [b for b in range(model.nbody) if model.body(b).name == name]
        bodies += [int(model.jnt_bodyid[j]) for j in self.hinges if model.joint(j).name == name]
        bodies += [int(model.geom_bodyid[g]) for g in range(model.ngeom) if model.geom(g).name == name]
        if not bodies:
            known = [model.body(limb.tip).name for limb in limbs]
            hint = did_you_mean(name, [*known, *(model.joint(j).name for j in self.hinges)])
            ends = f"limbs end in the bodies {', '.join(known)}"
            raise self._error(f"has no body, joint or shape '{one_line(name, 80)}'{hint or ';'} {ends}")
        chain = joint_chain(model, bodies[0], self.base)
        found = [limb for limb in limbs if limb.joints[: len(chain)] == tuple(chain)]
        if len(found) != 1:
            raise self._error(f"has {len(found)} limbs with '{one_line(name, 80)}'; name a part of one leg alone")
        return found[0]

    def _leg(self, limb: _Limb) -> Leg:
        model, data = self.model, self.data
        named = {g for name in self.answers.feet for g in self._shapes_of(name)} & set(limb.shapes)
        if self.answers.feet:
            if not named:
                body = model.body(limb.tip).name
                raise self._error(
                    f"has the leg that ends in '{body}', but --feet names no shape of it; name one for each leg"
                )
            return Leg(joints=limb.joints, feet=tuple(sorted(named)))
        last = limb.joints[-1]
        # wheels turn about their own centre
        wheels = [g for g in limb.shapes if is_wheel(model, data, last, g)]
        bends = pitch_joints(data, limb.joints)
        lowest = min(limb.shapes, key=lambda g: lowest_point(model, data, g))
        if wheels:
            return Leg(joints=limb.joints, feet=(max(wheels, key=lambda g: float(model.geom_rbound[g])),))
        if len(bends) > 2 or last not in bends:  # behind an ankle: a sole of all shapes at its underside
            sole = [
                g
                for g in limb.shapes
                if model.geom_bodyid[g] == model.geom_bodyid[lowest]
                and lowest_point(model, data, g) < lowest_point(model, data, lowest) + _SOLE
            ]
            return Leg(joints=limb.joints, feet=tuple(sole))
        round_ones = [g for g in limb.shapes if model.geom_type[g] == self.mujoco.mjtGeom.mjGEOM_SPHERE]
        knee = data.xanchor[last]
        foot = max(round_ones or limb.shapes, key=lambda g: float(np.linalg.norm(data.geom_xpos[g] - knee)))
        return Leg(joints=limb.joints, feet=(foot,))

    def _shapes_of(self, name: str) -> list[int]:
        """Return the solid geoms of a name, or of a body of that name."""
        model = self.model
        own = [
            g for g in range(model.ngeom) if name in (model.geom(g).name, model.body(int(model.geom_bodyid[g])).name)
        ]
        found = [g for g in own if solid(model, g)]
        if not found:
            raise self._error(f"has no shape or body '{one_line(name, 80)}' that meets the ground (--feet)")
        return found

    def _sorted(self, legs: list[Leg]) -> list[Leg]:
        """Return legs row by row from the front, the left one first."""
        hips = {leg.joints: self.data.xanchor[leg.joints[0]] for leg in legs}
        middle = np.mean([hip[0] for hip in hips.values()])
        return sorted(legs, key=lambda leg: (bool(hips[leg.joints][0] < middle - 1e-3), -hips[leg.joints][1]))

    def _with_feet(self, legs: list[Leg]) -> list[Leg]:
        """Return the legs, with a sphere added for a foot to each leg that ends in a whole shank."""
        # ids are lost once a geom is added
        geoms, bodies = ({e.id: e for e in kind} for kind in (self.spec.geoms, self.spec.bodies))
        names: dict[int, str] = {}
        for leg in legs:
            foot = leg.feet[0]
            bends = pitch_joints(self.data, leg.joints)
            shank = len(leg.feet) == 1 and len(bends) < 3 and leg.joints[-1] in bends
            end = shank_end(self.model, self.data, foot, self.data.xanchor[leg.joints[-1]]) if shank else None
            if end is not None:
                body = int(self.model.geom_bodyid[foot])
                bodies[body].name = bodies[body].name or f"body_{body}"
                names[foot] = self._free_name(bodies[body].name, "foot")
                add_foot(bodies[body], names[foot], end, geoms[foot])
        if not names:
            return legs
        self.renamed, self.added_feet = True, len(names)
        old = self.model
        self._compile()
        # a body's own shapes keep their order, and added shapes follow them
        moved = self.model.body_geomadr - old.body_geomadr

        def place(foot: int) -> int:
            return self.model.geom(names[foot]).id if foot in names else foot + int(moved[old.geom_bodyid[foot]])

        return [replace(leg, feet=tuple(place(foot) for foot in leg.feet)) for leg in legs]

    def leg_length(self, leg: Leg) -> float:
        """Return the length of a stretched leg [m]: its links from the first joint that bends it to the foot's centre."""
        return stretched_length(self.data, self.bends(leg), self.foot_center(leg))

    def bends(self, leg: Leg) -> list[int]:
        """Return the joints that bend a leg, from the hip outwards."""
        own = [j for j in leg.joints if not self.is_wheel(j)]
        return pitch_joints(self.data, own)

    def is_wheel(self, joint: int) -> bool:
        """Return whether a joint turns a wheel."""
        return any(leg.joints[-1] == joint and is_wheel(self.model, self.data, joint, leg.feet[0]) for leg in self.legs)

    def foot_center(self, leg: Leg) -> NDArray[np.float64]:
        """Return the centre of a foot, the mean of its shapes' centres, in the world [m], (3,)."""
        return np.asarray(self.data.geom_xpos[list(leg.feet)].mean(axis=0))

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
        return -min(lowest_point(self.model, self.data, foot) for leg in self.legs for foot in leg.feet)

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
        feet = {foot for leg in self.legs for foot in leg.feet}
        shapes = [g for g in range(self.model.ngeom) if solid(self.model, g) and g not in feet]
        bodies = {int(self.model.geom_bodyid[g]) for g in shapes}
        return [self.body_name(b) for b in sorted(bodies | {self.base}, key=lambda b: (b != self.base, b))]

    def trunk(self) -> int:
        """Return the largest shape of the base that meets the ground."""
        own = [g for g in range(self.model.ngeom) if self.model.geom_bodyid[g] == self.base and solid(self.model, g)]
        return max(own, key=lambda g: float(np.prod(self.model.geom_aabb[g, 3:])))
