"""What contacts do to a walking robot, by engine, friction cone, impratio and solver iterations, beside a converged solver.

    python benchmarks/contact_accuracy.py                                    # MuJoCo, all settings, all grounds
    python benchmarks/contact_accuracy.py --engine mujoco-warp --worlds 8 --seconds 2 --settings pyramidal,1,6
    python benchmarks/contact_accuracy.py --settings elliptic,10,6 --foot-condim 4 --no-self-collision

Robots walk with a policy (the shipped one unless ``--policy`` names another) in the physics of training
(``TRAINING_PHYSICS`` but for what is varied, and motors whose torque does not fall with speed: the contacts are compared,
not what a policy makes of motors, of which the shipped one learned with some up to five times as fast) on flat ground, on
stairs (forwards level 7, backwards level 5) and on a height field (waves, level 6). Every physics step after the first
half second counts until a robot falls. Printed are, for each ground and setting: the force on a foot that 99 % and 99.9 %
of all feet and steps stay below and the largest; the depth of loaded feet (over 20 N) in the ground and the horizontal
speed of their centres, likewise; and how many robots fell or diverged. ``converged`` stands for MuJoCo's solver with 200
iterations and a tolerance of 1e-10; the first row is MuJoCo's at 1 ms with an elliptic cone. Runs on the CPU.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from gaitgauge.backends import PhysicsBackend, PhysicsOptions, ResetState, Scene, make_backend
from gaitgauge.backends.base import TRAINING_PHYSICS
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.observation import ObservationBuilder
from gaitgauge.robots import load_robot
from gaitgauge.robots.rotation import from_yaw
from gaitgauge.terrains.base import Terrain
from gaitgauge.terrains.registry import make_terrain

GROUNDS = {"flat": [("flat", 0)], "stairs": [("stairs_fd", 7), ("stairs_bd", 5)], "field": [("wave", 6)]}
SETTINGS = [
    *(f"pyramidal,100,{iterations}" for iterations in (6, 15, "converged")),
    "pyramidal,10,6",
    *(f"pyramidal,1,{iterations}" for iterations in (3, 4, 6, 10, "converged")),
    *(f"elliptic,{impratio},{iterations}" for impratio in (100, 1) for iterations in (6, "converged")),
]
START = 0.5
"""Time before anything counts [s]."""
LOADED = 20.0
"""Normal force from which a foot counts as loaded [N]."""
FOOT_RADIUS = 0.022
"""Of the Go2 [m]."""
COLUMNS = (
    "ground  cone      impratio iterations |   force 99 %   99.9 %    most [N] | "
    "depth 99 %  99.9 % [mm] | speed 50 %   95 % [m/s] | fell diverged"
)


@dataclass(frozen=True, kw_only=True)
class Contacts:
    """What the feet of all robots felt."""

    force: np.ndarray
    """[N], every foot and step."""
    depth: np.ndarray
    """[m], loaded feet."""
    speed: np.ndarray
    """[m/s], loaded feet."""
    fell: int
    diverged: int

    def row(self) -> str:
        """A line of the table."""
        force, depth, speed = (
            np.quantile(values, shares) if len(values) else [np.nan] * 2
            for values, shares in (
                (self.force, (0.99, 0.999)),
                (1e3 * self.depth, (0.99, 0.999)),
                (self.speed, (0.5, 0.95)),
            )
        )
        return (
            f"{force[0]:13.0f} {force[1]:8.0f} {self.force.max():11.0f} | {depth[0]:10.1f} {depth[1]:12.1f} | "
            f"{speed[0]:10.3f} {speed[1]:12.3f} | {self.fell:4} {self.diverged:8}"
        )


def options(setting: str, **changes: Any) -> PhysicsOptions:
    """Training's physics with ``CONE,IMPRATIO,ITERATIONS`` and other changes."""
    cone, impratio, iterations = setting.split(",")
    physics = replace(TRAINING_PHYSICS, cone=cone, impratio=float(impratio), torque_speed_limit=False, **changes)
    if iterations == "converged":
        return replace(physics, iterations=200, ls_iterations=100, tolerance=1e-10)
    return replace(physics, iterations=int(iterations))


