"""Kernels compiled for a GPU that is not here."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from gaitgauge.backends.base import BackendError
from gaitgauge.cli.warmup import scenes_of
from gaitgauge.robots import load_robot

pytest.importorskip("warp")

PROGRAM = """
import json, sys
import warp as wp
from gaitgauge.backends.warp.warmup import cache_folder, compile_for, recorded_launches

@wp.kernel
def double(values: wp.array(dtype=float)):
    i = wp.tid()
    values[i] = 2.0 * values[i]

values = wp.full(4, 1.5, dtype=float, device="cpu")
with recorded_launches() as launched:
    wp.launch(double, dim=4, inputs=[values], device="cpu")
    wp.launch(double, dim=4, inputs=[values], device="cpu", block_dim=64)
usual = double.module.options["block_dim"]
names = [double.module.get_module_identifier(block_dim=block) for block in (64, 256)]
first = compile_for(90, launched)
second = compile_for(90, launched)
assert double.module.options["block_dim"] == usual
print(json.dumps([values.numpy().tolist(), first.modules, first.fresh, second.fresh, names, cache_folder()]))
"""


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """What the program above did, and the folder that it was told to use."""
    folder = tmp_path_factory.mktemp("kernels")
    program = folder / "program.py"  # Warp reads the source of its kernels
    program.write_text(PROGRAM)
    environment = os.environ | {"WARP_CACHE_PATH": str(folder / "cache")}
    done = subprocess.run([sys.executable, str(program)], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1]), folder / "cache"


@pytest.mark.slow
def test_launches_happen_and_are_compiled_once_for_each_block_size(compiled):
    (values, modules, fresh, again, _, _), _ = compiled
    assert values == [6.0] * 4
    assert (modules, fresh, again) == (2, 2, 0)


@pytest.mark.slow
def test_machine_code_lies_where_it_is_looked_for(compiled):
    (*_, names, cache), folder = compiled
    assert cache.startswith(str(folder))
    for name in names:
        (binary,) = folder.rglob(f"{name}/*.sm90*.cubin")
        assert binary.read_bytes()[:4] == b"\x7fELF"


SHARING = """
import json, sys
import warp as wp
from gaitgauge.backends.warp.warmup import compile_for, recorded_launches

FACTORS = (1.5, 2.5)

@wp.func
def scaled(value: float):
    total = float(0.0)
    for i in range(2):
        total += value * wp.static(FACTORS[i])
    return total

@wp.kernel(module="unique")
def first(values: wp.array(dtype=float)):
    values[wp.tid()] = scaled(values[wp.tid()])

@wp.kernel(module="unique")
def second(values: wp.array(dtype=float)):
    values[wp.tid()] = scaled(values[wp.tid()]) + 1.0

if sys.argv[1] == "compile":
    values = wp.full(4, 1.0, dtype=float, device="cpu")
    with recorded_launches() as launched:
        for kernel in (first, second):
            wp.launch(kernel, dim=4, inputs=[values], device="cpu")
    if sys.argv[2] == "gpu":
        compile_for(90, launched)
else:
    print(json.dumps([kernel.module.get_module_identifier(block_dim=256) for kernel in (first, second)]))
"""


@pytest.mark.slow
def test_names_are_those_of_a_program_that_builds_nothing(tmp_path):
    """The hash of a kernel holds what ``wp.static`` came to in the last build of a function that it shares with another one."""
    program = tmp_path / "program.py"
    program.write_text(SHARING)
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path / "cache")}
    for words in (("compile", "cpu"), ("compile", "cpu"), ("compile", "gpu"), ("name",)):
        command = [sys.executable, str(program), *words]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
    for name in json.loads(done.stdout.splitlines()[-1]):
        assert list(tmp_path.rglob(f"{name}/*.sm90*.cubin")), name


TRAINING = """
from dataclasses import replace
import torch
from gaitgauge.training.environment.environment import TrainingEnvironment
from gaitgauge.training.tasks import find_task

if __name__ == "__main__":
    configuration = replace(find_task("go2-moe-cts").environment, num_envs=16)
    environment = TrainingEnvironment(configuration, device="cpu")
    for _ in range(3):
        environment.step(torch.zeros(16, 12))
"""
WARMUP = """
from gaitgauge.backends.warp.warmup import exercise_until_compiled
from gaitgauge.cli.warmup import scenes_of
from gaitgauge.robots import load_robot

