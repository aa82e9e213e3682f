"""Motors by network: the network itself by hand and by torch, and the engines by a network that is the motor law."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from gaitgauge.backends.base import BackendError, PhysicsOptions, Randomization, Scene
from gaitgauge.backends.network_motors import NetworkState
from gaitgauge.backends.registry import make_backend
from gaitgauge.robots import RobotError, load_robot
from gaitgauge.robots.loading import parameter_set
from gaitgauge.robots.motor_network import MotorNetwork, MotorNetworkError, load_motor_network, save_motor_network
from gaitgauge.terrains.registry import make_terrain

GO2 = load_robot("go2", check=False)
KP, KD = 20.0, 0.5
CUDA = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]


def law_network(**changes):
    """Return the motor law as a network: kp · error − kd · velocity of the present call."""
    weight = np.array([[KP, 0.0, -KD, 0.0]])
    return MotorNetwork(
        kind="feed-forward", activation="identity", arrays={"weight_0": weight, "bias_0": [0.0]}, **changes
    )


def scene_of(tmp_path, network=None, *, timestep=0.005, substeps=4, worlds=2):
    nominal = GO2.parameters["gauge"]
    if network is not None:
        save_motor_network(network, tmp_path / "net.npz")
        nominal = replace(nominal, motor="network", network=str(tmp_path / "net.npz"), measured="a test")
    physics = PhysicsOptions(timestep=timestep, substeps=substeps, self_collision=False)
    terrains = (make_terrain("flat", None),)
    return Scene(robot=GO2, parameters=nominal, terrains=terrains, terrain_index=(0,) * worlds, physics=physics)


def test_feed_forward_network_by_hand():
    arrays = {"weight_0": [[1.0, 2.0, 0.0, -1.0]], "bias_0": [0.5]}
    network = MotorNetwork(
        kind="feed-forward", error_sign=-1, error_scale=2.0, velocity_scale=0.5, torque_scale=3.0, arrays=arrays
    )
    state = NetworkState(network, 1, 1, torch.device("cpu"))
    every, one = torch.ones(1, dtype=torch.bool), lambda x: torch.tensor([[x]])
    # errors −2·e now and before, velocities v/2 now and before: 3·(−2e − 4e' − v'/2 + 0.5)
    assert state.call(one(0.1), one(4.0), every).item() == pytest.approx(3 * (-0.2 + 0.5))
    assert state.call(one(0.3), one(1.0), every).item() == pytest.approx(3 * (-0.6 - 0.4 - 2.0 + 0.5))
    state.reset(every)
    assert state.call(one(0.0), one(0.0), every).item() == pytest.approx(1.5)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=CUDA)])
def test_lstm_is_torchs(device):
    torch.manual_seed(0)
    lstm, last = torch.nn.LSTM(2, 8, num_layers=2, batch_first=True), torch.nn.Linear(8, 1)
    arrays = {"weight_0": last.weight.detach().numpy(), "bias_0": last.bias.detach().numpy()}
    for i in range(2):
        arrays[f"lstm_{i}_input"] = getattr(lstm, f"weight_ih_l{i}").detach().numpy()
        arrays[f"lstm_{i}_hidden"] = getattr(lstm, f"weight_hh_l{i}").detach().numpy()
        arrays[f"lstm_{i}_bias"] = (getattr(lstm, f"bias_ih_l{i}") + getattr(lstm, f"bias_hh_l{i}")).detach().numpy()
    network = MotorNetwork(kind="lstm", error_scale=2.0, velocity_scale=0.25, torque_scale=20.0, arrays=arrays)
    place = torch.device(device)
    state = NetworkState(network, 3, 4, place)
    every = torch.ones(3, dtype=torch.bool, device=place)
    memory = None
    for _ in range(4):
        error, velocity = torch.randn(3, 4), torch.randn(3, 4)
        inputs = torch.stack((2.0 * error, 0.25 * velocity), dim=-1).view(12, 1, 2)
        output, memory = lstm(inputs, memory)
        found = state.call(error.to(place), velocity.to(place), every).cpu()
        torch.testing.assert_close(found, 20.0 * last(output).view(3, 4), atol=2e-5, rtol=1e-5)
    state.reset(torch.tensor([True, False, False], device=place))
    fresh = NetworkState(network, 3, 4, place)
    error, velocity = torch.randn(3, 4, device=place), torch.randn(3, 4, device=place)
    after = state.call(error, velocity, every)
    torch.testing.assert_close(after[0], fresh.call(error, velocity, every)[0])
    assert (after[1] - fresh.call(error, velocity, every)[1]).abs().max() > 1e-3


ENGINES = [
    ("mujoco", "cpu"),
    pytest.param("mujoco-warp", "cpu", marks=pytest.mark.slow),
    pytest.param("newton", "cpu", marks=pytest.mark.slow),
    pytest.param("mujoco-warp", "cuda", marks=CUDA),
    pytest.param("newton", "cuda", marks=CUDA),
]


@pytest.mark.parametrize(("engine", "device"), ENGINES)
def test_a_network_that_is_the_law_moves_as_the_law(engine, device, tmp_path):
    """At steps of 5 ms the torque of a call acts for one step, as the law's does."""
    network = make_backend(engine, scene_of(tmp_path, law_network()), device=device)
    law = make_backend(engine, scene_of(tmp_path), device=device)
    number, place = {"dtype": law.dtype, "device": law.device}, {"device": law.device}
    targets = torch.tensor([GO2.default_joint_position] * 2, **number) + torch.tensor([[0.2], [-0.1]], **number)
    delay, sample_at = torch.tensor([0, 2], **place), torch.tensor([3, 0], **place)
    strength, offset = torch.full((2, 12), 0.9, **number), torch.full((2, 12), 0.03, **number)
    for backend in (network, law):
        backend.randomize(Randomization(motor_strength=strength, motor_offset=offset))
        backend.reset(replace(backend.standing(), held_target=None))
        backend.step(None, substeps=1)
        for turn in range(5):
            backend.step(targets + 0.02 * turn, delay=delay, sample_at=sample_at)
    tolerance = 1e-6 if engine == "mujoco" else 2e-3  # the network computes in float32
    for name in ("joint_position", "base_position_w", "joint_torque"):
        own, theirs = getattr(network.state, name), getattr(law.state, name)
        scale = 10.0 if name == "joint_torque" else 1.0
        torch.testing.assert_close(own, theirs, atol=scale * tolerance, rtol=0.0)
    torch.testing.assert_close(network.sample.joint_position[0], law.sample.joint_position[0], atol=tolerance, rtol=0.0)


