"""Finding and reading robots, and the errors of those who describe their own."""

import subprocess
import sys
from dataclasses import replace

import pytest
from gaitgauge.robots import JointParameters, RobotError, check_robot, load_robot, robot_names
from gaitgauge.robots.checks import checking
from gaitgauge.robots.loading import robot_digest

pytestmark = pytest.mark.usefixtures("robots_are_tried_here")

LEGS = ("FL", "FR", "RL", "RR")


def test_go2_description():
    go2 = load_robot("go2")
    assert go2.joint_names == tuple(f"{leg}_{part}_joint" for leg in LEGS for part in ("hip", "thigh", "calf"))
    assert go2.default_joint_position == (0.1, 0.8, -1.5, -0.1, 0.8, -1.5, 0.1, 1.0, -1.5, -0.1, 1.0, -1.5)
    assert go2.foot_names == LEGS
    assert len(go2.collision_bodies) == 13
    assert go2.stand_height == 0.445
    assert go2.command_limits == (2.0, 1.0, 2.0)
    assert go2.default_parameters == "gauge"


def test_go2_parameter_sets():
    sets = load_robot("go2").parameters
    assert sets["gauge"] == JointParameters(
        stiffness=(20.0,) * 12,
        damping=(0.5,) * 12,
        torque_limit=(23.7, 23.7, 45.43) * 4,
        armature=(0.01,) * 12,
        joint_damping=(0.1,) * 12,
        friction_loss=(0.2,) * 12,
        driving_torque_limit=(20.2, 20.2, 38.72) * 4,
        full_torque_speed=(13.5, 13.5, 7.04) * 4,
        no_load_speed=(30.0, 30.0, 15.65) * 4,
    )
    assert sets["training"] == replace(
        sets["gauge"],
        torque_limit=(23.7, 23.7, 35.55) * 4,
        driving_torque_limit=(20.2, 20.2, 30.3) * 4,
        full_torque_speed=(13.5, 13.5, 8.91) * 4,
    )
    without = (0.0,) * 12
    assert sets["training-published"] == replace(
        sets["training"],
        armature=without,
        joint_damping=without,
        friction_loss=without,
        full_torque_speed=(13.5, 13.5, 9.0) * 4,
        no_load_speed=(30.0, 30.0, 20.0) * 4,
    )


def test_own_robots_are_named_as_their_folders():
    assert {"go1", "go2", "anymal_c", "g1"} <= set(robot_names())
    for name in robot_names():
        assert load_robot(name).name == name


def test_users_robot(write_hopper):
    path = write_hopper()
    robot = load_robot(path)
    assert robot == load_robot(str(path)) == load_robot(path.parent)
    assert robot.mjcf == path.parent.resolve() / "model" / "hopper.xml"
    assert robot.default_joint_position == (0.3, -0.6)
    assert robot.parameters["soft"] == JointParameters(
        stiffness=(30.0, 30.0),
        damping=(1.0, 2.0),
        torque_limit=(40.0, 50.0),
        armature=(0.01, 0.01),
        joint_damping=(0.0, 0.0),
        friction_loss=(0.1, 0.1),
    )
    check_robot(robot)


