"""What a score depends on, as versioned data: one TOML file for each suite in ``gauge/suites/``."""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, fields, is_dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from ..backends.base import PhysicsOptions

SUITE_FOLDER = Path(__file__).parent / "suites"

Limits = tuple[float, float, float]


class SuiteError(ValueError):
    """A suite that does not exist or is malformed, or a request that it does not allow."""


@dataclass(frozen=True, kw_only=True)
class Goal:
    """One kind of motion, made of sub-commands. The robot goes back to the spawn after each of them."""

    name: str
    """``diagonal_velocity``, ``max_velocity`` or ``target_pos_velocity``."""
    phases: tuple[float, ...]
    """Length of each phase of a sub-command [s]; empty for the goal that ends at its target."""


@dataclass(frozen=True, kw_only=True)
class Matrix:
    """The environments of the stress pipeline and the seeds of its episodes."""

    terrains: tuple[str, ...]
    frictions: tuple[float, ...]
    """Sliding friction coefficients."""
    payloads: tuple[float, ...]
    """Masses added to the base [kg]."""
    crossed: bool
    """True: every payload with every friction. False: payloads other than ``nominal_payload`` only at ``nominal_friction``."""
    nominal_friction: float
    nominal_payload: float
    seeds: tuple[int, ...]
    """Seeds of the quality episodes."""
    search_seeds: tuple[int, ...]
    """Seeds of the level test."""


@dataclass(frozen=True, kw_only=True)
class Commands:
    """Command limits, which are also the normalizers of the tracking errors."""

    flat: Limits
    """Forward, lateral [m/s] and yaw [rad/s] on flat ground."""
    levelled: Limits
    """The same on every other terrain."""
    target_speed: Mapping[str, float]
    """Forward speed towards the target by terrain family [m/s]."""
    target_time: Mapping[str, float]
    """Time allowed to reach the target by terrain family [s]."""
    target_radius: float
    """Distance at which the target counts as reached [m]."""
    target_distance: str
    """``body``: distance in the base's own x-y plane; ``horizontal``: in the world's."""
    heading_frame: str
    """``body``: bearing in the base's own x-y plane; ``horizontal``: in the yawed horizontal frame."""
    clock_offset: float
    """Part of a control period by which the goal clock is read early: with 0 a phase ends, and the next sub-command shows,
    one step too soon (the reference); with 0.5 phases have their exact length."""


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Uniform observation noise, half widths in physical units, and where the random numbers come from."""

    base_angular_velocity: float
    """[rad/s]."""
    joint_position: float
    """[rad]."""
    joint_velocity: float
    """[rad/s]."""
    latency: int
    """Largest delay of an action in substeps; drawn anew at every control step, 0 to this, uniformly."""
    stream: str
    """``reference``: Python's generator in the published order, one stream for each seed; ``counter``: independent for each episode."""


@dataclass(frozen=True, kw_only=True)
class Events:
    """What interrupts an episode."""

    fall_tilt: float
    """Tilt of the base that counts as a fall [rad]."""
    fall: str
    """``close-goal``: the goal ends, what was sampled counts; ``zero-rest``: the rest of the sub-command scores zero."""
    penetration: float | None = None
    """Depth in the terrain [m] at which the goal starts again, once in a run; None: never."""


@dataclass(frozen=True, kw_only=True)
class Settling:
    """How an episode waits for the robot to stand after a reset."""

    speed: float
    """Base speed below which the robot stands [m/s]."""
    shortest: float
    """[s] since the reset."""
    longest: float
    """[s] since the reset."""
    sampled: bool
    """Whether samples taken meanwhile count."""


@dataclass(frozen=True, kw_only=True)
class Metrics:
    """Which metrics count, and how they are taken."""

    weights: Mapping[str, float]
    """Exponent of each metric in the quality of a sample; its keys are the suite's metrics."""
    interval: int
    """Substeps between samples."""
    clock: str
    """``run``: samples on a grid that runs through resets; ``reset``: the grid starts anew at every reset."""
    angular_velocity: str
    """``twice-rotated``: the reference's three components; ``body``: the same in the body frame; ``commanded``: yaw alone."""
    linear_velocity: str
    """``body``: three components in the body frame; ``commanded``: the two commanded ones, forward and lateral."""
    smoothness: str
    """Torque difference between ``samples``, or between consecutive ``control-steps``."""
    power_scale: float
    """RMS joint power that scores zero [W]."""
    torque_scale: float
    """RMS torque difference that scores zero [N·m]."""
    soft_limit: float
    """Share of each joint range, around its middle, inside which no limit is exceeded."""
    soft_limit_joints: tuple[str, ...]
    """Name parts of the joints that the limit metric watches."""
    zmp_span: float | None = None
    """Diagonal stance span that normalizes the ZMP distance [m]; None: that of the robot's default pose."""
    contact_share: float = 0.05
    """Share of the weight that the ground must carry for the contact metrics to be defined."""