def test_torque_is_held_between_calls_limited_and_cleared_at_a_reset(tmp_path):
    backend = make_backend("mujoco", scene_of(tmp_path, law_network(), timestep=0.0025, substeps=8))
    backend.reset(replace(backend.standing(), held_target=None))
    backend.step(None, substeps=1)
    assert backend.state.joint_torque.abs().max() == 0.0  # limp
    target = backend.state.joint_position.clone() + 0.1
    start = backend.state.joint_velocity.clone()
    backend.step(target, substeps=2)
    torch.testing.assert_close(backend.state.joint_torque, torch.full((2, 12), 2.0).double() - KD * start)
    backend.step(target + 10.0, substeps=2)
    limit = torch.tensor(GO2.parameters["gauge"].torque_limit, dtype=torch.float64)
    torch.testing.assert_close(backend.state.joint_torque, limit.expand(2, 12))
    backend.reset(replace(backend.standing(), held_target=None), torch.tensor([True, False]))
    backend.step(None, substeps=2)
    assert backend.state.joint_torque[0].abs().max() == 0.0 and backend.state.joint_torque[1].abs().max() > 1.0


def test_networks_are_called_at_their_own_period_or_not_at_all(tmp_path):
    with pytest.raises(BackendError, match=r"made for a call every 5 ms, which physics steps of 2 ms .* do not give"):
        make_backend("mujoco", scene_of(tmp_path, law_network(), timestep=0.002, substeps=10))
    backend = make_backend("mujoco", scene_of(tmp_path, law_network()))
    with pytest.raises(BackendError, match="stiffness_scale changes gains"):
        backend.randomize(Randomization(stiffness_scale=torch.ones(2, 12)))


def test_a_file_comes_back_and_damage_is_said(tmp_path):
    save_motor_network(law_network(source="made here"), tmp_path / "net.npz")
    back = load_motor_network(tmp_path / "net.npz")
    assert back.source == "made here" and back.history == 2
    np.testing.assert_array_equal(back.arrays["weight_0"], law_network().arrays["weight_0"])
    (tmp_path / "other.npz").write_bytes(b"no")
    np.savez(tmp_path / "bare.npz", weight_0=np.zeros((1, 4)))
    for name, sentence in (("other", "is no .npz file"), ("bare", "has the format ''"), ("gone", "cannot be read")):
        with pytest.raises(MotorNetworkError, match=sentence):
            load_motor_network(tmp_path / f"{name}.npz")
    with pytest.raises(MotorNetworkError, match=r"bias_0 has the shape \(2,\); it must be \(1,\)"):
        MotorNetwork(kind="feed-forward", arrays={"weight_0": np.zeros((1, 4)), "bias_0": np.zeros(2)})
    with pytest.raises(MotorNetworkError, match="not all finite"):
        MotorNetwork(kind="feed-forward", arrays={"weight_0": np.full((1, 4), np.nan), "bias_0": [0.0]})


def test_a_set_with_a_network_says_where_it_comes_from(tmp_path):
    table = {
        k: getattr(GO2.parameters["gauge"], k)[0]
        for k in ("stiffness", "damping", "armature", "joint_damping", "friction_loss")
    }
    table |= {"torque_limit": 30.0, "motor": "network", "network": "net.npz", "measured": "a test"}
    found = parameter_set(GO2, table, "a file", folder=tmp_path)
    assert found.network == str(tmp_path / "net.npz")
    with pytest.raises(RobotError, match="without measured"):
        parameter_set(GO2, {k: v for k, v in table.items() if k != "measured"}, "a file", folder=tmp_path)
    with pytest.raises(RobotError, match="belong together"):
        parameter_set(GO2, table | {"motor": "law"}, "a file", folder=tmp_path)
