"""The rules that a score depends on, as versioned data: one TOML file for each suite in ``gauge/suites/``."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import Field

from ..backends.base import PhysicsOptions
from ..files.parsing import (
    Name,
    NotNegative,
    Seed,
    Share,
    Text,
    build,
    did_you_mean,
    one_line,
    parse_toml,
    read_text,
    shown,
)
from ..robots.base import Damping, Stiffness
from ..terrains.registry import terrain_names
from .commands import Phase
from .ground_rules import GroundRules
from .metric_rules import Metrics

SUITE_FOLDER = Path(__file__).parent / "suites"

_Speed = Annotated[float, Field(ge=0.0, le=100.0)]
_Time = Annotated[float, Field(gt=0.0, le=3600.0)]
_Noise = Annotated[float, Field(ge=0.0, le=1000.0)]
_Force = Annotated[float, Field(ge=0.0, le=10_000.0)]
_Tilt = Annotated[float, Field(gt=0.0, le=3.1416)]
Limits = tuple[_Speed, _Speed, _Speed]
MOST_FRICTION = 10.0
LEAST_PAYLOAD, MOST_PAYLOAD = -5.0, 50.0
Friction = Annotated[float, Field(gt=0.0, le=MOST_FRICTION)]
"""Sliding friction coefficient."""
Payload = Annotated[float, Field(ge=LEAST_PAYLOAD, le=MOST_PAYLOAD)]
"""Mass added to the base [kg]."""
GoalName = Literal["diagonal_velocity", "max_velocity", "target_pos_velocity"]
"""The paper's goals. Their commands are code (``goals.py``), with the reference's clock and its rounding errors."""
_AIMED = "target_pos_velocity"


class SuiteError(ValueError):
    """A suite that does not exist or is malformed, or a request that it does not allow."""


@dataclass(frozen=True, kw_only=True)
class Goal:
    """One kind of motion, made of sub-commands. The robot goes back to the spawn after each of them."""

    name: Name
    """One of ``GoalName``, with the paper's commands, or any other for a goal that is all data."""
    phases: tuple[_Time, ...] = ()
    """Length of each phase of a sub-command of the paper's goals [s]; empty for the one that ends at its target."""
    sub_commands: Annotated[
        tuple[Annotated[tuple[Phase, ...], Field(min_length=1, max_length=100)], ...], Field(max_length=100)
    ] = ()
    """Sub-commands of a goal of one's own, each a row of phases."""


@dataclass(frozen=True, kw_only=True)
class Matrix:
    """The environments of the stress pipeline and the seeds of its episodes."""

    terrains: Annotated[tuple[Text, ...], Field(min_length=1, max_length=100)]
    frictions: Annotated[tuple[Friction, ...], Field(min_length=1, max_length=100)]
    """Sliding friction coefficients."""
    payloads: Annotated[tuple[Payload, ...], Field(min_length=1, max_length=100)]
    """Masses added to the base [kg]."""
    crossed: bool
    """True: every payload with every friction. False: payloads other than ``nominal_payload`` only at ``nominal_friction``."""
    nominal_friction: Friction
    nominal_payload: Payload
    seeds: Annotated[tuple[Seed, ...], Field(min_length=1, max_length=1000)]
    """Seeds of the quality episodes."""
    search_seeds: Annotated[tuple[Seed, ...], Field(min_length=1, max_length=1000)]
    """Seeds of the level test."""
    foot_torsion: Annotated[
        tuple[Annotated[float, Field(ge=0.0, le=10.0)], ...], Field(min_length=1, max_length=10)
    ] = (1.0,)
    """Factors on the feet's torsional and rolling friction; the sub-commands and level tests of an environment take them in turn
    (``play/feet.py``). Feet that only slide, in the robot's model or in an engine, have neither."""


