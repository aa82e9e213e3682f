"""Every engine of the project against the conformance checks."""

from functools import cache
from pathlib import Path

import pytest
import torch
from gaitgauge.backends import BackendError, PhysicsBackend
from gaitgauge.backends.base import CAPABILITY_NAMES
from gaitgauge.backends.conformance import Outcome, all_checks, make_bench, run_check, run_conformance
from gaitgauge.robots import load_robot
from gaitgauge_fake_engine import FakeBackend

CHECKS = {check.name: check for check in all_checks()}
# What a scripted engine cannot keep of the contract: physics.
FAKE_CANNOT = (
    "kinematics/feet",
    "kinematics/free_fall",
    "kinematics/tumble",
    "contact/",
    "soles/",
    "ground/",
    "friction/",
    "model/",
    "disturbance/force",
    "motors/step_response",
    "motors/joint_friction",
    "health/penetration_watch",
)
FAKE_CAN = [name for name in CHECKS if not name.startswith(FAKE_CANNOT)]
WARP_ENGINES = ("mujoco-warp", "newton", "newton:steel")

bench_of = cache(make_bench)


def outcome(engine, check):
    result = run_check(CHECKS[check], bench_of(engine))
    assert result.outcome is not Outcome.FAILED, result.detail
    return result.outcome


def run_all(engine, device):
    results = run_conformance(engine, device, only=FAKE_CAN if engine == "fake" else ())
    failed = [f"{r.name}: {r.detail}" for r in results if r.outcome is Outcome.FAILED]
    assert not failed, "\n".join(failed)


@pytest.mark.parametrize("check", FAKE_CAN)
def test_fake(check):
    outcome("fake", check)


@pytest.mark.parametrize("check", CHECKS)
def test_mujoco(check):
    assert outcome("mujoco", check) is Outcome.PASSED


@pytest.mark.slow
@pytest.mark.parametrize("engine", WARP_ENGINES)
def test_warp_engines_on_the_cpu(engine):
    run_all(engine, "cpu")


@pytest.mark.gpu
@pytest.mark.parametrize("engine", [*WARP_ENGINES, "fake"])
def test_on_a_gpu(engine):
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    run_all(engine, "cuda")


def test_every_result_is_reported_in_order():
    seen = []
    results = run_conformance("fake", only=["state", "motors/law"], report=seen.append)
    assert [r.name for r in results] == ["state/fields", "state/time", "motors/law"]
    assert seen == results
    assert all(r.outcome is Outcome.PASSED and r.seconds > 0 for r in results)


def test_unknown_check_and_engine_are_refused():
    with pytest.raises(BackendError, match="no conformance check begins with 'contakt'"):
        run_conformance("fake", only=["contakt"])
    with pytest.raises(BackendError, match="unknown backend 'havok'"):
        run_conformance("havok")
    with pytest.raises(BackendError, match="robot 'g1' has 2 feet, and conformance takes one that stands on four"):
        run_conformance("fake", robot=load_robot("g1"))


def test_undeclared_capabilities_are_refused():
    class Silent(FakeBackend):
        @classmethod
        def capabilities(cls):
            return {name: c for name, c in FakeBackend.capabilities().items() if name not in ("push", "gpu")}

    with pytest.raises(BackendError, match="does not declare push, gpu"):
        make_bench(Silent)


def test_an_engine_that_crashes_fails_its_checks_and_no_more():
    class Crashing(FakeBackend):
        def step(self, *args, **kwargs):
            raise RuntimeError("solver exploded")

    assert issubclass(Crashing, PhysicsBackend)
    results = {r.name: r for r in run_conformance(Crashing, only=["state", "reset/state"])}
    assert results["reset/state"].outcome is Outcome.PASSED
    assert results["state/time"].outcome is Outcome.FAILED
    assert results["state/time"].detail == "RuntimeError: solver exploded"


def test_the_documentation_lists_every_check():
    text = (Path(__file__).parents[2] / "docs" / "reference" / "conformance.md").read_text()
    listed = " ".join(text.split())
    missing = [
        c.name for c in CHECKS.values() if f"| `{c.name}` | {' '.join(c.about.rstrip('.').split())} |" not in listed
    ]
    assert [name for name in missing if name.removeprefix("refusal/") not in CAPABILITY_NAMES] == []
