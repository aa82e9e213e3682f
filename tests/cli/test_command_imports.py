"""Quick answers: what needs no engine must not wait for one."""

import json
import subprocess
import sys

import pytest
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
PROGRAM = """
import json, sys
from gaitgauge.cli.main import main
sys.argv = ["gaitgauge", *json.loads(sys.argv[1])]
try:
    main()
except SystemExit as end:
    code = end.code
print(json.dumps([code, sorted(sys.modules)]))
"""


def loaded_by(*arguments: str) -> tuple[set[str], str]:
    """The heavy packages that a command line loads, and what it prints."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps(arguments)], capture_output=True, text=True, timeout=120, check=True
    )
    *printed, last = done.stdout.splitlines()
    code, modules = json.loads(last)
    assert not code, done.stderr
    return HEAVY & {m.partition(".")[0] for m in modules}, "\n".join(printed)


def test_help_loads_no_heavy_package():
    loaded, printed = loaded_by("--help")
    assert loaded == set()
    assert "evaluate" in printed


@pytest.mark.parametrize("command", sorted(get_command(app).commands))
def test_help_of_each_command_loads_no_heavy_package(command):
    loaded, printed = loaded_by(command, "-h")
    assert loaded == set()
    assert command in printed


@pytest.mark.parametrize(
    ("what", "shown"),
    [
        ("robots", "Unitree Go2"),
        ("terrains", "stairs_bd"),
        ("backends", "mujoco-warp"),
        ("suites", "gaitgauge-1"),
        ("tasks", "go2-moe-cts"),
    ],
)
def test_lists_load_no_engine(what, shown):
    loaded, printed = loaded_by("list", what)
    assert loaded <= {"numpy"}
    assert shown in printed