@dataclass(frozen=True, kw_only=True)
class Commands:
    """Command limits, which are also the normalizers of the tracking errors."""

    flat: Limits
    """Forward, lateral [m/s] and yaw [rad/s] on flat ground."""
    levelled: Limits
    """The same on every other terrain."""
    target_speed: Mapping[str, Annotated[float, Field(gt=0.0, le=100.0)]]
    """Forward speed towards the target by terrain family [m/s]."""
    target_time: Mapping[str, _Time]
    """Time allowed to reach the target by terrain family [s]."""
    target_radius: Annotated[float, Field(gt=0.0, le=10.0)]
    """Distance at which the target counts as reached [m]."""
    target_distance: Literal["body", "horizontal"]
    """``body``: distance in the base's own x-y plane; ``horizontal``: in the world's."""
    heading_frame: Literal["body", "horizontal"]
    """``body``: bearing in the base's own x-y plane; ``horizontal``: in the yawed horizontal frame."""
    clock_offset: Annotated[float, Field(ge=0.0, lt=1.0)]
    """Part of a control period by which the goal clock is read early: with 0 a phase ends, and the next sub-command shows,
    one step too soon (the reference); with 0.5 phases have their exact length."""
    beyond: Literal["published", "clip", "scale"] = "published"
    """What becomes of commands beyond a policy's limits: ``published``: they stay, and the result says how many there are;
    ``clip``: they end at the limits, and the result is custom; ``scale``: limits and target speeds above are shares of the
    policy's own limits."""


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Uniform observation noise, half widths in physical units, and where the random numbers come from."""

    base_angular_velocity: _Noise
    """[rad/s]."""
    joint_position: _Noise
    """[rad]."""
    joint_velocity: _Noise
    """[rad/s]."""
    projected_gravity: _Noise = 0.0
    """Of each component of the direction of gravity in the body frame, a unit vector."""
    base_linear_velocity: _Noise = 0.0
    """[m/s]; no robot measures it, and a policy that is told it counts as privileged all the same."""
    height_scan: _Noise = 0.02
    """Of each height of the map of the ground [m]; the published stream has none."""
    map_delay: Annotated[float, Field(ge=0.0, le=1.0)] = 0.06
    """Age of the map of the ground when the policy sees it [s], in whole control periods."""
    map_cell: Annotated[float, Field(ge=0.01, le=1.0)] = 0.05
    """Cell of the map of the ground [m]; the nearest node counts."""
    latency: Annotated[int, Field(ge=0)]
    """Largest delay of an action in substeps; drawn anew at every control step, 0 to this, uniformly."""
    stream: Literal["reference", "counter"]
    """``reference``: Python's generator in the published order, one stream for each seed; ``counter``: independent for each episode."""


@dataclass(frozen=True, kw_only=True)
class Events:
    """Events that interrupt an episode."""

    fall_tilt: _Tilt
    """Tilt of the base that counts as a fall [rad]."""
    fall: Literal["close-goal", "zero-rest"]
    """``close-goal``: the goal ends, what was sampled counts; ``zero-rest``: the rest of the sub-command scores zero."""
    penetration: Annotated[float, Field(gt=0.0, le=10.0)] | None = None
    """Depth in the terrain [m] at which the goal starts again, once in a run; None: never."""


@dataclass(frozen=True, kw_only=True)
class Settling:
    """The time after a reset until the robot stands."""

    speed: NotNegative
    """Base speed below which the robot stands [m/s]."""
    shortest: Annotated[float, Field(ge=0.0, le=60.0)]
    """[s] since the reset."""
    longest: Annotated[float, Field(ge=0.0, le=60.0)]
    """[s] since the reset."""
    sampled: bool
    """True: samples taken meanwhile count."""


@dataclass(frozen=True, kw_only=True)
class Scoring:
    """The rules by which samples become scores."""

    level_weight: Share
    """Score of each level passed before the last (0.09)."""
    quality_weight: Share
    """Score of the quality at the level reached (0.19)."""
    pass_rate: Annotated[float, Field(gt=0.0, le=1.0)]
    """Share of the search seeds that must reach the target."""
    levels: Annotated[int, Field(ge=1, le=1000)]
    """Highest level."""
    decimals: Annotated[int, Field(ge=0, le=15)] | None
    """Decimals to which run and aggregate values are rounded; None: not at all."""
    groups: Mapping[Name, Annotated[tuple[str, ...], Field(min_length=1, max_length=100)]]
    """Metrics averaged in each group, on their level-weighted mean@50."""
    bootstrap: Annotated[int, Field(ge=1, le=100_000)]
    """Number of bootstrap resamples for the confidence intervals."""
    level: Literal["bisection", "curve", "area"] = "bisection"
    """``bisection``: the highest level that a bisection of level tests finds passed, a whole number; ``curve``: the expected level
    where easy levels are never failed (``gauge/chance/level_curve.py``); ``area``: the area under the pass curve of any shape
    (``gauge/chance/level_area.py``)."""
    bracket_seeds: Annotated[int, Field(ge=1, le=1000)] = 2
    """Search seeds with which a curve's crossing is looked for, before all of them are played around it."""


