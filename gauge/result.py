"""The result of an evaluation: typed, with the only reader and the only writer of ``results.json``.

The dataclasses describe the file: their fields stand in its order and bear the ranges that a reader relies on, for anybody may have
edited a file since it was written. The reader ignores entries that no field names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, fields, make_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, TypeVar, get_type_hints

from pydantic import Field, GetCoreSchemaHandler, JsonValue, WrapValidator
from pydantic_core import CoreSchema, core_schema

from ..files.parsing import Name, NotNegative, Seed, Share, Text, one_line, read_results, shown, take
from .suite import Friction, Payload

SCHEMA: Final = 3
"""The schema that is written. Schema 2, which is read too, lacks what some of its figures follow from (``Result.proved``)."""
CONFIDENCE = 0.95
FLAT = "flat"
COMPLETE: Final = "complete"
PART: Final = "part"
CUSTOM: Final = "custom"
UNKNOWN: Final = "unknown"
BY_HAND = "it was changed by hand, so ask its maker for the results.json of the run"
MOST_ROWS = 10_000
"""Environments of one result."""
MOST_REPLICATES = 20_000_000
"""Environments times replicates of the level searches, which a comparison draws again."""


def _as_written(value: float, check: Callable[[Any], float]) -> float:
    """Check a number, and keep a whole number whole, so that it is written again as it was read."""
    check(value)
    return value


_AsWritten = WrapValidator(_as_written)
_Words = Annotated[str, Field(max_length=4096)]
Value = Annotated[float, Field(ge=-1e9, le=1e9), _AsWritten]
"""Of a metric, weighted by the level or not."""
Fraction = Annotated[float, Field(ge=0.0, le=1.0), _AsWritten]
"""Of a metric, quality or score, weighted by the level or not: the best is 1."""
Level = Annotated[float, Field(ge=0, le=1000), _AsWritten]
Interval = tuple[Value, Value]
"""Ends of a 95 % interval."""
_Counted = Annotated[int, Field(ge=0, lt=2**63)]
_Seeds = Annotated[tuple[Seed, ...], Field(min_length=1, max_length=10_000)]
Kind = TypeVar("Kind", bound="Table")


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of the file."""

    may_lack: ClassVar[frozenset[str]] = frozenset()
    """Entries that a file of the present schema may leave out."""
    lacking: frozenset[str] = field(default=frozenset(), repr=False, compare=False)
    """Entries that the file did not state, as older files do not; they have their defaults and are not written."""

    def left_out(self) -> Iterable[str]:
        """Return the names of the entries that are not written, beside those that the file lacked."""
        return ()

    def entries(self) -> dict[str, Any]:
        """Return what the table states, by name, in the file's order."""
        unwritten = {"lacking", *self.lacking, *self.left_out()}
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in unwritten}

    def to_data(self) -> dict[str, Any]:
        """Return the table as plain data, as it is written."""
        return {name: _plain(value) for name, value in self.entries().items()}


@dataclass(frozen=True, kw_only=True)
class SuiteName(Table):
    """The suite that was played."""

    name: Name
    version: Name
    title: _Words = ""
    digest: Text

    def __str__(self) -> str:
        """Return name and version."""
        return f"{self.name} {self.version}"


@dataclass(frozen=True, kw_only=True)
class ChanceRules(Table):
    """The rules of a suite that decide about chance."""

    confidence: Share = CONFIDENCE
    """Of the intervals."""
    level_weight: NotNegative
    quality_weight: NotNegative
    pass_rate: Share
    levels: Annotated[int, Field(ge=1, le=1000)]
    seeds: _Seeds
    """Of the quality episodes."""
    search_seeds: _Seeds
    shared_noise: bool
    """True where the environments of a seed share its random numbers."""
    resamples: Annotated[int, Field(ge=1, le=100_000)]
    """Replicates of the level searches."""
    level: Literal["bisection", "curve", "area"] = "bisection"
    """The search for a level, as the suite has it; absent from results that are older than the choice."""
    bracket_seeds: Annotated[int, Field(ge=1, le=1000)] = 2
    """Seeds that look for the crossing of a curve."""
    decimals: Annotated[int, Field(ge=0, le=15)] | None = None
    """Decimals to which the suite rounds runs and means; None: not at all, or unknown in schema 2."""
    note: _Words | None = None
    """Reason why there is no interval."""

    def unlike(self, other: ChanceRules, *apart: str) -> str | None:
        """Return the name of the first rule that differs, but for those named and those that a file of schema 2 lacks."""
        unknown = {"lacking", "confidence", "note", *apart, *({"decimals"} & (self.lacking | other.lacking))}
        names = [f.name for f in fields(self) if f.name not in unknown]
        return next((name for name in names if getattr(self, name) != getattr(other, name)), None)


