"""Quick answers: what needs no engine must not wait for one."""

import json
import subprocess
import sys

import pytest
from gaitgauge.backends.gpu import gpu_count
from gaitgauge.cli.main import app
from typer.main import get_command

HEAVY = {
    "torch",
    "mujoco",
    "mujoco_warp",
    "warp",
    "newton",
    "numpy",
    "scipy",
    "matplotlib",
    "onnx",
    "onnxruntime",
    "rsl_rl",
}
COMMANDS = sorted(get_command(app).commands)
LISTS = {
    "robots": "Unitree Go2",
    "terrains": "stairs_bd",
    "backends": "mujoco-warp",
    "suites": "gaitgauge-1",
    "tasks": "go2-moe-cts",
}
PROGRAM = """
import io, json, sys
from contextlib import redirect_stdout
from gaitgauge.cli.main import main
for line in json.loads(sys.argv[1]):
    sys.argv = ["gaitgauge", *line]
    with redirect_stdout(io.StringIO()) as printed:
        try:
            main()
        except SystemExit as end:
            code = end.code
    print(json.dumps([code, sorted(sys.modules), printed.getvalue()]))
"""


def loaded_by(*lines: list[str], refused: bool = False) -> list[tuple[set[str], str]]:
    """The heavy packages that a process has loaded after each of the command lines, and what each prints."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps(lines)], capture_output=True, text=True, timeout=120, check=True
    )
    found = []
    for code, modules, printed in map(json.loads, done.stdout.splitlines()):
        assert bool(code) is refused, done.stderr
        found.append((HEAVY & {m.partition(".")[0] for m in modules}, printed))
    assert len(found) == len(lines)
    return found


@pytest.fixture(scope="module")
def helps():
    return dict(zip(("", *COMMANDS), loaded_by(["--help"], *([name, "-h"] for name in COMMANDS)), strict=True))


@pytest.fixture(scope="module")
def lists():
    return dict(zip(LISTS, loaded_by(*(["list", what] for what in LISTS)), strict=True))


def test_help_loads_no_heavy_package(helps):
    loaded, printed = helps[""]
    assert loaded == set()
    assert "evaluate" in printed


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_each_command_loads_no_heavy_package(helps, command):
    loaded, printed = helps[command]
    assert loaded == set()
    assert command in printed


@pytest.mark.parametrize(("what", "shown"), LISTS.items())
def test_lists_load_no_engine(lists, what, shown):
    loaded, printed = lists[what]
    assert loaded <= {"numpy"}
    assert shown in printed


@pytest.mark.skipif(gpu_count() > 0, reason="this machine has a GPU")
def test_a_training_without_its_gpu_is_refused_before_anything_heavy_is_loaded():
    [(loaded, _)] = loaded_by(["train", "go2-flat"], refused=True)
    assert loaded <= {"numpy"}
