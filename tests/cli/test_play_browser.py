"""``gaitgauge play`` in a browser: shapes, who is let in, and what is chosen on the page."""

import socket
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from gaitgauge.cli.browser_access import is_own_request
from gaitgauge.cli.browser_stage import Stage, distance_between, geom_color, geom_mesh
from gaitgauge.cli.browser_viewer import Choice, Panel, serve
from gaitgauge.cli.errors import UserError
from gaitgauge.cli.play_session import PlaySession
from gaitgauge.cli.requests import PlayRequest
from gaitgauge.cli.worlds import WorldMaker
from gaitgauge.policy.base import PolicyError
from gaitgauge.terrains.gauge_terrains import LEVELS
from gaitgauge.terrains.registry import make_terrain

MAKER = WorldMaker(PlayRequest(policies=(), device="cpu"))


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return probe.getsockname()[1]


def show(sessions: list[PlaySession], *, port: int, seconds: float = 0.1) -> None:
    """Serve robots that stand."""
    chosen = Choice(terrain="flat", level=None, policies=tuple(str(s.policy.path) for s in sessions))
    serve(sessions, MAKER, chosen, PlayRequest(policies=(), command=(0.0, 0.0, 0.0), seconds=seconds, port=port))


@pytest.mark.parametrize("host", ["", "/dev/zero", "a\nb", "\udcff", "x" * 500, "192.0.2.1"])
def test_what_is_no_interface_of_this_machine_is_refused(session, host):
    """An empty name was every interface, and the others were waited for without an end."""
    chosen = Choice(terrain="flat", level=None, policies=("latest",))
    with pytest.raises(UserError, match=r"cannot be used: .*; choose another --port or --host") as caught:
        serve([session()], MAKER, chosen, PlayRequest(policies=(), seconds=0.1, port=free_port(), host=host))
    assert str(caught.value).isprintable()


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
    move = Stage.move
    monkeypatch.setattr(Stage, "move", lambda self: (moved.append(self.aside), move(self)))
    show([session(), session()], port=free_port())
    assert moved == [0.8, -0.8] * 4, "once when they appear, and every 40 ms for 0.1 s"


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

    def look(self):
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
    port = free_port()
    show([session()], port=port)
    assert answers == {"own page": 101, "no browser": 101, "other page": 403, "other name": 403}


def test_requests_from_other_machines_are_welcome_where_asked_for():
    page = {"Host": "robot.lan:8080", "Origin": "http://robot.lan:8080"}
    assert is_own_request(page, "0.0.0.0")
    assert not is_own_request(page, "127.0.0.1")
    assert not is_own_request(page | {"Origin": "http://evil.example"}, "0.0.0.0")


def test_what_is_chosen_on_the_page_is_played(session, monkeypatch):
    played, refused = [], []
    wishes = iter([("flat", None), ("wave", 3), ("moon", 3), ("stairs_fd", 2)])
    make, panel_refuse = WorldMaker.make, Panel.refuse

    def wish(self) -> Choice:
        terrain, level = next(wishes, ("stairs_fd", 2))
        return Choice(terrain=terrain, level=level, policies=(str(first.policy.path),))

    def step(self, command) -> None:
        played.append((self.readout().place, self.friction))
        self.time += self.period

    first = session()
    monkeypatch.setattr(Panel, "chosen", property(wish))
    monkeypatch.setattr(Panel, "friction", property(lambda self: 0.3))
    monkeypatch.setattr(Panel, "refuse", lambda self, *told: (refused.append(told[0]), panel_refuse(self, *told)))
    monkeypatch.setattr(WorldMaker, "make", lambda self, *choice: make(self, *choice))
    monkeypatch.setattr(PlaySession, "step", step)
    show([first], port=free_port(), seconds=0.16)
    assert list(dict.fromkeys(played)) == [("flat", 0.3), ("wave level 3", 0.3), ("stairs_fd level 2", 0.3)]
    assert len(refused) == 1 and "'moon'" in refused[0], "the page goes on with what it shows"


def test_worlds_stand_close_where_their_ground_looks_as_one():
    assert distance_between(make_terrain("stairs_fd", 4)) == distance_between(make_terrain("flat")) == 1.6
    assert distance_between(make_terrain("wave", 4)) == 10.5, "10 m wide"


def test_missing_policy_is_no_choice(tmp_path, monkeypatch):
    from gaitgauge.cli import browser_viewer

    def find(name: str) -> None:
        if name != "pretrained":
            raise PolicyError("no runs")

    monkeypatch.setattr(browser_viewer, "find_policy", find)
    assert browser_viewer._policies(["mine.pt", "pretrained"]) == ["mine.pt", "pretrained"]


def test_a_page_that_sends_what_was_not_offered_gets_what_was():
    """Menus and sliders hold whatever a client sends: files of this machine, numbers that are none."""
    panel = Panel.__new__(Panel)
    panel._terrains, panel._names, panel._frictions = ["flat", "wave"], ["mine.pt"], (0.1, 1.5)
    panel._reach = (1.0, 0.5, 2.0)
    wave, anything = SimpleNamespace(value="wave"), SimpleNamespace(value="/etc/passwd")
    panel._terrain, panel._policies = wave, [anything]
    panel._level = SimpleNamespace(value=1e9, disabled=False)
    assert panel.chosen == Choice(terrain="wave", level=LEVELS[-1], policies=("mine.pt",))
    panel._terrain, panel._level.value = SimpleNamespace(value="../x"), float("nan")
    assert panel.chosen == Choice(terrain="flat", level=None, policies=("mine.pt",))
    panel._friction, panel.auto = SimpleNamespace(value=float("nan")), SimpleNamespace(value=False)
    assert panel.friction == 0.1
    panel._sliders = [SimpleNamespace(value=v) for v in (float("inf"), float("nan"), -0.5)]
    assert panel.command == (1.0, -0.5, -0.5)
