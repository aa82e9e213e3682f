"""A field trial as data: the ground, commands over time, pulls, and what counts as success. One TOML file for each scenario."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from ...files.parsing import Name, Text, did_you_mean, one_line, read_toml
from ...gauge.commands import Phase
from ...gauge.suite import Friction, SuiteError, load_suite
from ...terrains.base import Box, Terrain
from ...terrains.course import Stretch, course_boxes
from ...terrains.registry import TerrainError, make_terrain

SCENARIO_FOLDER = Path(__file__).parent / "scenarios"

_Place = Annotated[float, Field(ge=-200.0, le=200.0)]
_Size = Annotated[float, Field(gt=0.0, le=200.0)]
_Seconds = Annotated[float, Field(gt=0.0, le=600.0)]
_Moment = Annotated[float, Field(ge=0.0, le=600.0)]
_Newtons = Annotated[float, Field(ge=0.0, le=10_000.0)]
_Angle = Annotated[float, Field(ge=-math.pi, le=math.pi)]
_Spread = Annotated[float, Field(ge=0.0, le=10.0)]
_Offset = Annotated[float, Field(ge=-2.0, le=2.0)]
_Number = Annotated[int, Field(ge=0, le=1_000_000)]
_KEPT = 0.85
"""Speed over the commanded one that a walk to a place is expected to have, for the remaining time."""


LONGEST = 3600.0
"""Of all commands together [s]."""
MOST_PULLS = 1000
"""Of one force."""
_LATER = ("patches", "payload", "latency")
"""Fields that came later: where they say nothing, digests are as they were."""
ON_ITS_BACK = 3.0
"""Tilt that a robot on its back comes to [rad]: π on level ground, less the room that legs and trunk may leave."""


class ScenarioError(ValueError):
    """A scenario that does not exist, is malformed, or could never be decided or failed."""


@dataclass(frozen=True, kw_only=True)
class Block:
    """A solid box that stands or lies somewhere."""

    center: tuple[_Place, _Place, _Place]
    """[m]."""
    size: tuple[_Size, _Size, _Size]
    """Whole lengths along the box's own axes [m]."""
    yaw: _Angle = 0.0
    """Turned about the vertical [rad]."""


@dataclass(frozen=True, kw_only=True)
class Ground:
    """What is walked on: a terrain by its name, or a course of stretches, or boxes, or both of these; with none of them a floor."""

    terrain: Text | None = None
    """Name of a terrain (``gaitgauge list terrains``)."""
    level: Annotated[int, Field(ge=1, le=1000)] | None = None
    """Its level."""
    begin: _Place = -2.0
    """x at which the course begins [m]."""
    height: Annotated[float, Field(ge=0.0, le=50.0)] = 0.0
    """Of the ground there [m]."""
    width: _Size = 6.0
    """Of the course [m]; it has no walls."""
    stretches: Annotated[tuple[Stretch, ...], Field(max_length=200)] = ()
    """The course, from its beginning on; behind it comes the floor."""
    boxes: Annotated[tuple[Block, ...], Field(max_length=1000)] = ()


@dataclass(frozen=True, kw_only=True)
class Start:
    """Where robots start, on the ground, in their standing pose."""

    x: _Place = 0.0
    """[m]."""
    y: _Place = 0.0
    """[m]."""
    yaw: _Angle = 0.0
    """Heading [rad]."""
    spread: tuple[_Spread, _Spread, _Spread] = (0.05, 0.05, 0.05)
    """Half widths of what each seed adds to x, y [m] and heading [rad], uniformly."""


@dataclass(frozen=True, kw_only=True)
class Leg(Phase):
    """What is commanded for a time, or up to a place."""

    until_x: _Place | None = None
    """The phase ends early once the base is beyond this x [m]."""
    steer: bool = False
    """Whether the yaw speed is an operator's who keeps the robot on the line through its start, in place of ``velocity``'s."""


@dataclass(frozen=True, kw_only=True)
class Force:
    """A pull at the base's centre of mass, horizontal, in a direction that turns with the robot's heading."""

    direction: Literal["left", "right", "side", "forward", "backward"]
    """``side``: left or right, as each pull's draw says."""
    newtons: tuple[_Newtons, _Newtons]
    """Least and largest [N]; each pull draws its own, uniformly."""
    begin: tuple[_Moment, _Moment]
    """When it begins [s] after the start, least and latest; drawn."""
    seconds: tuple[_Seconds, _Seconds]
    """How long it lasts [s], least and longest; drawn."""
    every: _Seconds | None = None
    """Time from the beginning of one pull to that of the next [s]; None for a single pull."""


