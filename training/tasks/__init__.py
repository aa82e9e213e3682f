"""The tasks that can be trained, by name."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches
from types import MappingProxyType

from ...backends.base import TRAINING_PHYSICS
from ...files.parsing import one_line, shown
from ...files.plugins import imported
from ...robots import load_robot
from ...robots.anatomy.roles import PLANS, WORDS, Plan, anatomy
from ...robots.loading import robot_digest
from ..configuration import AlgorithmConfiguration, NetworkConfiguration, Ramp, RunConfiguration, TrainingConfiguration
from ..environment.configuration import (
    CommandConfiguration,
    CommandStage,
    EnvironmentConfiguration,
    ObservationConfiguration,
    PushConfiguration,
    RandomizationConfiguration,
    ResetConfiguration,
    ScheduleConfiguration,
    Stretch,
    TerminationConfiguration,
)
from ..environment.reward_configuration import RewardConfiguration
from ..environment.stretches import with_own, without
from ..environment.terrain_configuration import ALL_TILES, FLAT_TILE, TerrainConfiguration
from ..overrides import TaskError, apply_overrides
from . import biped
from .scaling import scaled


@dataclass(frozen=True, kw_only=True)
class Task:
    """Environment and method of a training, under a name."""

    name: str
    """Name on the command line."""
    title: str
    """One line for people."""
    environment: EnvironmentConfiguration
    """Settings of the environment."""
    training: TrainingConfiguration
    """Settings of the method and the run."""
    backend: str = "mujoco-warp"
    """Physics engine that trains it where a command names none."""
    suite: str = "quick"
    """Suite that scores its checkpoints where a command names none."""

    def with_overrides(self, overrides: Iterable[str]) -> Task:
        """Return the task with some settings changed: ``environment.…`` and ``training.…`` keys, ``STRETCH:environment.…`` for those of
        one stretch.

        Raises:
            TaskError: a key or value that does not fit.
        """
        given, own = list[str](), list[str]()
        for setting in overrides:
            (own if ":" in setting.split("=", 1)[0] else given).append(setting)
        settings = apply_overrides(_Settings(environment=self.environment, training=self.training), given)
        keys = {setting.split("=", 1)[0].strip() for setting in given}
        environment = with_own(without(settings.environment, keys), own)
        return replace(self, environment=environment, training=settings.training)

    def for_robot(self, source: str) -> Task:
        """Return the task for another robot than its own, a name or the path of a description, scaled by its sizes.

        Raises:
            RobotError: it cannot be found, or is wrong.
            TaskError: it has another body plan.
        """
        own, robot = load_robot(self.environment.robot, check=False), load_robot(source)
        if robot_digest(robot) == robot_digest(own):
            return self
        theirs, its = _plan(self.environment.robot), _plan(source)
        if theirs != its:
            raise TaskError(
                f"task '{self.name}' is for {WORDS[theirs]}, and robot '{robot.name}' is {WORDS[its]}; name the ground instead: "
                f"{', '.join(name for name, tasks in GROUNDS.items() if its in tasks) or 'no task is made for it'}"
            )
        environment, training = scaled(self.environment, self.training, source)
        return replace(self, environment=environment, training=training)

    @property
    def shown(self) -> str:
        """Return its name, and the robot's where that is another one than the task is named for."""
        robot = load_robot(self.environment.robot, check=False).name
        own = TASKS[self.name].environment.robot if self.name in TASKS else robot
        return self.name if robot == own else f"{self.name} for {robot}"

    def with_horizon(self) -> Task:
        """Return the task with schedules spread over exactly the run's own iterations."""
        run = self.training.run
        schedule = replace(self.environment.schedule, horizon_steps=run.iterations * run.steps_per_iteration)
        return replace(self, environment=replace(self.environment, schedule=schedule))


@dataclass(frozen=True, kw_only=True)
class _Settings:
    """Settings that overrides may change."""

    environment: EnvironmentConfiguration
    training: TrainingConfiguration


