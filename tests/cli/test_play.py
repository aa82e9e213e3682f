"""``gaitgauge play``: the loop, the scenery, the keyboard, the gamepad, and bad requests."""

import math
import sys
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from gaitgauge.backends import ResetState
from gaitgauge.cli import doctor, play, scenery
from gaitgauge.cli.picture import PLAIN, show
from gaitgauge.cli.play_session import beyond
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.native import save_policy
from gaitgauge.robots import load_robot
from gaitgauge.robots.anatomy.body_plan import model_joint_order
from gaitgauge.terrains.registry import make_terrain

ROBOT = load_robot("go2")


# ---- the loop -------------------------------------------------------------------------------------------------------


def test_standing_policy_stands(session):
    played = session()
    for _ in range(50):
        played.step((0.0, 0.0, 0.0))
    assert played.time == pytest.approx(1.0)
    assert played.falls == 0
    assert played.tilt < 0.1
    height = played.position()[2]
    assert 0.2 < height < 0.4
    assert len(played.position()) == 7 + ROBOT.num_joints


def test_world_is_that_of_the_suite(session, tmp_path):
    suite = tmp_path / "coarse.toml"
    suite.write_text('extends = "gaitgauge-1"\nname = "coarse"\nphysics = { timestep = 0.005 }\n')
    assert session().backend.scene.physics.substeps == 0.02 / load_suite("gaitgauge-1").physics.timestep
    assert session(suite=str(suite)).backend.scene.physics.substeps == 4


def test_a_measured_delay_acts_as_it_does_in_the_gauge(session, monkeypatch):
    played = session(parameters="identified")
    seen = []
    step = played.backend.step
    monkeypatch.setattr(
        played.backend,
        "step",
        lambda *given, delay=None, **more: seen.append(delay) or step(*given, delay=delay, **more),
    )
    played.step((0.0, 0.0, 0.0))
    physics, late = played.backend.scene.physics, played.backend.scene.parameters.delay
    assert [each.tolist() for each in seen] == [[round(late / physics.timestep)]]


def test_world_has_the_parameter_set_that_was_asked_for(session):
    played = session(parameters="identified").backend.scene.parameters
    assert played.armature == ROBOT.parameters["identified"].armature != ROBOT.parameters["gauge"].armature


def test_fallen_robot_is_shown_and_starts_again(session):
    played = session()
    side = torch.tensor([[math.cos(math.pi / 4), math.sin(math.pi / 4), 0.0, 0.0]], dtype=torch.float64)
    played.backend.reset(
        ResetState(base_position=torch.tensor([[1.0, 0.0, 0.2]], dtype=torch.float64), base_quaternion=side)
    )
    played.step((0.0, 0.0, 0.0))
    assert played.falls == 0
    for _ in range(60):
        played.step((0.0, 0.0, 0.0))
    assert played.falls == 1
    assert abs(played.position()[0]) < 0.2


def test_a_robot_that_falls_at_once_is_named_with_what_tries_why(session, caplog):
    played = session()
    side = torch.tensor([[math.cos(math.pi / 4), math.sin(math.pi / 4), 0.0, 0.0]], dtype=torch.float64)
    place = torch.tensor([[1.0, 0.0, 0.2]], dtype=torch.float64)
    for _ in range(2):
        played.backend.reset(ResetState(base_position=place, base_quaternion=side))
        for _ in range(60):
            played.step((0.0, 0.0, 0.0))
    said = [m for m in caplog.messages if "falls at once" in m]
    assert len(said) == 1
    assert "gaitgauge doctor" in said[0]


def test_robot_at_the_target_starts_again(session):
    played = session("stairs_fd", 3)
    x, y, z = played.terrain.target
    near = torch.tensor([[x + 0.05, y, z + 0.3]], dtype=torch.float64)
    played.backend.reset(
        ResetState(base_position=near, base_quaternion=torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64))
    )
    played.step((0.0, 0.0, 0.0))
    assert played.arrivals == 1
    assert played.target_distance > 2.0


def test_own_way_leads_to_the_target_forward_and_backward(session):
    for terrain, sign in (("stairs_fd", 1.0), ("stairs_bd", -1.0)):
        forward, _, yaw = session(terrain, 2).autopilot()
        assert forward * sign == pytest.approx(load_suite("gaitgauge-1").commands.target_speed["stairs"])
        assert abs(yaw) < 0.2


