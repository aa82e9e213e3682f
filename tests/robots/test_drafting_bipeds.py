"""A first description of robots with two legs: plan, mends, pose, guesses that are made again, and what is refused."""

import re

import numpy as np
import pytest
from gaitgauge.robots import RobotError, load_robot
from gaitgauge.robots.anatomy.body_plan import body_plan, default_pose
from gaitgauge.robots.anatomy.roles import anatomy
from gaitgauge.robots.checks.examining import examine
from gaitgauge.robots.describing.drafting import draft_robot, joint_table
from gaitgauge.robots.describing.guessing import guessed_again
from gaitgauge.robots.describing.surveying import Answers
from stick_biped import ARMS_MASS, MASS, write_biped
from stick_robot import PLATE, SHANKS, write_stick

pytestmark = pytest.mark.usefixtures("robots_are_tried_here")

PASSIVE = '<default><joint damping="0.3" armature="0.01"/></default>'
FLOOR = (  # and what names parts that are taken out
    '<contact><exclude body1="table" body2="pelvis"/></contact><sensor><framepos objtype="geom" objname="floor"/></sensor>'
    '<worldbody><geom name="floor" type="plane" size="1 1 1"/><body name="table" pos="2 0 0"><geom size="0.1"/></body>'
)
LYING = "0 0 0.1 1 0 0 0" + " 0 0 -1.4 2.4 -0.9 0" * 2
STANDING = "0 0 0.6 1 0 0 0" + " 0 0 -0.2 0.4 -0.2 0" * 2


def described(model, **said):
    """The first description of a model in a folder beside it, and the robot that it is."""
    home = model.parent / "mine"
    home.mkdir(exist_ok=True)
    draft = draft_robot(model, folder=home, answers=Answers(**said))
    (home / "own.xml").write_text(draft.model or model.read_text())
    (home / "robot.toml").write_text(draft.text("own.xml"))
    return draft, load_robot(home)


def test_a_humanoid_is_described_with_mends(tmp_path):
    model = write_biped(tmp_path, arms=True, default=PASSIVE)
    model.write_text(model.read_text().replace("<worldbody>", FLOOR).replace("<freejoint/>", '<joint type="free"/>'))
    lines = model.read_text().splitlines()
    free, floor = (next(i for i, line in enumerate(lines, 1) if word in line) for word in ('type="free"', "floor"))
    draft, robot = described(model)
    assert draft.plan == "a biped with arms, with legs that end in l_f, r_f"
    assert [m.split(":")[0] for m in draft.mends] == [f"stickman.xml, line {line}" for line in (free, floor, floor)]
    for mend, told in zip(draft.mends, ("damping 0.3, armature 0.01", "'floor'", "'table'"), strict=True):
        assert told in mend
    assert robot.soles == tuple(tuple(f"{side}_f_foot{end}" for end in ("", "_2", "_3", "_4")) for side in ("l", "r"))
    assert body_plan(robot).mass == pytest.approx(MASS + ARMS_MASS)
    findings = {f.check: f for f in examine(robot)}
    assert [f.sentence for f in findings.values() if not f.passed] == [findings["SDK order"].sentence]
    assert findings["standing"].sentence.startswith("balances with its ankles")
    assert findings["legs"].sentence.startswith("a biped with arms: 2 legs of 0.6")
    # arms and trunk are not bent; the soles are level; the weight is over them
    angles = dict(zip(robot.joint_names, robot.default_joint_position, strict=True))
    assert all(angles[name] == 0.0 for name in angles if name[-1] not in "cde")
    assert angles["l_d"] > 0.2 and angles["l_c"] + angles["l_d"] + angles["l_e"] == pytest.approx(0.0, abs=2e-4)
    physics, data = default_pose(robot)
    over = (physics.body_mass @ data.xipos)[0] / physics.body_mass.sum() - body_plan(robot).foot_position[:, 0].mean()
    assert abs(over) < 0.02
    assert robot.variants is not None and len(robot.variants["legs"].driven_joints) == 12
    assert "weight times leg length is 1" in findings["measure"].sentence
    motors = robot.parameters["gauge"]
    of = dict(zip(robot.joint_names, motors.stiffness, strict=True))
    assert of["l_c"] > of["l_e"] > of["l_g"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("<freejoint/>", ""), "has a fixed base: no joint is free; give its body 'pelvis' a <freejoint/>"),
        (
            ('type="sphere" size="0.01"', 'contype="0" conaffinity="0" type="sphere" size="0.01"'),
            "has no feet: its leg ends in 'l_f'",
        ),
    ],
)
def test_bad_bipeds_are_refused_in_one_sentence(tmp_path, change, message):
    model = write_biped(tmp_path)
    assert change[0] in model.read_text()
    model.write_text(model.read_text().replace(*change))
    with pytest.raises(RobotError, match=re.escape(message)):
        draft_robot(model)


