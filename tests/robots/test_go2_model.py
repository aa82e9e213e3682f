"""The compiled Go2 against the numbers of the published gauge's robot, which was measured by compiling it."""

import mujoco
import numpy as np
import pytest
from gaitgauge.robots import check_robot, load_robot

LEGS = ("FL", "FR", "RL", "RR")
GO2 = load_robot("go2")

HIP_QUATERNION = {
    "FL": (0.497014, 0.499245, 0.505462, 0.498237),
    "FR": (0.498237, 0.505462, 0.499245, 0.497014),
    "RL": (0.505462, 0.498237, 0.497014, 0.499245),
    "RR": (0.499245, 0.497014, 0.498237, 0.505462),
}
THIGH_QUATERNION = {1: (0.829533, 0.0847635, -0.0200632, 0.551623), -1: (0.551623, -0.0200632, 0.0847635, 0.829533)}
CALF_QUATERNION = {1: (0.710672, 0.00154099, -0.00450087, 0.703508), -1: (0.703508, -0.00450087, 0.00154099, 0.710672)}


def body_table():
    """Name, parent, offset, mass, centre of mass, inertia quaternion, principal inertia."""
    yield (
        "base_link",
        "world",
        (0, 0, 0),
        6.921,
        (0.021112, 0, -0.005366),
        (-0.000543, 0.713435, -0.001738, 0.700719),
        (0.107027, 0.0980771, 0.0244531),
    )
    for leg in LEGS:
        front = 1 if leg[0] == "F" else -1
        left = 1 if leg[1] == "L" else -1
        yield (
            f"{leg}_hip",
            "base_link",
            (front * 0.1934, left * 0.0465, 0),
            0.678,
            (-front * 0.0054, left * 0.00194, -0.000105),
            HIP_QUATERNION[leg],
            (8.8403e-4, 5.96003e-4, 4.79967e-4),
        )
        yield (
            f"{leg}_thigh",
            f"{leg}_hip",
            (0, left * 0.0955, 0),
            1.152,
            (-0.00374, -left * 0.0223, -0.0327),
            THIGH_QUATERNION[left],
            (5.94973e-3, 5.84149e-3, 8.78787e-4),
        )
        yield (
            f"{leg}_calf",
            f"{leg}_thigh",
            (0, 0, -0.213),
            0.241352,
            (0.00629595, -left * 0.000622121, -0.141417),
            CALF_QUATERNION[left],
            (1.4901e-3, 1.46356e-3, 5.31397e-5),
        )


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_path(str(GO2.mjcf))


@pytest.fixture(scope="module")
def standing(model):
    """Kinematics of the default pose with the base at the origin."""
    data = mujoco.MjData(model)
    data.qpos[:7] = (0, 0, 0, 1, 0, 0, 0)
    data.qpos[7:] = GO2.default_joint_position
    mujoco.mj_forward(model, data)
    return data


def rotation(quaternion):
    matrix = np.zeros(9)
    quaternion = np.asarray(quaternion, dtype=float)
    mujoco.mju_quat2Mat(matrix, quaternion / np.linalg.norm(quaternion))
    return matrix.reshape(3, 3)


def collision_geoms(model):
    return [g for g in range(model.ngeom) if model.geom_contype[g] or model.geom_conaffinity[g]]


def test_description_and_model_agree():
    check_robot(GO2)


def test_bodies(model):
    rows = list(body_table())
    assert [model.body(b).name for b in range(1, model.nbody)] == [row[0] for row in rows]
    for name, parent, offset, mass, com, quaternion, inertia in rows:
        body = model.body(name)
        assert model.body(body.parentid[0]).name == parent
        np.testing.assert_allclose(body.pos, offset, atol=1e-12, err_msg=name)
        np.testing.assert_allclose(body.mass, mass, rtol=1e-12, err_msg=name)
        np.testing.assert_allclose(body.ipos, com, atol=1e-12, err_msg=name)
        # Compared as full tensors: principal axes may be listed in any order and sign.
        expected = rotation(quaternion) @ np.diag(inertia) @ rotation(quaternion).T
        actual = rotation(body.iquat) @ np.diag(body.inertia) @ rotation(body.iquat).T
        np.testing.assert_allclose(actual, expected, atol=1e-9, err_msg=name)


def test_total_mass(model):
    assert model.body_mass.sum() == pytest.approx(15.2064, abs=5e-5)


def test_mass_is_mirrored(standing):
    """Left and right legs are mirror images: a swapped sign in one of the tables would show here."""
    for front in "FR":
        for part in ("hip", "thigh", "calf"):
            left, right = (standing.body(f"{front}{side}_{part}") for side in "LR")
            mirror = np.diag((1.0, -1.0, 1.0))
            np.testing.assert_allclose(mirror @ left.xipos, right.xipos, atol=1e-9)
            left_axes, right_axes = left.ximat.reshape(3, 3), right.ximat.reshape(3, 3)
            # An axis has no sense: compare the projections onto each.
            for axis in range(3):
                a, b = mirror @ left_axes[:, axis], right_axes[:, axis]
                assert abs(a @ b) == pytest.approx(1.0, abs=1e-4)


