"""Engines that are no relatives of MuJoCo, where their extra is installed: `make test-jury` installs them."""

import subprocess
import sys
from contextlib import closing
from functools import partial
from importlib.util import find_spec
from itertools import product

import pytest
from gaitgauge.backends import BackendError, PhysicsOptions, Scene, make_backend, registry
from gaitgauge.backends.conformance import Outcome, all_checks, make_bench, run_check
from gaitgauge.backends.conformance.bench import FLAT
from gaitgauge.backends.registry import engine_class, list_backends
from gaitgauge.gauge.play.workers import Job, Progress, start_workers
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.loading import load_policy
from gaitgauge.robots import load_robot

PACKAGES = {"drake": "pydrake", "physx": "ovphysx"}
CHECKS = {check.name: check for check in all_checks()}
# Sliding contacts without torsion or rolling, the same in all worlds.
NOT_SUPPORTED = {"contact/torsion", "contact/foot_change"}


INSTALLED = [name for name, package in PACKAGES.items() if find_spec(package) is not None]
each_engine = pytest.mark.parametrize("engine", INSTALLED)


@pytest.mark.parametrize(("engine", "check"), product(INSTALLED, CHECKS))
def test_the_engine_conforms(engine, check):
    result = run_check(CHECKS[check], make_bench(engine))
    assert result.outcome is (Outcome.NOT_SUPPORTED if check in NOT_SUPPORTED else Outcome.PASSED), result.detail


@each_engine
def test_the_model_is_mujoco_s(engine):
    robot = load_robot("go2")
    physics = PhysicsOptions(foot_condim=3)
    scene = Scene(
        robot=robot, parameters=robot.parameters["gauge"], terrains=(FLAT,), terrain_index=(0,), physics=physics
    )
    with_mujoco, found = (make_backend(name, scene).describe() for name in ("mujoco", engine))
    with_mujoco["contact_softness"] = [0.0] * len(robot.foot_geoms)  # contacts of both are hard
    for name, values in with_mujoco.items():
        assert found[name] == pytest.approx(values, rel=1e-5), name


@each_engine
def test_solver_settings_name_the_licence(engine):
    assert engine_class(engine).solver_settings(PhysicsOptions())["licence"]
    (listing,) = [each for each in list_backends() if each.name == engine]
    assert engine_class(engine).solver_settings(PhysicsOptions())["licence"] in listing.terms
    assert any(digit in listing.version for digit in "0123456789")


@pytest.mark.parametrize("name", PACKAGES)
def test_an_engine_without_its_extra_is_named_with_the_command_that_installs_it(name, monkeypatch):
    if name in INSTALLED:

        def gone(module, package):
            raise ModuleNotFoundError(f"No module named '{PACKAGES[name]}'", name=PACKAGES[name])

        monkeypatch.setattr(registry, "import_module", gone)
    with pytest.raises(BackendError, match=rf"'{name}' needs .* not installed: pip install 'gaitgauge\[{name}\]'$"):
        engine_class(name)


def test_lists_import_no_engine():
    code = (
        "import sys; from gaitgauge.backends.registry import list_backends; list_backends(); "
        f"print([p for p in {[*PACKAGES.values(), 'torch']} if p in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.skipif("physx" not in INSTALLED, reason="PhysX is not installed; run `make test-jury`")
def test_workers_start_afresh_after_physx_was_at_work_here():
    with make_bench("physx").worlds() as worlds:
        worlds.step()
    forked = engine_class("physx").forkable()
    assert not forked  # a forked process would end with a segmentation fault
    job = Job(
        suite=load_suite("jury"),
        policy=load_policy("pretrained"),
        robot=load_robot("go2"),
        places=(("flat", 0),),
        worlds=1,
        build=partial(make_backend, "physx", device="cpu"),
    )
    with closing(start_workers(job, 2, forked=forked)) as workers:
        said = dict(workers.receive())
        while len(said) < 2:
            said |= dict(workers.receive())
    assert all(isinstance(message, Progress) for message in said.values()), said


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (
            ModuleNotFoundError("No module named 'pydrake'", name="pydrake"),
            "backend 'drake' needs the package 'pydrake', which is not installed: pip install 'gaitgauge[drake]'",
        ),
        (
            ImportError("libX11.so.6: cannot open shared object file", name="common"),
            "backend 'drake' is installed but cannot be loaded (libX11.so.6: cannot open shared object file); install what it "
            "lacks, or the engine anew: pip install 'gaitgauge[drake]'",
        ),
    ],
)
def test_a_missing_package_and_a_missing_library_are_told_apart(monkeypatch, error, expected):
    def fails(*_):
        raise error

    monkeypatch.setattr(registry, "import_module", fails)
    with pytest.raises(BackendError) as caught:
        engine_class("drake")
    assert str(caught.value) == expected
