"""A gauge in which nothing is left to physics: scripted policies, short suites, an engine without physics."""

from collections.abc import Callable, Sequence
from dataclasses import fields, replace

import torch
from gaitgauge.backends import Scene
from gaitgauge.backends.base import PhysicsState
from gaitgauge.gauge.episodes import Episode, Record
from gaitgauge.gauge.play.rollout import Rollout
from gaitgauge.gauge.suite import Goal, Suite, load_suite
from gaitgauge.policy.base import Policy, PolicySession
from gaitgauge.policy.contract import standard_contract
from gaitgauge.robots import load_robot
from gaitgauge.terrains.base import Pose, Terrain
from gaitgauge_fake_engine import FakeBackend, FakeScript

GO2 = load_robot("go2")
DIAGONAL, MAXIMUM, TARGET = "diagonal_velocity", "max_velocity", "target_pos_velocity"
PERIOD = 0.02
Act = Callable[[torch.Tensor], torch.Tensor]
STATE = tuple(item.name for item in fields(PhysicsState))


class ScriptedPolicy(Policy):
    """Answers each observation on its own, entry by entry, and remembers what it was asked."""

    def __init__(self, act: Act | None = None) -> None:
        self.contract = standard_contract(GO2)
        self.path = "scripted"
        self.act = act or (lambda observation: torch.zeros(len(observation), 12))
        self.seen: list[torch.Tensor] = []

    def session(self, num_episodes: int, *, device: str = "cpu") -> PolicySession:
        self.seen = []  # what earlier sessions were asked, as a trial, is of no interest
        return ScriptedSession(self)

    def commands(self, world: int = 0) -> torch.Tensor:
        """Forward, lateral and yaw commands that a world's policy was given, step by step, (T, 3)."""
        return torch.stack([o[world, 6:9] for o in self.seen]) / torch.tensor([2.0, 2.0, 0.25])


class ScriptedSession(PolicySession):
    def __init__(self, policy: ScriptedPolicy) -> None:
        self.policy, self.seen = policy, policy.seen

    def reset(self, episodes: torch.Tensor | None = None) -> None:
        pass

    def act(self, observation: torch.Tensor, rows: torch.Tensor | None = None) -> torch.Tensor:
        self.seen.append(observation.clone())
        return self.policy.act(observation)


def short_suite(
    base: str = "robogauge-1.1",
    *,
    diagonal: tuple[float, float] = (0.1, 0.1),
    maximum: tuple[float, float] = (0.1, 0.1),
    time: float = 0.4,
) -> Suite:
    """A suite whose goals take a moment: ten control steps of two coarse substeps a sub-command, and two to settle."""
    suite = load_suite(base)
    physics = replace(suite.physics, timestep=0.01, substeps=2)
    goals = (
        Goal(name=DIAGONAL, phases=diagonal),
        Goal(name=MAXIMUM, phases=maximum),
        Goal(name=TARGET, phases=()),
    )
    commands = replace(suite.commands, target_time=dict.fromkeys(suite.commands.target_time, time))
    metrics, noise = replace(suite.metrics, interval=5), replace(suite.noise, latency=1)
    settling = replace(suite.settling, shortest=0.02, longest=0.2)
    return replace(
        suite, settling=settling, goals=goals, commands=commands, physics=physics, metrics=metrics, noise=noise
    )


def episode(
    *goals: str, stage: str = "eval", seed: int = 0, friction: float = 0.6, terrain: str = "flat", level: int = 0
) -> Episode:
    return Episode(
        terrain=terrain, level=level, friction=friction, payload=0.0, seed=seed, stage=stage, goals=goals or (DIAGONAL,)
    )


def ground(target: tuple[float, float, float] | None = None, *, backward: bool = False) -> Terrain:
    """A plane with a target, which passes for a slope."""
    start = Pose(position=(0.0, 0.0, 0.0))
    return Terrain(
        name="flat" if target is None else "slope_fd",
        family="flat" if target is None else "slope",
        spawns={"level_search": start, "level_eval": start},
        target=target,
        backward=backward,
    )


