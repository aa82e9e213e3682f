"""Models of robots that would take all memory or time, or MuJoCo down: each ends in one sentence, outside of this process."""

import ctypes
import os
import resource
import shutil
import time
from pathlib import Path

import mujoco
import pytest
from gaitgauge.robots import RobotError, load_robot, loading
from gaitgauge.robots.checks import apart, checking
from gaitgauge.robots.loading import model_files

GO2 = load_robot("go2").mjcf.parent
TEXT = (GO2 / "go2.xml").read_text()
GEOM = '<geom type="sphere" size="0.01" mass="0" contype="0" conaffinity="0"/>'


def above(text: str) -> str:
    """The Go2 with elements before its bodies."""
    return TEXT.replace("<worldbody>", f"{text}<worldbody>", 1)


def on_base(text: str) -> str:
    """The Go2 with elements on its trunk."""
    return TEXT.replace('<body name="base_link">', f'<body name="base_link">{text}', 1)


@pytest.fixture
def stranger(tmp_path):
    """Writes a robot of somebody else and gives its folder."""

    def write(text: str) -> Path:
        (tmp_path / "go2.xml").write_text(text)
        shutil.copy(GO2 / "robot.toml", tmp_path)
        return tmp_path

    return write


def refused(folder: Path, named: str | None = None) -> str:
    with pytest.raises(RobotError, match=named) as caught:
        load_robot(folder)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 700
    return str(caught.value)


LAUGHS = '<!ENTITY a0 "ha">' + "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 30))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (f"<!DOCTYPE m [{LAUGHS}]>" + TEXT.replace('model="', 'model="&a29;', 1), "defines XML entities"),
        (above('<size memory="900G"/>'), "it may need more memory than there is"),
        (above('<asset><mesh name="m" file="/dev/zero"/></asset>'), "'/dev/zero' is not a regular file"),
        (TEXT + f"<!--{'x' * 4_000_000}-->", "larger than 4 MB"),
    ],
    ids=["entities", "arena", "device", "long"],
)
def test_a_model_that_would_take_all_memory(stranger, text, named):
    folder = stranger(text)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused(folder, named)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + 200_000  # kB, or on macOS bytes


CELLS = "at most 4,000,000 are made"
COMPOSITE = (
    '<composite type="cable" prefix="c" count="{}" size="1" curve="s"><geom type="capsule" size=".01"/></composite>'
)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (
            above('<asset><hfield name="h" nrow="40000" ncol="40000" size="1 1 1 1"/></asset>'),
            f"1,600,000,000.*{CELLS}",
        ),
        (above('<asset><texture type="2d" name="t" builtin="flat" width="60000" height="60000"/></asset>'), CELLS),
        (above('<asset><mesh name="m" builtin="plate" params="20000 20000"/></asset>'), CELLS),
        (above('<asset><hfield name="h" nrow="nan" ncol="2" size="1 1 1 1"/></asset>'), CELLS),
        (
            on_base(f'<replicate count="2500">{GEOM}</replicate>'),
            "geoms or more; at most 2,000 are simulated of a robot",
        ),
        (on_base(f'<replicate count="1000000">{GEOM}</replicate>'), r"1,000,0\d\d geoms or more"),
        (on_base(f'<replicate count="{"9" * 400}">{GEOM}</replicate>'), "inf geoms"),
        (on_base('<replicate count="50">' * 20 + GEOM + "</replicate>" * 20), "elements or more"),
        (on_base('<replicate count="-1000000"><replicate count="-2">' + GEOM + "</replicate></replicate>"), "elements"),
        (
            on_base('<replicate count="9000"><frame><light/></frame></replicate>'),
            "elements or more; at most 10,000 are simulated",
        ),
        (on_base(COMPOSITE.format("1000000 1 1")), "bodies or more"),
        (on_base('<flexcomp name="f" type="grid" count="300 300 300" dim="3"/>'), "27,000,0.. bodies or more"),
        (above('<size nkey="1000000000"/>'), "1,000,000,[0-9]+ elements or more"),
        (on_base(GEOM * 2000), "geoms or more; at most 2,000"),
        (above("<equality>" + '<joint joint1="a"/>' * 60_000 + "</equality>"), "joints or more"),
        ("<mujoco>" + "<body>" * 100_000 + "</body>" * 100_000 + "</mujoco>", "bodies or more"),
    ],
)
def test_a_model_is_counted_before_it_is_made(stranger, monkeypatch, text, named):
    monkeypatch.setattr(checking, "run_apart", lambda *_: pytest.fail("it was compiled"))
    folder, began = stranger(text), time.process_time()
    refused(folder, named)
    assert time.process_time() - began < 2.0


