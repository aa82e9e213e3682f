"""How a policy fares on training tiles of one kind at fixed levels: a known policy shows what training asks, pays and ends.

    python benchmarks/fixed_levels.py pretrained --kind stairs_up --levels 5 6 7 8 --worlds 32
    python benchmarks/fixed_levels.py pretrained RUN/model_1800.pt --levels 6 8 --ahead 0.8 --terms

The training environment of ``go2-moe-cts`` on MuJoCo, with the schedules at their end, in the last stretch; levels never
move. The student acts without exploration noise. Prints for each level: episodes that would move it up and down, among those
that count; the mean share of the commanded speed, along the robot's present heading and along the commanded one; how long it
heads more than 45 and 90 degrees off; reward per second; and which rules ended episodes, with how many of the stuck robots
walked: had more than half of the commanded speed of late along their own heading. Further arguments are settings, as for
``gaitgauge train``.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace

import torch
from gaitgauge.policy.loading import load_policy
from gaitgauge.training.environment.configuration import CommandConfiguration, CommandStage, Ramp
from gaitgauge.training.environment.environment import TrainingEnvironment
from gaitgauge.training.environment.memory import EnvironmentMemory
from gaitgauge.training.environment.randomness import UniformColumns
from gaitgauge.training.environment.rewards import progress_share
from gaitgauge.training.environment.step_inputs import StepInputs
from gaitgauge.training.environment.stretches import settings_in
from gaitgauge.training.environment.terminations import Ends
from gaitgauge.training.tasks import find_task

WALKING = "stuck but walking"
_OF_LATE = 4.0
"""Time constant of the mean that tells who walks [s]."""
LOOKED_AT = ("steps", "moving", "along base", "along command", "off 45", "off 90")


def steady(forward: float, lateral: float) -> CommandConfiguration:
    """The same speeds [m/s] for whole episodes, each of which holds the heading that it begins with."""
    stage = CommandStage(begin=0.0, forward=(forward, forward), lateral=(lateral, lateral), yaw=(-1.0, 1.0))
    never = Ramp(start=0.0, end=0.0)
    return CommandConfiguration(
        stages=(stage,),
        interval=1000.0,
        dynamic=False,
        straight_probability=1.0,
        extreme_probability=0.0,
        stationary_probability=never,
        heading_gain=1.0,
    )


class FixedLevels:
    """A policy on tiles of one kind, some worlds for each level."""

    def __init__(
        self,
        policy: str,
        *,
        kind: str,
        levels: Sequence[int],
        worlds: int,
        speeds: tuple[float, float] | None,
        settings: Sequence[str],
    ) -> None:
        """Build the worlds.

        Args:
            policy: file or name.
            kind: a kind of tile.
            levels: which levels.
            worlds: how many worlds in all.
            speeds: command these throughout, forward and to the left [m/s]; None for the task's commands.
            settings: ``environment.…=value``.
        """
        configuration = find_task("go2-moe-cts", settings).environment
        configuration = settings_in(configuration, len(configuration.schedule.stretches))
        tiles = tuple(replace(t, share=float(t.name == kind)) for t in configuration.terrain.tiles)
        configuration = replace(
            configuration,
            num_envs=worlds,
            commands=configuration.commands if speeds is None else steady(*speeds),
            terrain=replace(configuration.terrain, tiles=tiles),
            schedule=replace(configuration.schedule, begin=1.0, stretches=()),
        )
        self.environment = TrainingEnvironment(configuration, backend="mujoco", device="cpu")
        self.network = load_policy(policy, self.environment.robot).network.eval()
        self.level = torch.tensor([levels[i % len(levels)] for i in range(worlds)])
        self.sums = {level: dict.fromkeys(LOOKED_AT, 0.0) for level in levels}
        self.rewards: dict[int, torch.Tensor] = defaultdict(lambda: torch.zeros(len(self.terms)))
        self.moves = {level: Counter[str]() for level in levels}
        self.ends = {level: Counter[str]() for level in levels}
        self._own_share = torch.zeros(worlds)
        parts = self.environment.parts
        self.terms = parts.rewards.names
        self._terminations, self._move, self._step_rewards = parts.terminations, parts.levels.move, parts.rewards
        parts.terminations = self._ends  # type: ignore[assignment]
        parts.levels.move = self._judge  # type: ignore[method-assign]
        parts.rewards = self._earn  # type: ignore[assignment]
        parts.memory.level.copy_(self.level)
        parts.memory.moves_level.zero_()
        self.environment._begin(self.level)

    def _ends(self, inputs: StepInputs) -> Ends:
        """The environment's own, after a look at headings, and counted."""
        moving = inputs.command[:, :2].norm(dim=1) >= 0.1
        base = progress_share(replace(inputs, commanded_heading_xy=inputs.heading_xy))
        cosine = (inputs.heading_xy * inputs.commanded_heading_xy).sum(dim=1)
        values = (torch.ones_like(base), moving, base * moving, progress_share(inputs) * moving)
        for level, row in self.sums.items():
            here = self.level == level
            for name, value in zip(LOOKED_AT, (*values, cosine < 0.7071, cosine < 0.0), strict=True):
                row[name] += float(value[here].float().sum())
        ends = self._terminations(inputs)
        self._own_share.lerp_((base * moving).nan_to_num(0.0), inputs.period / _OF_LATE)
        for world, rule in ends.by_rule.nonzero().tolist():
            name = self._terminations.names[rule]
            walks = name == "stuck" and self._own_share[world] > 0.5
            self.ends[int(self.level[world])][WALKING if walks else name] += 1
        self._own_share.masked_fill_(ends.failed | ends.time_out, 0.0)
        return ends

    def _earn(self, inputs: StepInputs, progress: torch.Tensor) -> torch.Tensor:
        values = self._step_rewards(inputs, progress)
        for level in self.sums:
            self.rewards[level] = self.rewards[level] + values[self.level == level].sum(dim=0)
        return values

    def _judge(
        self, memory: EnvironmentMemory, uniform: UniformColumns, worlds: torch.Tensor, failed: torch.Tensor
    ) -> None:
        """Count what the rule would do, and leave the level as it is."""
        counted = worlds & memory.moves_level
        memory.level.copy_(self.level)
        self._move(memory, uniform, worlds, failed)
        for world in counted.nonzero().flatten().tolist():
            level, far = int(self.level[world]), float(memory.farthest[world])
            up = far > self.environment.configuration.terrain.promotion_distance
            self.moves[level]["up" if up else "down" if memory.level[world] < level else "same"] += 1
        palette = self.environment.palette.index
        wrong = worlds & (memory.level != self.level)
        variant = torch.randint(palette.shape[2], (len(worlds),))
        memory.level.copy_(self.level)
        memory.terrain_index.copy_(torch.where(wrong, palette[0, self.level, variant], memory.terrain_index))

    def play(self, seconds: float) -> None:
        """Step all worlds for so long."""
        environment = self.environment
        for _ in range(round(seconds / environment.configuration.physics.control_period)):
            with torch.no_grad():
                history = environment.get_observations()["history"].float()
                environment.step(self.network(history.view(len(self.level), -1, self.network.frame_width)))

    def lines(self, *, terms: bool) -> list[str]:
        """What is printed."""
        found = []
        for level, row in self.sums.items():
            moves, steps, moving = self.moves[level], max(row["steps"], 1.0), max(row["moving"], 1.0)
            per_second = self.rewards[level] / (steps * self.environment.configuration.physics.control_period)
            found.append(
                f"level {level:2}  up {moves['up']} down {moves['down']} same {moves['same']}  share of the speed: present "
                f"heading {row['along base'] / moving:.3f}, commanded {row['along command'] / moving:.3f}  off by 45: "
                f"{row['off 45'] / steps:.2f}, 90: {row['off 90'] / steps:.2f}  reward {float(per_second.sum()):.3f}/s"
            )
            found.append(
                "    ends: " + (", ".join(f"{name} {n}" for name, n in sorted(self.ends[level].items())) or "none")
            )
            if terms:
                earned = zip(self.terms, per_second.tolist(), strict=True)
                found += [f"    {name:20} {value:7.3f}" for name, value in earned if value != 0.0]
        return found


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("policies", nargs="+", help="policy files or names, and settings KEY=VALUE")
    parser.add_argument("--kind", default="stairs_up", help="kind of tile")
    parser.add_argument("--levels", nargs="+", type=int, default=[5, 6, 7, 8])
    parser.add_argument("--worlds", type=int, default=32, help="worlds in all")
    parser.add_argument("--seconds", type=float, default=25.0, help="time to play; an episode lasts 25 s")
    parser.add_argument("--ahead", type=float, help="command this forward speed throughout, at the first heading [m/s]")
    parser.add_argument("--aside", type=float, help="command this speed to the left throughout, likewise [m/s]")
    parser.add_argument("--terms", action="store_true", help="rewards term by term")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    settings = [p for p in arguments.policies if "=" in p]
    given = arguments.ahead, arguments.aside
    speeds = None if given == (None, None) else (arguments.ahead or 0.0, arguments.aside or 0.0)
    for policy in (p for p in arguments.policies if "=" not in p):
        played = FixedLevels(
            policy,
            kind=arguments.kind,
            levels=arguments.levels,
            worlds=arguments.worlds,
            speeds=speeds,
            settings=settings,
        )
        played.play(arguments.seconds)
        print(policy, *played.lines(terms=arguments.terms), sep="\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