def test_three_legs_and_a_leg_of_one_joint_are_refused(tmp_path):
    model = write_stick(tmp_path, SHANKS["capsule"] + PLATE)
    text = model.read_text()
    # the front left leg ends above its knee
    begin, end = text.index('<body name="fl_shank"'), text.index('<body name="fr_hip"')
    model.write_text(f"{text[:begin]}</body></body>{text[end:]}")
    with pytest.raises(
        RobotError,
        match=r"has 3 legs, which end lowest: 'fr_shank', .* and not 'fl_thigh'; .*--legs a,b",
    ):
        draft_robot(model)
    model.write_text(re.sub(r'<joint name="fl_(abduction|swing)"[^>]*>', "", text))
    with pytest.raises(RobotError, match="has a leg of one joint, 'fl_knee'; a leg has two or more"):
        draft_robot(model)
    with pytest.raises(RobotError, match="has no body, joint or shape 'fl_knees'; did you mean"):
        draft_robot(model, answers=Answers(legs=("fl_knees", "fr_knee")))


def test_legs_and_feet_are_those_that_are_named(tmp_path):
    """Arms that reach to the ground are legs too, where nobody says otherwise."""
    model = write_biped(tmp_path, arms=True)
    model.write_text(model.read_text().replace('pos="0 0 -0.2"><joint name="l_j"', 'pos="0 0 -0.8"><joint name="l_j"'))
    with pytest.raises(RobotError, match="has 3 legs"):
        draft_robot(model)
    assert described(model, legs=("l_d", "r_f"))[1].foot_names == ("l_f", "r_f")
    (tmp_path / "mine" / "robot.toml").unlink()
    assert anatomy(described(model, feet=("l_f", "r_f"))[1]).plan == "humanoid"


def test_a_keyframe_in_which_the_robot_lies_is_no_standing_pose(tmp_path):
    keys = f'<keyframe><key name="home" qpos="{LYING}"/><key name="up" qpos="{STANDING}"/></keyframe>'
    model = write_biped(tmp_path, more=keys)
    draft, robot = described(model)
    origin = next(e.remark for e in draft.entries if e.key == "default_joint_position")
    assert origin == "of the model's keyframe 'up'; not of 'home', in which the robot lies"
    assert robot.default_joint_position[3] == 0.4
    _, robot = described(model, keyframe="home")
    pose = next(f for f in examine(robot) if f.check == "pose")
    assert not pose.passed and pose.needed_for == "everything"
    assert "in its default pose, the model's keyframe 'home', the robot lies" in pose.sentence
    assert "left (" in pose.sentence and "right (" in pose.sentence
    with pytest.raises(RobotError, match="has no keyframe 'down'; it has home, up"):
        draft_robot(model, answers=Answers(keyframe="down"))


def test_legs_that_the_model_s_own_gains_do_not_hold_bent_are_straighter(tmp_path):
    motors = "".join(f'<position joint="{side}_{joint}" kp="15"/>' for side in "lr" for joint in "abcdef")
    draft, robot = described(write_biped(tmp_path, more=f"<actuator>{motors}</actuator>"))
    of = {entry.key: entry for entry in draft.entries}
    assert of["parameters.gauge.stiffness"].value == 15.0
    assert of["default_joint_position"].remark.endswith("; straighter than usual, since the model's gains hold no more")
    assert 0.1 < robot.default_joint_position[3] < 0.5, "0.59 with gains of its own"
    assert next(f for f in examine(robot) if f.check == "load").passed


def test_a_pose_beyond_the_range_of_a_joint_is_refused(tmp_path):
    with pytest.raises(RobotError, match=r"the pose has 'l_d' at -0\.5 rad, outside its range 0 to 2\.4 rad; give"):
        described(write_biped(tmp_path), pose={"d": 1.0, "l_d": -0.5})