def test_copies_of_an_included_file_are_counted(stranger, monkeypatch):
    monkeypatch.setattr(checking, "run_apart", lambda *_: pytest.fail("it was compiled"))
    folder = stranger(on_base('<replicate count="1000"><include file="parts.xml"/></replicate>'))
    (folder / "parts.xml").write_text(f"<mujoco>{GEOM * 3}</mujoco>")
    refused(folder, r"parts\.xml' has 2,[0-9]+ geoms or more")


def test_a_model_that_is_never_compiled(stranger, monkeypatch):
    monkeypatch.setattr(apart, "COMPUTING_SECONDS", 0)  # 1 s, which the system counts from a process's start
    monkeypatch.setattr(loading, "MOST_PARTS", 1e9)
    monkeypatch.setattr(loading, "_MOST_ELEMENTS", 1e9)
    folder = stranger(on_base(f'<replicate count="100000000">{GEOM}</replicate>'))
    refused(folder, "takes over 0 s of computing to be compiled")


def test_a_model_that_waits_for_ever(stranger, monkeypatch):
    monkeypatch.setattr(apart, "_WAITING_SECONDS", 0.2)
    monkeypatch.setattr(checking, "_inspect", lambda robot: time.sleep(60))
    refused(stranger(above("<!-- sleeping -->")), "within 0.2 s")


@pytest.mark.parametrize("end", ["crash", "exit", "bug"])
def test_a_model_that_brings_mujoco_down(stranger, monkeypatch, end):
    def inspect(robot: object) -> None:
        if end == "crash":
            ctypes.string_at(0)
        os._exit(3) if end == "exit" else {}["x"]

    monkeypatch.setattr(checking, "_inspect", inspect)
    named = {"crash": "SIGSEGV", "exit": "was not compiled", "bug": "cannot be checked: KeyError"}
    refused(stranger(above("<!-- falling -->")), named[end])


def test_a_pipe_is_not_waited_for(stranger):
    folder = stranger(above('<include file="parts.xml"/>'))
    os.mkfifo(folder / "parts.xml")
    refused(folder, r"parts\.xml' is not a regular file")


def test_a_file_of_any_size_is_not_read(stranger):
    folder = stranger(above('<asset><mesh name="m" file="shell.stl"/></asset>'))
    with (folder / "shell.stl").open("wb") as file:
        file.truncate(2**40)
    refused(folder, "over 512 MiB")


def test_included_files_are_known_by_what_includes_them(stranger):
    """MuJoCo reads them as XML whatever their ending; the digest has to cover what they name."""
    folder = stranger(above('<include file="parts.txt"/>'))
    (folder / "parts.txt").write_text('<mujoco><asset><mesh file="shell.stl"/></asset></mujoco>')
    (folder / "shell.stl").write_bytes(b"solid")
    assert [f.name for f in model_files(folder / "go2.xml")] == ["go2.xml", "parts.txt", "shell.stl"]


def test_only_a_robot_given_by_its_path_is_compiled_apart(stranger, monkeypatch):
    def here(robot: object) -> None:
        compiled.append(os.getpid())

    compiled: list[int] = []
    monkeypatch.setattr(checking, "_inspect", here)
    monkeypatch.setattr(checking, "_checked", set())
    load_robot("go2")
    assert compiled == [os.getpid()]
    load_robot(stranger(above("<!-- mine -->")))
    assert compiled == [os.getpid()], "it was compiled in this process"
    assert mujoco.MjModel.from_xml_path(str(GO2 / "go2.xml")).nu == 12