_MIRRORED = AlgorithmConfiguration(symmetry="augment", student_period=2)
_PRECISE_GROUND = replace(
    FLAT_TILE,
    # Told to run, a robot that stands has its whole pay for the yaw rate, and linear tracking is flat that far from the command. With pay
    # for progress and a wide kernel, walking fast is worth more than standing.
    progress=0.5,
    sigma=0.75,
    # The gauge's metrics fall where the trunk bobs. Ground that is to be climbed needs vertical speed; here a robot does without.
    vertical_velocity=2.5,
    interval=3.0,
    reversal_probability=0.5,
    stationary_probability=2.0,
    stationary_yaw_probability=2.0,
)
"""Level ground beside ground that is to be climbed: reversals, standing and turns on the spot are learned here."""
_PRECISE = Stretch(
    name="precise",
    begin=0.5,
    settings=" ".join(
        (
            # Feet resist turning on the ground, as the gauge's do, in some worlds and turn freely in others.
            "environment.physics.foot_condim=4",
            "environment.physics.cone=elliptic",
            "environment.physics.impratio=10",
            "environment.physics.iterations=10",
            "environment.randomization.foot_torsion=0,1",
            "environment.randomization.foot_torsion_ends=0.45",
            # Motors that could turn faster, and a price on doing so: a leg too fast for its motor sinks into a height field's prisms.
            "environment.randomization.motor_speed=1,5",
            "environment.rewards.joint_speed_limits=-0.15",
            "environment.randomization.friction=0.15,1.25",
            # The tracking kernels are narrow. Level ground alone pays more for tracking: a robot that stands on stairs has all of the yaw
            # rate's pay. Level ground prices a bobbing, rocking trunk too. The mean error of a turn on the spot costs most.
            "environment.rewards.tracking_sigma=0.15",
            "environment.rewards.turn_error=-6",
            "environment.rewards.turn_error_time=0.3",
            "environment.terrain.tiles.flat.linear_tracking=3",
            "environment.terrain.tiles.flat.yaw_tracking=3",
            "environment.terrain.tiles.flat.vertical_velocity=50",
            "environment.terrain.tiles.flat.roll_pitch_rate=5",
            # The fastest commands and their opposites tip a robot over.
            "environment.commands.extreme_probability=0.3",
            "environment.terrain.tiles.flat.stationary_probability=3",
            "environment.terrain.tiles.flat.stationary_yaw_probability=3",
            # The grounds on which most is left to gain.
            "environment.terrain.tiles.wave.share=0.18",
            "environment.terrain.tiles.flat.share=0.18",
        )
    ),
)
"""The end of a run on all terrains: what the shipped policy got in stretches that were begun by hand."""
_ALL_TERRAINS = EnvironmentConfiguration(
    num_envs=16384,
    schedule=ScheduleConfiguration(stretches=(_PRECISE,)),
    terrain=TerrainConfiguration(tiles=(*ALL_TILES[:-1], _PRECISE_GROUND)),
    rewards=RewardConfiguration(
        yaw_tracking=0.75,
        progress=1.5,
        vertical_velocity=Ramp(start=-2.0, end=-0.02, begin=0.0, until=0.1),
        collision=-0.25,
        foot_regulation=-0.1,
        foot_height_scale=0.05,
    ),
    commands=CommandConfiguration(straight_probability=0.5, heading_gain=1.0, crossing_probability=0.5),
    termination=TerminationConfiguration(stuck=8.0),
)
_ALL_TERRAINS_LEARNING = AlgorithmConfiguration(
    symmetry="alternate",
    student_period=2,
    # Exploration is worth more while the robot learns to walk and to climb than once it is to be precise.
    entropy_coefficient=Ramp(start=0.01, end=0.001, begin=0.3, until=0.5),
    # Large steps learn fast, also what the last stretch asks for; small ones, which a trained policy loses least by, end the run.
    desired_kl=Ramp(start=0.01, end=0.003, begin=0.5, until=1.0),
)
_ALL_TERRAINS_ITERATIONS = 5000
"""Two billion steps of 16,384 worlds, in all."""
_PLAIN = NetworkConfiguration(student_encoder="mlp")
_MOE_NG = NetworkConfiguration(student_encoder="moe_ng")
_AC_MOE = replace(_PLAIN, expert_width=128, actor_hidden=(512, 256), critic_hidden=(512, 256))
_MCP = replace(_PLAIN, gate_hidden=(512, 256, 128))
_HIM = replace(_PLAIN, latent_width=16, student_hidden=(128, 64), teacher_hidden=(128, 64))
_DREAMWAQ = replace(_HIM, teacher_hidden=(64, 128, 48))

_METHODS = (
    ("go2-moe-cts", "cts", NetworkConfiguration(), "Mixture-of-Experts student (the paper's method)"),
    ("go2-cts", "cts", _PLAIN, "plain student"),
    ("go2-moe-ng", "cts", _MOE_NG, "experts that do not see the command (ablation MoE-NG)"),
    ("go2-ac-moe", "ac_moe", _AC_MOE, "experts in actor and critic (ablation AC-MoE)"),
    ("go2-mcp", "mcp", _MCP, "an actor that multiplies primitives (ablation MCP)"),
    ("go2-him", "him", _HIM, "hybrid internal model (baseline HIM)"),
    ("go2-dreamwaq", "dreamwaq", _DREAMWAQ, "variational estimator (baseline DreamWaQ)"),
)
"""The paper's method, its baselines and its ablations, with their own sizes: task, method, network, title."""


