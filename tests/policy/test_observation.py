from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from gaitgauge.backends.base import PhysicsState
from gaitgauge.policy.contract import ContractError, History, ObservationTerm, standard_contract
from gaitgauge.policy.observation import ObservationBuilder
from gaitgauge.robots import load_robot
from scipy.spatial.transform import Rotation

EPISODES = 6
ROBOT = load_robot("go2")
# The order in which the robot's SDK numbers the motors: front right first.
SDK_ORDER = (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8)


def make_state(seed: int = 0) -> PhysicsState:
    generator = np.random.default_rng(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.from_numpy(generator.normal(size=(EPISODES, *shape)))

    values = {f.name: torch.zeros(EPISODES) for f in fields(PhysicsState)}
    values["base_quaternion_w"] = torch.from_numpy(Rotation.random(EPISODES, rng=generator).as_quat(scalar_first=True))
    values["base_linear_velocity_w"] = normal(3)
    values["base_angular_velocity_b"] = normal(3)
    values["joint_position"] = normal(12)
    values["joint_velocity"] = normal(12)
    return PhysicsState(**values)


def make_inputs(seed: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(EPISODES, 3, generator=generator), torch.randn(EPISODES, 12, generator=generator)


def permuted_contract():
    contract = standard_contract(ROBOT)

    def pick(values: tuple) -> tuple:
        return tuple(values[i] for i in SDK_ORDER)

    return replace(
        contract,
        joint_names=pick(contract.joint_names),
        default_joint_position=pick(contract.default_joint_position),
        action_scale=tuple(0.1 * i for i in range(12)),
    )


def test_frame_has_the_published_order_and_scales():
    state, (command, action) = make_state(), make_inputs()
    frame = ObservationBuilder(standard_contract(ROBOT), ROBOT, EPISODES).build(state, command, action)
    assert frame.shape == (EPISODES, 45)
    assert frame.dtype == torch.float32
    down = Rotation.from_quat(state.base_quaternion_w, scalar_first=True).inv().apply([0, 0, -1.0])
    default = np.array(ROBOT.default_joint_position)
    np.testing.assert_allclose(frame[:, 0:3], state.base_angular_velocity_b * 0.25, atol=1e-6)
    np.testing.assert_allclose(frame[:, 3:6], down, atol=1e-6)
    np.testing.assert_allclose(frame[:, 6:9], command * torch.tensor([2.0, 2.0, 0.25]), atol=1e-6)
    np.testing.assert_allclose(frame[:, 9:21], state.joint_position.numpy() - default, atol=1e-6)
    np.testing.assert_allclose(frame[:, 21:33], state.joint_velocity * 0.05, atol=1e-6)
    assert torch.equal(frame[:, 33:45], action)


def test_upright_gravity_points_down():
    state, inputs = make_state(), make_inputs()
    state.base_quaternion_w[:] = torch.tensor([1.0, 0, 0, 0])
    frame = ObservationBuilder(standard_contract(ROBOT), ROBOT, EPISODES).build(state, *inputs)
    assert torch.equal(frame[0, 3:6], torch.tensor([0.0, 0.0, -1.0]))


def test_base_linear_velocity_is_in_the_body_frame():
    contract = replace(
        standard_contract(ROBOT), observation=(ObservationTerm(name="base_linear_velocity_b", scale=(2.0,)),)
    )
    state, inputs = make_state(), make_inputs()
    frame = ObservationBuilder(contract, ROBOT, EPISODES).build(state, *inputs)
    turn = Rotation.from_quat(state.base_quaternion_w, scalar_first=True)
    np.testing.assert_allclose(frame, 2.0 * turn.inv().apply(state.base_linear_velocity_w), atol=1e-6)


def test_noise_is_added_in_physical_units_before_scaling():
    state, inputs = make_state(), make_inputs()
    builder = ObservationBuilder(standard_contract(ROBOT), ROBOT, EPISODES)
    clean = builder.build(state, *inputs)
    noise = {
        "base_angular_velocity_b": torch.full((EPISODES, 3), 0.8),
        "projected_gravity_b": torch.full((EPISODES, 3), 0.05),
        "joint_position": torch.full((EPISODES, 12), 0.01),
        "joint_velocity": torch.full((EPISODES, 12), 3.0),
    }
    shift = builder.build(state, *inputs, noise) - clean
    expected = torch.tensor([0.2] * 3 + [0.05] * 3 + [0.0] * 3 + [0.01] * 12 + [0.15] * 12 + [0.0] * 12)
    np.testing.assert_allclose(shift, expected.expand(EPISODES, -1), atol=2e-6)
    with pytest.raises(ContractError, match="command"):
        builder.build(state, *inputs, {"command": torch.zeros(EPISODES, 3)})


def test_joint_permutation_in_observation_noise_and_targets():
    state, inputs = make_state(), make_inputs()
    straight = ObservationBuilder(standard_contract(ROBOT), ROBOT, EPISODES)
    permuted = ObservationBuilder(permuted_contract(), ROBOT, EPISODES)
    noise = {"joint_position": torch.arange(12.0).expand(EPISODES, -1)}
    a, b = straight.build(state, *inputs, noise), permuted.build(state, *inputs, noise)
    assert torch.equal(b[:, 9:21], a[:, 9:21][:, list(SDK_ORDER)])
    assert torch.equal(b[:, 21:33], a[:, 21:33][:, list(SDK_ORDER)])
    assert torch.equal(b[:, 33:45], a[:, 33:45])
    targets = permuted.targets(torch.ones(EPISODES, 12))
    for policy_joint, robot_joint in enumerate(SDK_ORDER):
        expected = ROBOT.default_joint_position[robot_joint] + 0.1 * policy_joint
        assert targets[0, robot_joint] == pytest.approx(expected, abs=1e-6)


def test_targets_clip_scale_and_offset():
    action = torch.full((EPISODES, 12), 4.0)
    default = torch.tensor(ROBOT.default_joint_position)
    contract = standard_contract(ROBOT)
    np.testing.assert_allclose(ObservationBuilder(contract, ROBOT, EPISODES).targets(action)[0], default + 1.0)
    clipped = replace(contract, action_clip=2.0)
    np.testing.assert_allclose(ObservationBuilder(clipped, ROBOT, EPISODES).targets(-action)[0], default - 0.5)
    limited = replace(contract, target_range=((-0.5, 0.5),) * 12)
    assert ObservationBuilder(limited, ROBOT, EPISODES).targets(action).max() == 0.5
    action[2] = float("nan")
    assert ObservationBuilder(clipped, ROBOT, EPISODES).targets(action).isnan().any(dim=1).nonzero().tolist() == [[2]]


def test_observation_clip_acts_after_scaling():
    terms = (
        ObservationTerm(name="command", scale=(10.0,), clip=3.0),
        ObservationTerm(name="joint_velocity", scale=(1.0,)),
        ObservationTerm(name="base_angular_velocity_b", scale=(10.0,), clip=(1.0, 2.0, 3.0)),
    )
    contract = replace(standard_contract(ROBOT), observation=terms)
    state, (_, action) = make_state(), make_inputs()
    state.base_angular_velocity_b[:] = -5.0
    frame = ObservationBuilder(contract, ROBOT, EPISODES).build(state, torch.full((EPISODES, 3), 1.0), action)
    assert frame[0, :3].tolist() == [3.0, 3.0, 3.0]
    np.testing.assert_allclose(frame[:, 3:15], state.joint_velocity, atol=1e-6)
    assert frame[0, 15:].tolist() == [-1.0, -2.0, -3.0]


def frames_of(
    contract, steps: int, reset_row_before: int | None = None
) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Observations with history and, from a builder without one, the single frames."""
    builder = ObservationBuilder(contract, ROBOT, EPISODES)
    single = ObservationBuilder(replace(contract, history=History()), ROBOT, EPISODES)
    observations, frames = [], []
    for step in range(steps):
        if step == reset_row_before:
            builder.reset(torch.arange(EPISODES) == 1)
        state, inputs = make_state(step), make_inputs(step)
        observations.append(builder.build(state, *inputs))
        frames.append(single.build(state, *inputs))
    return observations, frames


@pytest.mark.parametrize("start", ["zeros", "repeat"])
def test_frame_major_history_oldest_first(start):
    contract = standard_contract(ROBOT, history=History(length=3, order="frame-major", start=start))
    observations, frames = frames_of(contract, 4)
    first = torch.zeros_like(frames[0]) if start == "zeros" else frames[0]
    assert torch.equal(observations[0], torch.cat([first, first, frames[0]], dim=1))
    assert torch.equal(observations[1], torch.cat([first, frames[0], frames[1]], dim=1))
    assert torch.equal(observations[3], torch.cat(frames[1:4], dim=1))


def test_newest_first_history():
    contract = standard_contract(ROBOT, history=History(length=3, order="frame-major-newest-first"))
    observations, frames = frames_of(contract, 3)
    assert torch.equal(observations[2], torch.cat(frames[::-1], dim=1))


def test_term_major_history():
    contract = standard_contract(ROBOT, history=History(length=3, order="term-major"))
    observations, frames = frames_of(contract, 3)
    blocks = [
        torch.cat([f[:, a:b] for f in frames], dim=1) for a, b in ((0, 3), (3, 6), (6, 9), (9, 21), (21, 33), (33, 45))
    ]
    assert torch.equal(observations[2], torch.cat(blocks, dim=1))


@pytest.mark.parametrize("start", ["zeros", "repeat"])
def test_reset_forgets_single_rows(start):
    contract = standard_contract(ROBOT, history=History(length=3, start=start))
    observations, frames = frames_of(contract, 4, reset_row_before=3)
    undisturbed, _ = frames_of(contract, 4)
    others = torch.arange(EPISODES) != 1
    assert torch.equal(observations[3][others], undisturbed[3][others])
    first = torch.zeros(45) if start == "zeros" else frames[3][1]
    assert torch.equal(observations[3][1], torch.cat([first, first, frames[3][1]]))


def test_rows_are_independent():
    contract = standard_contract(ROBOT, history=History(length=3))
    state, (command, action) = make_state(), make_inputs()
    clean = ObservationBuilder(contract, ROBOT, EPISODES).build(state, command, action)
    state.joint_position[2] = float("nan")
    state.base_quaternion_w[2] = float("nan")
    dirty = ObservationBuilder(contract, ROBOT, EPISODES).build(state, command, action)
    others = torch.arange(EPISODES) != 2
    assert torch.equal(clean[others], dirty[others])


def test_other_robots_joints_are_refused():
    contract = standard_contract(ROBOT)
    renamed = replace(contract, joint_names=("tail", *contract.joint_names[1:]))
    with pytest.raises(ContractError, match="tail"):
        ObservationBuilder(renamed, ROBOT, EPISODES)