@dataclass(frozen=True, kw_only=True)
class Scoring:
    """How samples become scores."""

    level_weight: float
    """Score of each level passed before the last (0.09)."""
    quality_weight: float
    """Score of the quality at the level reached (0.19)."""
    pass_rate: float
    """Share of the search seeds that must reach the target."""
    levels: int
    """Highest level."""
    decimals: int | None
    """Decimals to which run and aggregate values are rounded; None: not at all."""
    groups: Mapping[str, tuple[str, ...]]
    """Metrics averaged in each group, on their level-weighted mean@50."""
    bootstrap: int
    """Number of bootstrap resamples for the confidence intervals."""


@dataclass(frozen=True, kw_only=True)
class Suite:
    """Everything that a score depends on."""

    name: str
    version: str
    title: str
    parameters: str
    """Name of the robot's joint-parameter set."""
    physics: PhysicsOptions
    matrix: Matrix
    goals: tuple[Goal, ...]
    """In the order in which an episode runs them."""
    commands: Commands
    noise: Noise
    events: Events
    settling: Settling
    metrics: Metrics
    scoring: Scoring

    @property
    def digest(self) -> str:
        """SHA-256 over every rule, hexadecimal: two suites of one name and different rules differ in it."""
        rules = asdict(self)
        if not self.physics.torque_speed_limit:
            del rules["physics"]["torque_speed_limit"]  # suites that were published before it existed keep their digest
        return hashlib.sha256(json.dumps(rules, sort_keys=True).encode()).hexdigest()

    def goal(self, name: str) -> Goal:
        """The goal of that name."""
        return next(g for g in self.goals if g.name == name)

    def command_limits(self, family: str) -> Limits:
        """Command limits on a terrain family."""
        return self.commands.flat if family == "flat" else self.commands.levelled


def suite_names() -> list[str]:
    """Names of the suites that ship with the project."""
    return sorted(p.stem for p in SUITE_FOLDER.glob("*.toml"))


def load_suite(name: str) -> Suite:
    """Load a suite by name, or from a TOML file of the user's own (a path that ends in ``.toml``).

    Raises:
        SuiteError: no such suite, or a malformed file.
    """
    return _load(name, ())


def _load(name: str, behind: tuple[Path, ...]) -> Suite:
    """Load a suite that the files ``behind`` extend, one after the other."""
    own = name.endswith(".toml")
    path = Path(name) if own else SUITE_FOLDER / f"{name}.toml"
    if own and behind:
        path = behind[-1].parent / path
    if not path.is_file():
        close = get_close_matches(name, suite_names(), 1)
        hint = f"; did you mean '{close[0]}'" if close else ""
        raise SuiteError(
            f"there is no suite '{name}'{hint}; choose one of {', '.join(suite_names())}, or give a .toml file"
        )
    if path.resolve() in behind:
        raise SuiteError(f"suite file {path} extends itself; let 'extends' name another suite")
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SuiteError(f"suite file {path} cannot be read: {error}") from error
    base = data.pop("extends", None)
    if base is None:
        suite = _build(Suite, data, str(path))
    else:
        suite = _apply(_load(str(base), (*behind, path.resolve())), data, str(path))
    assert isinstance(suite, Suite)
    foreign = own and path.resolve().parent != SUITE_FOLDER.resolve()
    if foreign and ((base is not None and "name" not in data) or suite.name in suite_names()):
        raise SuiteError(
            f"suite file {path} is called '{suite.name}' as a suite that ships with the project or that it extends; "
            "give it a 'name' of its own, so that results are not taken for that suite's"
        )
    _check(suite, str(path))
    return suite


# What may stand in fields that name a rule.
_CHOICES: Mapping[str, tuple[str, ...]] = {
    "commands.target_distance": ("body", "horizontal"),
    "commands.heading_frame": ("body", "horizontal"),
    "noise.stream": ("reference", "counter"),
    "events.fall": ("close-goal", "zero-rest"),
    "metrics.clock": ("run", "reset"),
    "metrics.angular_velocity": ("twice-rotated", "body", "commanded"),
    "metrics.linear_velocity": ("body", "commanded"),
    "metrics.smoothness": ("samples", "control-steps"),
}