def _on_all_terrains(name: str, method: str, network: NetworkConfiguration, title: str) -> Task:
    """Return the task of a method on the environment that all methods share."""
    return Task(
        name=name,
        title=f"Unitree Go2 on all terrains, {title}",
        environment=_ALL_TERRAINS,
        training=TrainingConfiguration(
            algorithm=replace(_ALL_TERRAINS_LEARNING, method=method),
            network=network,
            run=RunConfiguration(experiment=name.replace("-", "_"), iterations=_ALL_TERRAINS_ITERATIONS),
        ),
    )


_LEVEL_GROUND = TerrainConfiguration(
    tiles=(FLAT_TILE,), levels=1, curriculum=False, leave_distance=None, spread_probability=0.0
)


def _flat() -> Task:
    """Return a task that walks within three minutes of an H200: no terrain, and every stage early, since the whole run is a few hundred
    iterations. Most of them must be spent on the fastest commands, and on the sudden reversals that the gauge asks for.
    """
    environment = EnvironmentConfiguration(
        num_envs=8192,
        terrain=_LEVEL_GROUND,
        termination=TerminationConfiguration(trunk_contact=1.0),
        commands=CommandConfiguration(
            stages=(
                CommandStage(begin=0.0, forward=(-1.0, 1.0), lateral=(-0.6, 0.6), yaw=(-1.0, 1.0)),
                CommandStage(begin=0.15, forward=(-1.5, 1.5), lateral=(-1.0, 1.0), yaw=(-1.5, 1.5)),
                CommandStage(begin=0.3, forward=(-2.0, 2.0), lateral=(-1.0, 1.0), yaw=(-2.0, 2.0)),
            ),
            interval=3.0,
            dynamic=False,
            extreme_probability=0.3,
            flip_probability=0.5,
        ),
        rewards=RewardConfiguration(linear_tracking=2.0, yaw_tracking=1.0, base_height=Ramp(start=-5.0, end=-10.0)),
    )
    training = TrainingConfiguration(
        # Compiling takes half a minute of a short run.
        algorithm=replace(
            _MIRRORED, compile_mode="none", entropy_coefficient=Ramp(start=0.01, end=0.003, begin=0.4, until=0.8)
        ),
        network=_PLAIN,
        run=RunConfiguration(experiment="go2_flat", iterations=380, save_interval=100, gauge_interval=0),
    )
    title = "Unitree Go2 on level ground (quick)"
    return Task(name="go2-flat", title=title, environment=environment, training=training)


def _toy() -> Task:
    """Return a task that learns to walk straight ahead within minutes of two CPU cores: small networks, nothing randomized that a first
    walk does not need, and large physics steps that MuJoCo takes without a look at the motors in between.
    """
    environment = EnvironmentConfiguration(
        num_envs=128,
        episode_length=10.0,
        physics=replace(TRAINING_PHYSICS, timestep=0.01, substeps=2, torque_speed_limit=False),
        terrain=_LEVEL_GROUND,
        termination=TerminationConfiguration(trunk_contact=1.0, tilt=1.0),
        observations=ObservationConfiguration(scan_length=0.4, scan_width=0.3),
        commands=CommandConfiguration(
            stages=(CommandStage(begin=0.0, forward=(0.5, 1.0), lateral=(0.0, 0.0), yaw=(0.0, 0.0)),),
            dynamic=False,
            extreme_probability=0.0,
            heading_gain=1.0,
            straight_probability=1.0,
            stationary_probability=Ramp(start=0.0, end=0.0),
        ),
        rewards=RewardConfiguration(
            linear_tracking=1.0,
            progress=3.0,
            yaw_tracking=0.5,
            base_height_target=0.32,
            termination=-2.0,
            action_rate=-0.005,
            action_smoothness=-0.005,
        ),
        reset=ResetConfiguration(joint_scale=(0.9, 1.1), velocity=0.0),
        randomization=RandomizationConfiguration(
            friction=(0.5, 1.0),
            base_mass=(0.0, 0.0),
            link_mass=(1.0, 1.0),
            base_com=(0.0, 0.0),
            stiffness=(1.0, 1.0),
            damping=(1.0, 1.0),
            motor_offset=(0.0, 0.0),
            motor_strength=(1.0, 1.0),
        ),
        push=PushConfiguration(interval=0.0),
    )
    network = NetworkConfiguration(
        student_encoder="mlp",
        latent_width=8,
        student_hidden=(64,),
        teacher_hidden=(64,),
        actor_hidden=(128, 64),
        critic_hidden=(128, 64),
    )
    training = TrainingConfiguration(
        algorithm=AlgorithmConfiguration(
            method="dreamwaq",
            symmetry="alternate",
            desired_kl=Ramp(start=0.02, end=0.005, begin=0.5, until=1.0),
            entropy_coefficient=Ramp(start=0.01, end=0.002, begin=0.3, until=0.7),
        ),
        network=network,
        run=RunConfiguration(experiment="toy", iterations=200, torch_threads=1, save_interval=100, gauge_interval=100),
    )
    title = "Unitree Go2 straight ahead on level ground (minutes of a CPU)"
    return Task(name="toy", title=title, environment=environment, training=training, backend="mujoco", suite="toy")


