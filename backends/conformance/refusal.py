"""Checks that an engine refuses undeclared capabilities, one check for each, and wrong arguments: it ignores nothing silently."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from ...terrains.base import Box, HeightField, Terrain
from ..base import BackendError, Randomization
from .bench import FLAT, Bench, ConformanceError, Worlds, expect
from .check import ENGINE_ERRORS, check

_BOX = Terrain(name="conformance_box", family="box", boxes=(Box(center=(0.0, 0.0, 0.1), half_size=(1.0, 1.0, 0.1)),))
_FIELD = Terrain(
    name="conformance_field",
    family="field",
    height_field=HeightField(center=(0.0, 0.0), half_size=(1.0, 1.0), heights=np.zeros((5, 5))),
)


def _build(bench: Bench, **scene: object) -> None:
    with bench.worlds(**scene):  # type: ignore[arg-type]
        pass


def _ask(bench: Bench, request: Callable[[Worlds], None]) -> None:
    with bench.worlds() as worlds:
        worlds.reset()
        request(worlds)


def _randomize(
    field: str, value: float, shape: Callable[[Bench], tuple[int, ...]] = lambda bench: ()
) -> Callable[[Bench], None]:
    return lambda bench: _ask(bench, lambda w: w.randomize(**{field: np.full((w.count, *shape(bench)), value)}))


def _joints(bench: Bench) -> tuple[int, ...]:
    return (bench.robot.num_joints,)


REQUESTS: dict[str, Callable[[Bench], None]] = {
    "plane": lambda bench: _build(bench, terrains=(FLAT,)),
    "boxes": lambda bench: _build(bench, terrains=(_BOX,)),
    "height_field": lambda bench: _build(bench, terrains=(_FIELD,)),
    "per_world_terrain": lambda bench: _build(bench, terrains=(FLAT, _BOX), terrain_index=(0, 1, 0, 1)),
    "friction": _randomize("friction", 0.7),
    "foot_contact": _randomize("foot_torsion", 0.5),
    "base_mass": _randomize("base_mass_offset", 1.0),
    "link_mass": _randomize("link_mass_scale", 1.1, lambda bench: (len(bench.robot.collision_bodies),)),
    "base_com": _randomize("base_com_offset", 0.01, lambda bench: (3,)),
    "gains": _randomize("stiffness_scale", 1.1, _joints),
    "motor_strength": _randomize("motor_strength", 0.9, _joints),
    "motor_speed": _randomize("motor_speed", 1.5, _joints),
    "motor_offset": _randomize("motor_offset", 0.01, _joints),
    "latency": lambda bench: _ask(bench, lambda w: w.step(w.default_pose, delay=[1] * w.count)),
    "push": lambda bench: _ask(bench, lambda w: w.push(linear_velocity_w=np.ones((w.count, 3)))),
    "external_force": lambda bench: _ask(bench, lambda w: w.apply_force(np.ones((w.count, 3)))),
    "torque_limits": lambda bench: _build(bench, torque_limits=True),
    "torque_speed_limit": lambda bench: _build(
        bench,
        parameters=bench.soft(full_torque_speed=10.0, no_load_speed=20.0),
        torque_limits=True,
        torque_speed_limit=True,
    ),
    "joint_friction": lambda bench: _build(bench, parameters=bench.soft(friction_loss=0.2)),
    "elliptic_cone": lambda bench: _build(bench, cone="elliptic"),
    "foot_condim_6": lambda bench: _build(bench, foot_condim=6),
    "self_collision": lambda bench: _build(bench, self_collision=True),
    "penetration": lambda bench: _build(bench, watch_penetration=0.02),
    "deterministic": lambda bench: _build(bench, deterministic=True),
    "gpu": lambda bench: bench.make(bench.scene(), "cuda").close(),
}
"""Request to an engine by the capability that it needs; contact forces need no request."""


def accepts_or_refuses(capability: str) -> Callable[[Bench], str]:
    """Return the check of one capability: the engine accepts a supported request and raises ``BackendError`` for others."""

    def run(bench: Bench) -> str:
        declared = bench.capabilities[capability].support.value
        possible = bench.supports(capability) and (capability != "gpu" or torch.cuda.is_available())
        try:
            REQUESTS[capability](bench)
        except BackendError as refusal:
            expect(not possible, f"declared as '{declared}', but refused: {refusal}")
            expect(len(str(refusal)) > 20, f"the refusal says too little: '{refusal}'")
            return f"refused: {refusal}"
        expect(possible, f"declared as '{declared}', but accepted without BackendError")
        return declared

    run.__doc__ = f"The engine takes a request for '{capability}' if it declares it, and raises BackendError if not."
    return run


def _mistakes(worlds: Worlds) -> dict[str, Callable[[], None]]:
    """Return calls with wrong arguments, by a description of the mistake."""
    backend, n = worlds.backend, worlds.count
    start = backend.standing()

    def zeros(*shape: int) -> torch.Tensor:
        return torch.zeros(shape, dtype=backend.dtype, device=backend.device)

    def numbers(*shape: int, value: int = 1) -> torch.Tensor:
        return torch.full(shape, value, dtype=torch.int64, device=backend.device)

    joints, some = worlds.robot.num_joints, torch.arange(n, device=backend.device) < 1
    pose = zeros(n, joints)
    mistakes: dict[str, Callable[[], None]] = {
        "one base_position for all masked worlds": lambda: backend.reset(
            replace(start, base_position=start.base_position[:1]), some
        ),
        "one held_target for all worlds": lambda: backend.reset(replace(start, held_target=zeros(1, joints))),
        "a mask for one world more": lambda: backend.reset(start, torch.cat((some, some[:1]))),
        "joint_targets for one world": lambda: backend.step(zeros(1, joints)),
        "joint_targets for one joint": lambda: backend.step(zeros(n, 1)),
        "a delay for one world": lambda: backend.step(pose, delay=numbers(1)),
        "a sample_at for one world": lambda: backend.step(pose, sample_at=numbers(1)),
        "a mask of numbers": lambda: backend.step(pose, worlds=numbers(n)),
        "no substeps": lambda: backend.step(pose, substeps=0),
        "one velocity to push all worlds to": lambda: backend.push(linear_velocity_w=zeros(3)),
        "one force for all worlds": lambda: backend.apply_force(zeros(3)),
        "one motor_strength for all joints": lambda: backend.randomize(Randomization(motor_strength=zeros(n, 1))),
    }
    if not start.base_position.is_cuda:  # an engine on a GPU does not check terrains, which would wait for the device
        for value in (-1, len(backend.scene.terrains)):
            beyond = replace(start, terrain_index=numbers(n, value=value))
            mistakes[f"terrain {value}"] = partial(backend.reset, beyond)
    return mistakes


@check("refusal/arguments")
def arguments(bench: Bench) -> str:
    """Wrong arguments (shape, mask, terrain, substeps) are refused and change nothing."""
    with bench.worlds() as worlds:
        worlds.reset()
        worlds.step(worlds.default_pose)
        before, mistakes = worlds.read(), _mistakes(worlds)
        for what, call in mistakes.items():
            try:
                call()
            except BackendError as refusal:
                expect(len(str(refusal)) > 20, f"the refusal of {what} says too little: '{refusal}'")
            except ENGINE_ERRORS as error:
                kind = type(error).__name__
                raise ConformanceError(f"{what} raises {kind} ('{error}') in place of BackendError") from error
            else:
                raise ConformanceError(f"{what} is accepted")
        after = worlds.read()
        for name, value in vars(before).items():
            expect(np.array_equal(getattr(after, name), value), f"state.{name} changes though everything was refused")
    return f"{len(mistakes)} mistakes"


for _name in REQUESTS:
    check(f"refusal/{_name}")(accepts_or_refuses(_name))
