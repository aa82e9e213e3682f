"""A robot of one's own: from a model to a description, a check, and a score."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from gaitgauge.robots import load_robot
from gaitgauge.robots.checks.examining import examine

sys.path.insert(0, str(Path(__file__).parents[1] / "robots"))

from stick_robot import write_stick
from unseen_robot import LEGS, write_unseen

pytestmark = pytest.mark.usefixtures("robots_are_tried_here")


@pytest.fixture
def model(tmp_path):
    return write_unseen(tmp_path)


def test_new_and_check(run, model):
    made = run("robot", "new", model, "--out", "mine")
    assert made.exit_code == 0, made.stderr
    assert "wrote mine/robot.toml: unseen, 4 legs, 12 joints" in made.stdout
    assert "parameters.gauge.stiffness = 32.0 (guessed from weight and leg length)" in made.stdout
    assert "gaitgauge robot check mine/robot.toml" in made.stdout
    robot = load_robot(Path("mine"))
    assert robot.mjcf.resolve() == model.resolve()
    assert robot.foot_names == tuple(f"sole of {leg}" for leg in ("fore_left", "fore_right", "hind_left", "hind_right"))
    assert set(robot.collision_bodies) == {"corpus", *(f"{p}.{leg[0]}" for p in ("femur", "tibia") for leg in LEGS)}
    before = sorted(Path().rglob("*"))
    checked = run("robot", "check", "mine", "--json")
    assert checked.exit_code == 0 and sorted(Path().rglob("*")) == before, "a check writes nothing unless asked"
    found = json.loads(checked.stdout)
    assert found["sound"] and found["picture"] is None
    rows = {row["check"]: row for row in found["checks"]}
    assert rows["standing"]["sentence"].startswith("stands in its default pose: after 2 s its base is 0.38")
    assert [name for name, row in rows.items() if not row["passed"]] == ["SDK order"]
    assert rows["SDK order"]["needed_for"] == "export of a deploy.yaml"


@pytest.mark.slow
def test_a_bare_process_has_loaded_what_its_enclosed_one_calls(tmp_path):
    """The enclosed one cannot read the package's own files, and a test's process has loaded more than a user's."""
    program = [sys.executable, "-m", "gaitgauge.cli.main", "robot"]
    for words, said in (
        (["new", write_stick(tmp_path), "--out", "mine"], "wrote mine/robot.toml: stick, 4 legs, 12 joints"),
        (["check", "mine"], "the robot is sound"),
        (["check", "go2"], "the robot is sound"),
    ):
        done = subprocess.run([*program, *words], cwd=tmp_path, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stdout + done.stderr
        assert said in done.stdout


def test_nothing_that_was_there_is_lost(refused, run, model):
    """The model with names replaced another file, and a failure took the earlier description with it."""
    text = model.read_text()
    model.write_text(text.replace('name="sole of hind_left"', ""))
    named = model.with_name(f"{model.stem}-named.xml")
    named.write_text("years of work")
    assert f"'{named}' already exists" in refused("robot", "new", model)
    assert named.read_text() == "years of work" and not (model.parent / "robot.toml").exists()
    (model.parent / "robot.toml").write_text("more years of work")
    model.write_text(text.replace('name="sole of hind_left"', "").replace("unseen", "un&#10;seen"))
    assert "title is 'un\\nseen'" in refused("robot", "new", model, "--force")
    assert named.read_text() == "years of work"
    assert (model.parent / "robot.toml").read_text() == "more years of work"
    model.write_text(text)
    assert run("robot", "new", model, "--force").exit_code == 0


@pytest.mark.parametrize("options", [(), ("--force",)])
def test_a_model_by_the_name_of_the_description_is_not_replaced(refused, model, options):
    model = model.rename(model.with_name("robot.toml"))
    before = model.read_bytes()
    assert "would be replaced by the description" in refused("robot", "new", model, *options)
    assert model.read_bytes() == before


@pytest.mark.parametrize("name", ["home&#10;imu_site = &quot;x&quot;&#10;#", "home\u2028", "home\x7f"])
def test_a_keyframe_s_name_is_no_line_of_the_description(run, model, name):
    """Where the pose comes from stands in a comment, which a line's end ends."""
    pose = "0 0 0.4 1 0 0 0" + " 0" * 12
    key = f'<keyframe><key name="{name}" qpos="{pose}"/></keyframe></mujoco>'
    model.write_text(model.read_text().replace("</mujoco>", key))
    made = run("robot", "new", model, "--out", "mine")
    assert made.exit_code == 0, made.stderr
    assert "imu_site" not in tomllib.loads(Path("mine/robot.toml").read_text())
    assert "keyframe 'home" in Path("mine/robot.toml").read_text()


def test_a_description_is_not_replaced_unasked(refused, run, model):
    assert run("robot", "new", model).exit_code == 0  # beside the model
    assert refused("robot", "new", model).startswith(f"'{model.parent}/robot.toml' already exists; give another folder")
    assert run("robot", "new", model, "--force", "--name", "Old Rover").exit_code == 0
    assert load_robot(model.parent).name == "old-rover"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("<freejoint/>", ""), "has a fixed base: no joint is free; give its body 'corpus' a <freejoint/>"),
        (
            ('<joint name="spread.fore_left"', '<joint type="slide" name="x"/><joint name="spread.fore_left"'),
            "'x', which is no hinge",
        ),
        (("</mujoco>", ""), "is not XML"),
    ],
)
def test_a_failed_try_leaves_nothing_that_refuses_the_second(refused, run, model, change, message):
    whole = model.read_text()
    assert change[0] in whole
    model.write_text(whole.replace(*change))
    assert message in refused("robot", "new", model, "--out", "mine")
    assert not Path("mine").exists()
    model.write_text(whole)
    assert run("robot", "new", model, "--out", "mine").exit_code == 0