def _sprint() -> Task:
    """Return the paper's fast task: commands of up to 4.5 m/s straight ahead, so that 4 m/s is not at the limit of what was learned.
    Weights and the order of the stages are the published ones; each stage is a larger fraction of this shorter run. A robot has fallen
    where its trunk touches level ground.
    """
    environment = EnvironmentConfiguration(
        num_envs=8192,
        terrain=replace(_LEVEL_GROUND, tiles=(replace(FLAT_TILE, command_limits=(4.5, 1.0, 2.0)),)),
        termination=TerminationConfiguration(trunk_contact=1.0),
        randomization=RandomizationConfiguration(friction=(0.4, 1.25)),
        commands=CommandConfiguration(
            stages=(
                CommandStage(begin=0.0, forward=(-1.0, 1.0), lateral=(-1.0, 1.0), yaw=(-1.0, 1.0)),
                CommandStage(begin=0.1, forward=(-2.0, 2.0), lateral=(-1.0, 1.0), yaw=(-2.0, 2.0)),
                CommandStage(begin=0.2, forward=(-2.0, 3.0), lateral=(-1.0, 1.0), yaw=(-2.0, 2.0)),
                CommandStage(begin=0.35, forward=(-2.0, 3.5), lateral=(-0.5, 0.5), yaw=(-1.0, 1.0)),
                CommandStage(begin=0.5, forward=(-2.0, 4.0), lateral=(-0.5, 0.5), yaw=(-1.0, 1.0)),
                CommandStage(begin=0.65, forward=(-2.0, 4.5), lateral=(-0.5, 0.5), yaw=(-1.0, 1.0)),
            ),
            interval=4.0,
            dynamic=False,
            straight_probability=0.5,
            extreme_probability=0.3,
            extreme_zero_probability=(0.0, 1.0, 1.0 / 3.0),
        ),
        rewards=RewardConfiguration(
            linear_tracking=2.0,
            # Far from the command the tracking kernel is flat: this is what makes a standing robot accelerate.
            progress=1.0,
            base_height_target=0.33,
            hip_symmetry=-0.5,
            dynamic_sigma=False,
        ),
    )
    training = TrainingConfiguration(
        algorithm=replace(_MIRRORED, entropy_coefficient=Ramp(start=0.01, end=0.003, begin=0.5, until=0.8)),
        run=RunConfiguration(experiment="go2_sprint", iterations=2000, save_interval=200, gauge_interval=0),
    )
    title = "Unitree Go2 at 4 m/s on level ground (the paper's fast task)"
    return Task(name="go2-sprint", title=title, environment=environment, training=training)


def _on_two_legs() -> Iterator[Task]:
    """Yield the tasks of the G1, each with the paper's method and with DreamWaQ."""
    for ending, method, network, means in (
        ("", "cts", NetworkConfiguration(), "Mixture-of-Experts student"),
        ("-dreamwaq", "dreamwaq", _DREAMWAQ, "variational estimator (DreamWaQ)"),
    ):
        for ground, where, settings in (
            ("walk", "level ground", biped.walk(_LEVEL_GROUND, method, network)),
            ("rough", "all terrains", biped.rough(method, network)),
        ):
            environment, training = settings
            name = f"g1-{ground}{ending}"
            yield Task(
                name=name,
                title=f"Unitree G1 on {where}, {means}",
                environment=environment,
                training=replace(training, run=replace(training.run, experiment=name.replace("-", "_"))),
                suite="gaitgauge-biped-1",
            )


TASKS: Mapping[str, Task] = MappingProxyType(
    {
        task.name: task
        for task in (*(_on_all_terrains(*row) for row in _METHODS), _flat(), _sprint(), _toy(), *_on_two_legs())
    }
)
"""All tasks by name."""