@dataclass(frozen=True, kw_only=True)
class Patch:
    """Another friction of the ground for a time, as on a patch that is wider than the robot."""

    begin: _Moment
    """[s] after the start."""
    seconds: _Seconds
    friction: Friction
    """Sliding friction coefficient meanwhile; of two patches at a time the later one in the file counts."""


@dataclass(frozen=True, kw_only=True)
class Payload:
    """A point mass that is fixed to the base; the base's own inertia stays."""

    kilograms: Annotated[float, Field(ge=0.0, le=1000.0)]
    """[kg]."""
    place: tuple[_Offset, _Offset, _Offset] = (0.0, 0.0, 0.0)
    """From the base's own centre of mass, forward, left and up [m]."""


@dataclass(frozen=True, kw_only=True)
class Success:
    """What must hold by the time the commands are over. A robot that fell has failed, whatever else it did."""

    survive: bool = False
    """Nothing but not to fall."""
    beyond: _Place | None = None
    """The base came beyond this x [m]."""
    speed: Annotated[float, Field(gt=0.0, le=100.0)] | None = None
    """The forward speed, a mean over 0.1 s, came to this [m/s]."""


@dataclass(frozen=True, kw_only=True)
class Failure:
    """What counts as a fall. Physics that becomes invalid always does."""

    tilt: Annotated[float, Field(gt=0.0, le=3.1416)] = 1.309
    """Tilt of the base [rad]."""
    lying: Annotated[float, Field(gt=0.0, le=60.0)] | bool = 1.0
    """Time without a break with the trunk on the ground [s]; false: that is allowed."""