def test_tour_shows_every_direction_within_the_limits(session):
    played = session()
    commands = []
    for seconds in np.arange(0.5, 17.0, 0.1):
        played.since_reset = float(seconds)
        commands.append(played.autopilot())
    values = np.array(commands)
    assert (np.abs(values) <= np.array(played.limits) + 1e-9).all()
    assert (values.max(axis=0) > 0.5).all()
    assert values[:, 0].min() < -0.5
    assert (values == 0.0).all(axis=1).any()


def test_commands_reach_as_far_as_the_policys_contract_and_clipping_is_said(session):
    """A command of 4 m/s became 2 m/s in silence; on stairs it became 1 m/s, which the policy was not made for either."""
    played = session("stairs_fd", 3)
    assert played.limits == (2.0, 1.0, 2.0)
    sentence = beyond((4.0, -0.5, -3.0), played.limits)
    assert sentence == (
        "the policy's contract clips the command: forward 4 m/s (it was made for at most 2), "
        "turning -3 rad/s (it was made for at most 2)"
    )
    assert beyond((2.0, -1.0, 2.0), played.limits) is None
    for _ in range(25):
        played.step((4.0, -0.5, -3.0))
    assert played.readout().command == (2.0, -0.5, -2.0)


def test_policies_are_played_with_the_gains_that_the_gauge_plays_them_with(session, contract, stored, tmp_path):
    """Play took the robot's own gains where the suite takes those of the policy's contract."""
    path = tmp_path / "soft.gauge.pt"
    soft = replace(contract, stiffness=(5.0,) * ROBOT.num_joints)
    save_policy(path, soft, stored)
    heights = []
    for played in (session(), session(policy=path)):
        for _ in range(50):
            played.step((0.0, 0.0, 0.0))
        heights.append(played.position()[2])
    assert heights[1] < heights[0] - 0.05, "a robot with a quarter of the stiffness sags"


def test_measured_speed_is_in_the_robots_heading_and_friction_acts(session):
    played = session()
    turned = torch.tensor([[math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4)]], dtype=torch.float64)  # faces +y
    state = ResetState(
        base_position=torch.tensor([[0.0, 0.0, 5.0]], dtype=torch.float64),  # in free fall nothing brakes
        base_quaternion=turned,
        base_linear_velocity=torch.tensor([[0.3, 1.2, 0.0]], dtype=torch.float64),
    )
    played.backend.reset(state)
    for _ in range(45):
        played.step((0.0, 0.0, 0.0))
    share = 1.0 - (1.0 - 0.02 / 0.3) ** 45  # of an exponential average over 0.3 s after 45 steps of 20 ms
    forward, lateral, _ = played.readout().speed
    assert (forward, lateral) == (pytest.approx(1.2 * share, abs=0.1), pytest.approx(-0.3 * share, abs=0.1))
    played.set_friction(0.25)
    assert played.readout().friction == 0.25


def test_joints_are_drawn_where_they_are_whatever_the_order_of_the_description(session):
    """The order of a description need not be that of the model's file, in which a pose is drawn."""
    shuffled = ROBOT.joint_names[::-1]
    pose = tuple(ROBOT.default_joint_position[ROBOT.joint_names.index(n)] for n in shuffled)
    assert model_joint_order(ROBOT) == list(range(12))
    assert model_joint_order(replace(ROBOT, joint_names=shuffled, default_joint_position=pose)) == list(
        range(11, -1, -1)
    )
    played = session()
    played._model_order = list(range(11, -1, -1))
    np.testing.assert_array_equal(played.position()[7:], played.state.joint_position[0].flip(0).numpy())


# ---- scenery --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("terrain", "level"), [("flat", None), ("stairs_fd", 5), ("wave", 4)])
def test_what_is_drawn_stands_where_the_physics_has_it(session, terrain, level):
    played = session(terrain, level)
    for _ in range(5):
        played.step((0.0, 0.0, 0.0))
    model = scenery.visual_model(ROBOT, played.terrain)
    data = mujoco.MjData(model)
    show(model, data, played.position())
    feet = np.array([data.site(name).xpos for name in ROBOT.foot_names])
    np.testing.assert_allclose(feet, played.state.foot_position_w[0].numpy(), atol=2e-3)


