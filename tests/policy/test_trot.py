import make_trot_policy
import mujoco
import numpy as np
import pytest
import torch
from gaitgauge.backends import Scene, make_backend
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.native import NativePolicy, save_policy
from gaitgauge.policy.networks.trot import TrotController
from gaitgauge.policy.observation import ObservationBuilder
from gaitgauge.robots.rotation import rotate_inverse
from gaitgauge.terrains.registry import make_terrain


@pytest.fixture(scope="module")
def controller() -> TrotController:
    return TrotController(**make_trot_policy.make()[1].arguments)


@pytest.fixture(scope="module")
def joints() -> torch.Tensor:
    """Joint angles inside the leg's ordinary range, (50, 4, 3)."""
    low, high = torch.tensor([-0.5, 0.0, -2.0]), torch.tensor([0.5, 1.4, -1.0])
    return low + (high - low) * torch.rand(50, 4, 3, generator=torch.Generator().manual_seed(0))


def test_leg_kinematics_are_those_of_the_model(controller, joints, go2):
    model = mujoco.MjModel.from_xml_path(str(go2.mjcf))
    data = mujoco.MjData(model)
    at = [model.joint(j).qposadr[0] for j in go2.joint_names]
    feet, _ = controller.foot_positions(joints)
    for row in range(10):
        data.qpos[:7] = (0, 0, 0, 1, 0, 0, 0)
        data.qpos[at] = joints[row].flatten().numpy()
        mujoco.mj_kinematics(model, data)
        expected = np.stack([data.site(f).xpos for f in go2.foot_names])
        # the model's feet lie 2 mm off the calf's axis, which the controller leaves out
        assert np.abs(feet[row].numpy() - expected).max() < 0.0021


def test_inverse_kinematics_and_jacobian(controller, joints):
    feet, jacobian = controller.foot_positions(joints)
    assert torch.allclose(controller.joint_positions(feet), joints, atol=2e-5)
    for k in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[k] = 1e-6
        double = joints.double()
        difference = (controller.foot_positions(double + step)[0] - controller.foot_positions(double - step)[0]) / 2e-6
        assert torch.allclose(jacobian[..., k].double(), difference, atol=1e-5)
    assert torch.isfinite(controller.joint_positions(feet * 3.0)).all()
    assert torch.isfinite(controller.joint_positions(torch.zeros_like(feet))).all()


def test_rows_do_not_influence_each_other_and_resets_forget(run, observations):
    policy = NativePolicy(*make_trot_policy.make(), path="trot")
    together = run(policy.session(4), observations)
    changed = observations.clone()
    changed[:, 0] += 1.0
    assert torch.equal(run(policy.session(4), changed)[:, 1:], together[:, 1:])
    fresh = policy.session(4)
    again = torch.stack([fresh.act(o) for o in observations[6:]])
    assert torch.equal(together[6:, 2], again[:, 2])
    assert not torch.equal(together[6:, 1], again[:, 1])


def test_the_file_is_reproducible(tmp_path):
    for name in ("a", "b"):
        save_policy(tmp_path / name / "go2.gauge.pt", *make_trot_policy.make())
    first = (tmp_path / "a" / "go2.gauge.pt").read_bytes()
    assert first == (tmp_path / "b" / "go2.gauge.pt").read_bytes()


def test_the_script_asks_where_to_write(tmp_path, monkeypatch):
    """Without a destination it wrote over the trained policy that ships."""
    written = []
    monkeypatch.setattr(make_trot_policy, "save_policy", lambda path, contract, network: written.append(path))
    monkeypatch.setattr("sys.argv", ["make_trot_policy.py"])
    with pytest.raises(SystemExit):
        make_trot_policy.main()
    assert written == []
    monkeypatch.setattr("sys.argv", ["make_trot_policy.py", str(tmp_path / "trot.gauge.pt")])
    make_trot_policy.main()
    assert written == [tmp_path / "trot.gauge.pt"]


def test_walks_as_told_despite_noise_and_latency(go2):
    """Forward, backward, sideways, round and standing, on level ground under the gauge's disturbances."""
    commands = torch.tensor([[0.6, 0, 0], [-0.6, 0, 0], [0, 0.4, 0], [0, 0, 0.8], [0, 0, 0]], dtype=torch.float64)
    count, suite = len(commands), load_suite("gaitgauge-1")
    scene = Scene(
        robot=go2,
        parameters=go2.parameters["gauge"],
        terrains=(make_terrain("flat"),),
        terrain_index=(0,) * count,
        physics=suite.physics,
    )
    backend = make_backend("mujoco", scene, threads=1)
    policy = NativePolicy(*make_trot_policy.make(), path="trot")
    session = policy.session(count)
    builder = ObservationBuilder(standard_contract(go2), go2, count)
    action, generator = torch.zeros(count, 12), torch.Generator().manual_seed(3)
    total, fallen = torch.zeros(count, 3), torch.zeros(count, dtype=torch.bool)
    for step in range(150):

        def noise(width: int, half: float) -> torch.Tensor:
            return half * (2.0 * torch.rand(count, width, generator=generator) - 1.0)

        disturbed = {
            "base_angular_velocity_b": noise(3, suite.noise.base_angular_velocity),
            "joint_position": noise(12, suite.noise.joint_position),
            "joint_velocity": noise(12, suite.noise.joint_velocity),
        }
        command = commands * (step >= 30)
        action = session.act(builder.build(backend.state, command, action, disturbed))
        delay = torch.randint(0, suite.noise.latency + 1, (count,), generator=generator)
        backend.step(builder.targets(action), delay=delay)
        state = backend.state
        fallen |= state.tilt_substep > 0
        if step >= 75:
            velocity = rotate_inverse(state.base_quaternion_w, state.base_linear_velocity_w)[:, :2]
            total += torch.cat((velocity, state.base_angular_velocity_b[:, 2:]), dim=1).float()
    mean = total / 75
    assert not fallen.any()
    assert (mean - commands.float()).abs().max() < 0.3
    assert mean[4].abs().max() < 0.05
