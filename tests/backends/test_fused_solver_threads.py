"""The GPU's form of the solver, run by threads of the CPU: no two of them meet in memory, and the result is mujoco_warp's."""

import shutil
import subprocess
from pathlib import Path

import mujoco_warp
import numpy as np
import pytest
from gaitgauge.backends.upstream.fused_solver import solve as fused
from gaitgauge.backends.upstream.fused_solver.kernel import program_text
from mujoco_warp._src import solver
from test_fused_solver import FEW, MANY, model_of, moving

COMPILER = shutil.which("g++")
WORLDS = 3
TYPES = {"float32": "float", "int32": "int"}

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(COMPILER is None, reason="needs g++ with the thread sanitizer"),
]


def _write(folder, name, structure):
    """The arrays of a structure as files, and its fields in C++."""
    lines = []
    for field in structure._cls.vars:
        values = np.ascontiguousarray(getattr(structure, field).numpy())
        values.tofile(folder / f"{field}.bin")
        five = field == "contact_friction"
        kind = "Five" if five else TYPES[str(values.dtype)]
        lines.append(f"FIELD({kind}, {field}, {values.shape[1] if values.ndim > 1 and not five else 1})")
    (folder / f"{name}.inc").write_text("\n".join(lines) + "\n")


def _run(folder, program):
    (folder / "program.inc").write_text(program)
    source = Path(__file__).with_name("solver_threads.cpp")
    flags = ["-std=c++20", "-O1", "-g", "-fsanitize=thread", f"-I{folder}", "-pthread", "-o", str(folder / "program")]
    subprocess.run([COMPILER, *flags, str(source)], check=True)
    return subprocess.run([str(folder / "program"), str(WORLDS)], cwd=folder, capture_output=True, text=True)


@pytest.mark.parametrize(
    ("spheres", "options", "condim"),
    [(FEW, "", 3), (MANY, "", 3), (FEW, 'cone="elliptic"', 3), (MANY, 'cone="elliptic" impratio="10"', 6)],
    ids=["pyramids", "many pyramids", "cones", "many cones"],
)
def test_threads_of_a_warp_wait_for_each_other(spheres, options, condim, tmp_path, monkeypatch):
    m, d = moving(model_of(spheres, options=options, condim=condim), WORLDS)
    monkeypatch.setattr(solver, "solve", lambda *_: None)
    mujoco_warp.forward(m, d)
    _write(tmp_path, "problem", fused.problem_of(m, d))
    _write(tmp_path, "solution", fused.solution_of(d))
    (tmp_path / "program.txt").write_text(program_text(fused.sizes_of(m, d)))
    fused.plain_solve(m, d)
    found = _run(tmp_path, (tmp_path / "program.txt").read_text())
    assert not found.returncode, found.stderr[:3000]
    expected = d.qacc.numpy()
    numbers = np.array(found.stdout.split(), dtype=float).reshape(expected.shape)
    np.testing.assert_allclose(numbers, expected, rtol=0.0, atol=1e-5 * np.abs(expected).max())


def test_a_forgotten_barrier_is_found(tmp_path, monkeypatch):
    test_threads_of_a_warp_wait_for_each_other(FEW, "", 3, tmp_path, monkeypatch)
    before, _, after = (tmp_path / "program.txt").read_text().partition("= LINE(i, c);")
    found = _run(tmp_path, f"{before}= LINE(i, c);{after.replace('SYNC;', '', 1)}")
    assert "data race" in found.stderr
