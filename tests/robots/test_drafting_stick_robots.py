"""A first description of a robot whose legs end in whole shanks, without motors: where its feet are, and that it stands."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from gaitgauge.robots import Robot
from gaitgauge.robots.anatomy.body_plan import body_plan, default_pose
from gaitgauge.robots.checks.examining import examine
from gaitgauge.robots.describing.drafting import Draft, draft_robot
from gaitgauge.robots.loading import load_robot_file
from stick_robot import LINK, MASS, PLATE, RADIUS, SHANKS, write_stick
from unseen_robot import write_unseen

pytestmark = pytest.mark.usefixtures("robots_are_tried_here")


def described(model: Path) -> tuple[Draft, Robot]:
    """The first description of a model, and the robot that it is."""
    draft, home = draft_robot(model), model.parent
    mjcf = model.name
    if draft.model:
        mjcf = "named.xml"
        (home / mjcf).write_text(draft.model)
    (home / "robot.toml").write_text(draft.text(mjcf))
    return draft, load_robot_file(home / "robot.toml")


def failures(robot: Robot) -> dict[str, str]:
    return {f.check: f.sentence for f in examine(robot) if not f.passed and f.check != "SDK order"}


@pytest.mark.parametrize(
    ("shank", "below_end"),
    # by hand: round a stick's end, 1.25 times as wide; half a width back from a flat end, with its corners inside
    [
        ("capsule", 0.0),
        pytest.param("ellipsoid", -RADIUS, marks=pytest.mark.slow),
        pytest.param("cylinder", -RADIUS / 2, marks=pytest.mark.slow),
        ("box", -np.sqrt(2) * RADIUS / 2),
    ],
)
def test_a_leg_that_ends_in_a_stick_gets_a_foot_at_its_end(tmp_path, shank, below_end):
    draft, robot = described(write_stick(tmp_path, SHANKS[shank]))
    assert not failures(robot)
    model, _ = default_pose(robot)
    for name in robot.foot_names:
        foot = model.geom(name)
        assert foot.type == mujoco.mjtGeom.mjGEOM_SPHERE
        np.testing.assert_allclose(foot.pos, (0.0, 0.0, -LINK - below_end), atol=1e-4)
        assert foot.size[0] == pytest.approx(1.25 * (np.sqrt(2) if shank == "box" else 1.0) * RADIUS, abs=1e-4)
    plan = body_plan(robot)
    assert plan.mass == pytest.approx(MASS, abs=1e-6), "feet are added without a mass"
    assert plan.leg_length == pytest.approx(2 * LINK + below_end, abs=1e-3)
    assert {f"{leg}_shank" for leg in ("fl", "fr", "rl", "rr")} < set(robot.collision_bodies)
    (guess,) = (guess for guess in draft.guesses if guess.startswith("foot_names"))
    assert "spheres added at the ends of shapes that are a whole shank" in guess


def test_the_end_of_a_mesh_is_where_its_points_are(tmp_path):
    """A tapered shank, 0.1 m wide at the knee and 0.02 m at its end."""
    _, robot = described(write_stick(tmp_path, SHANKS["mesh"]))
    assert not failures(robot)
    model, _ = default_pose(robot)
    for name in robot.foot_names:
        tip = np.sqrt(2) * 0.01
        np.testing.assert_allclose(model.geom(name).pos, (0.0, 0.0, -LINK + tip / 2), atol=1e-3)
        assert model.geom(name).size[0] == pytest.approx(1.25 * tip, abs=1e-3)


@pytest.mark.parametrize("make", [write_unseen, lambda folder: write_stick(folder, SHANKS["capsule"] + PLATE)])
def test_feet_that_are_there_are_taken(tmp_path, make):
    """Spheres; plates, which are long across the shank."""
    model = make(tmp_path)
    draft, robot = described(model)
    assert not failures(robot)
    assert mujoco.MjModel.from_xml_path(str(model)).ngeom == mujoco.MjModel.from_xml_path(str(robot.mjcf)).ngeom
    assert "added" not in " ".join(draft.guesses)


def test_a_foot_meets_the_ground_as_its_shank_does(tmp_path):
    """Whatever the model's defaults make of a shape that says nothing."""
    defaults = '<default><geom contype="0" conaffinity="0" friction="0.1" mass="3"/></default>'
    shank = SHANKS["capsule"].replace("/>", ' contype="1" conaffinity="2" friction="0.9 0.01 0.001" condim="6"/>')
    model = write_stick(tmp_path, shank, default=defaults)
    text = model.read_text()
    model.write_text(text.replace('<geom type="box" size="0.2', '<geom contype="1" type="box" size="0.2'))
    _, robot = described(model)
    foot = default_pose(robot)[0].geom(robot.foot_names[0])
    assert (foot.contype, foot.conaffinity, foot.condim) == (1, 2, 6)
    np.testing.assert_allclose(foot.friction, (0.9, 0.01, 0.001))
    assert body_plan(robot).mass == pytest.approx(MASS, abs=1e-6)


