"""What every engine makes of arguments at and beyond their limits."""

from collections.abc import Callable, Iterator
from dataclasses import fields, replace

import pytest
import torch
from gaitgauge.backends import BackendError, PhysicsBackend, Randomization, Scene
from gaitgauge.backends.base import SMALLEST_BASE_MASS
from gaitgauge.backends.registry import make_backend
from gaitgauge.robots import load_robot
from gaitgauge.terrains import make_terrain

ENGINES = ("mujoco", "mujoco-warp", pytest.param("newton", marks=pytest.mark.slow))


@pytest.fixture(scope="module", params=ENGINES)
def backend(request: pytest.FixtureRequest) -> Iterator[PhysicsBackend]:
    """Two worlds of a Go2 on flat ground."""
    robot = load_robot("go2")
    parameters = robot.parameters[robot.default_parameters]
    flat = make_terrain("flat")
    engine = make_backend(
        request.param, Scene(robot=robot, parameters=parameters, terrains=(flat, flat), terrain_index=(0, 1))
    )
    yield engine
    engine.close()


def test_a_base_keeps_a_little_mass_whatever_is_taken(backend: PhysicsBackend):
    names = backend.scene.robot.collision_bodies
    base = names.index(backend.scene.robot.base_body)
    backend.randomize(Randomization(base_mass_offset=torch.full((2,), -100.0)))
    assert backend.describe()["body_mass"][base] == pytest.approx(SMALLEST_BASE_MASS)
    backend.randomize(Randomization(base_mass_offset=torch.zeros(2)))
    assert backend.describe()["body_mass"][base] > 1.0


MASK = torch.tensor([True, False])
MISTAKES: dict[str, tuple[Callable[[PhysicsBackend], None], str]] = {
    "terrain before the first": (lambda b: reset(b, terrain_index=torch.tensor([0, -1])), "holds -1 to 0.* 0 to 1"),
    "terrain after the last": (lambda b: reset(b, terrain_index=torch.tensor([2, 0])), "holds 0 to 2.* 0 to 1"),
    "terrain of one world": (lambda b: reset(b, terrain_index=torch.tensor([1])), r"terrain_index has shape \(1,\)"),
    "short position": (
        lambda b: reset(b, worlds=MASK, base_position=torch.tensor([[0.0, 0.0, 1.0]])),
        r"base_position has shape \(1, 3\), but must be \(2, 3\)",
    ),
    "one held target": (lambda b: reset(b, held_target=torch.zeros(1, 12)), r"held_target has shape \(1, 12\)"),
    "velocity of three": (lambda b: reset(b, joint_velocity=torch.zeros(2, 3)), r"joint_velocity has shape \(2, 3\)"),
    "targets of one world": (
        lambda b: b.step(torch.zeros(1, 12)),
        r"joint_targets has shape \(1, 12\), but must be \(2, 12\)",
    ),
    "delay of one world": (lambda b: b.step(None, delay=torch.tensor([1])), r"delay has shape \(1,\)"),
    "sample of one world": (lambda b: b.step(None, sample_at=torch.tensor(1)), r"sample_at has shape \(\)"),
    "no substeps": (lambda b: b.step(None, substeps=0), "substeps is 0, but a step has at least one"),
    "mask of numbers": (lambda b: b.step(None, worlds=torch.tensor([0, 1])), r"2 booleans, not \(2,\) of torch.int64"),
    "push of one world": (
        lambda b: b.push(linear_velocity_w=torch.zeros(3)),
        r"linear_velocity_w has shape \(3,\), but must be \(2, 3\)",
    ),
    "force of one world": (lambda b: b.apply_force(torch.ones(3)), r"force_w has shape \(3,\), but must be \(2, 3\)"),
    "one strength a world": (
        lambda b: b.randomize(Randomization(motor_strength=torch.ones(2, 1))),
        r"motor_strength has shape \(2, 1\), but must be \(W, 12\)",
    ),
    "friction of joints": (
        lambda b: b.randomize(Randomization(friction=torch.ones(2, 12))),
        r"friction has shape \(2, 12\), but must be \(W,\)",
    ),
}


def reset(backend: PhysicsBackend, worlds: torch.Tensor | None = None, **changes: torch.Tensor) -> None:
    backend.reset(replace(backend.standing(), **changes), worlds)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_malformed_arguments_are_refused_and_change_nothing(backend: PhysicsBackend, mistake: str):
    """A row for one of two worlds was broadcast to both, and the last terrain taken for the one before the first."""
    call, message = MISTAKES[mistake]
    backend.reset(backend.standing())
    backend.step(None)
    before = backend.state.clone()
    with pytest.raises(BackendError, match=message):
        call(backend)
    after = backend.state.clone()
    assert all(torch.equal(getattr(after, f.name), getattr(before, f.name)) for f in fields(after))


def test_terrains_of_worlds_that_are_not_reset_do_not_matter(backend: PhysicsBackend):
    reset(backend, worlds=MASK, terrain_index=torch.tensor([1, 9]))
    reset(backend, worlds=~MASK & MASK, terrain_index=torch.tensor([9, 9]))


@pytest.mark.parametrize("index", [(0, -1), (0, 1)])
def test_a_scene_s_own_terrains_are_looked_at_too(index: tuple[int, int]):
    robot = load_robot("go2")
    parameters = robot.parameters[robot.default_parameters]
    wrong = f"terrain_index holds {min(index)} to {max(index)}, but the terrains are 0 to 0"
    with pytest.raises(BackendError, match=wrong):
        Scene(robot=robot, parameters=parameters, terrains=(make_terrain("flat"),), terrain_index=index)