if __name__ == "__main__":
    exercise_until_compiled("mujoco-warp", scenes_of(load_robot("go2")), "cpu")
"""


@pytest.mark.slow
def test_training_finds_all_but_one_of_its_kernels(tmp_path):
    """The number of worlds is part of the broad phase's."""
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path / "cache")}
    found = []
    for name, program in (("warmup.py", WARMUP), ("training.py", TRAINING)):
        (tmp_path / name).write_text(program)
        command = [sys.executable, str(tmp_path / name)]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
        assert done.returncode == 0, done.stderr
        found.append({path.name for path in (tmp_path / "cache").glob("*/wp_*")})
    assert [name for name in found[1] - found[0] if "_nxn_broadphase_" not in name] == []


@pytest.fixture
def forked(monkeypatch):
    """A program of its own is a copy of this one, which has imported everything already."""
    from gaitgauge.backends.warp import warmup

    monkeypatch.setattr(warmup.multiprocessing, "get_context", lambda _, get=multiprocessing.get_context: get("fork"))


@pytest.mark.usefixtures("forked")
def test_an_engine_is_played_until_a_process_compiles_nothing(monkeypatch):
    from gaitgauge.backends.warp import warmup

    there = iter([{1}, {1, 2}, {1, 2}, {1, 2, 3}, {1, 2, 3}, {1, 2, 3}])
    monkeypatch.setattr(warmup, "_compiled_files", lambda: next(there))
    monkeypatch.setattr(warmup, "exercise", print)
    assert warmup.exercise_until_compiled("mujoco-warp", [], "cpu") == 3
    numbers = iter(range(100))
    monkeypatch.setattr(warmup, "_compiled_files", lambda: {next(numbers)})
    with pytest.raises(BackendError, match=r"compiled kernels anew in each of 5 programs"):
        warmup.exercise_until_compiled("mujoco-warp", [], "cpu")


def _quits(*_):
    os._exit(9)


@pytest.mark.usefixtures("forked")
def test_a_program_that_was_killed_while_it_compiled_is_a_sentence(monkeypatch):
    from gaitgauge.backends.warp import warmup

    monkeypatch.setattr(warmup, "_compiled_files", set)
    monkeypatch.setattr(warmup, "_exercise_and_reply", _quits)
    with pytest.raises(BackendError, match=r"compiled kernels of mujoco-warp was killed"):
        warmup.exercise_until_compiled("mujoco-warp", [], "cpu")


@pytest.mark.usefixtures("forked")
def test_what_an_engine_refuses_in_a_program_of_its_own_is_said():
    from gaitgauge.backends.warp import warmup

    with pytest.raises(BackendError, match=r"no device 'tpu'"):
        warmup.exercise_until_compiled("mujoco-warp", scenes_of(load_robot("go2")), "tpu")


ENDED = """
import os, time
from gaitgauge.backends.warp import warmup

def plays_a_while(*_):
    print(os.getpid(), flush=True)
    time.sleep(1.0)

warmup.exercise = plays_a_while
if __name__ == "__main__":
    warmup._compiled_files = set
    warmup.exercise_until_compiled("mujoco-warp", [], "cpu")
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks a process up in /proc")
def test_a_program_whose_warmup_was_ended_does_not_stay(tmp_path):
    """It ends with its play, and waits for nobody."""
    program = tmp_path / "program.py"
    program.write_text(ENDED)
    with subprocess.Popen([sys.executable, str(program)], stdout=subprocess.PIPE, text=True) as warming:
        child = int(warming.stdout.readline())
        warming.terminate()
    for _ in range(300):
        if not Path(f"/proc/{child}").exists():
            return
        time.sleep(0.1)
    os.kill(child, signal.SIGKILL)
    pytest.fail("the program of a warmup that was ended is still there")


def test_an_architecture_that_the_compiler_does_not_know_is_refused():
    from gaitgauge.backends.warp.warmup import check_architecture

    assert check_architecture("sm_90") == check_architecture("90") == 90
    for text in ("sm_1", "²", "9" * 5000, "", "sm_"):
        with pytest.raises(BackendError, match=r"is not known to Warp's compiler; choose from: sm_75") as caught:
            check_architecture(text)
        assert len(str(caught.value)) < 400
