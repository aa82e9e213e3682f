"""What a score depends on, as versioned data: one TOML file for each suite in ``gauge/suites/``."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, get_type_hints

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
    path = Path(name) if name.endswith(".toml") else SUITE_FOLDER / f"{name}.toml"
    if not path.is_file():
        close = get_close_matches(name, suite_names(), 1)
        hint = f"; did you mean '{close[0]}'" if close else ""
        raise SuiteError(
            f"there is no suite '{name}'{hint}; choose one of {', '.join(suite_names())}, or give a .toml file"
        )
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SuiteError(f"suite file {path} is not valid TOML: {error}") from error
    base = data.pop("extends", None)
    if base is not None:
        suite = _apply(load_suite(base), data, path)
        assert isinstance(suite, Suite)
        return suite
    suite = _build(Suite, data, str(path))
    assert isinstance(suite, Suite)
    return suite


def _apply(item: Any, data: Mapping[str, Any], path: Path) -> Any:
    """A copy of a dataclass with the given (nested) fields replaced."""
    known = {f.name for f in fields(item)}
    changes: dict[str, Any] = {}
    hints = get_type_hints(type(item))
    for key, value in data.items():
        if key not in known:
            raise SuiteError(f"suite file {path} has the unknown key '{key}'; allowed here: {', '.join(sorted(known))}")
        present = getattr(item, key)
        nested = is_dataclass(present) and isinstance(value, dict)
        changes[key] = _apply(present, value, path) if nested else _value(hints[key], value, f"{path}: {key}")
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
        raise SuiteError(f"{where} is incomplete: {error}") from error


def _value(hint: Any, value: Any, where: str) -> Any:
    """Plain TOML data as the annotated type: nested dataclasses, tuples for lists, and None for ``false`` where allowed."""
    if value is False and type(None) in getattr(hint, "__args__", ()):
        return None  # TOML has no null
    if isinstance(value, dict) and is_dataclass(hint):
        return _build(hint, value, where)  # type: ignore[arg-type]
    if isinstance(value, list):
        inner = getattr(hint, "__args__", (Any,))[0]
        if is_dataclass(inner):
            return tuple(_build(inner, v, where) for v in value)  # type: ignore[arg-type]
        return tuple(value)
    if isinstance(value, dict):
        return {k: tuple(v) if isinstance(v, list) else v for k, v in value.items()}
    return value
