"""What is mirrored at the sagittal plane and stepped is what is stepped and mirrored: every robot that ships, in MuJoCo."""

from dataclasses import replace

import pytest
import torch
from gaitgauge.backends.base import TRAINING_PHYSICS, ResetState, Scene
from gaitgauge.backends.registry import make_backend
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.observation import ObservationBuilder
from gaitgauge.robots import load_robot, robot_names
from gaitgauge.terrains.registry import make_terrain
from gaitgauge.training.algorithms.symmetry import build_mirror
from gaitgauge.training.environment.configuration import ObservationConfiguration
from gaitgauge.training.environment.policy_interface import driven_robot, training_contract
from gaitgauge.training.tasks import TASKS

ROBOTS = sorted(robot_names())
LEFT_TO_RIGHT = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
COMMAND = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
PAIRS = 3
"""Worlds, each with its mirror image behind all of them."""


def mirror_of(robot):
    return build_mirror(ObservationConfiguration(), contract=standard_contract(robot), robot=robot)


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("group", ["policy", "history", "privileged", "action"])
def test_mirroring_twice_is_nothing(name, group):
    mapping = getattr(mirror_of(load_robot(name)), group)
    values = torch.randn(5, mapping.width)
    assert torch.equal(mapping(mapping(values)), values)
    assert not torch.equal(mapping(values), values)


# Left and right of ANYmal's model are alike; a Go1's trunk has its mass 2 mm beside the middle. A wrong sign is 0.1 or more.
# The G1 with its legs driven and a gait clock for each foot.
@pytest.mark.parametrize(("name", "apart"), [("anymal_c", 1e-4), ("go1", 0.03), ("go2", 2e-3), ("g1-walk", 0.03)])
def test_a_mirrored_state_steps_to_a_mirrored_state(name, apart):
    """Turning, pushed, with joints anywhere about the pose and random targets, on a ground on which it lands."""
    if name in TASKS:
        settings = TASKS[name].environment
        robot = driven_robot(load_robot(settings.robot), settings)
        contract = training_contract(robot, robot.parameters["training"], settings)
    else:
        robot = load_robot(name)
        contract = standard_contract(robot)
    mirror = build_mirror(ObservationConfiguration(), contract=contract, robot=robot)
    whole = build_mirror(ObservationConfiguration(), contract=standard_contract(load_robot(robot.name)), robot=robot)
    draw = torch.Generator().manual_seed(4)
    scene = Scene(
        robot=robot,
        parameters=robot.parameters["gauge"],
        terrains=(make_terrain("flat"),),
        terrain_index=(0,) * (2 * PAIRS),
        physics=replace(TRAINING_PHYSICS, iterations=100, tolerance=1e-10),
    )

    def drawn(*shape, size):
        return size * (2.0 * torch.rand(shape, generator=draw) - 1.0).double()

    def with_images(values, image):
        return torch.cat((values, image(values)))

    def axial(values):
        return -values * LEFT_TO_RIGHT

    def turned(values):
        return torch.cat((values[:, :1], axial(values[:, 1:])), dim=1)

    turn = torch.nn.functional.normalize(torch.tensor([[1.0, 0.0, 0.0, 0.0]]).double() + drawn(PAIRS, 4, size=0.1))
    default = torch.tensor(robot.default_joint_position).double()
    place = torch.tensor([0.0, 0.0, robot.stand_height]).double() + drawn(PAIRS, 3, size=0.02)
    backend = make_backend("mujoco", scene, device="cpu")
    try:
        backend.reset(
            ResetState(
                base_position=with_images(place, lambda v: v * LEFT_TO_RIGHT),
                base_quaternion=with_images(turn, turned),
                base_linear_velocity=with_images(drawn(PAIRS, 3, size=0.5), lambda v: v * LEFT_TO_RIGHT),
                base_angular_velocity=with_images(drawn(PAIRS, 3, size=0.5), axial),
                joint_position=default + with_images(drawn(PAIRS, robot.num_joints, size=0.2), whole.action),
            )
        )
        builder = ObservationBuilder(contract, robot, 2 * PAIRS)
        command = with_images(torch.tensor([[0.5, 0.2, 0.3]] * PAIRS).double(), lambda v: v * COMMAND)
        # another half of a cycle: where one foot swings, the other one does in the mirror
        builder.clocks[PAIRS:] = 20.0
        moved = torch.zeros(())
        for _ in range(10):
            action = with_images(drawn(PAIRS, contract.num_joints, size=0.5), mirror.action)
            backend.step(builder.targets(action))
            frame = builder.build(backend.state, command, action).double()
            difference = mirror.policy(frame[:PAIRS]) - frame[PAIRS:]
            moved = torch.maximum(moved, frame[:PAIRS].abs().max())
            assert difference.abs().max() < apart
        assert backend.state.foot_contact_force_w.norm(dim=-1).max() > 10.0
        assert moved > 0.3
        position = backend.state.base_position_w
        torch.testing.assert_close(position[:PAIRS] * LEFT_TO_RIGHT, position[PAIRS:], atol=apart, rtol=0.0)
    finally:
        backend.close()
