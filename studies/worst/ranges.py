"""Ranges that a search covers, and what a case within them is as a scenario. They are fixed before a search begins."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from ...robots import Robot
from ...robots.anatomy.body_plan import body_plan
from ...terrains.course import Stretch
from ..trials.scenario import Force, Ground, Leg, Patch, Payload, Scenario, Start, Success

Range = tuple[float, float]
GRAVITY = 9.81
_STAND = 0.5
"""Time for which a robot stands before its first command [s]."""
_COMMANDS = (1.5, 1.5, 2.0)
"""Lengths of the three commands [s]."""
_AHEAD = 0.8
"""Distance from the start to where slope and steps begin [m]."""
_SLOPE, _TREAD = 3.0, 0.3
"""Length of the slope and of a step's tread [m]."""
_BEHIND, _BEYOND, _WIDE = 20.0, 30.0, 60.0
"""Level ground behind the start and after the course, and the course's width [m]: no robot comes to an edge."""
_DIGITS = 4
"""Decimals that values are rounded to, so that a scenario's file holds a case exactly."""


@dataclass(frozen=True, kw_only=True)
class Ranges:
    """Least and largest value of everything that a case may have. Sizes are in the robot's own measure."""

    command: Range = (-1.0, 1.0)
    """Forward, lateral and turning speed of each command, shares of the policy's command limits."""
    push: Range = (-1.0, 1.0)
    """Force on the base, forward and to the left, shares of the robot's weight."""
    push_begin: Range = (0.5, 4.5)
    """Time of the push after the start [s]."""
    push_seconds: Range = (0.1, 0.3)
    """Length of the push [s]."""
    friction: Range = (0.2, 1.0)
    """Sliding friction coefficient of the ground."""
    patch_friction: Range = (0.05, 0.8)
    """Sliding friction coefficient of a patch of ground, wider than the robot."""
    patch_begin: Range = (0.5, 4.5)
    """Time at which the robot comes onto the patch [s]."""
    patch_seconds: Range = (0.2, 1.5)
    """Time for which it is on the patch [s]."""
    payload: Range = (0.0, 0.4)
    """Mass of a load on the base, share of the robot's mass."""
    payload_along: Range = (-0.4, 0.4)
    """Its place forward and to the left of the base's centre of mass, shares of the leg length."""
    payload_above: Range = (0.0, 0.4)
    """Its place above the base's centre of mass, share of the leg length."""
    latency: Range = (0.0, 0.06)
    """Time by which every action takes effect late [s]."""
    slope: Range = (-0.5, 0.5)
    """Inclination of 3 m of ground, positive uphill [rad]."""
    step: Range = (-0.5, 0.5)
    """Height of a step, positive upwards, share of the leg length."""
    step_count: Range = (1.0, 4.0)
    """Number of steps."""
    heading: Range = (-0.8, 0.8)
    """Heading in which the robot comes to the steps [rad]."""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One number of a case."""

    name: str
    factor: str
    """Factor of the parameter; a factor is in a case as a whole, or not at all."""
    range: str
    """Field of ``Ranges``."""
    nominal: float
    """Value that stands for nothing unusual."""
    sized: bool = True
    """True where a value further from the nominal one is harder."""
    whole: bool = False
    """True for a count."""


def _parameter(factor: str, name: str, nominal: float, sized: bool = True, whole: bool = False) -> Parameter:
    return Parameter(name=name, factor=factor, range=name, nominal=nominal, sized=sized, whole=whole)


PARAMETERS: tuple[Parameter, ...] = (
    *(
        Parameter(name=f"{axis}_{number}", factor="commands", range="command", nominal=0.5 * (axis == "forward"))
        for number in range(1, len(_COMMANDS) + 1)
        for axis in ("forward", "lateral", "turn")
    ),
    Parameter(name="push_forward", factor="push", range="push", nominal=0.0),
    Parameter(name="push_left", factor="push", range="push", nominal=0.0),
    _parameter("push", "push_begin", 2.0, sized=False),
    _parameter("push", "push_seconds", 0.1),
    _parameter("friction", "friction", 0.8),
    _parameter("patch", "patch_friction", 0.8),
    _parameter("patch", "patch_begin", 2.0, sized=False),
    _parameter("patch", "patch_seconds", 0.2),
    _parameter("payload", "payload", 0.0),
    Parameter(name="payload_forward", factor="payload", range="payload_along", nominal=0.0),
    Parameter(name="payload_left", factor="payload", range="payload_along", nominal=0.0),
    _parameter("payload", "payload_above", 0.0),
    _parameter("latency", "latency", 0.0),
    _parameter("slope", "slope", 0.0),
    _parameter("steps", "step", 0.0),
    _parameter("steps", "step_count", 1.0, whole=True),
    _parameter("steps", "heading", 0.0, sized=False),
)
FACTORS: tuple[str, ...] = tuple(dict.fromkeys(p.factor for p in PARAMETERS))
NOMINAL: Mapping[str, float] = {p.name: p.nominal for p in PARAMETERS}


@dataclass(frozen=True)
class Case:
    """Values within the ranges: of the factors that it has; everything else is nominal."""

    name: str
    """Unique in a search; start, noise and the suite's latency follow from it and a seed."""
    values: tuple[float, ...]
    """One for each of ``PARAMETERS``, rounded."""
    factors: frozenset[str] = field(default_factory=frozenset)

    def without(self, factor: str) -> Case:
        """Return the case with one factor less."""
        return make_case(self.name, self.named, self.factors - {factor})

    @property
    def named(self) -> dict[str, float]:
        """Return the values by name."""
        return dict(zip(NOMINAL, self.values, strict=True))

    @property
    def words(self) -> tuple[str, ...]:
        """Return the factors in their own order."""
        return tuple(f for f in FACTORS if f in self.factors)


