"""What a task pays a robot on level ground for one command, by the speed at which it walks: is a faster one always paid more?

    python benchmarks/reward_landscape.py pretrained --task go2-dreamwaq --told 2 0 0 --progress 1 [key=value …]

A trained policy walks at shares of the command; the rewards are those of the whole command, at a fraction of the run with its ramps and
stretches, on the highest level. Where standing is paid more than walking slowly, a robot that does not yet walk fast learns to stand.
Means of eight worlds after the first two seconds [1/s]. Needs no GPU.
"""

from __future__ import annotations

import argparse

import torch
from gaitgauge.policy.loading import load_policy
from gaitgauge.training.environment.environment import TrainingEnvironment
from gaitgauge.training.environment.step_inputs import StepInputs
from gaitgauge.training.tasks import find_task

SHARES, WORLDS, SETTLING = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0), 8, 100


def main() -> None:
    """Walk, and print one line for each share."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy")
    parser.add_argument("settings", nargs="*", help="environment.…=value")
    parser.add_argument("--task", default="go2-dreamwaq")
    parser.add_argument("--told", type=float, nargs=3, default=(2.0, 0.0, 0.0), help="forward, lateral, yaw")
    parser.add_argument("--progress", type=float, default=1.0, help="fraction of the run")
    parser.add_argument("--seconds", type=float, default=6.0)
    arguments = parser.parse_intermixed_args()
    tiles = [tile.name for tile in find_task(arguments.task).environment.terrain.tiles if tile.name != "flat"]
    given = [
        *(f"environment.terrain.tiles.{name}.share=0" for name in tiles),
        f"environment.num_envs={len(SHARES) * WORLDS}",
        "environment.push.interval=0",
        f"environment.schedule.begin={arguments.progress}",
    ]
    task = find_task(arguments.task, [*given, *arguments.settings])
    environment = TrainingEnvironment(task.environment, backend="mujoco", device="cpu", threads=2, fuse=False)
    parts, memory = environment.parts, environment.parts.memory
    told, pay = torch.tensor(arguments.told), parts.rewards
    rewards, speeds = [], []

    def record(inputs: StepInputs, progress: torch.Tensor) -> torch.Tensor:
        values = pay(inputs, progress)
        rewards.append(values / task.environment.physics.control_period)
        speeds.append(inputs.base_linear_velocity_b[:, :2].clone())
        return values

    parts.rewards = record  # type: ignore[assignment]
    contract = environment.contract
    policy = load_policy(arguments.policy, environment.robot)
    if (policy.contract.joint_names, policy.contract.observation) != (contract.joint_names, contract.observation):
        parser.error(f"'{arguments.policy}' observes or drives something else than the task's policies")
    session, share = policy.session(environment.num_envs), torch.tensor(SHARES).repeat_interleave(WORLDS)
    term = next(i for i, term in enumerate(contract.observation) if term.name == "command")
    at, scale = sum(contract.term_widths[:term]), torch.tensor(contract.observation[term].scale)
    observation = environment.get_observations()["policy"]
    for _ in range(round(arguments.seconds / task.environment.physics.control_period)):
        memory.level.fill_(task.environment.terrain.levels - 1)
        memory.command.copy_(told.expand_as(memory.command))
        memory.command_steps.fill_(1000)
        memory.holds_heading.fill_(False)
        seen = observation.clone()
        seen[:, at : at + 3] = share[:, None] * told * scale
        observation = environment.step(session.act(seen))[0]["policy"]
    paid, walked = (
        torch.stack(values[SETTLING:]).mean(0).view(len(SHARES), WORLDS, -1).mean(1) for values in (rewards, speeds)
    )
    shown = [i for i in range(len(pay.names)) if bool((paid[:, i].abs() > 0.02).any())]
    print("asked    walks          total  " + "  ".join(pay.names[i] for i in shown))
    for asked, (forward, lateral), values in zip(SHARES, walked.tolist(), paid, strict=True):
        terms = "  ".join(f"{float(values[i]):{len(pay.names[i])}.2f}" for i in shown)
        print(f"{asked:5.1f}  {forward:5.2f}, {lateral:5.2f}  {float(values.sum()):7.2f}  {terms}")


if __name__ == "__main__":
    main()
