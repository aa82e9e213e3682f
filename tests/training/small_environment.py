"""Small training environments on the scripted engine, for the tests of this folder."""

from dataclasses import replace
from unittest.mock import patch

import torch
from gaitgauge.training.environment import environment
from gaitgauge.training.environment.configuration import (
    EnvironmentConfiguration,
    PushConfiguration,
    ResetConfiguration,
    TerminationConfiguration,
)
from gaitgauge.training.environment.environment import TrainingEnvironment
from gaitgauge.training.environment.terrain_configuration import ALL_TILES, FLAT_TILE, TerrainConfiguration
from gaitgauge_fake_engine import FakeBackend, FakeScript

torch.set_num_threads(1)  # small tensors: threads only get in each other's way

FLAT = TerrainConfiguration(tiles=(FLAT_TILE,), levels=1, variants=1, spread_probability=0.0)
STAIRS = TerrainConfiguration(
    tiles=tuple(
        replace(t, share=share)
        for t in ALL_TILES
        for name, share in (("stairs_up", 0.25), ("flat", 0.15))
        if t.name == name
    ),
    levels=3,
    variants=1,
    spread_probability=0.0,
)
FALLS_END = TerminationConfiguration(trunk_contact=1.0)  # the scripted robot falls on its trunk
STILL = ResetConfiguration(velocity=0.0, joint_scale=(1.0, 1.0))
NO_PUSH = PushConfiguration(interval=0.0)


def make(num_envs=8, *, script=None, physics=None, seed=0, **settings):
    """An environment of ``num_envs`` worlds; without other settings flat, at rest and never pushed."""
    settings = {"terrain": FLAT, "reset": STILL, "push": NO_PUSH, "termination": FALLS_END, **settings}
    configuration = EnvironmentConfiguration(num_envs=num_envs, seed=seed, **settings)
    if physics is not None:
        configuration = replace(configuration, physics=replace(configuration.physics, **physics))
    return scripted_environment(configuration, script or FakeScript())


def scripted_environment(configuration, script):
    """An environment whose robots do as a script says."""
    with patch.object(environment, "make_backend", lambda name, scene, **_: FakeBackend(scene, script=script)):
        return TrainingEnvironment(configuration)


def gliding(forward=0.0, lateral=0.0, yaw=0.0):
    """A script in which every base moves at a constant twist, whatever the legs do."""

    def motion(backend):
        linear = torch.tensor([forward, lateral, 0.0], dtype=backend.dtype).expand(backend.num_worlds, 3)
        angular = torch.tensor([0.0, 0.0, yaw], dtype=backend.dtype).expand(backend.num_worlds, 3)
        return linear, angular

    return FakeScript(motion=motion)


def idle(environment, steps=1):
    """Steps with the zero action; returns what the last one returned."""
    action = torch.zeros(environment.num_envs, environment.num_actions)
    for _ in range(steps):
        result = environment.step(action)
    return result