def make_case(name: str, values: Mapping[str, float], factors: Iterable[str]) -> Case:
    """Return a case with some factors; values of others become nominal."""
    has = frozenset(factors)
    exact = (
        p.nominal if p.factor not in has else round(values[p.name], None if p.whole else _DIGITS) for p in PARAMETERS
    )
    return Case(name, tuple(float(v) for v in exact), has)


@dataclass(frozen=True, kw_only=True)
class Measures:
    """Turns cases into scenarios of a robot and its policy."""

    mass: float
    """Of the whole robot [kg]."""
    leg_length: float
    """[m]."""
    command_limits: tuple[float, float, float]
    """Forward, lateral [m/s] and turning [rad/s]."""
    suite: str
    seed: int
    """Of the search."""
    torque_speed_limit: bool
    """True where the robot's file says how a motor's torque falls with its speed."""

    @property
    def weight(self) -> float:
        """Weight [N]."""
        return self.mass * GRAVITY


def measures_of(
    robot: Robot, command_limits: tuple[float, float, float], suite: str, seed: int, parameters: str
) -> Measures:
    """Return the measures of a robot.

    Args:
        parameters: name of the joint parameters with which the suite plays it.
    """
    plan = body_plan(robot)
    return Measures(
        mass=plan.mass,
        leg_length=plan.leg_length,
        command_limits=command_limits,
        suite=suite,
        seed=seed,
        torque_speed_limit=robot.parameters[parameters].no_load_speed is not None,
    )


def scenario_of(case: Case, measures: Measures) -> Scenario:
    """Return a case as a scenario: stand for 0.5 s, then three commands; success is not to fall."""
    v, has = case.named, case.factors
    limits = measures.command_limits
    if "commands" in has:
        told = [
            Leg(
                seconds=seconds,
                velocity=_three(v[f"{axis}_{i}"] * limit for axis, limit in zip(_AXES, limits, strict=True)),
            )
            for i, seconds in enumerate(_COMMANDS, 1)
        ]
    else:
        told = [Leg(seconds=sum(_COMMANDS), velocity=_three((NOMINAL["forward_1"] * limits[0], 0.0, 0.0)))]
    load = Payload(
        kilograms=round(v["payload"] * measures.mass, _DIGITS),
        place=_three(v[f"payload_{side}"] * measures.leg_length for side in ("forward", "left", "above")),
    )
    patch = Patch(begin=v["patch_begin"], seconds=v["patch_seconds"], friction=v["patch_friction"])
    return Scenario(
        name=f"worst-{measures.seed}-{case.name}",
        title=f"Found by a search: {', '.join(case.words) or 'nothing unusual'}",
        friction=v["friction"],
        repeats=6,
        suite=measures.suite,
        torque_speed_limit=measures.torque_speed_limit,
        ground=_ground(case, measures),
        start=Start(yaw=v["heading"]),
        commands=(Leg(seconds=_STAND, velocity=(0.0, 0.0, 0.0)), *told),
        forces=_forces(v, measures.weight) if "push" in has else (),
        patches=(patch,) if "patch" in has else (),
        payload=load if "payload" in has else None,
        latency=v["latency"] if "latency" in has else None,
        success=Success(survive=True),
    )