def _check(suite: Suite, where: str) -> None:
    """Refuse values that would be ignored or cannot work."""
    for field, allowed in _CHOICES.items():
        section, _, key = field.partition(".")
        value = getattr(getattr(suite, section), key)
        if value not in allowed:
            raise SuiteError(f"{where}: {field} is '{value}'; choose one of {', '.join(allowed)}")
    physics, events, metrics, scoring = suite.physics, suite.events, suite.metrics, suite.scoring
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
            0 <= suite.noise.latency <= physics.substeps
        ),
        "metrics.weights must be above zero, at least one of them": (
            len(metrics.weights) > 0 and all(w > 0 for w in metrics.weights.values())
        ),
        f"scoring.pass_rate is {scoring.pass_rate}; it must lie above 0 and not above 1": 0 < scoring.pass_rate <= 1,
        f"scoring.levels is {scoring.levels}; at least 1 is needed": scoring.levels >= 1,
        f"scoring.bootstrap is {scoring.bootstrap}; at least 1 resample is needed": scoring.bootstrap >= 1,
        "matrix needs at least one terrain, friction, payload, seed and search seed": all(
            (
                suite.matrix.terrains,
                suite.matrix.frictions,
                suite.matrix.payloads,
                suite.matrix.seeds,
                suite.matrix.search_seeds,
            )
        ),
    }
    for rule, kept in rules.items():
        if not kept:
            raise SuiteError(f"{where}: {rule}")
    for group, names in scoring.groups.items():
        missing = [n for n in names if n not in metrics.weights]
        if missing:
            raise SuiteError(
                f"{where}: scoring.groups.{group} names '{missing[0]}', which has no weight; "
                f"choose from {', '.join(metrics.weights)}"
            )


def _apply(item: Any, data: Mapping[str, Any], where: str) -> Any:
    """A copy of a dataclass with the given (nested) fields replaced."""
    known = {f.name for f in fields(item)}
    changes: dict[str, Any] = {}
    hints = get_type_hints(type(item))
    for key, value in data.items():
        if key not in known:
            raise SuiteError(f"{where} has the unknown key '{key}'; allowed here: {', '.join(sorted(known))}")
        present, inside = getattr(item, key), f"{where}: {key}"
        nested = is_dataclass(present) and isinstance(value, dict)
        changes[key] = _apply(present, value, inside) if nested else _value(hints[key], value, inside)
    return replace(item, **changes)


def _build(kind: type, data: Mapping[str, Any], where: str) -> Any:
    """Build a dataclass from plain data, recursively."""
    hints = get_type_hints(kind)
    unknown = set(data) - set(hints)
    if unknown:
        raise SuiteError(f"{where} has the unknown key '{min(unknown)}'; allowed: {', '.join(sorted(hints))}")
    values = {key: _value(hints[key], value, f"{where}: {key}") for key, value in data.items()}
    try:
        return kind(**values)
    except TypeError as error:
        missing = [f.name for f in fields(kind) if f.name not in values and f.default is MISSING]
        raise SuiteError(f"{where} is incomplete; it lacks {', '.join(missing)}") from error


def _value(hint: Any, value: Any, where: str) -> Any:
    """Plain TOML data as the annotated type: nested dataclasses, tuples for lists, and None for ``false`` where allowed."""
    inner = get_args(hint)
    if get_origin(hint) in (Union, UnionType):
        if value is False:
            return None  # TOML has no null
        return _value(next(i for i in inner if i is not type(None)), value, where)
    if is_dataclass(hint) and isinstance(value, dict):
        return _build(hint, value, where)  # type: ignore[arg-type]
    if get_origin(hint) is tuple and isinstance(value, list):
        kinds = inner[:1] * len(value) if inner[-1] is Ellipsis else inner
        if len(kinds) == len(value):
            return tuple(_value(k, v, where) for k, v in zip(kinds, value, strict=True))
    elif get_origin(hint) is Mapping and isinstance(value, dict):
        return {k: _value(inner[1], v, f"{where}.{k}") for k, v in value.items()}
    elif hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    elif hint in (int, str, bool) and type(value) is hint:
        return value
    shape = f" with {len(inner)} entries" if get_origin(hint) is tuple and inner[-1] is not Ellipsis else ""
    raise SuiteError(f"{where} is {value!r}; a {_KINDS.get(get_origin(hint) or hint, 'table')}{shape} is needed")


_KINDS = {float: "number", int: "whole number", str: "text", bool: "true or false", tuple: "list"}