def test_drawn_ground_is_the_terrains():
    for name, level in (("obstacle", 6), ("wave", 5), ("slope_fd", 4)):
        terrain = make_terrain(name, level)
        model = scenery.visual_model(ROBOT, terrain)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        group = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)
        for x in np.linspace(0.5, 9.5, 12):
            above = np.array([x, 0.7, 20.0])
            distance = mujoco.mj_ray(
                model, data, above, np.array([0.0, 0.0, -1.0]), group, 1, -1, np.zeros(1, np.int32)
            )
            assert 20.0 - distance == pytest.approx(float(terrain.height(x, 0.7)), abs=5e-3), (name, x)


def test_fewer_nodes_are_drawn_where_they_show_the_same_ground():
    wave = make_terrain("wave", 5).height_field.heights
    assert scenery.drawn_heights(wave, 64).shape == (64, 64)
    np.testing.assert_allclose(scenery.drawn_heights(wave, 1024), wave)
    stones = np.random.default_rng(0).uniform(0.0, 0.1, (128, 128))
    assert scenery.drawn_heights(stones, 64) is stones


def test_collision_shapes_are_not_drawn_and_the_robot_is():
    model = scenery.visual_model(ROBOT, make_terrain("flat", None))
    groups = set(model.geom_group.tolist())
    assert scenery.VISUAL_GROUP in groups
    assert scenery.COLLISION_GROUP not in groups


# ---- keyboard -------------------------------------------------------------------------------------------------------


def test_keys():
    from gaitgauge.cli.native_viewer import Keyboard

    keyboard = Keyboard((0.25, 0.5, 1.0), None)
    keyboard.press(ord("W"))  # one of the viewer's own
    assert keyboard.command is None
    for _ in range(4):
        keyboard.press(265)
    assert keyboard.command == (0.25, 0.0, 0.0)
    keyboard.press(263)
    keyboard.press(269)
    assert keyboard.command == (0.25, -0.1, 0.25)
    keyboard.press(257)
    assert keyboard.command == (0.0, 0.0, 0.0)
    keyboard.press(261)
    assert keyboard.command is None
    assert not keyboard.restart
    keyboard.press(260)
    assert keyboard.restart


def test_window_shows_what_is_measured(session):
    from gaitgauge.cli.native_viewer import texts

    names, values = texts(session("wave", 3).readout())
    assert names.split("\n") == ["command", "measured", "standing", ""]
    assert values.split("\n")[0] == "+0.00 forward m/s  +0.00 left m/s  +0.00 turn rad/s"
    assert values.split("\n")[2:] == ["wave level 3", "friction 0.8, 0 falls, 0.0 s"]
    assert (names + values).isascii()


# ---- gamepad --------------------------------------------------------------------------------------------------------


class FakePads:
    """What ``Gamepad`` uses of pygame, with sticks to be set by hand."""

    CONTROLLER_AXIS_LEFTX, CONTROLLER_AXIS_LEFTY, CONTROLLER_AXIS_RIGHTX = 0, 1, 2

    def __init__(self, pads):
        self.sticks, self.ended = {0: 0, 1: 0, 2: 0}, False
        self.display = SimpleNamespace(init=lambda: None)
        self.event = SimpleNamespace(pump=lambda: None)
        pad = SimpleNamespace(get_axis=lambda axis: self.sticks[axis])
        controller = SimpleNamespace(
            init=lambda: None, get_count=lambda: len(pads), is_controller=lambda i: pads[i], Controller=lambda i: pad
        )
        self._sdl2 = SimpleNamespace(controller=controller)

    def quit(self):
        self.ended = True


def test_sticks():
    from gaitgauge.cli.native_viewer import Gamepad

    driver = FakePads([False, True])
    pad = Gamepad((2.0, 1.0, 1.5), driver)
    assert pad.moved() is None, "keys act until a stick moves"
    driver.sticks |= {0: 3000, 1: -32768, 2: 32767}  # a worn stick; up; right
    assert pad.moved() == (2.0, 0.0, -1.5)
    assert pad.moved() is None
    driver.sticks |= {0: -32768, 1: 0, 2: 0}
    assert pad.moved() == (0.0, 1.0, 0.0)
    driver.sticks[0] = -round(0.56 * 32767)
    assert pad.moved()[1] == pytest.approx(0.5, abs=1e-3)
    pad.close()
    assert driver.ended