def test_a_foot_that_is_a_whole_shank_is_noted(tmp_path):
    """Where somebody describes the robot by hand."""
    model = write_stick(tmp_path)
    text = model.read_text()
    for leg in ("fl", "fr", "rl", "rr"):
        head, tail = text.split(f'<joint name="{leg}_knee"')
        text = f'{head}<joint name="{leg}_knee"' + tail.replace("<geom ", f'<geom name="{leg}_stick" ', 1)
    model.write_text(text)
    described(model)
    path = model.parent / "robot.toml"
    path.write_text(
        path.read_text().replace("_shank_foot", "_stick").replace("named.xml", model.name).replace("_trunk", "_box")
    )
    model.write_text(text.replace('<geom type="box"', '<geom name="trunk_box" type="box"', 1))
    found = {f.check: f for f in examine(load_robot_file(path))}
    note = found["foot shapes"]
    assert not note.passed and note.needed_for != "everything"
    assert note.sentence.startswith(
        "the foot 'fl_stick' is 0.24 m long: its centre, which counts as the foot's position, is 0.1"
    )
    assert "add a small sphere at its end" in note.sentence


def test_stiffness_is_raised_until_the_robot_stands(tmp_path):
    """0.3 of weight and leg length, 8.8 N·m/rad, lets this one sink to half its height."""
    draft, robot = described(write_stick(tmp_path, SHANKS["capsule"] + PLATE))
    assert robot.parameters["gauge"].stiffness[0] in (18.0, 35.0, 70.0)
    assert robot.parameters["gauge"].damping[0] == pytest.approx(robot.parameters["gauge"].stiffness[0] / 40, rel=0.05)
    (guess,) = (guess for guess in draft.guesses if "stiffness =" in guess)
    assert "raised from 8.8, with which it does not stand well" in guess
    assert not failures(robot)


def test_what_does_not_stand_whatever_its_stiffness_is_said(tmp_path):
    """Motors of 0.3 N·m cannot carry 73 N on legs of 0.4 m."""
    model = write_stick(tmp_path)
    model.write_text(model.read_text().replace("<joint ", '<joint actuatorfrcrange="-0.3 0.3" '))
    draft, robot = described(model)
    (guess,) = (guess for guess in draft.guesses if "stiffness =" in guess)
    assert "it does not stand well with it" in guess and "torque_limit" in guess
    assert robot.parameters["gauge"].stiffness[0] == 8.6, "the first guess is as good as any"
    assert "standing" in failures(robot)


def test_actuators_that_a_sensor_reads_do_not_stand_in_the_way(tmp_path):
    model = write_stick(tmp_path)
    motors = "".join(
        f'<motor name="{leg}_{kind}" joint="{leg}_{kind}" ctrlrange="-12 12"/>'
        for leg in ("fl", "fr", "rl", "rr")
        for kind in ("abduction", "swing", "knee")
    )
    more = f'<actuator>{motors}</actuator><sensor><actuatorfrc actuator="fl_knee"/></sensor>'
    model.write_text(model.read_text().replace("</mujoco>", f"{more}</mujoco>"))
    _, robot = described(model)
    assert robot.parameters["gauge"].torque_limit == (12.0,) * 12
    assert not failures(robot)


def test_feet_are_found_again_beside_those_that_are_added(tmp_path):
    """One leg has a ball of its own, and one shank has no name."""
    model = write_stick(tmp_path)
    head, tail = model.read_text().split('<joint name="fr_knee"')
    tail = tail.replace(
        "/>\n          </body>",
        f'/><geom name="ball" type="sphere" size="0.025" pos="0 0 {-LINK}" mass="0"/></body>',
        1,
    )
    model.write_text(f'{head}<joint name="fr_knee"{tail}'.replace('<body name="fl_shank"', "<body"))
    draft, robot = described(model)
    assert robot.foot_names[1:] == ("ball", "rl_shank_foot", "rr_shank_foot")
    assert robot.foot_names[0].startswith("body_") and robot.foot_names[0].endswith("_foot")
    assert "3 are small spheres added" in " ".join(draft.guesses)
    assert not failures(robot)
