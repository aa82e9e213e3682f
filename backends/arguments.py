"""What every engine refuses alike, before anything changes: masks, shapes, terrains and substeps that the contract does not know."""

from __future__ import annotations

from dataclasses import fields

import torch

from .base import BackendError, Randomization, ResetState, Scene


def check_worlds(scene: Scene, worlds: torch.Tensor | None) -> None:
    """Refuse what is no mask of a scene's worlds, (N,) bool or None.

    Raises:
        BackendError: says what it is instead.
    """
    if worlds is not None and (worlds.dtype != torch.bool or worlds.shape != (scene.num_worlds,)):
        raise BackendError(
            f"the mask of worlds must be {scene.num_worlds} booleans, not {tuple(worlds.shape)} of {worlds.dtype}"
        )


def check_start(scene: Scene, start: ResetState, worlds: torch.Tensor | None) -> None:
    """Refuse arguments of ``PhysicsBackend.reset``. Terrains on a GPU are not looked at, which would mean to wait for it.

    Raises:
        BackendError: mask, a field's shape, or the terrain of a masked world.
    """
    check_worlds(scene, worlds)
    n, joints = scene.num_worlds, scene.robot.num_joints
    _check_shape("base_position", start.base_position, (n, 3))
    _check_shape("base_quaternion", start.base_quaternion, (n, 4))
    _check_shape("base_linear_velocity", start.base_linear_velocity, (n, 3))
    _check_shape("base_angular_velocity", start.base_angular_velocity, (n, 3))
    _check_shape("joint_position", start.joint_position, (n, joints))
    _check_shape("joint_velocity", start.joint_velocity, (n, joints))
    _check_shape("held_target", start.held_target, (n, joints))
    index = start.terrain_index
    _check_shape("terrain_index", index, (n,))
    if index is None or any(each is not None and each.device.type != "cpu" for each in (index, worlds)):
        return
    chosen = index if worlds is None else index[worlds]
    if chosen.numel():
        scene.check_terrains(int(chosen.min()), int(chosen.max()))


def check_step(
    scene: Scene,
    joint_targets: torch.Tensor | None,
    *,
    delay: torch.Tensor | None,
    sample_at: torch.Tensor | None,
    worlds: torch.Tensor | None,
    substeps: int | None,
) -> int:
    """Refuse arguments of ``PhysicsBackend.step``.

    Returns:
        The number of substeps to take.

    Raises:
        BackendError: mask, shape, or less than one substep.
    """
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
    *,
    linear_velocity_w: torch.Tensor | None,
    angular_velocity_b: torch.Tensor | None,
) -> None:
    """Refuse arguments of ``PhysicsBackend.push``.

    Raises:
        BackendError: mask or shape.
    """
    check_worlds(scene, worlds)
    _check_shape("linear_velocity_w", linear_velocity_w, (scene.num_worlds, 3))
    _check_shape("angular_velocity_b", angular_velocity_b, (scene.num_worlds, 3))


def check_force(scene: Scene, force_w: torch.Tensor) -> None:
    """Refuse arguments of ``PhysicsBackend.apply_force``.

    Raises:
        BackendError: the shape.
    """
    _check_shape("force_w", force_w, (scene.num_worlds, 3))


def check_randomization(scene: Scene, randomization: Randomization, worlds: torch.Tensor | None) -> None:
    """Refuse arguments of ``PhysicsBackend.randomize``, but for the number of rows, which only looking at the mask tells.

    Raises:
        BackendError: mask, or what a field has for each world.
    """
    check_worlds(scene, worlds)
    joints, bodies = scene.robot.num_joints, len(scene.robot.collision_bodies)
    columns = {"friction": (), "base_mass_offset": (), "link_mass_scale": (bodies,), "base_com_offset": (3,)}
    for item in fields(Randomization):
        value = getattr(randomization, item.name)
        row = columns.get(item.name, (joints,))
        if value is not None and (value.dim() == 0 or value.shape[1:] != row):
            wanted = ", ".join(("W", *map(str, row))) + ("" if row else ",")
            raise BackendError(
                f"Randomization.{item.name} has shape {tuple(value.shape)}, but must be ({wanted}), a row for each of W worlds"
            )


def _check_shape(name: str, value: torch.Tensor | None, shape: tuple[int, ...]) -> None:
    if value is not None and value.shape != shape:
        raise BackendError(f"{name} has shape {tuple(value.shape)}, but must be {shape}")
