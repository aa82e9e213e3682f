"""Build MuJoCo models from a scene: the robot's own file, the motors' constants, the ground and the sensors for contacts.

Static bodies are added to the robot's model: ``environment`` holds ``ground`` (floor and walls) and ``terrain`` (boxes and height
field), so that contact sensors can tell the three apart.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from ...robots.base import Robot
from ...terrains.base import Terrain
from ..base import BackendError, Scene
from ..description import FootContact, ModelFields

CONTACT_SLOTS = 12
"""Ground contacts reported one by one, the strongest first; a robot that lies flat has about as many, one on soles more."""
ROUND_SLOTS, FLAT_SLOTS = 3, 8
"""Contacts reported one by one for each shape of feet of spheres, and for each of other feet: a box on a box has eight."""
SPARSE_FROM = 24
"""Degrees of freedom from which on constraints have sparse Jacobians: a step of a humanoid of 35 takes two thirds of the time. MuJoCo
itself takes them from 60 on. The results of smaller robots, down to the last bit, are those of dense ones."""
FOOT_SITE = "centre of {}"
"""Name of the site that the engine adds to a foot."""
NOTHING: dict[str, Any] = {"contype": 2, "conaffinity": 0}
"""Collision geom that meets nothing, so that all models of a layout have bounding-volume trees of one size."""
PARKED: dict[str, Any] = {"size": [0.01, 0.01, 0.01], "pos": [0.0, 0.0, -1.0], **NOTHING}
"""Unused boxes of a layout."""


def robot_spec(scene: Scene) -> mujoco.MjSpec:
    """Return the robot's model with the scene's joint constants, motors and solver options, without ground."""
    robot, physics, constants = scene.robot, scene.physics, scene.parameters
    spec = mujoco.MjSpec.from_file(str(robot.mjcf))
    option = spec.option
    for name in ("timestep", "impratio", "iterations", "ls_iterations", "tolerance"):
        setattr(option, name, getattr(physics, name))
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    if physics.cone not in ("elliptic", "pyramidal"):
        use = "use 'elliptic' or 'pyramidal' (PhysicsOptions.cone)"
        raise BackendError(f"friction cone '{physics.cone}' does not exist; {use}")
    option.cone = getattr(mujoco.mjtCone, f"mjCONE_{physics.cone.upper()}")
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    for j, name in enumerate(robot.joint_names):
        joint = spec.joint(name)
        if joint is None:
            missing = f"joint '{name}' of robot '{robot.name}' is not in {robot.mjcf.name}"
            raise BackendError(f"{missing}; correct joint_names in robot.toml")
        joint.armature = constants.armature[j]
        joint.damping = np.array([constants.joint_damping[j], 0.0, 0.0])
        joint.frictionloss = constants.friction_loss[j]
    _set_motors(spec, scene)
    weighed = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    for geom in list(spec.geoms):
        if not (geom.contype or geom.conaffinity):
            if geom.parent.explicitinertial and not weighed:  # else the body's mass may come from this geom
                spec.delete(geom)  # a visual geom costs time in every step
            continue
        if geom.name in robot.foot_geoms and physics.foot_condim is not None:
            geom.condim = physics.foot_condim
        if not physics.self_collision:
            geom.contype, geom.conaffinity = 0, 1  # the ground's contype 1 still meets it, other robot geoms do not
    return spec


def _mark_feet(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Put a site for motion sensors at the centre of each foot, the mean of its geoms' centres."""
    compiled = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    for name, sole in zip(robot.foot_names, robot.soles, strict=True):
        center = np.mean([compiled.geom(shape).pos for shape in sole], axis=0)
        spec.geom(sole[0]).parent.add_site(name=FOOT_SITE.format(name), pos=center)


def slots_per_shape(model: mujoco.MjModel | mujoco.MjSpec, robot: Robot) -> int:
    """Return the number of contacts that are reported one by one for each shape of a foot."""
    sphere = mujoco.mjtGeom.mjGEOM_SPHERE
    return ROUND_SLOTS if all(model.geom(name).type == sphere for name in robot.foot_geoms) else FLAT_SLOTS


