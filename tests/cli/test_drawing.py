"""Pictures of a film in their order, whoever draws them."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from gaitgauge.cli import drawing
from gaitgauge.cli.drawing import Shot, draw, processes_for
from gaitgauge.cli.errors import UserError
from gaitgauge.cli.picture import PLAIN, RICH, Follower, Tile, choose_renderer
from gaitgauge.cli.scenery import visual_model
from gaitgauge.robots import load_robot
from gaitgauge.terrains import make_terrain

TILES = [Tile(model=None, heading=0.0, leg_length=0.4), Tile(model=None, heading=1.0, leg_length=0.4)]


def shots(count):
    for i in range(count):
        yield Shot(poses=[(np.full(19, float(i)), np.zeros(3)), (np.full(19, float(i + 100)), np.zeros(3))], note=i)


def test_tiles_stand_side_by_side_and_pictures_are_drawn_as_they_are_needed(monkeypatch):
    closed, taken = [], []

    class Flat:
        def __init__(self, tile, *, size):
            self.size = size

        def draw(self, position, looks_at):
            return np.full((self.size[1], self.size[0], 3), int(position[0]), dtype=np.uint8)

        def close(self):
            closed.append(self)

    monkeypatch.setattr(drawing, "Picture", Flat)
    for picture, note in draw(TILES, (4, 3), (taken.append(s.note) or s for s in shots(5)), processes=0):
        assert taken == list(range(note + 1))
        assert picture.shape == (3, 8, 3)
        assert (picture[:, :4] == note).all() and (picture[:, 4:] == note + 100).all()
    assert note == 4
    assert len(closed) == 2


def test_processes_are_started_where_they_are_worth_it(monkeypatch):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(2)), raising=False)
    assert [processes_for(n, PLAIN) for n in (20, 99, 100, 5000)] == [0, 0, 2, 2]
    assert processes_for(5000, RICH) == 0, "a GPU draws for one process as fast as for several"
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(64)), raising=False)
    assert processes_for(5000, PLAIN) == 4
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0}, raising=False)
    assert processes_for(5000, PLAIN) == 0


def test_camera_follows_a_walk_and_does_not_fly_back_to_the_start():
    follower, position = Follower(), np.zeros(19)
    assert follower.follow(position, 0.04).tolist() == [0.0, 0.0, 0.06]
    position[0] = 1.0
    assert follower.follow(position, 0.05)[0] == pytest.approx(0.05 / 0.25)
    position[0] = -5.0
    assert follower.follow(position, 0.04)[0] == -5.0


@pytest.fixture
def drawn(monkeypatch):
    """Runs a script that draws in a process of its own, because MuJoCo chooses the renderer when it is imported; its output."""
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.delenv("LP_NUM_THREADS", raising=False)
    try:
        choose_renderer()
    except UserError as error:
        pytest.skip(str(error))

    def run(script: str) -> str:
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-3000:]
        return done.stdout

    return run


@pytest.mark.slow
def test_several_processes_draw_what_one_draws_and_one_that_dies_is_a_sentence(drawn):
    assert drawn(_SCRIPT).startswith("a drawing process ended, perhaps for want of memory")


@pytest.mark.slow
def test_plain_pictures_keep_the_robots_shadow_and_leave_out_that_of_the_ground(drawn):
    drawn(_SHADOWS)


_SHADOWS = """
import numpy as np
from gaitgauge.cli.picture import PLAIN, Picture, Tile
from gaitgauge.cli.scenery import visual_model
from gaitgauge.robots import load_robot
from gaitgauge.terrains import make_terrain
robot = load_robot("go2")
model = visual_model(robot, make_terrain("obstacle", 5), PLAIN)
def drawn(ground_shadows):
    picture = Picture(Tile(model=model, heading=0.0, leg_length=0.4, ground_shadows=ground_shadows), size=(480, 270))
    position = np.array([-1.0, 0.0, 0.4, 1.0, 0.0, 0.0, 0.0, *robot.default_joint_position])
    image = picture.draw(position, np.array([-0.5, 0.0, 0.2])).astype(int).sum(axis=2)
    picture.close()
    return image
all_of_them, robots = drawn(True), drawn(False)
model.light_castshadow[:] = 0
none = drawn(False)
assert (none - robots > 30).sum() > 500, "the robot has a shadow"
assert (robots - all_of_them > 30).sum() > 100, "obstacles have one too where it is asked for"
"""


_SCRIPT = """
import multiprocessing, os, signal
import numpy as np
from gaitgauge.cli.drawing import Shot, draw
from gaitgauge.cli.errors import UserError
from gaitgauge.cli.picture import PLAIN, Tile
from gaitgauge.cli.scenery import visual_model
from gaitgauge.robots import load_robot
from gaitgauge.terrains.registry import make_terrain

tiles = [Tile(model=visual_model(load_robot("go2"), make_terrain("flat"), PLAIN), heading=0.0, leg_length=0.4)]

def shots(count):
    for i in range(count):
        position = np.array([0.1 * i, 0.0, 0.3, 1.0, *[0.0] * 15])
        yield Shot(poses=[(position, position[:3])], note=i)

one = list(draw(tiles, (160, 90), shots(9), 0))
two = list(draw(tiles, (160, 90), shots(9), 2))
assert [note for _, note in two] == list(range(9))
for (a, _), (b, _) in zip(one, two):
    assert np.abs(a.astype(int) - b).mean() < 0.5
assert np.abs(one[0][0].astype(int) - one[8][0]).mean() > 1.0

pictures = draw(tiles, (160, 90), shots(500), 2)
next(pictures)
for child in multiprocessing.active_children():
    os.kill(child.pid, signal.SIGKILL)
try:
    list(pictures)
except UserError as error:
    print(error)
"""


@pytest.mark.parametrize(("dressed", "groups"), [("b", {2, 3}), ("abc", {2})])
def test_shapes_that_collide_are_drawn_where_the_robot_has_few_others(tmp_path, dressed, groups):
    """A model may have visual shapes at its feet alone."""
    bodies = "".join(
        f'<body name="{name}" pos="0 0 {height}"><freejoint/><geom size="0.1" group="3"/>'
        + ('<geom size="0.1" group="2" contype="0" conaffinity="0"/></body>' if name in dressed else "</body>")
        for height, name in enumerate("abc", 1)
    )
    (tmp_path / "robot.xml").write_text(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    model = visual_model(replace(load_robot("go2"), mjcf=tmp_path / "robot.xml"), make_terrain("flat"), PLAIN)
    assert {int(model.geom_group[g]) for g in range(model.ngeom) if model.geom_bodyid[g]} == groups


def test_a_load_is_drawn_in_its_place_and_size():
    robot = load_robot("go2")
    bare, loaded = (visual_model(robot, make_terrain("flat"), PLAIN, load) for load in (None, (8.0, (0.1, -0.05, 0.2))))
    cube = loaded.geom("load")
    base = loaded.body(robot.base_body)
    assert loaded.ngeom == bare.ngeom + 1 and cube.bodyid[0] == base.id
    assert cube.size == pytest.approx([0.1] * 3), "8 kg of water"
    assert cube.pos - base.ipos == pytest.approx([0.1, -0.05, 0.2])
