"""``gaitgauge play``: the loop, the scenery, the keyboard, the browser's shapes, videos, and bad requests."""

import math
import socket
import subprocess
import sys
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from gaitgauge.backends import ResetState
from gaitgauge.cli import scenery
from gaitgauge.cli.browser_viewer import Stage, geom_color, geom_mesh, is_own_request, serve
from gaitgauge.cli.errors import UserError
from gaitgauge.cli.play_session import PlaySession, PlaySettings
from gaitgauge.cli.video import Video, choose_renderer
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.loading import load_policy
from gaitgauge.robots import load_robot
from gaitgauge.terrains.registry import make_terrain

ROBOT = load_robot("go2")


@pytest.fixture
def session(policy):
    def make(terrain: str = "flat", level: int | None = None, friction: float = 0.8) -> PlaySession:
        settings = PlaySettings(
            backend="mujoco", device="cpu", friction=friction, seed=0, suite=load_suite("gaitgauge-1")
        )
        return PlaySession(load_policy(policy), ROBOT, make_terrain(terrain, level), settings)

    return make


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


# ---- scenery --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("terrain", "level"), [("flat", None), ("stairs_fd", 5), ("wave", 4)])
def test_what_is_drawn_stands_where_the_physics_has_it(session, terrain, level):
    played = session(terrain, level)
    for _ in range(5):
        played.step((0.0, 0.0, 0.0))
    model = scenery.visual_model(ROBOT, played.terrain)
    data = mujoco.MjData(model)
    scenery.show(model, data, played.position())
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
    from gaitgauge.cli.gamepad import Gamepad

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
    from gaitgauge.cli.gamepad import Gamepad

    driver = FakePads([False])
    with pytest.raises(UserError, match="there is no gamepad"):
        Gamepad((1.0, 1.0, 1.0), driver)
    assert driver.ended
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(UserError, match=r"gaitgauge\[gamepad\]"):
        Gamepad((1.0, 1.0, 1.0))
    assert "--viewer native" in refused("play", policy, "--viewer", "viser", "--gamepad")


# ---- browser --------------------------------------------------------------------------------------------------------


