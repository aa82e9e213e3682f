"""A task that was written for the Go2, for other robots."""

from dataclasses import replace

import pytest
from gaitgauge.robots import RobotError, load_robot
from gaitgauge.training.scaling import ratios, scaled_environment
from gaitgauge.training.tasks import TaskError, find_task


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
    assert found.torque == pytest.approx(2.0)


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
    assert other.training.run.experiment == "heavy_moe_cts"
    assert replace(other.training, run=own.training.run) == own.training


def test_settings_change_what_is_scaled(heavy):
    chosen = find_task("go2-flat", ["environment.rewards.torque=-1e-3", "training.run.experiment=mine"], robot=heavy)
    assert chosen.environment.rewards.torque == -1e-3
    assert chosen.training.run.experiment == "mine"


def test_the_setting_is_the_same_as_the_option(heavy):
    assert find_task("go2-flat", [f"environment.robot={heavy}"]) == find_task("go2-flat", robot=heavy)


def test_the_tasks_own_robot_changes_nothing():
    assert find_task("go2-sprint", robot="go2") == find_task("go2-sprint")
    assert scaled_environment(find_task("go2-flat").environment, "go2") == find_task("go2-flat").environment


def test_wrong_robots():
    with pytest.raises(RobotError, match="unknown robot 'go3'; did you mean 'go2'"):
        find_task("go2-flat", robot="go3")
    with pytest.raises(TaskError, match="the robot is given twice"):
        find_task("go2-flat", ["environment.robot=go2"], robot="go2")
