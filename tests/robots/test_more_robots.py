"""Go1 and ANYmal C: sizes as published, left and right alike, standing; all that the engine tests ask of a model."""

import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from gaitgauge.backends.conformance import Outcome, run_conformance
from gaitgauge.robots import load_robot, robot_names
from gaitgauge.robots.anatomy.body_plan import body_plan, default_pose, mirror_image
from gaitgauge.robots.checks.examining import damped_share, examine
from gaitgauge.training.environment.environment import TrainingEnvironment
from gaitgauge.training.tasks import find_task

ROBOTS = ("go1", "anymal_c")
MIRROR = np.diag([1.0, -1.0, 1.0])


def test_they_are_installed():
    assert set(ROBOTS) < set(robot_names())


@pytest.mark.parametrize(
    ("name", "mass", "base", "leg"),
    # the sum of the published links: trunk 5.204, and 0.68, 1.009, 0.195862 a leg; base 19.2035, and 2.781, 3.071, 0.58842
    [
        ("go1", 5.204 + 4 * 1.884862, 5.204, 0.426),
        ("anymal_c", 19.2035 + 4 * 6.44042, 19.2035, 0.285 + np.hypot(0.08795, 0.31547)),
    ],
)
def test_sizes(name, mass, base, leg):
    robot = load_robot(name)
    plan = body_plan(robot)
    model, _ = default_pose(robot)
    assert plan.mass == pytest.approx(mass, abs=1e-4)
    assert model.body(robot.base_body).mass[0] == base
    assert plan.leg_length == pytest.approx(leg, abs=1e-4)


def test_standing_heights():
    """Worked out by hand. Go1's front legs: thigh and calf of 0.213 m at 0.8 and -0.7 rad from the vertical, swung out by 0.1 rad
    about a hip 0.08 m further in. ANYmal's: a thigh of 0.285 m at 0.4 rad, and a foot that is 0.31547 m below the knee and
    0.08795 m beside it, turned by another 0.4 rad.
    """
    go1 = np.cos(0.1) * 0.213 * (np.cos(0.8) + np.cos(0.7)) - np.sin(0.1) * 0.08 + 0.023
    assert body_plan(load_robot("go1")).standing_height == pytest.approx(go1, abs=1e-4)
    shank = np.hypot(0.08795, 0.31547) * np.cos(0.4 + np.arctan2(0.08795, 0.31547))
    anymal = 0.285 * np.cos(0.4) + shank + 0.03
    assert body_plan(load_robot("anymal_c")).standing_height == pytest.approx(anymal, abs=1e-4)


@pytest.mark.parametrize("name", ROBOTS)
def test_every_check_holds(name):
    failed = [f.sentence for f in examine(load_robot(name)) if not f.passed and f.check != "SDK order"]
    assert not failed


@pytest.mark.parametrize(("name", "apart"), [("go1", 2.5e-3), ("anymal_c", 1e-6)])
def test_left_and_right_are_mirror_images(name, apart):
    """Masses, centres of mass and inertias, in the default pose and seen from the base. The maker's URDF of the Go1 has the same
    calf on both sides, whose centre of mass is 1 mm beside its middle, and a trunk that is 2 mm off.
    """
    robot = load_robot(name)
    model, data = default_pose(robot)
    mujoco.mj_comPos(model, data)
    image = mirror_image(robot)
    moved = {int(model.jnt_bodyid[model.joint(n).id]): i for i, n in enumerate(robot.joint_names)}
    of_joint = {i: body for body, i in moved.items()}
    base = model.body(robot.base_body).id
    for body in range(1, model.nbody):
        other = base if body == base else of_joint[image.joint[moved[body]]]
        assert model.body_mass[body] == model.body_mass[other]
        np.testing.assert_allclose(MIRROR @ data.xipos[body], data.xipos[other], atol=2.0 * apart)
        turn, turned = (data.ximat[b].reshape(3, 3) for b in (body, other))
        inertia = MIRROR @ turn @ np.diag(model.body_inertia[body]) @ turn.T @ MIRROR
        expected = turned @ np.diag(model.body_inertia[other]) @ turned.T
        np.testing.assert_allclose(inertia, expected, atol=5e-6 + 0.01 * np.abs(expected).max())
        np.testing.assert_allclose(
            [model.joint(robot.joint_names[i]).range for i in sorted(moved.values())],
            [_seen(model, robot, image, i) for i in sorted(moved.values())],
            atol=1e-9,
        )