def test_shapes_without_names_are_given_some(run, model):
    model.write_text(model.read_text().replace('name="shell" ', "").replace('name="sole of hind_left" ', ""))
    made = run("robot", "new", model, "--out", "mine")
    assert made.exit_code == 0, made.stderr
    robot = load_robot("mine/robot.toml")
    assert robot.mjcf == Path("mine/unseen-named.xml").resolve()
    assert robot.trunk_shapes == ("corpus_trunk",)
    assert robot.foot_names[2] == "tibia.hind_left_foot"
    assert all(f.passed for f in examine(robot) if f.needed_for == "everything")


def test_a_model_with_names_finds_its_meshes(run, model):
    """The copy lies in another folder than the meshes."""
    meshes = model.parent / "meshes"
    meshes.mkdir()
    (meshes / "part.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    text = model.read_text().replace('angle="radian"', 'angle="radian" meshdir="meshes"').replace('name="shell" ', "")
    asset = '<asset><mesh name="part" file="part.obj" scale="0.1 0.1 0.1"/></asset><worldbody>'
    seen = '<freejoint/><geom type="mesh" mesh="part" contype="0" conaffinity="0" mass="0"/>'
    model.write_text(text.replace("<worldbody>", asset).replace("<freejoint/>", seen))
    made = run("robot", "new", model, "--out", "robots/mine")
    assert made.exit_code == 0, made.stderr
    assert 'meshdir="../../meshes' in Path("robots/mine/unseen-named.xml").read_text()
    assert all(f.passed for f in examine(load_robot("robots/mine/robot.toml")) if f.needed_for == "everything")


def test_a_keyframe_is_the_pose(run, model):
    angles = " ".join(f"0 {-leg[1] * leg[4] * 0.4:g} {leg[1] * leg[5] * 0.8:g}" for leg in LEGS)
    key = f'<keyframe><key name="home" qpos="0 0 0.5 1 0 0 0 {angles}"/></keyframe></mujoco>'
    model.write_text(model.read_text().replace("</mujoco>", key))
    assert run("robot", "new", model, "--out", "mine").exit_code == 0
    robot = load_robot("mine/robot.toml")
    pose = dict(zip(robot.joint_names, robot.default_joint_position, strict=True))
    assert {abs(angle) for name, angle in pose.items() if name.startswith("bend")} == {0.8}
    assert "of the model's keyframe 'home'" in Path("mine/robot.toml").read_text()


def test_what_is_wrong_is_said_and_ends_with_1(run, model):
    run("robot", "new", model, "--out", "mine")
    path = Path("mine/robot.toml")
    text = path.read_text()
    path.write_text(text.replace("stiffness = 32.0", "stiffness = 1.0"))
    weak = run("robot", "check", "mine")
    assert weak.exit_code == 1
    assert "FAIL  standing: it does not stand: after 2 s its base is" in weak.stdout
    assert "the robot cannot be used yet" in weak.stdout
    path.write_text(text.replace("base_body", "base_bodi"))
    unread = run("robot", "check", "mine")
    assert unread.exit_code == 1
    assert "FAIL  description: robot file 'mine/robot.toml': " in unread.stdout and "base_bodi" in unread.stdout


def test_the_picture_is_a_png(refused):
    assert (
        refused("robot", "check", "go2", "--picture", "x.jpg") == "--picture is 'x.jpg'; give a file that ends in .png"
    )


@pytest.mark.slow
def test_an_unseen_robot_goes_from_its_model_to_a_score_in_five_commands(run, model):
    """And nobody has to say again which robot it is, even when its files are gone."""
    description = "robots/unseen/robot.toml"
    small = ("--backend", "mujoco", "--device", "cpu", "--num-envs", 4, "--iterations", 2, "--no-score", "--no-film")
    for words in (
        ("robot", "new", model, "--out", "robots/unseen"),
        ("robot", "check", description),
        ("train", "go2-flat", "--robot", description, *small),
        ("evaluate", "latest", "--suite", "demo", "--terrain", "flat", "--out", "results/unseen"),
        ("export", "latest"),
    ):
        done = run(*words)
        assert done.exit_code == 0, f"{words}: {done.output}"
    results = json.loads(Path("results/unseen/results.json").read_text())
    assert results["robot"] == "unseen" and 0.0 <= results["score"] <= 1.0
    remembered = results["policy"]["provenance"]["robot"]
    assert remembered["source"] == str(Path(description).absolute()) and "files" not in remembered
    (folder,) = Path("logs/rsl_rl/unseen_flat").iterdir()
    assert (folder / "exported" / "policy.onnx").is_file() and not (folder / "exported" / "deploy.yaml").exists()
    Path(description).unlink()
    again = run("evaluate", "latest", "--suite", "demo", "--terrain", "flat", "--out", "results/again")
    assert again.exit_code == 0, again.output
    assert "the robot is the copy that the policy carries" in again.stderr
    assert json.loads(Path("results/again/results.json").read_text())["score"] == results["score"]


def test_a_description_whose_guesses_stay_is_not_written(run, model):
    assert run("robot", "new", model, "--out", "mine").exit_code == 0
    file = Path("mine/robot.toml")
    file.write_text(f"# owner: me\n{file.read_text()}# the end\n")
    before = file.read_text()
    done = run("robot", "guess", file)
    assert "every guess stays" in done.stdout and file.read_text() == before


@pytest.mark.parametrize("end", ["npz", "toml"])
def test_a_motor_s_files_are_not_replaced_unasked(refused, tmp_path, end):
    (tmp_path / f"network.{end}").write_text("mine")
    words = ("robot", "motor", tmp_path / "net.pt", "go2", "--out", tmp_path)
    assert f"network.{end}' already exists" in refused(*words) and "--force" in refused(*words)
    assert "already exists" not in refused(*words, "--force")
    assert (tmp_path / f"network.{end}").read_text() == "mine"
