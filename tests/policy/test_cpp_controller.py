"""The C++ example reads what ``export --layout unitree`` writes and acts as the policy does."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NoReturn

import gaitgauge
import onnxruntime
import pytest
from gaitgauge.policy.export.files import export_unitree
from gaitgauge.policy.loading import load_policy
from gaitgauge.robots import load_robot
from gaitgauge.studies.reality.readers import LogMap, read_log

ROOT = Path(gaitgauge.__path__[0])
EXAMPLE = ROOT / "examples" / "cpp_controller"
ASKED = os.environ.get("ONNXRUNTIME_INCLUDE")
"""Folder of onnxruntime's headers, as ``make cpp`` sets it: what is missing then is a failure."""
HEADERS = (
    [Path(ASKED)]
    if ASKED
    else [
        Path("/usr/include/onnxruntime"),
        Path("/usr/local/include/onnxruntime"),
        Path("/usr/include/onnxruntime/core/session"),
    ]
)

pytestmark = pytest.mark.slow


def run(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(w) for w in words], capture_output=True, text=True, check=False)


def missing(sentence: str) -> NoReturn:
    (pytest.fail if ASKED else pytest.skip)(sentence)


@pytest.fixture(scope="module")
def controller(tmp_path_factory) -> Path:
    """The program, built against the library of the Python package."""
    for program in ("cmake", "c++"):
        if shutil.which(program) is None:
            missing(f"{program} is not installed")
    headers = next((p for p in HEADERS if (p / "onnxruntime_cxx_api.h").is_file()), None)
    if headers is None:
        missing("onnxruntime's C++ headers are not here: run make cpp, or set ONNXRUNTIME_INCLUDE")
    (library,) = (Path(onnxruntime.__file__).parent / "capi").glob("libonnxruntime.so.*")
    folder = tmp_path_factory.mktemp("cpp")
    for name in ("libonnxruntime.so", "libonnxruntime.so.1"):
        (folder / name).symlink_to(library)
    settings = [f"-DONNXRUNTIME_INCLUDE={headers}", f"-DONNXRUNTIME_LIBRARY={folder / 'libonnxruntime.so'}"]
    configured = run("cmake", "-S", EXAMPLE, "-B", folder / "build", *settings)
    if "yaml-cpp" in configured.stderr:
        missing("yaml-cpp is not installed: install libyaml-cpp-dev")
    assert configured.returncode == 0, configured.stderr
    built = run("cmake", "--build", folder / "build")
    assert built.returncode == 0, built.stdout + built.stderr
    assert "warning:" not in built.stdout + built.stderr
    return folder / "build" / "controller"


@pytest.fixture(scope="module")
def bundle(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("bundle")
    export_unitree(load_policy("pretrained"), folder, load_robot("go2"))
    recorded = run(sys.executable, EXAMPLE / "record.py", "pretrained", folder, folder / "states.csv")
    assert recorded.returncode == 0, recorded.stderr
    return folder


def test_it_acts_as_the_policy_does_over_200_steps(controller, bundle):
    done = run(controller, bundle, bundle / "states.csv")
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("200 steps")


@pytest.mark.parametrize(
    ("right", "wrong"),
    [("scale: [0.25, 0.25, 0.25]", "scale: [0.2, 0.25, 0.25]"), ("joint_ids_map: [3, 4,", "joint_ids_map: [4, 3,")],
)
def test_it_notices_other_settings(controller, bundle, tmp_path, right, wrong):
    shutil.copytree(bundle, tmp_path / "other")
    deploy = tmp_path / "other" / "params" / "deploy.yaml"
    text = deploy.read_text()
    assert right in text
    deploy.write_text(text.replace(right, wrong))
    done = run(controller, tmp_path / "other", bundle / "states.csv")
    assert done.returncode == 1
    assert "NOT the same" in done.stdout


def test_it_says_what_is_missing(controller, tmp_path):
    done = run(controller, tmp_path, tmp_path / "states.csv")
    assert done.returncode == 2
    assert done.stderr.startswith("controller: ")


def test_it_writes_a_log_that_preflight_reads(controller, bundle, tmp_path):
    done = run(controller, bundle, bundle / "states.csv", tmp_path / "log.csv")
    assert done.returncode == 0, done.stdout + done.stderr
    mapping = LogMap(joints=load_robot("go2").sdk_joint_names, stiffness=20.0, damping=0.5, held="walking")
    log = read_log(tmp_path / "log.csv", robot="go2", mapping=mapping)
    assert log.time[-1] == pytest.approx(199 * 0.02) and log.period == pytest.approx(0.02)
    assert log.velocity is not None and log.angular_velocity is not None and log.torque is None