def _seen(model, robot, image, joint):
    """The range that a joint must have for its counterpart's."""
    low, high = model.joint(robot.joint_names[image.joint[joint]]).range
    return (low, high) if image.sign[joint] > 0 else (-high, -low)


def test_damping_takes_less_than_the_speed():
    """By hand: a shank of 0.59 kg has about 0.016 kg·m² about its knee, and ANYmal's torque falls by 16 N·m per rad/s; without
    rotor inertia that is 16 · 0.005 / 0.016 = 5 times the joint's speed in a step, less what the rest of the leg gives way.
    """
    robot = load_robot("anymal_c")
    motors = robot.parameters["gauge"]
    bare = replace(motors, armature=(0.0,) * 12)
    assert 3.0 < damped_share(robot, bare) < 6.0
    assert damped_share(robot, motors) < 1.0
    limits = "the motors of parameters.gauge take .* times a joint's speed away .* give armature"
    found = examine(replace(robot, parameters={"gauge": bare}))
    assert [re.search(limits, f.sentence) for f in found if f.check == "motor law" and not f.passed] != []
    assert damped_share(load_robot("go2"), load_robot("go2").parameters["training"]) < 2.0


def test_anymals_frames_knees_and_order_are_unlike_go2s():
    robot = load_robot("anymal_c")
    plan, (model, data) = body_plan(robot), default_pose(robot)
    assert plan.legs == tuple((i, 4 + i, 8 + i) for i in range(4))
    assert [robot.joint_names[i] for i in plan.abduction] == ["LF_HAA", "LH_HAA", "RF_HAA", "RH_HAA"]
    knee = {
        n: data.xanchor[model.joint(f"{n}_KFE").id] - data.xanchor[model.joint(f"{n}_HFE").id] for n in ("LF", "LH")
    }
    assert knee["LF"][0] < -0.05 and knee["LH"][0] > 0.05  # fore knees behind the hips, hind knees before them
    np.testing.assert_allclose(mirror_image(robot).sign, [-1.0] * 4 + [1.0] * 8)


@pytest.mark.parametrize(
    ("name", "only"),
    [
        *((name, ("model/", "kinematics/", "motors/", "contact/rest")) for name in ROBOTS),
        *(pytest.param(name, (), marks=pytest.mark.slow) for name in ROBOTS),
    ],
)
def test_mujoco_holds_their_models_to_the_contract(name, only):
    results = run_conformance("mujoco", robot=load_robot(name), only=only)
    assert not [f"{r.name}: {r.detail}" for r in results if r.outcome is not Outcome.PASSED]


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco-warp", "newton"])
@pytest.mark.parametrize("name", ROBOTS)
def test_warp_engines_hold_their_models_to_the_contract(engine, name):
    results = run_conformance(engine, "cpu", robot=load_robot(name), only=("model/", "kinematics/feet", "contact/rest"))
    assert not [f"{r.name}: {r.detail}" for r in results if r.outcome is Outcome.FAILED]


@pytest.mark.parametrize("name", ROBOTS)
def test_they_can_be_trained(name):
    """A few steps of the Go2's task, scaled, on MuJoCo."""
    task = find_task("go2-flat", ["environment.num_envs=2"], robot=name)
    environment = TrainingEnvironment(task.environment, backend="mujoco", device="cpu")
    try:
        assert environment.contract.robot == name
        assert environment.contract.provenance["robot"]["name"] == name
        for _ in range(3):
            observations, reward, _, _ = environment.step(0.1 * environment.get_observations()["policy"][:, :12])
        assert observations["policy"].isfinite().all() and reward.isfinite().all()
        height = environment.parts.inputs.base_position_w[:, 2]
        assert (height > 0.5 * body_plan(load_robot(name)).standing_height).all()
    finally:
        environment.close()
