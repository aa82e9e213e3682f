"""``gaitgauge warmup`` without a GPU."""

import pytest
import torch
from gaitgauge.backends.warp import warmup


def test_without_a_gpu_the_architecture_must_be_named(refused, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "there is no GPU here; say which one" in refused("warmup")


def test_engines_without_kernels_are_refused(refused):
    assert "'mujoco' has no kernels to compile" in refused("warmup", "--backend", "mujoco", "--arch", "sm_90")
    assert "'sm_12' is not known" in refused("warmup", "--arch", "sm_12")


def test_it_says_what_it_did(run, monkeypatch):
    played = []
    monkeypatch.setattr(warmup, "exercise", lambda name, scenes, device: played.append((name, len(scenes), device)))
    monkeypatch.setattr(warmup, "exercise_until_compiled", warmup.exercise)
    done = warmup.Compiled(modules=3, fresh=2, seconds=1.0)
    monkeypatch.setattr(warmup, "compile_for", lambda number, launched, threads: done)
    result = run("warmup", "--arch", "sm_90", "--threads", 1)
    assert result.exit_code == 0, result.output
    assert played == 2 * [("mujoco-warp", 3, "cpu")], "once for the CPU's own kernels, once to see what is launched"
    assert "mujoco-warp, sm_90: 2 of 3 compiled" in result.stdout


@pytest.mark.gpu
def test_on_a_gpu_the_second_time_is_quick(run):
    assert run("warmup").exit_code == 0
    assert "all kernels for this GPU are there" in run("warmup").stdout