def test_joints(model):
    hinges = [model.joint(j) for j in range(1, model.njnt)]
    assert tuple(j.name for j in hinges) == GO2.joint_names
    assert GO2.joint_names == tuple(f"{leg}_{part}_joint" for leg in LEGS for part in ("hip", "thigh", "calf"))
    assert model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    ranges = {"hip": (-1.0472, 1.0472), "calf": (-2.7227, -0.83776)}
    for joint in hinges:
        leg, part, _ = joint.name.split("_")
        thigh = (-1.5708 if leg[0] == "F" else -0.5236, 1.5708)
        assert tuple(joint.axis) == ((1, 0, 0) if part == "hip" else (0, 1, 0))
        np.testing.assert_allclose(joint.range, ranges.get(part, thigh), atol=1e-12, err_msg=joint.name)
        assert model.jnt_limited[joint.id]
        assert model.body(model.jnt_bodyid[joint.id]).name == f"{leg}_{part}"
        assert (joint.damping[0], joint.armature[0], joint.frictionloss[0]) == (0.1, 0.01, 0.2)


def test_motors_are_position_servos_without_limits(model):
    for j, name in enumerate(GO2.joint_names):
        actuator = model.actuator(j)
        assert actuator.name == name.removesuffix("_joint")
        assert model.joint(actuator.trnid[0]).name == name
        assert actuator.gainprm[0] == 20
        assert tuple(actuator.biasprm[:3]) == (0, -20, -0.5)
    assert model.nu == GO2.num_joints
    assert not model.actuator_ctrllimited.any()
    assert not model.actuator_forcelimited.any()
    assert not model.jnt_actfrclimited.any()


def collision_table():
    """Name, body, type, size, position, quaternion."""
    sphere, cylinder, box = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_BOX
    upright = (1, 0, 0, 0)
    yield "base_trunk", "base_link", box, (0.1881, 0.04675, 0.057), (0, 0, 0), upright
    yield "base_head", "base_link", cylinder, (0.05, 0.045), (0.285, 0, 0.01), upright
    yield "base_chin", "base_link", sphere, (0.047,), (0.293, 0, -0.06), upright
    for leg in LEGS:
        side = 1 if leg[1] == "L" else -1
        calf = f"{leg}_calf"
        yield f"{leg}_hip_motor", f"{leg}_hip", cylinder, (0.046, 0.02), (0, side * 0.08, 0), (0.7071, 0.7071, 0, 0)
        yield (
            f"{leg}_thigh_link",
            f"{leg}_thigh",
            box,
            (0.1065, 0.01225, 0.017),
            (0, 0, -0.1065),
            (0.7071, 0, 0.7071, 0),
        )
        if leg == "FL":
            yield f"{leg}_calf_upper", calf, cylinder, (0.012, 0.06), (0.008, 0, -0.06), (0.994493, 0, -0.104807, 0)
        else:
            yield f"{leg}_calf_upper", calf, cylinder, (0.013, 0.06), (0.01, 0, -0.06), (0.995004, 0, -0.0998334, 0)
        yield f"{leg}_calf_lower", calf, cylinder, (0.011, 0.0325), (0.02, 0, -0.148), (0.999688, 0, 0.0249974, 0)
        yield leg, calf, sphere, (0.022,), (-0.002, 0, -0.213), upright


def test_collision_shapes(model):
    rows = list(collision_table())
    assert {model.geom(g).name for g in collision_geoms(model)} == {row[0] for row in rows}
    for name, body, shape, size, position, quaternion in rows:
        geom = model.geom(name)
        assert model.body(geom.bodyid[0]).name == body
        assert geom.type[0] == shape
        np.testing.assert_allclose(geom.size[: len(size)], size, atol=1e-12, err_msg=name)
        np.testing.assert_allclose(geom.pos, position, atol=1e-12, err_msg=name)
        np.testing.assert_allclose(rotation(geom.quat), rotation(quaternion), atol=1e-9, err_msg=name)


def test_contact_parameters(model):
    for g in collision_geoms(model):
        geom = model.geom(g)
        is_foot = geom.name in GO2.foot_names
        assert (geom.contype[0], geom.conaffinity[0]) == (1, 1)
        assert geom.condim[0] == (6 if is_foot else 1)
        assert geom.priority[0] == (1 if is_foot else 0)
        assert geom.margin[0] == 0.001
        assert tuple(geom.friction[1:]) == ((0.02, 0.01) if is_foot else (0.005, 0.0001))
        assert tuple(geom.solref) == (0.02, 1)
        assert tuple(geom.solimp) == (0.9, 0.95, 0.001, 0.5, 2)
    assert model.npair == model.nexclude == 0


