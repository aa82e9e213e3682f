"""A task that was written for the Go2, for other robots."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from gaitgauge.gauge.suite import load_suite
from gaitgauge.robots import RobotError, load_robot
from gaitgauge.robots.anatomy.body_plan import body_plan, default_pose
from gaitgauge.training.tasks import TaskError, find_task
from gaitgauge.training.tasks.scaling import ratios, scaled


@pytest.fixture(scope="module")
def heavy(tmp_path_factory):
    """The Go2 with a trunk that is one Go2 heavier, told to go half as fast, without training's motors."""
    go2 = load_robot("go2")
    folder = tmp_path_factory.mktemp("heavy")
    text = go2.mjcf.read_text().replace('<inertial mass="6.921"', '<inertial mass="22.127408"')
    (folder / "go2.xml").write_text(text)
    description = (go2.mjcf.parent / "robot.toml").read_text()
    description = description.replace('name = "go2"', 'name = "heavy"').replace("[2.0, 1.0, 2.0]", "[1.0, 0.5, 3.0]")
    description = description.replace("[parameters.training]", "[parameters.other]")
    (folder / "robot.toml").write_text(description)
    return str(folder / "robot.toml")


def test_ratios(heavy):
    found = ratios(load_robot(heavy), load_robot("go2"))
    assert (found.mass, found.length, found.height) == pytest.approx((2.0, 1.0, 1.0))
    assert found.speed == (0.5, 0.5, 1.5)
    assert found.stance == pytest.approx((1.0, 1.0)) and found.action == 1.0
    assert found.torque == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("robot", "shown"), [(None, "go2-dreamwaq"), ("go2", "go2-dreamwaq"), ("anymal_c", "go2-dreamwaq for anymal_c")]
)
def test_a_task_names_a_robot_that_is_not_its_own(robot, shown):
    assert find_task("rough-dreamwaq", robot=robot).shown == shown


def test_what_is_scaled(heavy):
    own, other = find_task("go2-moe-cts"), find_task("go2-moe-cts", robot=heavy)
    environment = other.environment
    assert environment.robot == heavy
    assert environment.joints.parameters == "gauge"
    assert environment.rewards.torque == pytest.approx(own.environment.rewards.torque / 4)
    assert environment.rewards.joint_power == pytest.approx(own.environment.rewards.joint_power / 2)
    assert environment.rewards.base_height_target == own.environment.rewards.base_height_target
    assert environment.randomization.base_mass == pytest.approx((-2.0, 2.0))
    assert environment.commands.stages[-1].forward == (-1.0, 1.0) and environment.commands.stages[-1].yaw == (-3.0, 3.0)
    tiles = {tile.name: tile.command_limits for tile in environment.terrain.tiles}
    assert tiles["flat"] == (1.0, 0.5, 3.0)
    # what the gauge asks for there is asked for here, as far as the robot goes
    assert tiles["stairs_up"] == (1.0, 0.5, 2.25)
    assert other.training.run.experiment == "heavy_moe_cts"
    assert replace(other.training, run=own.training.run) == own.training


@pytest.mark.parametrize("name", ["go1", "anymal_c"])
def test_what_scaled_settings_mean_for_the_robot(name):
    """Whatever the robot, the base is to be as high as the Go2's is in shares of what the legs reach (0.85), exploration turns
    joints by the same angles, episodes start on ground that is level below all feet, and the gauge's commands are learned.
    """
    own, task = find_task("go2-moe-cts"), find_task("go2-moe-cts", robot=name)
    robot, environment = load_robot(name), task.environment
    model, data = default_pose(robot)
    legs, radius = body_plan(robot).legs, model.geom(robot.foot_geoms[0]).size[0]
    reach = []
    for swing in np.linspace(-1.2, 1.2, 49):  # the lowest that any swing and bend of a leg puts its foot
        for bend in np.linspace(-2.4, 2.4, 97):
            for leg in legs:
                data.joint(robot.joint_names[leg[1]]).qpos[0] = swing
                data.joint(robot.joint_names[leg[2]]).qpos[0] = bend
            mujoco.mj_kinematics(model, data)
            reach.append(radius - data.geom_xpos[[model.geom(g).id for g in robot.foot_geoms], 2])
    highest = np.max(reach, axis=0).min()
    assert environment.rewards.base_height_target == pytest.approx(0.85 * highest, rel=0.03)
    angle = task.training.network.initial_std * np.array(robot.action_scale or 0.25)
    assert angle == pytest.approx(own.training.network.initial_std * 0.25)
    scale = np.array(robot.action_scale or 0.25).mean()
    assert environment.rewards.action_rate / scale**2 == pytest.approx(own.environment.rewards.action_rate / 0.25**2)
    feet = np.abs(body_plan(robot).foot_position[:, :2]).max(axis=0)
    assert (np.array(environment.reset.footprint) / 2 > feet - 0.05).all()
    suite = load_suite("robogauge-1.1")
    assert environment.commands.stages[-1].forward[1] >= suite.command_limits("flat")[0]


def test_settings_change_what_is_scaled(heavy):
    chosen = find_task("go2-flat", ["environment.rewards.torque=-1e-3", "training.run.experiment=mine"], robot=heavy)
    assert chosen.environment.rewards.torque == -1e-3
    assert chosen.training.run.experiment == "mine"


def test_the_setting_is_the_same_as_the_option(heavy):
    assert find_task("go2-flat", [f"environment.robot={heavy}"]) == find_task("go2-flat", robot=heavy)


def test_the_tasks_own_robot_changes_nothing():
    assert find_task("go2-sprint", robot="go2") == find_task("go2-sprint")
    task = find_task("go2-flat")
    assert scaled(task.environment, task.training, "go2") == (task.environment, task.training)


def test_wrong_robots():
    with pytest.raises(RobotError, match="unknown robot 'go3'; did you mean 'go2'"):
        find_task("go2-flat", robot="go3")
    with pytest.raises(TaskError, match="the robot is given twice"):
        find_task("go2-flat", ["environment.robot=go2"], robot="go2")
