"""Refuse wrong masks, shapes, terrains and numbers of substeps for every engine alike, before anything changes."""

from __future__ import annotations

from dataclasses import fields

import torch

from .base import BackendError, Randomization, ResetState, Scene


def check_worlds(scene: Scene, worlds: torch.Tensor | None) -> None:
    """Raise ``BackendError`` unless ``worlds`` is None or a mask of the scene's worlds, (N,) bool."""
    if worlds is not None and (worlds.dtype != torch.bool or worlds.shape != (scene.num_worlds,)):
        found = f"{tuple(worlds.shape)} of {worlds.dtype}"
        raise BackendError(f"the mask of worlds must be {scene.num_worlds} booleans, not {found}")


def check_start(scene: Scene, start: ResetState, worlds: torch.Tensor | None) -> None:
    """Raise ``BackendError`` for a wrong mask or shape of ``PhysicsBackend.reset``, or an unknown terrain of a masked world.

    Terrains on a GPU are not checked, because the check would wait for the GPU.
    """
    check_worlds(scene, worlds)
    columns: dict[str, tuple[int, ...]] = {"base_quaternion": (4,), "terrain_index": ()}
    for item in fields(ResetState):
        joints = (scene.robot.num_joints,) if item.name.startswith(("joint_", "held_")) else (3,)
        _check_shape(item.name, getattr(start, item.name), (scene.num_worlds, *columns.get(item.name, joints)))
    index = start.terrain_index
    if index is None or any(each is not None and each.device.type != "cpu" for each in (index, worlds)):
        return
    chosen = index if worlds is None else index[worlds]
    if chosen.numel():
        scene.check_terrains(int(chosen.min()), int(chosen.max()))


def check_step(
    scene: Scene,
    joint_targets: torch.Tensor | None,
    delay: torch.Tensor | None,
    sample_at: torch.Tensor | None,
    worlds: torch.Tensor | None,
    substeps: int | None,
) -> int:
    """Return the number of substeps of ``PhysicsBackend.step``; raise ``BackendError`` for a wrong mask or shape, or no substep."""
    check_worlds(scene, worlds)
    n = scene.num_worlds
    _check_shape("joint_targets", joint_targets, (n, scene.robot.num_joints))
    _check_shape("delay", delay, (n,))
    _check_shape("sample_at", sample_at, (n,))
    total = scene.physics.substeps if substeps is None else substeps
    if total < 1:
        raise BackendError(f"substeps is {total}, but a step has at least one")
    return total


def check_push(
    scene: Scene,
    worlds: torch.Tensor | None,
    linear_velocity_w: torch.Tensor | None,
    angular_velocity_b: torch.Tensor | None,
) -> None:
    """Raise ``BackendError`` for a wrong mask or shape of ``PhysicsBackend.push``."""
    check_worlds(scene, worlds)
    _check_shape("linear_velocity_w", linear_velocity_w, (scene.num_worlds, 3))
    _check_shape("angular_velocity_b", angular_velocity_b, (scene.num_worlds, 3))


def check_force(scene: Scene, force_w: torch.Tensor) -> None:
    """Raise ``BackendError`` for a wrong shape of ``PhysicsBackend.apply_force``."""
    _check_shape("force_w", force_w, (scene.num_worlds, 3))


def check_randomization(scene: Scene, randomization: Randomization, worlds: torch.Tensor | None) -> None:
    """Raise ``BackendError`` for a wrong mask of ``PhysicsBackend.randomize`` or a wrong shape of a field's rows.

    The number of rows is not checked here, because it depends on the mask's values.
    """
    check_worlds(scene, worlds)
    joints, bodies = scene.robot.num_joints, len(scene.robot.collision_bodies)
    columns: dict[str, tuple[int, ...]] = dict.fromkeys(
        ("friction", "foot_torsion", "foot_softness", "base_mass_offset"), ()
    )
    columns |= {"link_mass_scale": (bodies,), "base_com_offset": (3,)}
    for item in fields(Randomization):
        value = getattr(randomization, item.name)
        row = columns.get(item.name, (joints,))
        if value is not None and (value.dim() == 0 or value.shape[1:] != row):
            wanted = ", ".join(("W", *map(str, row))) + ("" if row else ",")
            shape = f"shape {tuple(value.shape)}, but must be ({wanted})"
            raise BackendError(f"Randomization.{item.name} has {shape}, a row for each of W worlds")


def _check_shape(name: str, value: torch.Tensor | None, shape: tuple[int, ...]) -> None:
    if value is not None and value.shape != shape:
        raise BackendError(f"{name} has shape {tuple(value.shape)}, but must be {shape}")
