import numpy as np
import pytest
import torch
from gaitgauge.robots import rotation
from scipy.spatial.transform import Rotation


@pytest.fixture
def sample() -> tuple[Rotation, torch.Tensor, torch.Tensor]:
    generator = np.random.default_rng(0)
    turns = Rotation.random(50, rng=generator)
    quaternions = torch.from_numpy(turns.as_quat(scalar_first=True))
    return turns, quaternions, torch.from_numpy(generator.normal(size=(50, 3)))


def test_rotate_inverse(sample):
    turns, quaternions, vectors = sample
    np.testing.assert_allclose(rotation.rotate_inverse(quaternions, vectors), turns.inv().apply(vectors), atol=1e-12)


def test_rotate_broadcasts_over_points_of_a_body(sample):
    turns, quaternions, vectors = sample
    points = vectors[:4]
    rotated = rotation.rotate_inverse(quaternions[:, None], points)
    assert rotated.shape == (50, 4, 3)
    np.testing.assert_allclose(rotated[7], turns[7].inv().apply(points), atol=1e-12)


def test_yaw():
    angles = torch.tensor([[0.3, -0.7, 2.9], [-1.0, 0.2, -3.0], [0.0, 0.0, 0.5]], dtype=torch.float64)
    made = torch.from_numpy(Rotation.from_euler("xyz", angles.numpy()).as_quat(scalar_first=True))
    np.testing.assert_allclose(rotation.yaw_of(made), angles[:, 2], atol=1e-12)
    assert _same(rotation.from_yaw(angles[:, 2]), Rotation.from_euler("z", angles[:, 2:].numpy()))


def test_gravity_and_tilt(sample):
    turns, quaternions, _ = sample
    np.testing.assert_allclose(rotation.projected_gravity(quaternions), turns.inv().apply([0, 0, -1.0]), atol=1e-12)
    np.testing.assert_allclose(rotation.tilt(quaternions), np.arccos(turns.apply([0, 0, 1.0])[:, 2]), atol=1e-7)


def test_tilt_is_precise_near_upright_in_single_precision():
    angle = torch.tensor([1e-3, 1e-4, torch.pi - 1e-3])
    made = torch.from_numpy(Rotation.from_euler("x", angle.numpy()[:, None]).as_quat(scalar_first=True)).to(
        torch.float32
    )
    np.testing.assert_allclose(rotation.tilt(made), angle, rtol=1e-3, atol=1e-6)


def _same(quaternions: torch.Tensor, turns: Rotation) -> bool:
    expected = turns.as_quat(scalar_first=True)
    signs = np.sign(np.sum(expected * quaternions.numpy(), axis=-1, keepdims=True))
    return np.allclose(quaternions.numpy() * signs, expected, atol=1e-12)


def test_heading_is_that_of_yaw(sample):
    _, quaternions, _ = sample
    cosine, sine = rotation.heading_of(quaternions)
    yaw = rotation.yaw_of(quaternions)
    np.testing.assert_allclose(cosine, torch.cos(yaw), atol=1e-12)
    np.testing.assert_allclose(sine, torch.sin(yaw), atol=1e-12)


def test_vectors_in_the_heading_and_back(sample):
    _, quaternions, vectors = sample
    forward, left = vectors[:, 0], vectors[:, 1]
    world = rotation.from_heading(quaternions, forward, left)
    turned = Rotation.from_euler("z", rotation.yaw_of(quaternions)[:, None].numpy())
    np.testing.assert_allclose(world, turned.apply(np.stack((forward, left, 0.0 * left), axis=1)), atol=1e-12)
    back = rotation.in_heading(quaternions, world + torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64))
    np.testing.assert_allclose(back, vectors[:, :2], atol=1e-12)