_AXES = ("forward", "lateral", "turn")


def _three(values: Iterable[float]) -> tuple[float, float, float]:
    first, second, third = (round(value, _DIGITS) for value in values)
    return first, second, third


def _forces(v: Mapping[str, float], weight: float) -> tuple[Force, ...]:
    """Return the push as two forces that act together, one along each axis of the robot's heading."""
    begin, seconds = v["push_begin"], v["push_seconds"]
    found = []
    for share, positive, negative in ((v["push_forward"], "forward", "backward"), (v["push_left"], "left", "right")):
        newtons = round(abs(share) * weight, _DIGITS)
        found.append(
            Force(
                direction=positive if share >= 0.0 else negative,  # type: ignore[arg-type]
                newtons=(newtons, newtons),
                begin=(begin, begin),
                seconds=(seconds, seconds),
            )
        )
    return tuple(found)


def _ground(case: Case, measures: Measures) -> Ground:
    """Return level ground, then the slope, then the steps, then level ground."""
    v = case.named
    slope = round(_SLOPE * math.tan(v["slope"]), _DIGITS)
    count = round(v["step_count"])
    steps = round(count * v["step"] * measures.leg_length, _DIGITS)
    if not slope and not steps:
        return Ground()
    course = [Stretch(length=_BEHIND + _AHEAD)]
    if slope:
        course.append(Stretch(length=_SLOPE, rise=slope))
    if steps:
        course.append(Stretch(length=round(_TREAD * count, _DIGITS), rise=steps, steps=count))
    course.append(Stretch(length=_BEYOND))
    lowest = min(0.0, slope, slope + steps)
    return Ground(begin=-_BEHIND, height=round(abs(lowest), _DIGITS), width=_WIDE, stretches=tuple(course))


def describe_case(case: Case, measures: Measures) -> list[str]:
    """Return what is unusual about a case, one sentence part for each factor, with units."""
    v, limits = case.named, measures.command_limits
    told = [
        " and ".join(
            f"{v[f'{axis}_{i}'] * limit:+.2f} {unit}"
            for axis, limit, unit in zip(_AXES, limits, ("m/s forward", "m/s left", "rad/s"), strict=True)
        )
        for i in range(1, len(_COMMANDS) + 1)
    ]
    newtons = math.hypot(v["push_forward"], v["push_left"]) * measures.weight
    angle = math.degrees(math.atan2(v["push_left"], v["push_forward"]))
    length = measures.leg_length
    push_when = f"{v['push_begin']:.2f} s after the start for {v['push_seconds']:.2f} s"
    patch_when = f"{v['patch_begin']:.2f} s after the start for {v['patch_seconds']:.2f} s"
    words = {
        "commands": f"commands {'; then '.join(told)}",
        "push": f"push of {newtons:.0f} N at {angle:+.0f}° from ahead, {push_when}",
        "friction": f"friction {v['friction']:.2f}",
        "patch": f"patch with friction {v['patch_friction']:.2f}, {patch_when}",
        "payload": (
            f"load of {v['payload'] * measures.mass:.1f} kg, {v['payload_forward'] * length:+.2f} m forward, "
            f"{v['payload_left'] * length:+.2f} m left, {v['payload_above'] * length:.2f} m above the base's centre of mass"
        ),
        "latency": f"latency {1000 * v['latency']:.0f} ms",
        "slope": f"slope of {math.degrees(v['slope']):+.0f}°",
        "steps": (
            f"{_counted(round(v['step_count']))} {'up' if v['step'] > 0 else 'down'} of {abs(v['step']) * length:.2f} m, met at "
            f"{math.degrees(v['heading']):+.0f}°"
        ),
    }
    return [words[factor] for factor in case.words]


def _counted(count: int) -> str:
    return "1 step" if count == 1 else f"{count} steps"