def _set_motors(spec: mujoco.MjSpec, scene: Scene) -> None:
    """Replace the file's actuators by one position servo per joint, in the robot's joint order."""
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    limits = scene.parameters.torque_limit
    for j, name in enumerate(scene.robot.joint_names):
        kp, kd = scene.parameters.stiffness[j], scene.parameters.damping[j]
        direct = scene.parameters.motor == "torque"
        motor = spec.add_actuator(name=f"motor_{name}", target=name)
        motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
        motor.gaintype = mujoco.mjtGain.mjGAIN_FIXED
        motor.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        by_velocity = name in (scene.robot.velocity_joints or ())
        motor.gainprm[0] = 1.0 if direct else kd if by_velocity else kp
        motor.biasprm[:3] = (0.0, 0.0, 0.0) if direct else (0.0, 0.0 if by_velocity else -kp, -kd)
        motor.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
        if scene.physics.torque_limits:
            motor.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            motor.forcerange = np.array([-limits[j], limits[j]])
        else:
            motor.forcelimited = mujoco.mjtLimited.mjLIMITED_FALSE


def add_terrain(
    spec: mujoco.MjSpec, terrain: Terrain, *, walls: int, blocks: int, field_shape: tuple[int, int] | None
) -> None:
    """Add the ground of one world; geoms of the layout that the terrain does not need meet nothing.

    Args:
        walls: number of walls in the layout, at least as many as the terrain has.
        blocks: the same for the other boxes.
        field_shape: (rows, columns) of the layout's height field, None for none.
    """
    environment = spec.worldbody.add_body(name="environment")
    ground = environment.add_body(name="ground")
    ground.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0])
    body = environment.add_body(name="terrain")
    for parent, label, slots, wall in ((ground, "wall", walls, True), (body, "box", blocks, False)):
        boxes = [b for b in terrain.boxes if b.wall == wall]
        for i in range(slots):
            place = PARKED
            if i < len(boxes):
                place = {"size": boxes[i].half_size, "pos": boxes[i].center, "quat": boxes[i].quaternion}
            parent.add_geom(name=f"{label}_{i}", type=mujoco.mjtGeom.mjGEOM_BOX, **place)
    if field_shape is not None:
        field = terrain.height_field
        heights = np.zeros(field_shape) if field is None else field.heights
        top = max(float(heights.max()), 1e-6)
        hfield = spec.add_hfield(name="field", nrow=field_shape[0], ncol=field_shape[1])
        half = (1.0, 1.0) if field is None else field.half_size
        hfield.size = np.array([half[0], half[1], top, 0.1 if field is None else field.base])
        hfield.userdata = (heights / top).astype(np.float32).ravel()
        place = {"pos": [*field.center, 0.0]} if field is not None else NOTHING
        body.add_geom(name="field", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="field", **place)


def add_report_sensors(spec: mujoco.MjSpec, scene: Scene) -> None:
    """Add the sensors for foot velocities and ground contacts."""
    robot = scene.robot
    _mark_feet(spec, robot)

    def contact(name: str, reduce: str, data: tuple[str, ...], slots: int, **objects: tuple[int, str]) -> None:
        sensor = spec.add_sensor(name=name, type=mujoco.mjtSensor.mjSENS_CONTACT)
        sensor.objtype, sensor.objname = objects["robot"]
        sensor.reftype, sensor.refname = objects["other"]
        kinds = ("found", "force", "torque", "dist", "pos", "normal", "tangent")
        bits = sum(1 << kinds.index(d) for d in data)
        sensor.intprm[:3] = (bits, ("none", "mindist", "maxforce", "netforce").index(reduce), slots)

    body, geom, tree = mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_GEOM, mujoco.mjtObj.mjOBJ_XBODY
    everything = (tree, "environment")
    slots = slots_per_shape(spec, robot)
    for foot, sole in zip(robot.foot_names, robot.soles, strict=True):
        spec.add_sensor(
            name=f"velocity_{foot}",
            type=mujoco.mjtSensor.mjSENS_FRAMELINVEL,
            objtype=mujoco.mjtObj.mjOBJ_SITE,
            objname=FOOT_SITE.format(foot),
        )
        for shape in sole:
            contact(f"net_{shape}", "netforce", ("force",), 1, robot=(geom, shape), other=everything)
            contact(f"each_{shape}", "maxforce", ("force",), slots, robot=(geom, shape), other=everything)
    for name in robot.collision_bodies:
        contact(f"body_{name}", "netforce", ("force",), 1, robot=(body, name), other=everything)
    for name in robot.trunk_shapes:
        contact(f"trunk_{name}", "netforce", ("force",), 1, robot=(geom, name), other=everything)
    whole = (tree, robot.base_body)
    contact("ground_net", "netforce", ("force", "torque", "pos"), 1, robot=whole, other=everything)
    points = max(CONTACT_SLOTS, slots * len(robot.foot_geoms))
    contact("ground_each", "maxforce", ("found", "force", "pos"), points, robot=whole, other=everything)
    if scene.physics.watch_penetration is not None:
        contact("penetration", "mindist", ("found", "dist"), 1, robot=whole, other=(body, "terrain"))