def walk(
    engine: str, ground: str, physics: PhysicsOptions, *, worlds: int, seconds: float, path: str = "pretrained"
) -> Contacts:
    """Let robots walk, each with another command, and look at their feet after every physics step."""
    robot = load_robot("go2")
    policy = load_policy(path, robot)
    terrains = [make_terrain(name, level) for name, level in GROUNDS[ground]]
    index = tuple(i % len(terrains) for i in range(worlds))
    scene = Scene(
        robot=robot,
        parameters=robot.parameters["training"],
        terrains=tuple(terrains),
        terrain_index=index,
        physics=physics,
    )
    backend = make_backend(engine, scene)
    places = [terrains[i].spawns["level_search"] for i in index]
    position = torch.tensor([p.position for p in places], dtype=backend.dtype)
    position[:, 2] += robot.stand_height + 0.02
    heading = from_yaw(torch.tensor([p.yaw for p in places], dtype=backend.dtype))
    backend.reset(ResetState(base_position=position, base_quaternion=heading))
    random = torch.Generator().manual_seed(0)
    sideways, turning = torch.rand(2, worlds, generator=random) - 0.5
    command = torch.stack([torch.linspace(0.4, 1.2, worlds), 0.3 * sideways, 0.6 * turning], dim=1)
    builder = ObservationBuilder(policy.contract, robot, worlds, "cpu")
    session = policy.session(worlds, device="cpu")
    action = torch.zeros(worlds, robot.num_joints)
    walking, diverged = torch.ones(worlds, dtype=torch.bool), torch.zeros(worlds, dtype=torch.bool)
    seen: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for period in range(round(seconds / physics.control_period)):
        action = session.act(builder.build(backend.state, command, action))
        targets = builder.targets(action).to(backend.dtype)
        for substep in range(physics.substeps):
            backend.step(targets if substep == 0 else None, substeps=1)
            state = backend.state
            diverged |= state.diverged
            walking &= ~diverged & (state.base_quaternion_w[:, 1:3].square().sum(1) < 0.25)
            if period * physics.control_period >= START:
                seen.append(look(backend, terrains, index, walking))
    backend.close()
    force, depth, speed = (np.concatenate(values) for values in zip(*seen, strict=True))
    return Contacts(force=force, depth=depth, speed=speed, fell=int((~walking).sum()), diverged=int(diverged.sum()))


def look(
    backend: PhysicsBackend, terrains: list[Terrain], index: tuple[int, ...], walking: torch.Tensor
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Forces on all feet, and depths and speeds of the loaded ones, of the robots that walk."""
    state = backend.state
    force = state.foot_contact_force_w.norm(dim=-1)[walking].numpy().ravel()
    position, velocity = state.foot_position_w.numpy().astype(np.float64), state.foot_velocity_w.numpy()
    ground = np.stack([terrains[i].height(feet[:, 0], feet[:, 1]) for i, feet in zip(index, position, strict=True)])
    loaded = ((state.foot_normal_force > LOADED) & walking[:, None]).numpy()
    depth = (ground + FOOT_RADIUS - position[..., 2])[loaded]
    return force, depth, np.linalg.norm(velocity[..., :2], axis=-1)[loaded]


def main(argv: list[str] | None = None) -> None:
    """Walk and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engine", default="mujoco", help="registry name")
    parser.add_argument("--worlds", type=int, default=16, help="robots")
    parser.add_argument("--seconds", type=float, default=4.0, help="time walked")
    parser.add_argument("--ground", nargs="+", choices=GROUNDS, default=list(GROUNDS))
    parser.add_argument("--settings", nargs="+", default=SETTINGS, metavar="CONE,IMPRATIO,ITERATIONS")
    parser.add_argument("--policy", default="pretrained")
    parser.add_argument("--foot-condim", type=int, default=TRAINING_PHYSICS.foot_condim)
    parser.add_argument(
        "--self-collision", action=argparse.BooleanOptionalAction, default=TRAINING_PHYSICS.self_collision
    )
    arguments = parser.parse_args(argv)
    changes = {"foot_condim": arguments.foot_condim, "self_collision": arguments.self_collision}
    print(COLUMNS)
    for ground in arguments.ground:
        rows = [(setting, options(setting, **changes)) for setting in arguments.settings]
        if arguments.engine == "mujoco":
            fine = replace(options("elliptic,1,converged", **changes), timestep=0.001, substeps=20)
            rows.insert(0, ("elliptic,1,1 ms", fine))
        for setting, physics in rows:
            found = walk(
                arguments.engine,
                ground,
                physics,
                worlds=arguments.worlds,
                seconds=arguments.seconds,
                path=arguments.policy,
            )
            cone, impratio, iterations = setting.split(",")
            print(f"{ground:7} {cone:9} {impratio:>8} {iterations:>10} | {found.row()}", flush=True)


if __name__ == "__main__":
    main()