def test_surfaces_of_geoms():
    text = """<mujoco><asset><material name="red" rgba="1 0 0 1"/><hfield name="f" nrow="3" ncol="4" size="2 1 0.5 0.1"
      elevation="0 0 0 0  0 1 1 0  0 0 0 0"/></asset><worldbody>
      <geom type="box" size="0.1 0.2 0.3" material="red"/><geom type="sphere" size="0.5" rgba="0 0.2 1 1"/>
      <geom type="ellipsoid" size="0.1 0.2 0.3"/><geom type="cylinder" size="0.1 0.5"/><geom type="capsule" size="0.1 0.5"/>
      <geom type="hfield" hfield="f"/><geom type="plane" size="1 1 1"/></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)
    meshes = [geom_mesh(model, i) for i in range(model.ngeom)]
    extents = [None if m is None else m.bounds[1] - m.bounds[0] for m in meshes]
    wanted = [(0.2, 0.4, 0.6), (1, 1, 1), (0.2, 0.4, 0.6), (0.2, 0.2, 1.0), (0.2, 0.2, 1.2), (4.0, 2.0, 0.5)]
    for found, expected in zip(extents[:6], wanted, strict=True):
        np.testing.assert_allclose(found, expected, atol=0.01)
    assert meshes[6] is None
    for solid in meshes[:5]:
        np.testing.assert_allclose(solid.center_mass, 0.0, atol=0.01)
    assert (meshes[5].face_normals[:, 2] > 0).all()
    assert geom_color(model, 0) == (255, 0, 0)
    assert geom_color(model, 1) == (0, 51, 255)


def test_page_is_served_and_ends(session, monkeypatch):
    moved = []
    monkeypatch.setattr(Stage, "move", lambda self, data: moved.append(data.qpos[2]))
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        port = probe.getsockname()[1]
    serve(session(), (0.0, 0.0, 0.0), 0.1, port, "127.0.0.1")
    assert len(moved) == 2


def test_only_this_machine_and_only_the_own_page(session, monkeypatch):
    """The page listened on every interface and took any origin."""
    from http.client import HTTPConnection

    answers = {}

    def ask(name: str, **headers: str) -> None:
        connection = HTTPConnection("127.0.0.1", port, timeout=10)
        upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
        key = {"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Protocol": "viser-v0"}
        connection.request("GET", "/", headers=upgrade | key | headers)
        answers[name] = connection.sock and connection.getresponse().status
        connection.close()

    def look(self, data):
        if answers:
            return
        own = f"localhost:{port}"
        ask("own page", Host=own, Origin=f"http://{own}")
        ask("no browser", Host=own)
        ask("other page", Host=own, Origin="http://evil.example")
        ask("other name", Host=f"evil.example:{port}", Origin=f"http://evil.example:{port}")
        others = [a[4][0] for a in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)]
        for address in (a for a in others if not a.startswith("127.")):
            with pytest.raises(OSError):
                socket.create_connection((address, port), timeout=5).close()

    monkeypatch.setattr(Stage, "move", look)
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        port = probe.getsockname()[1]
    serve(session(), (0.0, 0.0, 0.0), 0.1, port, "127.0.0.1")
    assert answers == {"own page": 101, "no browser": 101, "other page": 403, "other name": 403}


def test_requests_from_other_machines_are_welcome_where_asked_for():
    page = {"Host": "robot.lan:8080", "Origin": "http://robot.lan:8080"}
    assert is_own_request(page, "0.0.0.0")
    assert not is_own_request(page, "127.0.0.1")
    assert not is_own_request(page | {"Origin": "http://evil.example"}, "0.0.0.0")


# ---- video ----------------------------------------------------------------------------------------------------------


def test_video_file_is_whole_or_not_there(tmp_path):
    import imageio.v3 as imageio

    path = tmp_path / "walk.mp4"
    with Video(path, fps=25, width=64, height=48) as video:
        for i in range(10):
            video.add(np.full((48, 64, 3), 20 * i, dtype=np.uint8))
    frames = imageio.imread(path, plugin="FFMPEG")
    assert frames.shape == (10, 48, 64, 3)
    assert frames[9].mean() > frames[0].mean() + 100
    with pytest.raises(RuntimeError, match="gone"), Video(tmp_path / "half.mp4", fps=25, width=64, height=48) as video:
        video.add(np.zeros((48, 64, 3), dtype=np.uint8))
        raise RuntimeError("gone")
    assert [f.name for f in tmp_path.glob("*.mp4")] == ["walk.mp4"]


def test_machine_without_a_renderer(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setattr(subprocess, "run", lambda *a, **k: subprocess.CompletedProcess(a, 1))
    with pytest.raises(UserError, match="MUJOCO_GL=osmesa does not draw"):
        choose_renderer()
    monkeypatch.delenv("MUJOCO_GL")
    with pytest.raises(UserError, match="neither EGL nor OSMesa draws"):
        choose_renderer()


@pytest.mark.slow
def test_video_of_a_walk(policy, tmp_path, monkeypatch):
    import imageio.v3 as imageio

    try:
        monkeypatch.setenv("MUJOCO_GL", choose_renderer())
    except UserError as error:
        pytest.skip(str(error))
    path = tmp_path / "walk.mp4"
    # In a process of its own: MuJoCo chooses the renderer when it is imported.
    command = [sys.executable, "-m", "gaitgauge.cli.main", "play", str(policy), "--terrain", "wave", "--level", "3"]
    command += ["--out", str(path), "--seconds", "0.2"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert str(path) in done.stdout.replace("\n", "")
    frames = imageio.imread(path, plugin="FFMPEG")
    assert frames.shape == (5, 720, 1280, 3)
    middle, sky = frames[2][200:550, 400:900], frames[2][:60]
    assert middle.std() > 20, "no robot in the middle"
    assert sky[..., 2].mean() > sky[..., 0].mean() + 20, "no blue sky"


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


def test_video_into_a_wrong_file(refused, policy, monkeypatch):
    from gaitgauge.cli import play

    monkeypatch.setattr(play, "choose_renderer", lambda: "egl")
    assert ".mp4" in refused("play", policy, "--out", "walk.avi")
    assert "nowhere" in refused("play", policy, "--out", "nowhere/walk.mp4")