def test_a_keyframe_at_the_end_of_a_range_with_many_digits_stays_within_it(tmp_path):
    """0.5235987 would be 0.5236 with four digits."""
    pose = STANDING.replace("0 0 -0.2", "0 0.5235987 -0.2")
    model = write_biped(tmp_path, more=f'<keyframe><key name="home" qpos="{pose}"/></keyframe>')
    model.write_text(model.read_text().replace('range="-0.5 0.5"', 'range="-0.5235987 0.5235987"'))
    _, robot = described(model)
    assert robot.default_joint_position[:3] == (0.0, 0.5235987, -0.2)


def test_guesses_are_made_again_after_an_edit(tmp_path):
    draft, robot = described(write_biped(tmp_path), pose={"d": 0.4, "c": -0.2, "e": -0.2})
    origin = next(e.remark for e in draft.entries if e.key == "default_joint_position")
    assert origin.startswith("as said for d, c, e; else guessed") and robot.default_joint_position[2:5] == (
        -0.2,
        0.4,
        -0.2,
    )
    home = tmp_path / "mine"
    assert guessed_again(home)[1] == []
    text = (home / "robot.toml").read_text().replace("d = 0.4", "d = 0.8").replace("= -0.2", "= -0.4")
    text = text.replace("default_joint_position", "# deeper\ndefault_joint_position", 1)
    (home / "robot.toml").write_text(text.replace("action_scale = 0.25", "action_scale = 0.5"))
    again, changes, file = guessed_again(home / "robot.toml")
    (home / "robot.toml").write_text(again)
    assert file == home / "robot.toml" and changes[0].startswith(f"stand_height: {robot.stand_height:g} becomes 0.")
    assert "# deeper" in again
    edited = load_robot(home)
    assert edited.default_joint_position[2:5] == (-0.4, 0.8, -0.4) and edited.action_scale == (0.5,) * 12
    assert edited.stand_height == pytest.approx(body_plan(edited).standing_height + 0.02, abs=1.1e-3)
    assert guessed_again(home)[1] == []


def test_a_sole_of_which_half_is_inside_the_ground_is_told(tmp_path):
    _, robot = described(write_biped(tmp_path))
    angles = dict(zip(robot.joint_names, robot.default_joint_position, strict=True)) | {"l_e": 0.3}
    path = tmp_path / "mine" / "robot.toml"
    toes = ", ".join(f"{name} = {angle}" for name, angle in angles.items())
    text = re.sub(r"(?m)^default_joint_position = .*", f"default_joint_position = {{ {toes} }}", path.read_text())
    path.write_text(text)
    with pytest.raises(
        RobotError, match=r"at stand_height 0\.\d+ m the geom 'l_f_foot_\d' is 0\.0\d+ m below the ground; raise it to"
    ):
        load_robot(path)


@pytest.mark.parametrize(
    ("values", "table"),
    [
        ([1.0] * 4, 1.0),
        ([1.0, 2.0, 1.0, 2.0], {"hip": 1.0, "knee": 2.0}),
        ([1.0, 2.0, 3.0, 2.0], {"knee": 2.0, "left_hip": 1.0, "right_hip": 3.0}),
    ],
)
def test_values_of_joints_stand_under_words_of_names(values, table):
    names = ["left_hip_joint", "left_knee_joint", "right_hip_joint", "right_knee_joint"]
    made = joint_table(names, values)
    if isinstance(table, dict):
        assert {key: made[key] for key in table if key in made} and len(made) == len(table)
        found = [made[max((k for k in made if f"_{k}_" in f"_{n}_"), key=len)] for n in names]
        np.testing.assert_array_equal(found, values)
    else:
        assert made == table


def test_shapes_that_a_scene_pairs_with_the_ground_meet_it(tmp_path):
    """They meet the ground and not each other; the trunk's is the largest."""
    model = write_biped(tmp_path, default='<default><geom contype="0" conaffinity="0"/></default>')
    draft, robot = described(model)
    assert any("given conaffinity 1" in mend for mend in draft.mends)
    physics, _ = default_pose(robot)
    assert (physics.geom_conaffinity == 1).all() and not physics.geom_contype.any()
    assert {len(sole) for sole in robot.soles} == {5}, "four balls, and the box 12 mm above their underside"