@dataclass(frozen=True, kw_only=True)
class Reported:
    """What somebody reports of the same trial on a real robot."""

    who: Text
    successes: _Number | None = None
    trials: _Number | None = None
    text: Text | None = None
    """What was measured, in words."""


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A field trial."""

    name: Name
    title: Text
    about: Annotated[str, Field(max_length=4000)] = ""
    """What it stands for, and what had to be assumed."""
    friction: Friction
    """Sliding friction coefficient of every contact."""
    repeats: Annotated[int, Field(ge=1, le=1000)] = 20
    """Robots, where no other number is asked for."""
    legs: Annotated[int, Field(ge=1, le=100)] | None = None
    """Number of legs of the robots that ``all`` sends through it; None: any. By its name a scenario takes every robot."""
    suite: Text = "gaitgauge-1"
    """Suite of the physics, sensor noise and latency."""
    torque_speed_limit: bool = True
    """True where the motors' torque falls with their speed, as a real one's does."""
    ground: Ground = field(default_factory=Ground)
    start: Start = field(default_factory=Start)
    commands: Annotated[tuple[Leg, ...], Field(min_length=1, max_length=1000)]
    """One after another, from the start on."""
    forces: Annotated[tuple[Force, ...], Field(max_length=100)] = ()
    patches: Annotated[tuple[Patch, ...], Field(max_length=100)] = ()
    payload: Payload | None = None
    latency: Annotated[float, Field(ge=0.0, le=0.2)] | None = None
    """Time by which every action takes effect late [s], a whole number of physics steps; None: random, as in the suite."""
    success: Success = field(default_factory=Success)
    failure: Failure = field(default_factory=Failure)
    reported: Annotated[tuple[Reported, ...], Field(max_length=100)] = ()

    @property
    def seconds(self) -> float:
        """The longest that a trial can take [s]."""
        return sum(phase.seconds for phase in self.commands)

    def usual_rest(self, spent: float, x: float) -> float:
        """Return how long robots usually take on that are at ``x`` [m] after some time [s]: they keep part of the commanded speed."""
        rest = 0.0
        for leg in self.commands:
            whole = max(leg.seconds - spent, 0.0)
            if leg.until_x is not None and leg.velocity[0] > 0.0:
                whole = min(whole, max(leg.until_x - x, 0.0) / (_KEPT * leg.velocity[0]))
            rest += whole
            spent = max(spent - leg.seconds, 0.0)
        return rest

    @property
    def digest(self) -> str:
        """SHA-256 over all that decides about outcomes, hexadecimal."""
        words = ("title", "about", "repeats", "legs", "reported")
        rules = {k: v for k, v in asdict(self).items() if k not in words and (k not in _LATER or v not in ((), None))}
        rules |= {"suite": load_suite(self.suite).digest}
        return hashlib.sha256(json.dumps(rules, sort_keys=True).encode()).hexdigest()

    def terrain(self) -> Terrain:
        """The ground. Raises TerrainError: no such terrain or level, or a course that leads below the floor."""
        ground = self.ground
        if ground.terrain is not None:
            return make_terrain(ground.terrain, ground.level)
        course = course_boxes(
            ground.stretches,
            begin=ground.begin,
            height=ground.height,
            width=ground.width,
            source=f"scenario '{self.name}'",
        )
        blocks = tuple(
            Box(
                center=block.center,
                half_size=(0.5 * block.size[0], 0.5 * block.size[1], 0.5 * block.size[2]),
                quaternion=(math.cos(0.5 * block.yaw), 0.0, 0.0, math.sin(0.5 * block.yaw)),
            )
            for block in ground.boxes
        )
        return Terrain(name=self.name, family="course", boxes=course + blocks)


def scenario_names() -> list[str]:
    """Names of the scenarios that ship with the project."""
    return sorted(path.stem for path in SCENARIO_FOLDER.glob("*.toml"))


def load_scenario(name: str) -> Scenario:
    """Load a scenario by name, or from a TOML file of the user's own (a path that ends in ``.toml``).

    Raises:
        ScenarioError: no such scenario, a malformed file, its suite, or a scenario that could never be decided or failed.
    """
    own = name.endswith(".toml")
    if not own and name not in scenario_names():
        known = ", ".join(scenario_names())
        raise ScenarioError(
            f"there is no scenario '{one_line(name, 80)}'{did_you_mean(name, scenario_names()) or ';'} choose one of {known}, "
            "or give a .toml file"
        )
    path = Path(name) if own else SCENARIO_FOLDER / f"{name}.toml"
    source = f"scenario file {one_line(path)}"
    scenario = read_toml(path, Scenario, "scenario file", ScenarioError, source=source)
    for problem in _problems(scenario):
        raise ScenarioError(f"{source}: {problem}")
    if path.resolve().parent != SCENARIO_FOLDER.resolve() and scenario.name in scenario_names():
        raise ScenarioError(
            f"{source} is called '{scenario.name}' as a scenario that ships with the project; give it a 'name' of its own, so that "
            "results are not taken for that one's"
        )
    return scenario


def scenario_text(scenario: Scenario) -> str:
    """Return a scenario as a TOML file from which ``load_scenario`` reads the same one; what stands for nothing is left out."""
    return "\n".join(_lines(asdict(scenario), "")) + "\n"


def _lines(table: Mapping[str, Any], name: str) -> Iterator[str]:
    """Yield the lines of a table: its own values, then tables and lists of tables in it."""
    given = {k: v for k, v in table.items() if v is not None and v != ()}
    parts = {k: v for k, v in given.items() if isinstance(v, dict) or (isinstance(v, tuple) and isinstance(v[0], dict))}
    yield from (f"{k} = {json.dumps(v)}" for k, v in given.items() if k not in parts)
    for key, part in parts.items():
        path = f"{name}{key}"
        for entry in (part,) if isinstance(part, dict) else part:
            yield f"\n[{path}]" if isinstance(part, dict) else f"\n[[{path}]]"
            yield from _lines(entry, f"{path}.")


def _problems(scenario: Scenario) -> Iterator[str]:
    """What each field alone allows and all of them together do not, in sentences."""
    try:
        load_suite(scenario.suite)
    except SuiteError as error:
        yield str(error)
    ground, success = scenario.ground, scenario.success
    seconds = scenario.seconds
    if seconds > LONGEST:
        yield f"the commands last {seconds:g} s; at most {LONGEST:g} s are possible"
    if ground.terrain is None and ground.level is not None:
        yield f"ground.level is {ground.level} of no terrain; give ground.terrain, or leave it out"
    if ground.terrain is not None and (ground.stretches or ground.boxes):
        yield f"ground has the terrain '{one_line(ground.terrain, 80)}' and stretches or boxes too; choose one of them"
    try:
        scenario.terrain()
    except TerrainError as error:
        yield str(error)
    if scenario.failure.lying is True:
        yield "failure.lying is true; give the time [s] after which it is a fall, or false where it never is"
    for number, force in enumerate(scenario.forces):
        for name, (least, largest) in (("newtons", force.newtons), ("begin", force.begin), ("seconds", force.seconds)):
            if least > largest:
                yield f"forces[{number}].{name} is {least:g} to {largest:g}; the least must come first"
        if force.begin[1] >= seconds:
            yield (
                f"forces[{number}] may begin after {force.begin[1]:g} s, when the commands, of {seconds:g} s, are over; let it "
                "begin sooner"
            )
        if force.every is not None and seconds / force.every > MOST_PULLS:
            yield (
                f"forces[{number}] pulls every {force.every:g} s of {seconds:g} s; at most {MOST_PULLS:,} pulls are possible"
            )
    for number, patch in enumerate(scenario.patches):
        if patch.begin >= seconds:
            yield (
                f"patches[{number}] begins after {patch.begin:g} s, when the commands, of {seconds:g} s, are over; let it begin "
                "sooner"
            )
    for number, found in enumerate(scenario.reported):
        successes, trials = found.successes, found.trials
        if (successes is None) != (trials is None):
            given, lacking = ("successes", "trials") if trials is None else ("trials", "successes")
            yield f"reported[{number}] has {given} = {getattr(found, given)} and no {lacking}; give both, or a text alone"
        elif successes is None and found.text is None:
            yield f"reported[{number}] says nothing of what was found; give successes and trials, or a text"
        if successes is not None and trials is not None and (successes > trials or trials == 0):
            yield (
                f"reported[{number}] has {successes} successes in {trials} trials; there cannot be more of them than trials, nor "
                "no trials"
            )
    if not success.survive and success.beyond is None and success.speed is None:
        yield (
            "nothing says what success is, so it can never be decided; give beyond, speed or survive = true under [success]"
        )
    tilt, lying = scenario.failure.tilt, scenario.failure.lying
    if success.beyond is None and success.speed is None and lying is False and tilt > ON_ITS_BACK:
        yield (
            f"success is to survive, and nothing counts as a fall: failure.lying is false, and failure.tilt is {tilt:g} rad, which a "
            f"robot on its back need not exceed; give failure.lying a time [s], or failure.tilt at most {ON_ITS_BACK:g} rad"
        )
    fastest = max(phase.velocity[0] for phase in scenario.commands)
    if success.speed is not None and success.speed > fastest:
        yield (
            f"success.speed is {success.speed:g} m/s and no more than {fastest:g} m/s is ever commanded, so success can never be "
            "decided; command more, or ask for less"
        )
    yield from _way_problems(scenario)


def _way_problems(scenario: Scenario) -> Iterator[str]:
    """What is wrong with the way along x, in sentences: a walk through the commands as they are told, from the furthest start.

    Once robots are told to turn their heading is unknown: every command may lead on, and no place is surely passed.
    """
    start, beyond = scenario.start, scenario.success.beyond
    begin = x = furthest = start.x + start.spread[0]
    turned = False
    for number, phase in enumerate(scenario.commands):
        limit = math.inf if phase.until_x is None else phase.until_x
        if limit <= x and not turned:
            yield (
                f"commands[{number}].until_x is x = {limit:g} m, and robots are at up to {x:g} m by then, where it is over before it "
                "begins; let it lead on, or leave it out"
            )
        forward, lateral, yaw = phase.velocity
        turned = turned or bool(yaw and not phase.steer)
        along = math.cos(start.yaw) * forward - math.sin(start.yaw) * lateral
        x = min(x + phase.seconds * (math.hypot(forward, lateral) if turned else along), max(x, limit))
        furthest = max(furthest, x)
    if beyond is not None and furthest == begin:
        yield (
            f"success.beyond is x = {beyond:g} m, but no command leads along x from a heading of {start.yaw:g} rad, so success "
            "can never be decided; command a velocity that leads there, or ask for something else under [success]"
        )
    elif beyond is not None and not begin < beyond <= furthest:
        yield (
            f"success.beyond is x = {beyond:g} m, but robots start at up to {begin:g} m and the commands lead no further than to "
            f"{furthest:g} m, so success can never be decided; choose a place between, or lead further"
        )
