"""mujoco_warp's kernels launched side by side do what they do in a row."""

from dataclasses import fields

import mujoco_warp
import pytest
import torch
from gaitgauge.backends import PhysicsState, ResetState
from gaitgauge.backends.mujoco_warp import MujocoWarpBackend, side_by_side
from mujoco_warp_scenes import BOXES, COARSE, FINE, FLAT, ROBOT, TRAINING, scene, upright

HEIGHTS = [0.30, 0.48, 0.58, 0.33]
"""Of robots that stand on each ground."""


def walked(monkeypatch, *, apart: bool, device: str, periods: int) -> dict[str, torch.Tensor]:
    """States after some control periods, in mujoco_warp's own order or with launches apart."""
    physics = TRAINING | {"self_collision": True}
    backend = MujocoWarpBackend(scene(FLAT, BOXES, COARSE, FINE, **physics), device=device)
    assert side_by_side.knows(backend._model, backend._data)
    if not apart:
        monkeypatch.setattr(side_by_side, "step", mujoco_warp.step)
        backend._graphs.clear()
    start = {name: value.to(device) for name, value in upright(backend, HEIGHTS).items()}
    backend.reset(ResetState(**start))
    random = torch.Generator().manual_seed(0)
    pose = torch.tensor(ROBOT.default_joint_position, dtype=torch.float32)
    for _ in range(periods):
        noise = 0.3 * torch.randn(4, len(pose), generator=random)
        backend.step((pose + noise).to(device))
    state = {f.name: getattr(backend.state, f.name).cpu().clone() for f in fields(PhysicsState)}
    backend.close()
    monkeypatch.undo()
    return state


def test_launches_apart_change_no_bit(monkeypatch):
    plain, apart = (walked(monkeypatch, apart=a, device="cpu", periods=6) for a in (False, True))
    assert plain["contact_count"].sum() > 4
    for name, value in plain.items():
        assert torch.equal(apart[name], value), name


@pytest.mark.gpu
def test_launches_apart_do_the_same_on_a_gpu(monkeypatch):
    plain, apart = (walked(monkeypatch, apart=a, device="cuda:0", periods=1) for a in (False, True))
    assert torch.equal(apart["contact_count"], plain["contact_count"])
    for name in ("base_position_w", "joint_position", "foot_position_w"):
        # contacts come in another order in every run, so that sums differ in their last bits
        torch.testing.assert_close(apart[name], plain[name], atol=1e-4, rtol=0.0)


def test_what_needs_mujoco_warps_order_keeps_it():
    backend = MujocoWarpBackend(scene(FLAT, deterministic=True, **TRAINING))
    assert not side_by_side.knows(backend._model, backend._data)
