"""The example plug-in: found through its entry point like any installed package, and held to the conformance checks."""

import importlib
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from gaitgauge.backends import BackendError, backend_class, backend_names
from gaitgauge.backends.conformance import Outcome, all_checks, make_bench, run_check

EXAMPLE = Path(__file__).parents[2] / "examples" / "plugin_backend"
CHECKS = {check.name: check for check in all_checks()}
SHORT = ("reset/", "motors/")
"""Checks that a guide shows; all others are slow tests, as the engine below is that of the conformance tests."""
NOT_SUPPORTED = {"contact/foot_change"}


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The example's wheel on the import path, which is what an installation is to Python."""
    pytest.importorskip("setuptools", minversion="61")
    folder = tmp_path_factory.mktemp("plugin")
    source = shutil.copytree(EXAMPLE, folder / "source")
    build = "from setuptools.build_meta import build_wheel; print(build_wheel('..'))"
    done = subprocess.run([sys.executable, "-c", build], cwd=source, capture_output=True, text=True, check=True)
    wheel = str(folder / done.stdout.split()[-1])
    sys.path.insert(0, wheel)
    importlib.invalidate_caches()
    yield "plain-mujoco"
    sys.path.remove(wheel)


def test_an_installed_plugin_is_found_by_name(installed):
    assert installed in backend_names()
    assert backend_class(installed).__module__ == "gaitgauge_plain_mujoco"


@pytest.mark.parametrize(
    "name", [n if n.startswith(SHORT) else pytest.param(n, marks=pytest.mark.slow) for n in CHECKS]
)
def test_the_plugin_conforms(installed, name):
    result = run_check(CHECKS[name], make_bench(installed))
    expected = Outcome.NOT_SUPPORTED if name in NOT_SUPPORTED else Outcome.PASSED
    assert result.outcome is expected, result.detail


def test_a_plugin_that_is_not_installed_is_unknown(installed):
    with pytest.raises(BackendError, match=f"unknown backend 'plain-bullet'.*{installed}"):
        backend_class("plain-bullet")