def test_longest_key_wins(write_hopper):
    path = write_hopper(("{ hip = 1.0, knee = 2.0 }", "{ hip = 1.0, knee = 2.0, left_knee = 3.0 }"))
    assert load_robot(path).parameters["soft"].damping == (1.0, 3.0)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('title = "One leg"\n', "", "it lacks title"),
        ('title = "One leg"\n', 'titel = "One leg"\n', "unknown field 'titel'; did you mean 'title'?"),
        ('trunk_shapes = ["chest"]\n', "", "it lacks trunk_shapes"),
        (
            "stand_height = 0.5",
            'stand_height = 0.5\nsdk_joint_names = ["hip", "knee"]',
            "sdk_joint_names names 'knee', which is none of joint_names; give every joint once",
        ),
        (
            "stand_height = 0.5",
            'stand_height = 0.5\nsdk_joint_names = ["hip"]',
            "sdk_joint_names does not name each joint once",
        ),
        ("armature = 0.01\n", "", "parameters.soft lacks armature"),
        ("armature = 0.01", "amature = 0.01", "unknown field 'parameters.soft.amature'; did you mean 'armature'"),
        ("armature = 0.01", "armature = true", "parameters.soft.armature[0] is True; it must be a number"),
        ("armature = 0.01", "armature = nan", "parameters.soft.armature[0] is nan; it must be a finite number"),
        ("armature = 0.01", 'armature = "0.01"', "parameters.soft.armature[0] is '0.01'; it must be a number"),
        (
            "armature = 0.01",
            "armature = -0.01",
            "parameters.soft.armature[0] is -0.01; it must be greater than or equal to 0",
        ),
        ("armature = 0.01", "armature = 1e300", "parameters.soft.armature[0] is 1e+300; it must be less than or equal"),
        ("[40, 50]", "[40, 1e9]", "parameters.soft.torque_limit[1] is 1000000000.0; it must be less than or equal to"),
        ("[40, 50]", "[40, 50, 60]", "parameters.soft.torque_limit has 3 values but there are 2 joints"),
        (
            "armature = 0.01",
            "armature = 0.01\nno_load_speed = 20",
            "full_torque_speed and no_load_speed belong together",
        ),
        (
            "armature = 0.01",
            "armature = 0.01\nfull_torque_speed = 20\nno_load_speed = 20",
            "full_torque_speed is 20 rad/s for hip but must be below no_load_speed, 20",
        ),
        (
            "armature = 0.01",
            "armature = 0.01\ndriving_torque_limit = 41",
            "driving_torque_limit is 41 N·m for hip but must not be above torque_limit, 40",
        ),
        ("knee = 2.0", "ankle = 2.0", "'ankle', which is neither a joint nor words of its name"),
        ("knee = 2.0", "left_kne = 2.0", "did you mean 'left_knee'?"),
        (", knee = 2.0", "", "no value for the joint 'left_knee_joint'"),
        ("[0.3, -0.6]", "[0.3]", "default_joint_position has 1 values but there are 2 joints"),
        ('"hip", "left_knee_joint"', '"hip", "hip"', "joint_names must hold names, each once"),
        ('["foot"]', "[]", "foot_names is []; it must have at least 1 item"),
        ('"trunk"\nfoot', "3\nfoot", "base_body is 3; it must be a text"),
        ("stand_height = 0.5", "stand_height = 0", "stand_height is 0; it must be greater than 0"),
        ("[0.5, 0, 1]", "[0.5, 1]", "command_limits is [0.5, 1]; more entries are needed"),
        ("[0.5, 0, 1]", "[0.5, -1, 1]", "command_limits[1] is -1; it must be greater than or equal to 0"),
        ('= "soft"', '= "hard"', "default_parameters is 'hard'; choose from: soft"),
        ("model/hopper.xml", "x" * 300, "which does not exist"),
        ("model/hopper.xml", "hopper.xml", "which does not exist; the path is relative to the robot file"),
        ("stand_height = 0.5", "stand_height = inf", "stand_height is inf; it must be a finite number"),
        (
            "stand_height = 0.5",
            "stand_height = 1e9",
            "stand_height is 1000000000.0; it must be less than or equal to 10",
        ),
        ("[0.3, -0.6]", "[0.3, 99]", "default_joint_position[1] is 99; it must be less than or equal to 12.6"),
        ('name = "hopper"', 'name = "../hopper"', "name is '../hopper'; it must be letters, digits and"),
        ('name = "hopper"', f'name = "{"x" * 300}"', "it must have at most 100 characters"),
        ('"trunk", "upper"', '"trunk", "trunk"', "collision_bodies names 'trunk' twice"),
        ("stand_height = 0.5", "stand_height = ", "is not valid TOML"),
    ],
)
def test_malformed_description(write_hopper, old, new, message):
    path = write_hopper((old, new))
    with pytest.raises(RobotError) as caught:
        load_robot(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_and_unreadable_files(tmp_path):
    with pytest.raises(RobotError, match=r"robot file '.*robot.toml' does not exist"):
        load_robot(tmp_path)
    binary = tmp_path / "robot.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RobotError, match="is not a UTF-8 text file"):
        load_robot(binary)


def test_unknown_name_offers_close_ones():
    with pytest.raises(RobotError, match=r"unknown robot 'g02'; did you mean 'go2'\?"):
        load_robot("g02")
    with pytest.raises(RobotError, match=r"unknown robot 'elephant' \(installed: anymal_c, g1, go1, go2"):
        load_robot("elephant")


@pytest.mark.parametrize(
    ("changes", "mjcf", "message"),
    [
        ([("left_knee_joint", "right_knee_joint")], ("", ""), "no joint of that name; did you mean 'left_knee_joint'?"),
        ([('"lower"]', '"lowest"]')], ("", ""), "collision_bodies names 'lowest' but hopper.xml has no body"),
        ([('"trunk"\nfoot', '"upper"\nfoot')], ("", ""), "one free joint, on the base_body 'upper'"),
        ([('"imu"', '"foot"')], ("", ""), "imu_site 'foot' must be on the base_body 'trunk'"),
        ([('"chest"', '"cheat"')], ("", ""), "trunk_shapes names 'cheat' but hopper.xml has no geom of that name; did"),
        ([('"chest"', '"foot"')], ("", ""), "trunk_shapes names 'foot', which is not on the base_body 'trunk'"),
        (
            [],
            ('name="chest" type', 'size="0.1" mass="1"/><geom name="chest" contype="0" conaffinity="0" type'),
            "trunk shape 'chest' does not meet the ground",
        ),
        ([("[0.3, -0.6]", "[0.3, 0.6]")], ("", ""), "'left_knee_joint' is 0.6 rad, outside its range -2 to 0 rad"),
        ([("stand_height = 0.5", "stand_height = 0.4")], ("", ""), "the geom 'foot' is 0.052 m below the ground"),
        ([], ('size="0.02" pos', 'size="0.02" contype="0" conaffinity="0" pos'), "does not meet the ground"),
        ([], ('<position joint="hip"/>', ""), "has 0 actuators on 'hip'; it must have one"),
        ([], ('<position joint="hip"/>', '<position joint="hip"/>' * 2), "has 2 actuators on 'hip'; it must have one"),
        ([], ("<worldbody>", '<worldbody><geom type="plane" size="1 1 1"/>'), "must hold the robot alone"),
        (
            [],
            ('<joint name="hip"', '<joint name="roll"/><joint name="hip"'),
            "the joint 'roll', which joint_names lacks",
        ),
        ([], ('<joint name="hip"', '<joint name="hip" type="slide"'), "'hip', which is not a hinge"),
        ([], ('type="box"', 'type="bix"'), "is not a model that MuJoCo can compile"),
        ([], ("</mujoco>", "<equality><weld body1='trunk'/></equality></mujoco>"), "ties the robot to the world"),
        ([], ("</mujoco>", "<equality><connect body1='lower' anchor='0 0 0'/></equality></mujoco>"), "ties the robot"),
        ([], ("<worldbody>", "<option gravity='0 0 -1'/><worldbody>"), "has a gravity of [0.0, 0.0, -1.0]"),
        ([], ("<worldbody>", "<option><flag contact='disable'/></option><worldbody>"), "disables or overrides"),
        ([], ("<worldbody>", "<option density='1000'/><worldbody>"), "has a medium or wind"),
        ([], ("<worldbody>", "<worldbody><body name='crane'/>"), "has the body 'crane' outside 'trunk'"),
        ([], ("<worldbody>", "<worldbody><site name='hook'/>"), "has geoms or sites in its worldbody"),
        ([], ('<body name="trunk">', '<body name="trunk" gravcomp="1">'), "has gravity compensation"),
        ([], ("<freejoint/>", "<joint type='free' damping='100'/>"), "on the base's free joint"),
        ([], ('size="0.02" mass', 'contype="2" conaffinity="2" size="0.02" mass'), "no geom of body 'upper'"),
        (
            [],
            ('<geom name="chest"', '<geom pos="0 0 -0.6" name="chest"'),
            "the geom 'chest' is 0.150 m below the ground",
        ),
        ([("stand_height = 0.5", "stand_height = 0.436")], ("", ""), "the geom 'foot' is 0.016 m below the ground"),
    ],
)
def test_description_that_the_model_contradicts(write_hopper, changes, mjcf, message):
    path = write_hopper(*changes, mjcf=mjcf)
    load_robot(path, check=False)
    with pytest.raises(RobotError) as caught:
        load_robot(path)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_listing_and_loading_import_no_engine():
    code = (
        "import sys; from gaitgauge.robots import load_robot, robot_names\n"
        "[load_robot(n, check=False) for n in robot_names()]\n"
        "print(sorted({'mujoco', 'torch', 'warp', 'numpy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_robot_s_digest_covers_the_model_and_all_that_it_includes(write_hopper):
    path = write_hopper()
    legs = path.parent / "model" / "parts" / "legs.xml"
    mesh = path.parent / "model" / "meshes" / "shell.stl"
    seen = [robot_digest(load_robot(path, check=False))]
    assert seen[0] == robot_digest(load_robot(path, check=False))

    def changed() -> bool:
        seen.append(robot_digest(load_robot(path, check=False)))
        return seen[-1] not in seen[:-1]

    path.write_text(path.read_text().replace("stiffness = 30", "stiffness = 31"))
    assert changed()
    model = path.parent / "model" / "hopper.xml"
    model.write_text(model.read_text().replace("<worldbody>", "<include file='parts/legs.xml'/><worldbody>"))
    assert changed()
    legs.parent.mkdir()
    legs.write_text("<mujoco><compiler meshdir='meshes'/><asset><mesh file='shell.stl'/></asset></mujoco>")
    assert changed()
    mesh.parent.mkdir()
    mesh.write_bytes(b"solid")
    assert changed()
    mesh.write_bytes(b"Solid")
    assert changed()


def test_a_sound_robot_is_compiled_once_until_a_file_changes(write_hopper, monkeypatch):
    compiled = []
    run = checking.run_apart
    monkeypatch.setattr(checking, "run_apart", lambda work, file: compiled.append(file) or run(work, file))
    path = write_hopper(("armature = 0.01", "armature = 0.0123"))
    load_robot(path)
    load_robot(path)
    assert len(compiled) == 1
    write_hopper(mjcf=('mass="3"', 'mass="3.5"'))
    load_robot(path)
    assert len(compiled) == 2


@pytest.mark.parametrize(
    "text",
    [
        "",
        "<mujoco>",
        "<robot/>",
        "<mujoco><worldbody><body/></worldbody></mujoco>",
        "<mujoco><include file='missing.xml'/></mujoco>",
        "<mujoco><include file='hopper.xml'/></mujoco>",
        "<mujoco><asset><mesh file='missing.stl'/></asset></mujoco>",
        "<mujoco><compiler angle='round'/></mujoco>",
        "<mujoco><option timestep='-1'/><worldbody><body name='trunk'><freejoint/></body></worldbody></mujoco>",
        "<mujoco><worldbody><body><joint type='free'/><geom size='nan'/></body></worldbody></mujoco>",
        "<mujoco><default class='x'/><default class='x'/></mujoco>",
        "<mujoco><extension><plugin plugin='mujoco.missing'/></extension></mujoco>",
        "<!DOCTYPE a [<!ENTITY a 'xxxx'><!ENTITY b '&a;&a;'>]><mujoco model='&b;'/>",
        "\ud83d\ude00".encode("utf-8", "surrogatepass").decode("utf-8", "replace"),
    ],
)
def test_models_that_mujoco_refuses_are_one_sentence(write_hopper, text):
    path = write_hopper()
    (path.parent / "model" / "hopper.xml").write_text(text)
    with pytest.raises(RobotError, match=r"hopper\.xml") as caught:
        load_robot(path)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 600


def test_a_binary_in_the_place_of_the_model(write_hopper):
    path = write_hopper()
    (path.parent / "model" / "hopper.xml").write_bytes(bytes(range(256)) * 10)
    with pytest.raises(RobotError, match="is not XML"):
        load_robot(path)


def test_a_parameter_set_may_begin_with_another(write_hopper):
    more = '[parameters.stiff]\nlike = "soft"\nstiffness = 90.0\n'
    path = write_hopper()
    path.write_text(path.read_text() + more)
    sets = load_robot(path).parameters
    assert sets["stiff"] == replace(sets["soft"], stiffness=(90.0, 90.0))
    path.write_text(path.read_text().replace('like = "soft"', 'like = "stiff"'))
    with pytest.raises(RobotError, match=r"parameters.stiff.like is 'stiff', .* before it; choose from soft$"):
        load_robot(path)


def test_keys_are_words_of_joint_names():
    g1 = load_robot("g1")
    hips = {n: kp for n, kp in zip(g1.joint_names, g1.parameters["gauge"].torque_limit, strict=True) if "hip" in n}
    assert hips == {n: 139.0 if "roll" in n else 88.0 for n in hips}
