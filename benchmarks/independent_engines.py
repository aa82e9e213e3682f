"""Compare engines on the Go2: the model, walks on flat ground, stairs, time. Prints the tables of the report on independent engines.

python benchmarks/independent_engines.py mujoco mujoco@foot_condim=3 drake physx
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import numpy as np
import torch
from gaitgauge.backends import BackendError, PhysicsOptions, Randomization, ResetState, Scene, make_backend
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.observation import ObservationBuilder
from gaitgauge.robots import load_robot
from gaitgauge.robots.rotation import in_heading
from gaitgauge.terrains.base import Terrain
from gaitgauge.terrains.registry import make_terrain

ROBOT = load_robot("go2")
POLICY = load_policy("pretrained", ROBOT)
FRICTION = 0.6
COMMANDS = ((0.5, 0.0, 0.0), (1.0, 0.0, 0.0), (-0.5, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 1.0))
WALK, SKIP = 5.0, 2.6
"""Duration of a walk and what of it is not averaged [s]."""
LANES = (-0.2, -0.1, 0.0, 0.1, 0.2)
"""Lateral starts on stairs [m]."""


def build(name: str, terrain: Terrain, worlds: int) -> object:
    """Return the worlds of an engine, named as ``gaitgauge consistency`` names it, on one terrain."""
    engine, _, option = name.partition("@")
    condim = int(option.partition("=")[2]) if option else None
    physics = PhysicsOptions(torque_speed_limit=True, foot_condim=condim)
    parameters = ROBOT.parameters["gauge"]
    index = (0,) * worlds
    scene = Scene(robot=ROBOT, parameters=parameters, terrains=(terrain,), terrain_index=index, physics=physics)
    backend = make_backend(engine, scene)
    backend.randomize(Randomization(friction=torch.full((worlds,), FRICTION, dtype=backend.dtype)))
    return backend


def play(backend: object, start: ResetState, commands: Sequence[Sequence[float]], seconds: float):  # noqa: ANN201
    """Yield the state after every control step; microseconds of processor time for each physics step at the end."""
    n = len(commands)
    builder, session = ObservationBuilder(POLICY.contract, ROBOT, n), POLICY.session(n)
    backend.reset(start)
    action, command = torch.zeros(n, ROBOT.num_joints), torch.tensor(commands, dtype=torch.float32)
    for _ in range(round(seconds / backend.scene.physics.control_period)):
        observation = builder.build(backend.state, command, action)
        action = session.act(observation)
        backend.step(builder.targets(action).to(backend.dtype))
        yield backend.state


def walk(name: str) -> str:
    """Return the row of an engine: speed along each command on flat ground, time of a physics step."""
    backend = build(name, Terrain(name="flat", family="flat"), len(COMMANDS))
    sums, count, began = np.zeros((len(COMMANDS), 3)), 0, time.process_time()
    for step, state in enumerate(play(backend, backend.standing(), COMMANDS, WALK)):
        if step >= SKIP / 0.02:
            flat = in_heading(state.base_quaternion_w, state.base_linear_velocity_w)
            sums += torch.cat([flat, state.base_angular_velocity_b[:, 2:]], 1).double().numpy()
            count += 1
    spent = (time.process_time() - began) / (WALK / 0.002 * len(COMMANDS))
    found = [abs(sums[row] / count)[int(np.argmax(np.abs(command)))] for row, command in enumerate(COMMANDS)]
    fallen = " (fell)" if bool(backend.state.diverged.any()) else ""
    return f"| `{name}` | " + " | ".join(f"{v:.3f}" for v in found) + f" | {1e6 * spent:.0f}{fallen} |"


def climb(name: str, terrain_name: str, level: int) -> str:
    """Return the row of an engine: forward speed at 0.5 m/s on a terrain, mean and scatter over lateral starts."""
    terrain = make_terrain(terrain_name, level)
    backend = build(name, terrain, len(LANES))
    pose = next(iter(terrain.spawns.values()))
    standing = backend.standing()
    place = torch.tensor([pose.position], dtype=backend.dtype).repeat(len(LANES), 1)
    place[:, 1] += torch.tensor(LANES, dtype=backend.dtype)
    place[:, 2] += ROBOT.stand_height
    start = ResetState(base_position=place, base_quaternion=standing.base_quaternion, held_target=standing.held_target)
    seconds = 8.0
    for state in play(backend, start, [(0.5, 0.0, 0.0)] * len(LANES), seconds):
        last = state
    speed = (last.base_position_w - place)[:, 0].double().numpy() / seconds
    return f"| `{name}` | {speed.mean():.3f} | {speed.std(ddof=1):.3f} | {', '.join(f'{v:.3f}' for v in speed)} |"


def model(name: str) -> str:
    """Return the row of an engine: the largest relative difference of each field of its model from MuJoCo's."""
    flat = Terrain(name="flat", family="flat")
    reference, found = build("mujoco", flat, 1).describe(), build(name, flat, 1).describe()
    cells = [np.max(np.abs(np.subtract(found[k], v)) / np.maximum(np.abs(v), 1e-9)) for k, v in reference.items()]
    return f"| `{name}` | " + " | ".join(f"{cell:.0e}" for cell in cells) + " |"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("engines", nargs="+")
    parser.add_argument("--stairs", nargs=2, default=("stairs_fd", "6"), metavar=("TERRAIN", "LEVEL"))
    asked = parser.parse_args()
    torch.set_num_threads(1)
    terrain, level = asked.stairs[0], int(asked.stairs[1])
    for title, row in (
        ("model", model),
        ("walk: " + ", ".join(map(str, COMMANDS)), walk),
        (f"{terrain} {level}: mean, scatter, each", lambda name: climb(name, terrain, level)),
    ):
        print(f"\n{title}")
        for name in asked.engines:
            try:
                print(row(name), flush=True)
            except BackendError as refusal:
                print(f"| `{name}` | {refusal} |", flush=True)


if __name__ == "__main__":
    main()