class Puppet(FakeBackend):
    """``FakeBackend`` that leaves out feet and contacts, which no test with it looks at: several times faster.

    ``sampled`` lists world, number of resets so far and substeps since the last one of every sample taken.
    """

    def __init__(self, *arguments, **options) -> None:
        self.sampled: list[tuple[int, int, int]] = []
        super().__init__(*arguments, **options)
        self.resting = FakeScript()
        if options.get("script") is None:
            self.script = self.resting

    def _place_feet(self, mask: torch.Tensor) -> None:
        pass

    def _advance(self, mask: torch.Tensor) -> None:
        if self.script is not self.resting or not bool(mask.all()):
            super()._advance(mask)
            return
        state, step = self._state, self.scene.physics.timestep  # the base rests, the joints follow their motors
        state.joint_torque.copy_(self._torque())
        state.joint_velocity.add_(step * state.joint_torque)
        state.joint_position.add_(step * state.joint_velocity)
        self._substeps_since_reset += 1
        state.time.copy_(self._substeps_since_reset.to(self.dtype) * step)

    def _watch(self, mask: torch.Tensor, substep: int) -> None:
        if self.script is not self.resting:
            super()._watch(mask, substep)

    def step(self, joint_targets, *, delay=None, sample_at=None, worlds=None, substeps=None) -> None:
        mask, state = self._mask(worlds), self._state
        count = self.scene.physics.substeps if substeps is None else substeps
        late = torch.zeros(self.num_worlds, dtype=torch.int64) if delay is None else delay
        state.tilt_substep[mask] = 0
        state.penetration_substep[mask] = 0
        for substep in range(1, count + 1):
            self._take_targets(joint_targets, mask & (late == substep - 1))
            self._advance(mask)
            self._watch(mask, substep)
            asked = mask & (torch.zeros_like(late) if sample_at is None else sample_at).eq(substep)
            if bool(asked.any()):
                columns = (torch.arange(self.num_worlds), self.resets, self._substeps_since_reset)
                self.sampled += zip(*(column[asked].tolist() for column in columns), strict=True)
                rows = slice(None) if bool(asked.all()) else asked  # a slice is copied several times faster
                for name in STATE:
                    getattr(self._sample, name)[rows] = getattr(state, name)[rows]
        self._take_targets(joint_targets, mask & (late >= count))


def fake(
    suite: Suite, script: FakeScript | None = None, *, worlds: int = 1, terrain: Terrain | None = None
) -> FakeBackend:
    """An engine without physics that follows a script."""
    return Puppet(scene(suite, worlds, terrain), script=script)


def scene(suite: Suite, worlds: int, terrain: Terrain | None = None) -> Scene:
    """Worlds on one terrain."""
    return Scene(
        robot=GO2,
        parameters=GO2.parameters[suite.parameters],
        terrains=(terrain or ground(),),
        terrain_index=(0,) * worlds,
        physics=suite.physics,
    )


def play(
    suite: Suite,
    episodes: Sequence[Episode],
    script: FakeScript | None = None,
    *,
    worlds: int = 6,
    terrain: Terrain | None = None,
    policy: ScriptedPolicy | None = None,
) -> list[Record]:
    """Records of the episodes in the order in which they ended."""
    return run(suite, fake(suite, script, worlds=worlds, terrain=terrain), episodes, policy)


def run(
    suite: Suite,
    backend: FakeBackend,
    episodes: Sequence[Episode],
    policy: ScriptedPolicy | None = None,
    *,
    watch: Callable[[Rollout], None] = lambda rollout: None,
    **options,
) -> list[Record]:
    """Records of the episodes in the order in which they ended; ``watch`` is called at every poll."""
    rollout = Rollout(suite, policy or ScriptedPolicy(), backend, lambda e: 0, **options)
    rollout.play(episodes)
    return to_the_end(rollout, watch)


def to_the_end(rollout: Rollout, watch: Callable[[Rollout], None] = lambda rollout: None) -> list[Record]:
    """Records of all that a rollout has to play, which must come to an end."""
    records = []
    while not rollout.idle:
        records += rollout.advance()
        watch(rollout)
        assert rollout.control_steps < 4000, "the rollout does not come to an end"
    return records


def beginning(suite: Suite, script: FakeScript | None = None, *, steps: int) -> torch.Tensor:
    """Commands of the first control steps of an episode with the diagonal goal, (steps, 3)."""
    policy = ScriptedPolicy()
    rollout = Rollout(suite, policy, fake(suite, script), lambda e: 0)
    rollout.play([episode(DIAGONAL)])
    for _ in range(steps):
        rollout.advance()
    return policy.commands()


def moving(linear=(0.0, 0.0, 0.0), angular=(0.0, 0.0, 0.0), *, since: float = 0.0):
    """A motion at constant velocity, body frame, that begins some time after each reset [s]."""

    def motion(backend: FakeBackend) -> tuple[torch.Tensor, torch.Tensor]:
        goes = (backend.state.time >= since - 1e-9).to(torch.float64)[:, None]
        return goes * torch.tensor(linear, dtype=torch.float64), goes * torch.tensor(angular, dtype=torch.float64)

    return motion


def tipping(substep: int):
    """A motion that turns the robot upside down in one coarse substep, the given one (1-based) since each reset."""

    def motion(backend: FakeBackend) -> tuple[torch.Tensor, torch.Tensor]:
        now = torch.round(backend.state.time / 0.01).to(torch.int64) + 1
        rate = torch.zeros(backend.num_worlds, 3, dtype=torch.float64)
        rate[:, 0] = now.eq(substep) * 300.0
        return torch.zeros_like(rate), rate

    return motion


def at(seconds: float, worlds: int = 1) -> torch.Tensor:
    """The same moment for every world."""
    return torch.full((worlds,), seconds)
