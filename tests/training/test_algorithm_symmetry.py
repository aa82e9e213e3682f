import pytest
import torch
from gaitgauge.robots import load_robot
from gaitgauge.terrains.height_scan import scan_pattern
from gaitgauge.training.algorithms.symmetry import (
    MirrorMap,
    SymmetryError,
    mirror_points,
)
from toy_training import toy_mirror


@pytest.fixture(scope="module")
def mirror():
    return toy_mirror()


@pytest.mark.parametrize("group, width", [("policy", 45), ("history", 225), ("privileged", 263), ("action", 12)])
def test_mirroring_twice_is_nothing(mirror, group, width):
    mapping: MirrorMap = getattr(mirror, group)
    values = torch.randn(7, width)
    assert mapping.width == width
    assert torch.equal(mapping(mapping(values)), values)
    assert not torch.equal(mapping(values), values)


def test_frame_meaning(mirror):
    """What points to the left points to the right afterwards; pitching and walking ahead stay."""
    frame = torch.zeros(45)
    frame[:9] = torch.arange(1.0, 10.0)
    image = mirror.policy(frame)
    assert image[:9].tolist() == [-1, 2, -3, 4, -5, 6, 7, -8, -9]


def test_joints_change_sides(mirror):
    names = load_robot("go2").joint_names
    action = torch.zeros(12)
    action[names.index("FL_hip_joint")] = 0.3
    action[names.index("RR_calf_joint")] = -0.7
    image = mirror.action(action)
    assert image[names.index("FR_hip_joint")] == pytest.approx(-0.3)
    assert image[names.index("RL_calf_joint")] == pytest.approx(-0.7)
    assert image.count_nonzero() == 2


def test_history_is_mirrored_frame_by_frame(mirror):
    frames = torch.randn(3, 5, 45)
    assert torch.equal(mirror.history(frames.flatten(1)), mirror.policy(frames).flatten(1))


def test_privileged_layout(mirror):
    robot = load_robot("go2")
    state = torch.randn(263)
    image = mirror.privileged(state)
    assert torch.equal(image[:3], state[:3] * torch.tensor([1.0, -1.0, 1.0]))
    assert torch.equal(image[3:48], mirror.policy(state[3:48]))
    left, right = robot.foot_names.index("FL"), robot.foot_names.index("FR")
    assert image[48 + left] == state[48 + right]
    for block in (slice(52, 64), slice(64, 76)):
        assert torch.equal(image[block], mirror.action(state[block]))
    assert torch.equal(image[76:].view(17, 11), state[76:].view(17, 11).flip(1))


def test_a_scan_keeps_its_middle_line():
    scan = mirror_points(scan_pattern(0.2, 0.4, 0.1, "cpu"))
    image = scan(torch.arange(15.0)).view(3, 5)
    assert image[:, 2].tolist() == [2, 7, 12] and image[0].tolist() == [4, 3, 2, 1, 0]


def test_points_without_an_image_are_refused():
    with pytest.raises(SymmetryError, match=r"point \[0\.0, 0\.5\d*\] has no mirror image"):
        mirror_points(torch.tensor([[0.0, 0.5], [0.0, 0.0]]))
