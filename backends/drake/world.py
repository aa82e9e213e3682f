"""One world of Drake: a context of a plant, and a simulator that advances it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydrake.geometry import GeometryId, ProximityProperties, RoleAssign
from pydrake.multibody.plant import CoulombFriction
from pydrake.systems.analysis import Simulator

from ..sequential import Base, Contact, RobotModel, World
from ..sequential.rotation import matrix
from ..sequential.world import Array
from .hydroelastic import deepest, mean_normal
from .plant import Plant, spatial_inertia


class DrakeWorld(World):
    """See ``World``."""

    def __init__(self, built: Plant, robot: RobotModel, timestep: float) -> None:
        self._built, self._robot, self._timestep = built, robot, timestep
        self._simulator = Simulator(built.diagram)
        self._root = self._simulator.get_mutable_context()
        self._context = built.plant.GetMyMutableContextFromRoot(self._root)
        self._sources = built.scene_graph.GetMyMutableContextFromRoot(self._root)
        plant = built.plant
        self._forces = plant.get_applied_generalized_force_input_port().FixValue(
            self._context, np.zeros(plant.num_velocities())
        )
        self._results = plant.get_contact_results_output_port()
        self._ticks = 0
        base = built.bodies[0]
        self._base_q = base.floating_positions_start()
        self._base_v = base.floating_velocities_start_in_v()
        self._center = robot.links[0].center
        self._friction, self._feet = robot.foot_friction, robot.feet
        self._q = plant.GetPositions(self._context)
        self._v = plant.GetVelocities(self._context)

    def place(self, base: Base, joint_position: Array, joint_velocity: Array) -> None:
        """See ``World.place``."""
        q, v, turn = self._q.copy(), self._v.copy(), matrix(base.quaternion)
        q[self._base_q : self._base_q + 4], q[self._base_q + 4 : self._base_q + 7] = base.quaternion, base.position
        v[self._base_v : self._base_v + 3] = turn @ base.angular_velocity
        v[self._base_v + 3 : self._base_v + 6] = base.linear_velocity
        q[self._built.joint_q], v[self._built.joint_v] = joint_position, joint_velocity
        self._q, self._v, self._ticks = q, v, 0
        if np.isfinite(q).all() and np.isfinite(v).all():
            self._built.plant.SetPositions(self._context, q)
            self._built.plant.SetVelocities(self._context, v)
            self._root.SetTime(0.0)
            self._simulator.Initialize()

    def step(self, torque: Array, force_w: Array) -> None:
        """See ``World.step``."""
        applied = np.zeros(len(self._v))
        applied[self._built.joint_v] = torque
        if force_w.any():
            arm = matrix(self._q[self._base_q : self._base_q + 4]) @ self._center
            applied[self._base_v : self._base_v + 3] = np.cross(arm, force_w)
            applied[self._base_v + 3 : self._base_v + 6] = force_w
        self._forces.GetMutableData().set_value(applied)
        self._ticks += 1
        self._simulator.AdvanceTo(self._ticks * self._timestep)
        self._q = self._built.plant.GetPositions(self._context)
        self._v = self._built.plant.GetVelocities(self._context)

    def joints(self) -> tuple[Array, Array]:
        """See ``World.joints``."""
        return self._q[self._built.joint_q], self._v[self._built.joint_v]

    def base(self) -> Base:
        """See ``World.base``."""
        q, v = self._q[self._base_q : self._base_q + 7], self._v[self._base_v : self._base_v + 6]
        return Base(
            position=q[4:7],
            quaternion=q[0:4] / np.linalg.norm(q[0:4]),
            linear_velocity=v[3:6],
            angular_velocity=matrix(q[0:4]).T @ v[0:3],
        )

    def feet(self) -> tuple[Array, Array]:
        """See ``World.feet``."""
        plant, positions, velocities = self._built.plant, [], []
        for foot in self._feet:
            body = self._built.bodies[foot.link]
            place = plant.EvalBodyPoseInWorld(self._context, body)
            motion = plant.EvalBodySpatialVelocityInWorld(self._context, body)
            arm = place.rotation().matrix() @ foot.position
            positions.append(place.translation() + arm)
            velocities.append(motion.translational() + np.cross(motion.rotational(), arm))
        return np.array(positions), np.array(velocities)

    def contacts(self) -> list[Contact]:
        """See ``World.contacts``."""
        results, shape_of, terrain = self._results.Eval(self._context), self._built.shape_of, self._built.terrain
        found: list[Contact] = []

        def keep(mine: GeometryId, other: GeometryId, force: Array, normal: Array, **more: Any) -> None:
            along = float(force @ normal)
            across = float(np.linalg.norm(force - along * normal))
            own = {"force_w": force, "normal": along, "tangential": across}
            found.append(Contact(shape=shape_of[mine], terrain=terrain[other], **own, **more))  # type: ignore[arg-type]

        for i in range(results.num_point_pair_contacts()):
            info = results.point_pair_contact_info(i)
            pair, on_b = info.point_pair(), info.contact_force()
            more = {"point_w": info.contact_point(), "depth": pair.depth}
            if pair.id_B in shape_of and pair.id_A in terrain:
                keep(pair.id_B, pair.id_A, on_b, -pair.nhat_BA_W, **more)
            elif pair.id_A in shape_of and pair.id_B in terrain:
                keep(pair.id_A, pair.id_B, -on_b, pair.nhat_BA_W, **more)
        for i in range(results.num_hydroelastic_contacts()):
            info = results.hydroelastic_contact_info(i)
            surface, on_m = info.contact_surface(), info.F_Ac_W()
            for mine, other, sign in ((surface.id_M(), surface.id_N(), 1.0), (surface.id_N(), surface.id_M(), -1.0)):
                if mine in shape_of and other in terrain:
                    more = {"point_w": surface.centroid(), "moment_w": sign * on_m.rotational()}
                    depth = deepest(surface, self._robot.shapes[shape_of[mine]])
                    keep(mine, other, sign * on_m.translational(), sign * mean_normal(surface), depth=depth, **more)
        return found

    def change(self, changes: Mapping[str, Array]) -> None:
        """See ``World.change``."""
        built = self._built
        for body, (mass, center, inertia) in zip(built.bodies, self._robot.inertias(changes), strict=True):
            body.SetSpatialInertiaInBodyFrame(self._context, spatial_inertia(mass, center, inertia))
        self._center = self._robot.inertias(changes)[0][1]
        friction = float(changes.get("friction", self._robot.foot_friction))
        if friction != self._friction:
            self._friction = friction
            source = built.plant.get_source_id()
            for geometry, nominal in built.properties.items():
                properties = ProximityProperties(nominal)
                properties.UpdateProperty("material", "coulomb_friction", CoulombFriction(friction, friction))
                built.scene_graph.AssignRole(self._sources, source, geometry, properties, RoleAssign.kReplace)

    def constants(self) -> dict[str, Any]:
        """See ``World.constants``."""
        built, plant = self._built, self._built.plant
        inertias = [body.CalcSpatialInertiaInBodyFrame(self._context) for body in built.bodies]
        chosen = [inertias[i] for i in self._robot.collision_links]
        joints = [plant.get_joint_actuator(index).joint() for index in plant.GetJointActuatorIndices()]
        order = np.argsort([np.flatnonzero(built.joint_v == joint.velocity_start())[0] for joint in joints])
        inspector = built.scene_graph.get_query_output_port().Eval(self._sources).inspector()

        def friction(geometry: Any) -> float:
            return (
                inspector.GetProximityProperties(geometry)
                .GetProperty("material", "coulomb_friction")
                .dynamic_friction()
            )

        feet = {self._robot.shapes[shape].foot: geometry for geometry, shape in built.shape_of.items()}
        return {
            "total_mass": plant.CalcTotalMass(self._context),
            "body_mass": [each.get_mass() for each in chosen],
            "body_inertia": [each.Shift(each.get_com()).CalcRotationalInertia().CopyToFullMatrix3() for each in chosen],
            "joint_range": [
                (joints[i].position_lower_limits()[0], joints[i].position_upper_limits()[0]) for i in order
            ],
            "joint_armature": [
                plant.get_joint_actuator(plant.GetJointActuatorIndices()[i]).rotor_inertia(self._context) for i in order
            ],
            "joint_damping": [joints[i].GetDamping(self._context) for i in order],
            "foot_friction": [friction(feet[i]) for i in range(len(self._feet))],
            "floor_friction": friction(next(iter(built.terrain))),
        }
