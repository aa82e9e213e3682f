"""Each repair of another project installs itself on request alone, for the versions it was written for, and is still needed."""

import subprocess
import sys
from dataclasses import replace

import mujoco_warp
import numpy as np
import pytest
import warp as wp
from gaitgauge.backends import BackendError
from gaitgauge.backends.upstream.fused_solver import FUSED_SOLVER
from gaitgauge.backends.upstream.fused_solver.solve import plain_solve
from gaitgauge.backends.upstream.height_fields import HEIGHT_FIELDS
from mujoco_warp._src import collision_driver, constraint
from test_fused_solver import model_of, moving

REPAIRS = (HEIGHT_FIELDS, FUSED_SOLVER)
UNTOUCHED = """
import gaitgauge.backends.mujoco_warp.backend, gaitgauge.backends.newton.solvers
from mujoco_warp._src import collision_convex, collision_driver, collision_gjk, solver
for function in (collision_gjk.support, collision_convex.support, collision_driver.convex_narrowphase, solver.solve):
    assert function.__module__.startswith("mujoco_warp"), function.__module__
"""
PLAIN_FIELDS = """
import field_contacts, numpy as np
from gaitgauge.terrains.registry import make_terrain
terrain = make_terrain("wave", 5)
model, qpos = field_contacts.model_of("foot", terrain), field_contacts.poses("foot", terrain, 60)
seen = field_contacts.compare(field_contacts.contacts_of_mujoco(model, qpos), field_contacts.contacts_of_mujoco_warp(model, qpos))
print(float(np.abs(seen["depth"]).max()))
"""


def run(program: str) -> str:
    """Run a program in a process in which nothing has been repaired."""
    paths = [p for p in sys.path if p]
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path[:0] = {paths!r}\n{program}"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
def test_importing_an_engine_changes_nothing_in_other_projects():
    run(UNTOUCHED)


@pytest.mark.parametrize("repair", REPAIRS, ids=lambda r: r.install.__module__.rpartition(".")[2])
def test_another_version_is_refused(repair):
    with pytest.raises(BackendError, match=r"mujoco-warp \S+ is installed, but .* is repaired for <1 alone; install"):
        replace(repair, versions="<1").apply()


@pytest.mark.slow
def test_contacts_with_height_fields_are_still_wrong_upstream():
    """When this fails, height_fields/ can go."""
    depth = float(run(PLAIN_FIELDS).splitlines()[-1])
    assert depth > 5e-3


def test_the_solver_still_launches_many_kernels_upstream(monkeypatch):
    """When this fails, fused_solver/ can go: mujoco_warp solves in one kernel, too."""
    model, data = moving(model_of(3))
    mujoco_warp.forward(model, data)
    launched = []
    plain = wp.launch
    monkeypatch.setattr(wp, "launch", lambda *a, **k: (launched.append(a), plain(*a, **k))[1])
    plain_solve(model, data)
    assert len(launched) > 3 * max(int(np.max(data.solver_niter.numpy())), 1)


def test_contacts_and_rows_are_still_unsorted_upstream():
    """When this fails, order.py can go: the two functions are empty in mujoco_warp 3.17, so they take anything."""
    assert collision_driver._sort_contacts(None, None) is None
    assert constraint._sort_constraints(None, None) is None