def build_models(scene: Scene) -> list[mujoco.MjModel]:
    """Return one model per terrain of the scene's palette, all of one layout.

    Raises:
        BackendError: the palette's height fields differ in their number of nodes, or a name of the robot is missing in its file.
    """
    fields = {t.height_field.heights.shape for t in scene.terrains if t.height_field is not None}
    if len(fields) > 1:
        nodes = f"the height fields of one scene must have the same number of nodes, but have {sorted(fields)}"
        raise BackendError(f"{nodes}; use one scene for each")
    shape = next(iter(fields), None)
    walls = max(sum(b.wall for b in t.boxes) for t in scene.terrains)
    blocks = max(sum(not b.wall for b in t.boxes) for t in scene.terrains)
    models = []
    for terrain in scene.terrains:
        spec = robot_spec(scene)
        add_terrain(spec, terrain, walls=walls, blocks=blocks, field_shape=shape)
        add_report_sensors(spec, scene)
        try:
            model = spec.compile()
        except ValueError as error:
            ground = f"terrain '{terrain.name}' level {terrain.level}"
            raise BackendError(f"MuJoCo cannot build {ground}: {error}") from error
        if shape is not None and terrain.height_field is not None:
            # undo the compiler, which stretches heights to [0, 1]
            heights = terrain.height_field.heights
            model.hfield_data[:] = (heights / max(float(heights.max()), 1e-6)).ravel()
        if model.nv >= SPARSE_FROM:
            model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
        models.append(model)
    return models


def describe_model(model: mujoco.MjModel, robot: Robot) -> dict[str, list[float]]:
    """Return a world's model in the terms of ``PhysicsBackend.describe``."""
    feet, floor = [model.geom(sole[0]).id for sole in robot.soles], model.geom("floor").id
    bodies = [model.body(name).id for name in robot.collision_bodies]
    joints = [model.joint(name).id for name in robot.joint_names]
    dofs = model.jnt_dofadr[joints]
    return ModelFields(
        total_mass=float(model.body_mass.sum()),
        body_mass=model.body_mass[bodies],
        body_inertia=model.body_inertia[bodies],
        joint_range=np.where(model.jnt_limited[joints, None], model.jnt_range[joints], [-np.inf, np.inf]),
        joint_armature=model.dof_armature[dofs],
        joint_damping=model.dof_damping[dofs],
        joint_friction_loss=model.dof_frictionloss[dofs],
        stiffness=np.where(robot.driven_by_velocity, 0.0, model.actuator_gainprm[:, 0]),
        damping=-model.actuator_biasprm[:, 2],
        torque_limit=np.where(model.actuator_forcelimited > 0, model.actuator_forcerange[:, 1], np.inf),
        foot_friction=model.geom_friction[feet, 0],
        floor_friction=float(model.geom_friction[floor, 0]),
        foot_priority=model.geom_priority[feet] - model.geom_priority[floor],
        foot_contact=foot_contact(model, [*feet, floor]),
    ).describe()


def foot_contact(model: mujoco.MjModel, geoms: list[int]) -> FootContact:
    """Return the contacts of the feet, the geoms before the last, with the floor, which is the last."""
    return FootContact.of_mujoco(
        dimension=model.geom_condim[geoms],
        friction=model.geom_friction[geoms],
        softness=model.geom_solref[geoms],
        priority=model.geom_priority[geoms],
        pyramidal=model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL,
    )