@dataclass(frozen=True, kw_only=True)
class Statistics(Table):
    """Means of a quality or metric: over all samples, and over the lowest 25 % and 50 % of them."""

    mean: Fraction
    mean25: Fraction
    mean50: Fraction


@dataclass(frozen=True, kw_only=True)
class MetricScore(Statistics):
    """A metric over all environments, weighted by level."""

    interval: Interval | None = None


@dataclass(frozen=True, kw_only=True)
class TerrainScore(Table):
    """One terrain: the mean over its environments."""

    score: Fraction | None = None
    """None where levels alone were searched."""
    interval: Interval | None = None
    level: Level | None = None
    """None on flat ground."""
    level_interval: Interval | None = None
    """None where the level was given."""
    mean: Fraction | None = None
    mean25: Fraction | None = None
    mean50: Fraction | None = None

    def left_out(self) -> Iterable[str]:
        """Leave out scores where there are levels alone."""
        return ("score", "interval", "mean", "mean25", "mean50") if self.score is None else ()


@dataclass(frozen=True, kw_only=True)
class RunHealth(Table):
    """The counts of one run."""

    samples: _Counted
    falls: _Counted
    diverged: _Counted
    overflowed: _Counted
    restarted: _Counted
    self_contact: Fraction | None
    """Share of the samples in which parts of the robot touch each other; None where it is not known."""