def test_contacts_with_a_floor_have_the_gauge_dimensions():
    spec = mujoco.MjSpec.from_file(str(GO2.mjcf))
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 1], friction=[0.6, 0.005, 1e-4])
    model = spec.compile()
    model.geom_friction[:, 0] = 0.6
    data = mujoco.MjData(model)
    data.qpos[7:] = GO2.default_joint_position
    data.qpos[2] = 0.0  # sunk into the floor: feet, calves, thighs and trunk all touch it
    mujoco.mj_forward(model, data)
    seen = {}
    for contact in data.contact:
        names = {model.geom(g).name for g in contact.geom}
        if "floor" in names:
            seen[(names - {"floor"}).pop()] = (contact.dim, tuple(contact.friction))
    assert seen["FL"] == (6, (0.6, 0.6, 0.02, 0.01, 0.01))
    assert seen["base_trunk"] == (3, (0.6, 0.6, 0.005, 0.0001, 0.0001))


def test_legs_collide_with_each_other(model):
    data = mujoco.MjData(model)
    data.qpos[7:] = GO2.default_joint_position
    data.qpos[7:] = np.where([n.endswith("hip_joint") for n in GO2.joint_names], 0, data.qpos[7:])
    data.joint("FL_hip_joint").qpos = -0.9
    data.joint("FR_hip_joint").qpos = 0.9
    mujoco.mj_forward(model, data)
    touching = {frozenset(model.body(model.geom_bodyid[g]).name for g in c.geom) for c in data.contact}
    assert any({name[:2] for name in pair} == {"FL", "FR"} for pair in touching)


def test_default_pose_has_no_self_contact(standing):
    assert standing.ncon == 0


def test_default_pose_feet(model, standing):
    bottom = {f: standing.geom(f).xpos[2] - model.geom(f).size[0] for f in GO2.foot_names}
    assert bottom["FL"] == pytest.approx(-0.3235, abs=5e-5)
    assert bottom["FR"] == pytest.approx(-0.3235, abs=5e-5)
    assert bottom["RL"] == pytest.approx(-0.3139, abs=5e-5)
    assert bottom["RR"] == pytest.approx(-0.3139, abs=5e-5)
    for a, b in (("FL", "RR"), ("FR", "RL")):
        diagonal = np.linalg.norm((standing.site(a).xpos - standing.site(b).xpos)[:2])
        assert diagonal == pytest.approx(0.5656, abs=5e-5)
    for foot in GO2.foot_names:
        np.testing.assert_allclose(standing.site(foot).xpos, standing.geom(foot).xpos, atol=1e-12)


def test_imu(model, standing):
    site = model.site("imu")
    np.testing.assert_allclose(site.pos, (-0.02557, 0, 0.04232))
    np.testing.assert_allclose(standing.site("imu").xmat.reshape(3, 3), np.eye(3), atol=1e-12)
    kinds = [model.sensor(i).type[0] for i in range(model.nsensor)]
    expected = (
        mujoco.mjtSensor.mjSENS_FRAMEQUAT,
        mujoco.mjtSensor.mjSENS_GYRO,
        mujoco.mjtSensor.mjSENS_ACCELEROMETER,
    )
    assert kinds == list(expected)


def test_options(model):
    assert model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert model.opt.impratio == 100
    assert model.opt.timestep == 0.002
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER


def test_visuals_weigh_nothing_and_cover_every_body(model):
    visual = [g for g in range(model.ngeom) if model.geom_group[g] == 2]
    assert set(visual).isdisjoint(collision_geoms(model))
    assert len(visual) + len(collision_geoms(model)) == model.ngeom
    assert {int(model.geom_bodyid[g]) for g in visual} == set(range(1, model.nbody))
    assert model.nmesh == 0


def test_stands_on_its_own_motors():
    """Dropped from the episode's start height, the robot catches itself and stands still on its feet."""
    spec = mujoco.MjSpec.from_file(str(GO2.mjcf))
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 1])
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[2] = GO2.stand_height
    data.qpos[7:] = GO2.default_joint_position
    data.ctrl[:] = GO2.default_joint_position
    mujoco.mj_step(model, data, 1500)
    touching = {model.geom(g).name for c in data.contact for g in c.geom}
    assert touching == {"floor", *GO2.foot_names}
    assert data.qpos[2] > 0.25
    assert np.abs(data.qvel).max() < 0.05


def test_warp_engines_read_the_model():
    mujoco_warp = pytest.importorskip("mujoco_warp")
    warp_model = mujoco_warp.put_model(mujoco.MjModel.from_xml_path(str(GO2.mjcf)))
    assert (warp_model.nv, warp_model.nu) == (18, 12)
