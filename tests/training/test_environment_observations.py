"""Frames, noise, history, the privileged state and the height scan."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from gaitgauge.policy.contract import History
from gaitgauge.policy.observation import ObservationBuilder
from gaitgauge.robots import load_robot
from gaitgauge.terrains.height_scan import HeightRasters, heading, place_pattern, scan_pattern
from gaitgauge.terrains.training_tiles import make_tile
from gaitgauge.training.environment.configuration import (
    NoiseConfiguration,
    ObservationConfiguration,
    ResetConfiguration,
)
from gaitgauge.training.environment.observations import push_history
from gaitgauge_fake_engine import FakeScript
from scipy.spatial.transform import Rotation
from small_environment import STAIRS, gliding, make

SILENT = NoiseConfiguration(base_angular_velocity=0.0, projected_gravity=0.0, joint_position=0.0, joint_velocity=0.0)


def wiggle(environment, steps, seed=0):
    random = torch.Generator().manual_seed(seed)
    for _ in range(steps):
        result = environment.step(torch.randn(environment.num_envs, 12, generator=random) * 0.3)
    return result


@pytest.mark.parametrize("start", ["zeros", "repeat"])
def test_frames_and_history_are_those_of_the_policy_room_s_builder(start):
    seen = ObservationConfiguration(noise=SILENT, history_start=start)
    environment = make(5, script=gliding(0.3, 0.1, 0.5), observations=seen)
    assert environment.contract.history == History(start=start)
    contract = replace(environment.contract, history=History(length=5, start=start))
    builder = ObservationBuilder(contract, load_robot("go2"), 5)
    parts = environment.parts
    expected = builder.build(environment.backend.state, parts.memory.command, parts.memory.action)
    random = torch.Generator().manual_seed(0)
    for step in range(7):
        observations = environment.get_observations()
        assert torch.allclose(observations["history"], expected, atol=1e-6), step
        assert torch.allclose(observations["policy"], expected[:, 180:], atol=1e-6)
        environment.step(torch.randn(5, 12, generator=random) * 0.3)
        expected = builder.build(environment.backend.state, parts.memory.command, parts.memory.action)


def test_noise_amplitudes_and_where_there_is_none():
    noise = NoiseConfiguration(
        base_angular_velocity=0.8, projected_gravity=0.05, joint_position=0.01, joint_velocity=3.0
    )
    environment = make(3000, observations=ObservationConfiguration(noise=noise))
    observations = environment.get_observations()
    error = observations["policy"] - observations["privileged"][:, 3:48]
    for columns, half_width in (
        (slice(0, 3), 0.2),
        (slice(3, 6), 0.05),
        (slice(6, 9), 0.0),
        (slice(9, 21), 0.01),
        (slice(21, 33), 0.15),
        (slice(33, 45), 0.0),
    ):
        block = error[:, columns]
        assert float(block.abs().max()) == pytest.approx(half_width, rel=0.01, abs=1e-6)
        assert float(block.std()) == pytest.approx(half_width / 3**0.5, rel=0.03, abs=1e-6)
    assert torch.equal(observations["history"][:, 180:], observations["policy"]), "a frame keeps its noise"


@pytest.mark.parametrize(("start", "first"), [("zeros", 0.0), ("repeat", 3.0)])
def test_history_is_oldest_first_and_starts_as_the_contract_says(start, first):
    history = torch.zeros(2, 3, 1)
    for value in (1.0, 2.0, 3.0, 4.0):
        forget = torch.tensor([False, value == 3.0])
        history = push_history(history, torch.full((2, 1), value), forget, start=start)
    assert history[:, :, 0].tolist() == [[2.0, 3.0, 4.0], [first, 3.0, 4.0]]


def test_privileged_layout():
    force = torch.tensor([[3.0, 4.0, 0.0], [0.0, 0.0, 60.0], [0.0, 0.0, 0.0], [0.0, 0.0, 7.0]], dtype=torch.float64)
    script = replace(gliding(0.6, -0.2, 0.3), foot_force=lambda b: force.expand(b.num_worlds, 4, 3))
    environment = make(3, script=script)
    wiggle(environment, 3)
    before = environment.backend.state.joint_velocity.clone()
    observations = wiggle(environment, 1, seed=9)[0]
    privileged, state = observations["privileged"], environment.backend.state
    assert torch.allclose(privileged[:, :3], torch.tensor([1.2, -0.4, 0.0]).expand(3, 3), atol=3e-3)
    assert torch.allclose(privileged[:, 3:6], torch.tensor([0.0, 0.0, 0.075]).expand(3, 3), atol=1e-6)
    assert torch.allclose(privileged[:, 48:52], torch.tensor([0.005, 0.06, 0.0, 0.007]).expand(3, 4), atol=1e-6)
    limit = torch.tensor(environment.backend.scene.parameters.torque_limit)
    assert torch.allclose(privileged[:, 52:64], state.joint_torque.float() / limit, atol=1e-5)
    acceleration = (state.joint_velocity - before).float() / 0.02
    assert torch.allclose(privileged[:, 64:76], acceleration * 1e-4, atol=1e-6)
    assert acceleration.abs().max() > 1.0
    assert privileged[:, 76:].shape == (3, 187)
    expected = (state.base_position_w[:, 2:].float() - 0.5) * 2.5
    assert torch.allclose(privileged[:, 76:], expected.expand(3, 187), atol=1e-5)


def test_scan_pattern_has_x_as_the_slow_index():
    pattern = scan_pattern(1.6, 1.0, 0.1, "cpu")
    assert pattern.shape == (187, 2)
    assert pattern[0].tolist() == pytest.approx([-0.8, -0.5])
    assert pattern[1].tolist() == pytest.approx([-0.8, -0.4])
    assert pattern[11].tolist() == pytest.approx([-0.7, -0.5], abs=1e-6)
    assert pattern[93].tolist() == pytest.approx([0.0, 0.0], abs=1e-6)


def test_scan_turns_with_the_heading_alone():
    yaw = torch.tensor([0.5, -2.0])
    tilted = torch.from_numpy(
        Rotation.from_euler("xyz", [[0.4, -0.3, yaw[0]], [0.0, 0.6, yaw[1]]]).as_quat(scalar_first=True)
    ).to(yaw)
    direction = heading(tilted)
    assert torch.allclose(torch.atan2(direction[:, 1], direction[:, 0]), yaw, atol=1e-5)
    assert torch.allclose(direction.norm(dim=1), torch.ones(2))
    points = place_pattern(torch.tensor([[1.0, 0.0], [0.0, 1.0]]), torch.tensor([[5.0, 6.0]] * 2), direction)
    assert points[0, 0].tolist() == pytest.approx([5 + np.cos(0.5), 6 + np.sin(0.5)], abs=1e-5)
    assert points[0, 1].tolist() == pytest.approx([5 - np.sin(0.5), 6 + np.cos(0.5)], abs=1e-5)


@pytest.mark.parametrize("kind", ["stairs_up", "slope_down", "wave", "obstacles"])
def test_rasters_hold_the_terrain_s_heights(kind):
    tiles = [make_tile("flat", 0), make_tile(kind, 7)]
    rasters = HeightRasters(tiles, half_size=4.5, cell=0.05, device="cpu")
    random = np.random.default_rng(0)
    nodes = random.integers(-90, 91, (200, 2)) * 0.05
    found = rasters.height(torch.tensor([1]), torch.tensor(nodes, dtype=torch.float32)[None])[0].numpy()
    assert found == pytest.approx(tiles[1].height(nodes[:, 0], nodes[:, 1]), abs=1e-5)
    assert (rasters.height(torch.tensor([0]), torch.rand(1, 50, 2) * 9 - 4.5) == 0).all()
    # Between nodes the nearest one counts, so a value of the terrain within half a cell.
    points = random.uniform(-4.4, 4.4, (200, 2))
    found = rasters.height(torch.tensor([1]), torch.tensor(points, dtype=torch.float32)[None])[0].numpy()
    nearest = np.round(points / 0.05) * 0.05
    assert found == pytest.approx(tiles[1].height(nearest[:, 0], nearest[:, 1]), abs=1e-5)


def test_rasters_go_on_beyond_their_edge_and_survive_nan():
    tile = make_tile("slope_up", 5)
    rasters = HeightRasters([tile], half_size=4.5, cell=0.1, device="cpu")
    far = rasters.height(torch.tensor([0]), torch.tensor([[[50.0, 0.0], [-1e9, 3.0], [0.0, float("inf")]]]))
    rim = float(tile.height(4.4, 0.0))
    assert far[0, :2].tolist() == pytest.approx([rim, rim])
    assert rasters.height(torch.tensor([0]), torch.full((1, 2, 2), float("nan"))).isfinite().all()


def test_height_entries_are_clipped_and_read_the_world_s_own_terrain():
    environment = make(40, terrain=replace(STAIRS, highest_start_level=2), reset=ResetConfiguration(velocity=0.0))
    privileged = environment.get_observations()["privileged"][:, 76:]
    state, pattern = environment.backend.state, environment.parts.scan
    points = place_pattern(pattern, state.base_position_w[:, :2].float(), heading(state.base_quaternion_w.float()))
    for world in (0, 5, 17, 39):
        terrain = environment.palette.terrains[int(environment.backend.terrain_index[world])]
        node = np.round(points[world].double().numpy() / 0.05) * 0.05
        ground = terrain.height(node[:, 0], node[:, 1])
        expected = np.clip(float(state.base_position_w[world, 2]) - 0.5 - ground, -1, 1) * 2.5
        wrong = np.abs(privileged[world].numpy() - expected) > 1e-3
        assert wrong.mean() < 0.02, "points exactly between two nodes may round either way"
    assert privileged.max() <= 2.5 and privileged.min() >= -2.5


def test_foot_and_base_heights_are_measured_over_the_ground():
    environment = make(8, terrain=replace(STAIRS, highest_start_level=2), script=FakeScript())
    wiggle(environment, 1)
    parts = environment.parts
    state = environment.backend.state
    inputs = parts.read(parts.inputs, parts.memory, parts.action, parts.progress())
    for world in range(8):
        terrain = environment.palette.terrains[int(parts.memory.terrain_index[world])]
        feet = np.round(state.foot_position_w[world].numpy() / 0.05) * 0.05
        expected = state.foot_position_w[world, :, 2].numpy() - terrain.height(feet[:, 0], feet[:, 1])
        assert inputs.foot_height[world].numpy() == pytest.approx(expected, abs=1e-4)
        base = state.base_position_w[world].numpy()
        if max(abs(base[0]), abs(base[1])) < 0.9:
            assert float(inputs.base_height[world]) == pytest.approx(base[2], abs=1e-5), "level ground in the middle"