@dataclass(frozen=True, kw_only=True)
class Run(Table):
    """One seed in one environment: the statistics of each metric and of ``quality``."""

    columns: Mapping[str, float]
    """Mean@50 by column."""
    commands: Mapping[str, float] = field(default_factory=dict)
    """Mean@50 of the quality by sub-command."""
    mean: Mapping[str, float] = field(default_factory=dict)
    """Mean by column; empty in schema 2, as are the fields below."""
    mean25: Mapping[str, float] = field(default_factory=dict)
    """Mean@25 by column."""
    health: RunHealth | None = None

    def to_data(self) -> dict[str, Any]:
        """Return mean@50 by column, and the other fields under their names beside it."""
        own = {"commands": dict(self.commands)}
        if self.health is not None:
            own |= {"mean": dict(self.mean), "mean25": dict(self.mean25), "health": self.health.to_data()}
        return {**self.columns, **own}

    @classmethod
    def __get_pydantic_core_schema__(cls, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Read a run from its table: columns and the other fields side by side."""
        kinds = dict.fromkeys(("commands", "mean", "mean25"), Mapping[Text, Fraction]) | {"health": RunHealth}
        own = {n: core_schema.typed_dict_field(handler.generate_schema(k), required=False) for n, k in kinds.items()}

        def made(table: dict[str, Any]) -> Run:
            return cls(
                columns={k: v for k, v in table.items() if k not in own}, **{k: table[k] for k in own & table.keys()}
            )

        return core_schema.no_info_after_validator_function(
            made,
            core_schema.typed_dict_schema(
                own, extra_behavior="allow", extras_schema=handler.generate_schema(Fraction), config={"strict": True}
            ),
        )


Runs = Mapping[Seed, Run]


@dataclass(frozen=True, kw_only=True)
class EnvironmentRow(Table):
    """One environment: a terrain at one friction and payload."""

    terrain: Text
    friction: Annotated[Friction, _AsWritten]
    payload: Annotated[Payload, _AsWritten]
    """Mass added to the base [kg]."""
    level: Level | None = None
    """None on flat ground; 0 where no level is passed."""
    quality: Statistics | None = None
    """At the level, not weighted by it."""
    score: Fraction | None = None
    interval: Interval | None = None
    search: Mapping[Seed, bool] | None = None
    """The levels of the search and their outcome; None where the level was given."""
    trials: Mapping[Seed, Mapping[Seed, bool]] = field(default_factory=dict)
    """Success by level and search seed."""
    curve: Mapping[Seed, Fraction] = field(default_factory=dict)
    """Fitted share of successes by level, where the suite expects levels."""
    runs: Runs = field(default_factory=dict)
    """By quality seed; empty where no quality was measured."""
    runs_by_level: Mapping[Seed, Runs] = field(default_factory=dict)
    """The runs at the two levels beside an expected one."""
    metrics: Mapping[Text, Statistics] = field(default_factory=dict)
    """At the level, not weighted by it."""
    falls: _Counted | None = None
    """None where no quality was measured, as for the counts below."""
    diverged: _Counted | None = None
    overflowed: _Counted | None = None
    restarted: _Counted | None = None
    self_contact: Fraction | None = None
    """Share of the samples in which parts of the robot touch each other; None where it is not known."""

    @property
    def key(self) -> tuple[str, float, float]:
        """Terrain, friction and payload."""
        return self.terrain, self.friction, self.payload

    @property
    def flat(self) -> bool:
        """True on flat ground, which has no levels."""
        return self.terrain == FLAT

    @property
    def reached(self) -> float:
        """The level, 0 on flat ground and where none is passed."""
        return self.level or 0

    def left_out(self) -> Iterable[str]:
        """Leave out the search of a level that was given, and the figures of quality that was not measured."""
        searched = () if self.search is not None else ("search", "trials")
        played = ("runs", "metrics", "falls", "diverged", "overflowed", "restarted", "self_contact")
        empty = (name for name in ("curve", "runs_by_level") if not getattr(self, name))
        return (*searched, *(played if self.falls is None else ()), *empty)


@dataclass(frozen=True, kw_only=True)
class PolicyName(Table):
    """The policy that was judged."""

    path: _Words
    """As the user gave it."""
    contract_hash: str = ""
    file_sha256: Text
    observations: Annotated[tuple[Text, ...], Field(max_length=1000)] | None = None
    """Terms of the observation; None in results that do not say."""
    kind_of_observations: Literal["measurable", "exteroceptive", "privileged"] | None = None
    provenance: Mapping[str, JsonValue] = field(default_factory=dict)
    """The origin of the policy, as its file has it."""
    assumptions: Annotated[tuple[_Words, ...], Field(max_length=100)] = ()
    """Sentences on what the file does not say of the policy and was assumed; empty where its description is complete."""


@dataclass(frozen=True, kw_only=True)
class AxisCoverage(Table):
    """One axis of the suite's matrix."""

    played: tuple[Text | Value, ...]
    missing: tuple[Text | Value, ...]
    foreign: tuple[Text | Value, ...]
    """Played, and not in the suite."""


@dataclass(frozen=True, kw_only=True)
class Coverage(Table):
    """The part of the suite that was played."""

    kind: Literal["complete", "part", "custom", "unknown"] = UNKNOWN
    text: _Words = "results that do not say what of the suite they hold"
    """In words."""
    environments: tuple[_Counted, _Counted] | None = None
    """Number of the suite's environments that were played, and number of all."""
    levels: tuple[Level, ...] = ()
    """Levels that were given instead of searched for."""
    terrains: AxisCoverage | None = None
    frictions: AxisCoverage | None = None
    payloads: AxisCoverage | None = None
    seeds: AxisCoverage | None = None

    @property
    def complete(self) -> bool:
        """True where the whole suite was played, and nothing else."""
        return self.kind == COMPLETE

    @property
    def words(self) -> str:
        """Kind and text: ``complete``, or ``part: 1 of 7 terrains``."""
        return COMPLETE if self.complete else f"{self.kind}: {self.text}"


@dataclass(frozen=True, kw_only=True)
class Motors(Table):
    """Joint gains that were played with, in the robot's joint order."""

    stiffness: tuple[Value, ...] = ()
    """[N·m/rad]"""
    damping: tuple[Value, ...] = ()
    """[N·m·s/rad]"""
    note: _Words | None = None
    """A sentence where they are not the policy's own or the robot's usual ones."""


@dataclass(frozen=True, kw_only=True)
class EngineName(Table):
    """Physics in which a policy learned, or by which it was chosen."""

    engine: Text
    """Name of the backend."""
    version: Text | None = None
    """Of the engine's package; None where it is not known."""
    settings: Mapping[Text, Value | bool | Text | None] = field(default_factory=dict)
    """Solver, time step and feet, or the suite that chose, by name."""


@dataclass(frozen=True, kw_only=True)
class TrainingPhysics(Table):
    """Physics that the policy was trained and tuned with, as the provenance in its file says."""

    trained: Annotated[tuple[EngineName, ...], Field(max_length=100)] = ()
    """Engines in which it learned, in their order."""
    tuned: Annotated[tuple[EngineName, ...], Field(max_length=100)] = ()
    """Engines that scored it while it learned, so that its checkpoint or settings may be chosen by them."""
    note: _Words | None = None
    """A sentence where its file does not say."""


@dataclass(frozen=True, kw_only=True)
class CommandShares(Table):
    """Commands of the suite against the largest ones that the policy was made for."""

    limits: tuple[Value, Value, Value] | None = None
    """Largest forward, lateral [m/s] and yaw [rad/s] command of the policy's contract."""
    beyond: Mapping[Literal["forward", "lateral", "yaw"], Fraction] = field(default_factory=dict)
    """For each axis the share of the commands that ask for something on it and ask for more than its limit; empty where the
    suite does not count them."""


@dataclass(frozen=True, kw_only=True)
class Feet(Table):
    """Contact of the feet with the ground."""

    dimension: Annotated[tuple[Literal[1, 3, 4, 6], ...], Field(max_length=4)] = ()
    """Dimensions that were played, rising: 3 slides alone, 4 adds torsional friction, 6 rolling friction too; empty where unknown."""
    torsion: Value | None = None
    """Largest coefficient of torsional friction of a foot [m]; 0 where no contact has one, None where unknown."""


@dataclass(frozen=True, kw_only=True)
class Health(Table):
    """Quality episodes: how many there were, fell, diverged and dropped contacts."""

    episodes: _Counted = 0
    falls: _Counted = 0
    diverged: _Counted = 0
    overflowed: _Counted = 0
    self_contact: Fraction | None = None
    """Share of the samples in which parts of the robot touch each other; None where it is not known."""


@dataclass(frozen=True, kw_only=True)
class ClusterName(Table):
    """The cluster that played."""

    address: str
    processors: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Provenance(Table):
    """Programs, machine, command and digests of what was read."""

    may_lack: ClassVar[frozenset[str]] = frozenset({"host", "command"})
    versions: Mapping[str, Text] = field(default_factory=dict)
    commit: str | None = None
    plugins: Mapping[str, str] = field(default_factory=dict)
    digests: Mapping[str, Text] = field(default_factory=dict)
    """SHA-256 of policy, robot, suite and source."""
    command: str = ""
    date: str = ""
    host: str = ""
    machine: str = ""
    processor: str = ""
    device: str = ""
    threads: _Counted = 0
    seconds: Value = 0.0
    physics_steps: _Counted = 0
    processes: _Counted = 0
    set_aside: tuple[str, ...] = ()
    """Damaged files of episodes."""
    cluster: ClusterName | None = None
    engine_seconds: Value | None = None
    """Time in the engine [s], on the CPU."""

    def left_out(self) -> Iterable[str]:
        """Leave out what the transport and the engine do not have."""
        return (name for name in ("cluster", "engine_seconds") if getattr(self, name) is None)

    def without_place(self) -> Provenance:
        """Return what may be given to everybody: no machine's name and, since commands hold paths, no command."""
        return replace(self, host="", command="", lacking=self.lacking | {"host", "command"})


@dataclass(frozen=True, kw_only=True)
class Scores(Table):
    """The scores of an evaluation, and the rows that they follow from."""

    schema: Literal[2, 3] = SCHEMA
    suite: SuiteName
    chance: ChanceRules
    score: Fraction | None
    """Mean over terrains; None where levels alone were searched."""
    score_interval: Interval | None = None
    groups: Mapping[Text, Fraction] = field(default_factory=dict)
    """Mean of the metrics of each group of the suite."""
    group_metrics: Mapping[Text, tuple[Text, ...]] = field(default_factory=dict)
    level: Level | None = None
    """Mean over environments; None where all are flat."""
    level_interval: Interval | None = None
    terrains: Mapping[Text, TerrainScore] = field(default_factory=dict)
    metrics: Mapping[Text, MetricScore] = field(default_factory=dict)
    environments: tuple[EnvironmentRow, ...]
    groups_interval: Mapping[Text, Interval | None] = field(default_factory=dict)

    def left_out(self) -> Iterable[str]:
        """Leave out intervals of groups where there are levels alone."""
        return ("groups_interval",) if self.score is None else ()


@dataclass(frozen=True, kw_only=True)
class Result(Scores):
    """Everything of a ``results.json``."""

    policy: PolicyName
    coverage: Coverage = Coverage()
    pipeline: Text
    backend: Text
    robot: Name
    motors: Motors = Motors()
    training: TrainingPhysics = TrainingPhysics()
    commands: CommandShares = CommandShares()
    feet: Feet = Feet()
    health: Health = Health()
    solver: Mapping[Text, Value | bool | Text | None] = field(default_factory=dict)
    """Settings of the engine's solver."""
    provenance: Provenance

    @classmethod
    def from_data(cls, data: object, source: str, error: type[Exception]) -> Result:
        """Return the result that plain data describe, after a check of names, types and ranges.

        Args:
            data: content of ``results.json``.
            source: the file, the beginning of every sentence.

        Raises:
            error: something is missing, of another type or out of range.
        """
        if not isinstance(data, Mapping):
            raise error(f"{source} is {shown(data)}; it must be a table")
        if (schema := data.get("schema")) not in (2, SCHEMA):
            raise error(
                f"{source}: it has schema {shown(schema)}, this version reads 2 and {SCHEMA}; evaluate the policy again"
            )
        figures = take(_figures(), data, source, error)
        absent = {name for name in _OPTIONAL if data.get(name) is None}
        tables: dict[str, Any] = {
            name: _read(kind, {} if name in absent else data.get(name), f"{source}: {name}", error)
            for name, kind in _TABLES.items()
        }
        rows = data.get("environments")
        if not isinstance(rows, list) or len(rows) > MOST_ROWS:
            raise error(f"{source}: environments is {shown(rows)}; it must be a list of at most {MOST_ROWS:,}")
        read = (_read(EnvironmentRow, row, f"{source}: environments[{at}]", error) for at, row in enumerate(rows))
        tables |= {"environments": tuple(read), "lacking": _lacking(cls, data) | absent}
        found = cls(**vars(figures), **tables)
        if found.score_interval is not None and found.score_interval[0] > found.score_interval[1]:
            raise error(f"{source}: score_interval is {shown(list(found.score_interval))}; its ends must rise")
        found.check_replicates(source, error)
        found._check_lacking(source, error)
        return found

    def _check_lacking(self, source: str, error: type[Exception]) -> None:
        """Check that a file of the present schema states all that it has; raise ``error`` on the first entry that it lacks."""
        tables: list[tuple[str, Table]] = [("it", self), *((name, getattr(self, name)) for name in _TABLES)]
        tables += [(f"environments[{at}]", row) for at, row in enumerate(self.environments)]
        for name, table in tables if self.schema == SCHEMA else ():
            if missing := table.lacking.difference(table.left_out(), table.may_lack):
                raise error(f"{source}: {name} lacks '{min(missing)}', which schema {SCHEMA} has; {BY_HAND}")

    def check_replicates(self, source: str, error: type[Exception]) -> None:
        """Check that the level searches can be drawn again; raise ``error`` where all replicates together are too many."""
        if len(self.environments) * self.chance.resamples > MOST_REPLICATES:
            raise error(
                f"{source}: {len(self.environments)} environments with {self.chance.resamples:,} replicates are more than is "
                f"computed; {MOST_REPLICATES:,} replicates in all are allowed"
            )

    @property
    def complete(self) -> bool:
        """True where the whole suite was played, and nothing else."""
        return self.coverage.complete

    @property
    def proved(self) -> bool:
        """True where every figure follows from runs and trials that the file holds; schema 2 holds mean@50 of its runs alone."""
        return self.schema == SCHEMA

    @property
    def robot_digest(self) -> str | None:
        """SHA-256 of the files of the robot; None in older results, which do not say."""
        return self.provenance.digests.get("robot")

    @property
    def engine_version(self) -> str | None:
        """Version of the engine's package; None where it has none of its own."""
        engine = self.backend.partition(":")[0]
        return self.provenance.versions.get({"physx": "ovphysx"}.get(engine, engine))

    @property
    def versions(self) -> dict[str, str | None]:
        """Versions of gaitgauge and of the engine, and the digest of gaitgauge's source; None where the result does not say."""
        stated, source = self.provenance.versions, self.provenance.digests.get("source")
        own = {"gaitgauge": stated.get("gaitgauge"), self.backend.partition(":")[0]: self.engine_version}
        return {**own, "source of gaitgauge": source and source[:12]}


_TABLES: Mapping[str, type[Table]] = {
    "suite": SuiteName,
    "policy": PolicyName,
    "provenance": Provenance,
    "chance": ChanceRules,
    "coverage": Coverage,
    "motors": Motors,
    "training": TrainingPhysics,
    "commands": CommandShares,
    "feet": Feet,
    "health": Health,
}
_OPTIONAL = ("coverage", "motors", "training", "commands", "feet", "health")
"""Tables that older files lack."""


def read_result(path: Path, error: type[Exception], *, words: str = "") -> Result:
    """Read a results folder, its ``results.json``, or a copy of that.

    Args:
        words: what a sentence says of a file that cannot be read.

    Raises:
        error: there is none, or it is damaged or of another schema.
    """
    try:
        file = path / "results.json" if path.is_dir() else path
        there = file.exists()
    except OSError as problem:
        raise error(f"'{one_line(path)}' cannot be read: {problem.strerror}") from problem
    if not there:
        raise error(f"there are no results at '{one_line(path)}'; give a folder of 'gaitgauge evaluate'")
    return Result.from_data(read_results(file, "results", error), f"results '{one_line(file)}'{words}", error)


def unlike(tables: Sequence[Mapping[str, object]]) -> list[str]:
    """Return the differences of some tables, in words: ``mujoco 3.16.0 and 3.17.0``. An entry that one lacks is no difference."""
    words = {}
    for name in dict.fromkeys(name for table in tables for name in table):
        values = list(dict.fromkeys(str(table[name]) for table in tables if table.get(name) is not None))
        if len(values) > 1:
            words[name] = f"{one_line(name)} {one_line(', '.join(values[:-1]))} and {one_line(values[-1])}"
    return list(words.values())


def _plain(value: Any) -> Any:
    """Return a value of the dataclasses as plain data."""
    if isinstance(value, Table):
        return value.to_data()
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, tuple | list) else value


def _read(kind: type[Kind], data: object, source: str, error: type[Exception]) -> Kind:
    """Return a table, with the names of the entries that it lacks."""
    found = take(kind, data, source, error)
    return replace(found, lacking=_lacking(kind, data))


def _lacking(kind: type[Table], data: Any) -> frozenset[str]:
    return frozenset(f.name for f in fields(kind)) - data.keys() - {"lacking"}


@cache
def _figures() -> Any:
    """Return a dataclass of the fields of a result that are no tables with a sentence of their own."""
    apart, hints = (*_TABLES, "environments", "lacking"), get_type_hints(Result, include_extras=True)
    own = [(f.name, hints[f.name], copy(f)) for f in fields(Result) if f.name not in apart]
    return make_dataclass("Figures", own, frozen=True, kw_only=True)