@dataclass(frozen=True, kw_only=True)
class Push:
    """A sudden lateral push: a force on the base's centre of mass, to the left or right of its heading, chance says which."""

    goal: Name
    """Velocity goal; each of its sub-commands has a push."""
    after: tuple[_Time, _Time]
    """Earliest and latest beginning, from the first commanded control step on, all between equally likely [s]."""
    duration: _Time
    """[s]."""
    force: tuple[_Force, _Force]
    """Smallest and largest force, all between equally likely [N]; ``metrics.measure`` says for which robot."""


@dataclass(frozen=True, kw_only=True)
class Family:
    """Policies of one training code, known by the scale of their command, and the gains that they are played with."""

    name: Name
    robot: Name
    command_scale: tuple[NotNegative, NotNegative, NotNegative]
    """Factors on the forward, lateral and yaw command in the policy's observation."""
    stiffness: Stiffness
    """kp of every joint [N·m/rad]."""
    damping: Damping
    """kd of every joint [N·m·s/rad]."""


@dataclass(frozen=True, kw_only=True)
class Suite:
    """Everything that a score depends on."""

    name: Name
    version: Name
    title: Text
    parameters: Text
    """Name of the robot's joint-parameter set."""
    physics: PhysicsOptions
    matrix: Matrix
    goals: Annotated[tuple[Goal, ...], Field(min_length=1, max_length=20)]
    """In the order in which an episode runs them."""
    commands: Commands
    noise: Noise
    events: Events
    settling: Settling
    metrics: Metrics
    scoring: Scoring
    gains: Literal["suite", "contract"] = "suite"
    """Motor gains kp and kd of every policy: those of ``parameters``, or those of the policy's own contract."""
    families: Annotated[tuple[Family, ...], Field(max_length=100)] = ()
    """Policies with other gains than ``gains = "suite"`` gives; the first family that fits a contract counts."""
    push: Push | None = None
    """None: nothing pushes."""
    ground: GroundRules | None = None
    """None: the published terrains, the same for every robot."""
    written: Suite | None = None
    """The suite as it is written, where this one was suited to a policy (``suited.suited``); no rule of a suite file."""

    @property
    def digest(self) -> str:
        """Return the SHA-256 over every rule, hexadecimal: two suites of one name and different rules differ in it."""
        if self.written is not None:
            return self.written.digest
        rules = asdict(self)
        for goal in rules["goals"]:
            if not goal["sub_commands"]:
                del goal["sub_commands"]
        for path, plain in _ADDED.items():  # suites that were published before these existed keep their digest
            *tables, field = path.split(".")
            table = rules[tables[0]] if tables else rules
            if table[field] == plain:
                del table[field]
        return hashlib.sha256(json.dumps(rules, sort_keys=True).encode()).hexdigest()

    def goal(self, name: str) -> Goal:
        """Return the goal of that name."""
        return next(g for g in self.goals if g.name == name)

    def command_limits(self, family: str) -> Limits:
        """Return the command limits on a terrain family."""
        return self.commands.flat if family == "flat" else self.commands.levelled


_ADDED: Mapping[str, Any] = {
    "matrix.foot_torsion": (1.0,),
    "physics.torque_speed_limit": False,
    "noise.projected_gravity": 0.0,
    "noise.base_linear_velocity": 0.0,
    "noise.height_scan": 0.02,
    "noise.map_delay": 0.06,
    "noise.map_cell": 0.05,
    "metrics.foot_force": 0.0,
    "metrics.flight": "left-out",
    "metrics.measure": "fixed",
    "scoring.level": "bisection",
    "scoring.bracket_seeds": 2,
    "gains": "suite",
    "families": (),
    "push": None,
    "ground": None,
    "metrics.motors": "all",
    "commands.beyond": "published",
    "written": None,
}
"""Rules that came after suites had been published, and the values that say what held before."""


def suite_names() -> list[str]:
    """Return the names of the suites that ship with the project."""
    return sorted(p.stem for p in SUITE_FOLDER.glob("*.toml"))