def test_no_gamepad_and_no_extra(refused, policy, monkeypatch):
    from gaitgauge.cli.errors import UserError
    from gaitgauge.cli.native_viewer import Gamepad

    driver = FakePads([False])
    with pytest.raises(UserError, match="there is no gamepad"):
        Gamepad((1.0, 1.0, 1.0), driver)
    assert driver.ended
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(UserError, match=r"gaitgauge\[gamepad\]"):
        Gamepad((1.0, 1.0, 1.0))
    assert "--viewer native" in refused("play", policy, "--viewer", "viser", "--gamepad")


# ---- bad requests ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("nowhere.pt", "--viewer", "viser"), ("'nowhere.pt'", "pretrained")),
        (("standing.gauge.pt", "--viewer", "vdeo"), ("'vdeo'", "video")),
        (("standing.gauge.pt", "--viewer", "viser", "--out", "a.mp4"), ("--out", "--viewer")),
        (("standing.gauge.pt", "--viewer", "viser", "--terrain", "moon"), ("'moon'", "wave")),
        (("standing.gauge.pt", "--viewer", "viser", "--terrain", "wave", "--level", 12), ("12", "1 to 10")),
        (("standing.gauge.pt", "--viewer", "viser", "--terrain", "flat", "--level", 2), ("flat", "no levels")),
        (("standing.gauge.pt", "--viewer", "viser", "--friction", 0), ("--friction", "0")),
        (("standing.gauge.pt", "--viewer", "viser", "--seconds", 0), ("--seconds", "0")),
        (("standing.gauge.pt", "--viewer", "viser", "--backend", "mujoko"), ("'mujoko'", "mujoco")),
        (("standing.gauge.pt",) * 2 + ("--viewer", "native"), ("one policy", "viser")),
        (("standing.gauge.pt",) * 5 + ("--viewer", "viser"), ("5 policies", "at most 4")),
        (("standing.gauge.pt", "--gif", "walk.avi"), ("--gif", ".gif or .webp")),
        (("standing.gauge.pt", "--gif", "walk.gif", "--seconds", 300), ("300", "60")),
    ],
)
def test_bad_request(refused, policy, arguments, named):
    message = refused("play", *arguments)
    for text in named:
        assert text in message


def test_window_without_a_display(refused, policy, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    message = refused("play", policy, "--viewer", "native")
    assert "viser" in message
    assert "--out" in message


def test_window_on_macos_needs_mjpython(refused, policy, monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.delenv("MJPYTHON_BIN", raising=False)
    assert "mjpython -m gaitgauge.cli.main play POLICY" in refused("play", policy, "--viewer", "native")
    (display,) = doctor.check_display()
    assert display.status == "warning" and "needs mjpython" in display.found
    assert play._viewer(None, [], several=False) == "viser"
    monkeypatch.setenv("MJPYTHON_BIN", "/mjpython")
    assert play._viewer(None, [], several=False) == "native"
    assert next(doctor.check_display()).status == "ok"


def test_a_policy_that_ships_is_named_without_the_folder_of_the_installation(run, tmp_path, monkeypatch):
    monkeypatch.setattr("gaitgauge.cli.play.choose_renderer", lambda: PLAIN)
    monkeypatch.setattr("gaitgauge.cli.recording.record", lambda *a: None)
    shown = run("play", "pretrained", "--gif", tmp_path / "a.gif").stdout.splitlines()[0]
    assert shown.startswith("pretrained on ")


def test_video_into_a_wrong_file(refused, policy):
    assert ".mp4" in refused("play", policy, "--out", "walk.avi")
    assert "nowhere" in refused("play", policy, "--out", "nowhere/walk.mp4")


@pytest.mark.parametrize("speed", ["nan", "inf", "1e300"])
def test_a_speed_that_is_none_is_refused(refused, policy, speed):
    message = refused("play", policy, "--video", "a.mp4", "--command", speed, "0", "0")
    assert message.startswith("--command is ") and "from -100 to 100" in message