_ROUGH = {f"-{name.removeprefix('go2-')}": name for name, *_ in _METHODS}
GROUNDS: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {
        "rough": {"quadruped": "go2-moe-cts", "biped": "g1-rough"},
        **{f"rough{method}": {"quadruped": name} for method, name in _ROUGH.items()},
        "rough-moe-cts": {"quadruped": "go2-moe-cts", "biped": "g1-rough"},
        "rough-dreamwaq": {"quadruped": "go2-dreamwaq", "biped": "g1-rough-dreamwaq"},
        **{name: {"quadruped": "go2-flat", "biped": "g1-walk"} for name in ("walk", "flat")},
        "walk-dreamwaq": {"biped": "g1-walk-dreamwaq"},
        "sprint": {"quadruped": "go2-sprint"},
    }
)
"""Names of tasks without a robot: all terrains (``rough``, with a method behind a dash), level ground (``walk``, ``flat``), fast. The
robot's body plan chooses the task."""


def named_robot(overrides: Iterable[str]) -> str | None:
    """Return the robot that ``environment.robot=`` names, which is the same as ``--robot``; None where no override does."""
    named = [o.split("=", 1)[1].strip() for o in overrides if _names_robot(o)]
    return named[-1] if named else None


def _names_robot(override: str) -> bool:
    key, sign, _ = override.partition("=")
    return bool(sign) and key.strip() == "environment.robot"


def settled_name(name: str, robot: str | None = None) -> str:
    """Return the task of ``TASKS`` for a ground's name and a robot, None for the Go2; other names stay as they are.

    Raises:
        TaskError: the ground has no task for the robot's body plan.
        RobotError: the robot cannot be found, or is wrong.
    """
    if name not in GROUNDS:
        return name
    robot = robot or "go2"
    plan = _plan(robot)
    if plan not in GROUNDS[name]:
        fits = [each for each, tasks in GROUNDS.items() if plan in tasks]
        raise TaskError(
            f"task '{name}' is not made for robot '{load_robot(robot).name}', {WORDS[plan]}; "
            f"{'tasks for it are: ' + ', '.join(fits) if fits else 'no task is'}"
        )
    return GROUNDS[name][plan]


def _plan(robot: str) -> Plan:
    """Return the body plan that a robot's tasks go by: arms make no other task, nor do wheels."""
    return PLANS[len(anatomy(load_robot(robot)).legs)]


def _own_task(path: str) -> Task:
    """Return the task at ``module:attribute``, under this name, by which a resumed run finds it again."""
    found, (module, _, attribute) = imported(path, f"task {shown(path)}:", TaskError), path.partition(":")
    if not isinstance(found, Task):
        raise TaskError(f"task {shown(path)}: module {shown(module)} has no Task of the name {shown(attribute)}")
    return replace(found, name=path)


def find_task(name: str, overrides: Iterable[str] = (), *, robot: str | None = None) -> Task:
    """Return a task, for a robot, with settings changed.

    Schedules are spread over the run's iterations, unless an override sets ``environment.schedule.horizon_steps``.

    Args:
        name: one of ``TASKS`` or ``GROUNDS``, or ``module:attribute`` of a ``Task`` of one's own.
        overrides: ``environment.…=value`` and ``training.…=value``, which change what is scaled for the robot;
            ``STRETCH:environment.…=value`` for one stretch.
        robot: name or path of a robot; None for the task's own.

    Raises:
        TaskError: unknown task, or a key or value that does not fit.
        RobotError: the robot cannot be found, or is wrong.
    """
    if ":" not in name and name not in TASKS and name not in GROUNDS:
        names = (*TASKS, *GROUNDS)
        near = get_close_matches(name, names, n=3, cutoff=0.3)
        hint = f"did you mean {' or '.join(near)}? " if near else ""
        raise TaskError(f"unknown task '{one_line(name, 80)}'; {hint}the tasks are: {', '.join(names)}")
    chosen = list(overrides)
    if (named := named_robot(chosen)) is not None:
        if robot is not None:
            raise TaskError(f"the robot is given twice, as '{robot}' and with environment.robot=; leave one out")
        robot, chosen = named, [o for o in chosen if not _names_robot(o)]
    name = settled_name(name, robot)
    known = TASKS[name] if name in TASKS else _own_task(name)
    if robot is not None:
        known = known.for_robot(robot)
    task = known.with_overrides(chosen)
    own_horizon = any(o.split("=", 1)[0].strip() == "environment.schedule.horizon_steps" for o in chosen)
    return task if own_horizon else task.with_horizon()


__all__ = ["GROUNDS", "TASKS", "Task", "TaskError", "find_task", "named_robot", "settled_name"]
