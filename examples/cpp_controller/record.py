"""Writes down 200 steps of a walk in MuJoCo: what the robot measured, and what gaitgauge's policy did with it.

    gaitgauge export pretrained --layout unitree --out unitree
    python record.py pretrained unitree states.csv

Motors are in the order of the maker's SDK, as a robot gives them; actions are in the policy's.
"""

from __future__ import annotations

import argparse
import csv
from dataclasses import replace
from pathlib import Path

import torch
from gaitgauge.backends.base import TRAINING_PHYSICS, Randomization, ResetState, Scene
from gaitgauge.backends.registry import make_backend
from gaitgauge.gauge.motors import joint_parameters
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.contract import PolicyContract
from gaitgauge.policy.foreign.deploy_yaml import deploy_contract
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.observation import ObservationBuilder
from gaitgauge.policy.robot_of import robot_for
from gaitgauge.robots import Robot
from gaitgauge.robots.rotation import projected_gravity
from gaitgauge.terrains.registry import make_terrain

STEPS = 200


def record(policy_name: str, folder: Path, out: Path) -> None:
    """Walk over waves, and write a line for each step."""
    policy = load_policy(policy_name)
    robot = robot_for(policy.contract)
    deployed = deploy_contract(folder / "params" / "deploy.yaml", robot)
    # the controller fills the history with the first observation, whatever the policy was trained on
    policy.contract = replace(policy.contract, history=replace(policy.contract.history, start=deployed.history.start))
    physics = make_backend("mujoco", scene_for(policy.contract, robot))
    physics.randomize(Randomization(friction=torch.tensor([0.8], dtype=physics.dtype)))
    terrain = physics.scene.terrains[0]
    x, y, z = terrain.spawns["level_search"].position
    place = torch.tensor([[x, y, z + robot.stand_height]], dtype=physics.dtype)
    upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=physics.dtype)
    held = torch.tensor([robot.default_joint_position], dtype=physics.dtype)
    physics.reset(ResetState(base_position=place, base_quaternion=upright, held_target=held))
    builder, session = ObservationBuilder(policy.contract, robot, 1), policy.session(1)
    motors = [robot.joint_names.index(name) for name in robot.sdk_joint_names or robot.joint_names]
    action = torch.zeros(1, robot.num_joints)
    with out.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        for step in range(STEPS):
            command = torch.tensor([[0.8, 0.0, 0.5 if step > STEPS // 2 else 0.0]], dtype=physics.dtype)
            state = physics.state
            columns = {
                "angular_velocity": state.base_angular_velocity_b[0].clone(),
                "gravity": projected_gravity(state.base_quaternion_w)[0].clone(),
                "command": command[0],
                "position": state.joint_position[0, motors],
                "velocity": state.joint_velocity[0, motors],
            }
            action = session.act(builder.build(state, command, action))
            targets = builder.targets(action)
            columns |= {"action": action[0], "target": targets[0, motors]}
            if step == 0:
                writer.writerow([f"{name}.{i}" for name, values in columns.items() for i in range(len(values))])
            writer.writerow([f"{float(v):.17g}" for values in columns.values() for v in values])
            physics.step(targets.to(physics.dtype))
    height = float(physics.state.base_position_w[0, 2])
    physics.close()
    if height < 0.5 * robot.stand_height:
        raise SystemExit("the robot fell, so this is no walk to compare on")
    print(f"wrote {out}, {STEPS} steps")


def scene_for(contract: PolicyContract, robot: Robot) -> Scene:
    """One robot on waves, with the gains that the policy was made for."""
    suite = replace(load_suite("gaitgauge-1"), gains="contract")
    substeps = round(contract.control_period / TRAINING_PHYSICS.timestep)
    return Scene(
        robot=robot,
        parameters=joint_parameters(suite, robot, contract),
        terrains=(make_terrain("wave", 3),),
        terrain_index=(0,),
        physics=replace(TRAINING_PHYSICS, substeps=substeps),
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", help="the policy that was exported")
    parser.add_argument("folder", type=Path, help="what 'gaitgauge export --layout unitree' wrote")
    parser.add_argument("out", type=Path, help="file to write (.csv)")
    words = parser.parse_args()
    record(words.policy, words.folder, words.out)