def load_suite(name: str) -> Suite:
    """Load a suite by name, or from a TOML file of the user's own (a path that ends in ``.toml``).

    Raises:
        SuiteError: no such suite, or a malformed file.
    """
    path, data = _tables(name, ())
    source = f"suite file {one_line(path)}"
    suite = build(Suite, data, source, SuiteError, false_is_none=True)
    own = path.resolve().parent != SUITE_FOLDER.resolve()
    if own:
        from .metrics import MetricError, find_metric  # listing the project's suites must not wait for torch

        try:
            for metric in suite.metrics.weights:
                find_metric(metric)
        except MetricError as error:
            raise SuiteError(f"{source}: {error}") from error
    _check(suite, source)
    if own and suite.name in suite_names():
        raise SuiteError(f"{source} is called '{suite.name}' as a suite that ships with the project; {_OWN_NAME}")
    return suite


_OWN_NAME = "give it a 'name' of its own, so that results are not taken for that suite's"


def _tables(name: str, behind: tuple[Path, ...]) -> tuple[Path, dict[str, Any]]:
    """Return a suite's file and its tables, laid over those of the suite that it extends; the files ``behind`` extend it."""
    own = name.endswith(".toml")
    path = Path(name) if own else SUITE_FOLDER / f"{name}.toml"
    if own and behind:
        path = behind[-1].parent / path
    if not own and name not in suite_names():
        hint = did_you_mean(name, suite_names()) or ";"
        known = ", ".join(suite_names())
        if behind:
            raise SuiteError(
                f"suite file {one_line(behind[-1])}: extends is {shown(name)}{hint} it must be one of {known}, or a .toml file"
            )
        raise SuiteError(f"there is no suite '{one_line(name, 80)}'{hint} choose one of {known}, or give a .toml file")
    source = f"suite file {one_line(path)}"
    data = parse_toml(read_text(path, "suite file", SuiteError), source, SuiteError)
    base = data.pop("extends", None)
    if base is None:
        return path, data
    if not isinstance(base, str):
        raise SuiteError(f"{source}: extends is {shown(base)}; it must be a suite's name or the path of a .toml file")
    here = path.resolve()
    if here in behind or len(behind) >= _LONGEST_CHAIN:
        raise SuiteError(f"{source} extends itself, or through too many others; let 'extends' name another suite")
    if "name" not in data and here.parent != SUITE_FOLDER.resolve():
        raise SuiteError(f"{source} is called as the suite that it extends; {_OWN_NAME}")
    whole = _tables(base, (*behind, here))[1]
    for key, value in data.items():
        under = whole.get(key)
        whole[key] = {**under, **value} if isinstance(under, dict) and isinstance(value, dict) else value
    return path, whole


_LONGEST_CHAIN = 10


def _goal_rules(suite: Suite) -> dict[str, bool]:
    """Return sentences on goals, each with True if the rule is kept."""
    paper, goals = get_args(GoalName), [g.name for g in suite.goals]
    rules = {
        f"goals must differ in their first word, which names files; they are {', '.join(goals)}": (
            len({name.partition("_")[0] for name in goals}) == len(set(goals))
        )
    }
    for goal in suite.goals:
        own, name = goal.name not in paper, f"the goal '{goal.name}'"
        wanted = 0 if goal.name == _AIMED else 2
        largest = max((abs(v) for row in goal.sub_commands for phase in row for v in phase.velocity), default=0.0)
        rules |= {
            f"{name} has no commands; give it sub_commands, or choose one of {', '.join(paper)}": (
                bool(goal.sub_commands) or not own
            ),
            f"{name} has phases or sub_commands that it cannot have; the paper's goals have phases and no sub_commands, one's "
            "own have sub_commands and no phases": not (goal.phases if own else goal.sub_commands),
            f"{name} has the phases {shown(list(goal.phases))}; give it {wanted} lengths [s]": (
                own or len(goal.phases) == wanted
            ),
            f"{name} commands {largest:g} times a limit; velocities of a suite are multiples of its limits, -1 to 1": (
                largest <= 1.0
            ),
        }
    return rules


