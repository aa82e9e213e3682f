"""What every engine makes of arguments at and beyond their limits."""

from collections.abc import Iterator

import pytest
import torch
from gaitgauge.backends import PhysicsBackend, Randomization, Scene
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