def _check(suite: Suite, source: str) -> None:
    """Raise ``SuiteError``, one sentence, for values that are allowed one by one and not together."""
    physics, events, metrics, settling = suite.physics, suite.events, suite.metrics, suite.settling
    goals = [g.name for g in suite.goals]
    matrix, scoring = suite.matrix, suite.scoring
    best = scoring.level_weight * (scoring.levels - 1) + scoring.quality_weight
    rules = {
        f"events.fall_tilt ({events.fall_tilt}) and physics.watch_tilt ({physics.watch_tilt}) must be the same": (
            events.fall_tilt == physics.watch_tilt
        ),
        f"events.penetration ({events.penetration}) and physics.watch_penetration ({physics.watch_penetration}) must be "
        "the same": events.penetration == physics.watch_penetration,
        f"metrics.interval is {metrics.interval} substeps; at least physics.substeps ({physics.substeps}) are needed": (
            metrics.interval >= physics.substeps
        ),
        f"noise.latency is {suite.noise.latency} substeps; 0 to physics.substeps ({physics.substeps}) are possible": (
            suite.noise.latency <= physics.substeps
        ),
        f"settling.shortest ({settling.shortest}) must not be above settling.longest ({settling.longest})": (
            settling.shortest <= settling.longest
        ),
        f"scoring: a perfect score would be {best:g} (level_weight {scoring.level_weight:g} for each of {scoring.levels - 1} "
        f"levels, quality_weight {scoring.quality_weight:g}); it must be 1 at most": best <= 1.0 + 1e-9,
        f"goals has a goal twice: {', '.join(goals)}": len(set(goals)) == len(goals),
        f"scoring.bracket_seeds is {scoring.bracket_seeds}; at most the {len(matrix.search_seeds)} of matrix.search_seeds "
        "are possible": scoring.level != "curve" or scoring.bracket_seeds <= len(matrix.search_seeds),
    }
    for name in ("projected_gravity", "base_linear_velocity"):
        half = getattr(suite.noise, name)
        rules[
            f"noise.{name} is {half:g}, which the stream 'reference' does not draw; let it be 0, or the stream 'counter'"
        ] = half == 0.0 or suite.noise.stream == "counter"
    rules[
        f"scoring.level is 'area', and episodes need noise of their own; noise.stream is '{suite.noise.stream}', let it be "
        "'counter', or let scoring.level be 'bisection'"
    ] = scoring.level != "area" or suite.noise.stream == "counter"
    rules["written is no rule of a suite file; leave it out"] = suite.written is None
    commands = suite.commands
    largest = max(*commands.flat, *commands.levelled, *commands.target_speed.values())
    rules[
        f"commands.beyond is 'scale', which takes limits and target speeds as shares of a policy's limits; {largest:g} is above 1"
    ] = commands.beyond != "scale" or largest <= 1.0
    rules |= _goal_rules(suite)
    if (push := suite.push) is not None:
        rules[f"push.after ({push.after[0]:g} to {push.after[1]:g} s) must rise"] = push.after[0] <= push.after[1]
        rules[f"push.force ({push.force[0]:g} to {push.force[1]:g} N) must rise"] = push.force[0] <= push.force[1]
        rules[f"push.goal ({push.goal}) is none of goals with sub-commands ({', '.join(goals)})"] = any(
            g.name == push.goal and (g.phases or g.sub_commands) for g in suite.goals
        )
    for name in ("terrains", "frictions", "payloads", "seeds", "search_seeds", "foot_torsion"):
        values = getattr(matrix, name)
        rules[f"matrix.{name} has an entry twice: {shown(list(values))}"] = len(set(values)) == len(values)
    for one, among in (("nominal_friction", "frictions"), ("nominal_payload", "payloads")):
        nominal, values = getattr(matrix, one), getattr(matrix, among)
        rules[
            f"matrix.{one} ({nominal:g}) is none of matrix.{among} ({', '.join(f'{v:g}' for v in values)}); add it there, or "
            f"let {one} be one of them"
        ] = nominal in values
    grounds = terrain_names()
    for name in matrix.terrains:
        rules[
            f"matrix.terrains has the unknown terrain {shown(name)}{did_you_mean(name, grounds) or ';'} choose from "
            f"{', '.join(grounds)}"
        ] = name in grounds
    for name, limits in (("flat", commands.flat), ("levelled", commands.levelled)):
        rules[
            f"commands.{name} is {shown(list(limits))}; tracking errors are measured by these limits, so each must be above 0"
        ] = all(limit > 0.0 for limit in limits)
    rules["metrics.weights are all zero; give at least one metric a weight above 0"] = any(metrics.weights.values())
    for group, names in scoring.groups.items():
        for name in names:
            rules[
                f"scoring.groups.{group} names {shown(name)}, which has no weight; choose from {', '.join(metrics.weights)}"
            ] = name in metrics.weights
    for rule, kept in rules.items():
        if not kept:
            raise SuiteError(f"{source}: {rule}")
