"""Check whether a score card holds here: its environments are played again, by the same policy under the same rules, and compared."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...backends.base import BackendError
from ...backends.registry import engine_class
from ...files.parsing import edited, one_line, shown
from ...gauge.chance.intervals import Evidence
from ...gauge.coverage import coverage
from ...gauge.described import Description, describe
from ...gauge.episodes import QUALITY
from ...gauge.evaluate import Prepared, Request, Status, evaluate, prepare
from ...gauge.goals import TARGET, command_name, count_sub_commands
from ...gauge.pipelines import Environment
from ...gauge.result import BY_HAND, CUSTOM, UNKNOWN, Coverage, EnvironmentRow, Result, Run, Table, unlike
from ...gauge.results import chance_rules
from ...gauge.suite import Suite, load_suite
from ...gauge.totals import environment_weights
from ...policy.finding import shipped_policies
from ...policy.native import FilePolicy
from ...policy.robot_of import REMEMBERED
from ...robots import Robot, robot_names
from ...robots.loading import robot_digest
from ..policies import file_digest
from .agreement import figures_that_are_off

_APART = 1_000_000
"""Distance of fresh seeds from those of the next number."""
_SAME = 1e-5
"""Differences of a figure up to this are rounding."""
_SCORES = (
    "score",
    "level",
    "terrains",
    "metrics",
    "groups",
    "health",
    *("score_interval", "level_interval", "groups_interval"),
)
"""Figures over all environments."""
_OF_THE_PLACE = ("imported_from", REMEMBERED)
"""Entries of a policy's provenance that a copy of it may have otherwise."""


class CardError(ValueError):
    """A score card that cannot be replayed; the message says why and what to do."""


def prepare_replay(
    card: Result,
    *,
    policy: str | None = None,
    beside: Path | None = None,
    suite: str | None = None,
    device: str = "cpu",
    threads: int | None = 1,
    quick: bool = False,
    fresh: int | None = None,
    trust: bool = False,
    contract: str | None = None,
) -> Prepared:
    """Return the evaluation that checks a card.

    Args:
        policy: the policy's file, where it is not at the card's path and none that ships.
        quick: one environment of each terrain, at nominal friction and payload where the card has it, else the card's first.
        fresh: number from which other seeds than the card's are made; None for the card's.

    Raises:
        CardError: policy, suite or robot is not the card's, or other seeds can say nothing about it.
        SuiteError, PolicyError, …: as ``evaluate.prepare``.
    """
    path, wanted = policy or card.policy.path, card.suite
    if fresh is not None and card.score_interval is None:
        raise CardError("the card has no interval, so that nothing can be said of other seeds; leave out --fresh")
    if policy is None and path not in shipped_policies() and not Path(path).is_file():
        if beside is not None and (beside / path).is_file():
            path = str(beside / path)
        else:
            raise CardError(
                f"the card's policy is not at '{one_line(path)}' on this machine; say where it is with --policy"
            )
    found = file_digest(path)
    if found != card.policy.file_sha256:
        raise CardError(
            f"'{one_line(path)}' is another policy than the card's: SHA-256 {found[:12]}…, not {card.policy.file_sha256[:12]}…; "
            "give the right file with --policy"
        )
    rules = load_suite(suite or wanted.name)
    if rules.digest != wanted.digest:
        raise CardError(
            f"the card was made on {wanted} with digest {wanted.digest[:12]}…, here it is "
            f"{rules.name} {rules.version} with {rules.digest[:12]}…; give the card's suite file with --suite"
        )
    check_card(card, rules, "the card")
    rows = _sample(card.environments, rules) if quick else card.environments
    prepared = prepare(
        Request(
            policy=path,
            suite=suite or wanted.name,
            pipeline="level" if card.pipeline == "level" else "stress",
            backend=card.backend,
            robot=card.robot if card.robot in robot_names() else None,  # else the policy carries it
            device=device,
            seeds=card.chance.seeds,
            threads=threads,
            trust=trust,
            contract=contract,
        )
    )
    check_policy(card, prepared.suite, prepared.policy, prepared.robot, "the card")
    prepared = replace(prepared, environments=tuple(_environment(row) for row in rows))
    return prepared if fresh is None else with_fresh_seeds(prepared, fresh)


def check_card(card: Result, suite: Suite | None, source: str) -> None:
    """Check that a card is of the suite it names and holds what of it it says: else a replay of what is left would confirm it.

    Args:
        suite: the one of the card's digest; None where it does not ship, and the card's interval alone is checked.
        source: what the card is called in the sentence.

    Raises:
        CardError: suite, rules, coverage or interval are others.
    """
    rules, named = card.chance, card.suite
    if suite is not None:
        if (named.name, named.version) != (suite.name, suite.version):
            raise CardError(
                f"{source} names its suite {named}, but its digest {suite.digest[:12]}… is that of "
                f"{suite.name} {suite.version}; {BY_HAND}"
            )
        expected = chance_rules(suite, rules.seeds)
        if name := expected.unlike(rules):
            raise CardError(
                f"{source}: chance.{name} is {shown(getattr(rules, name))}, but that of {suite.name} is "
                f"{shown(getattr(expected, name))}; {BY_HAND}"
            )
        stated = card.coverage.kind
        environments = [_environment(row) for row in card.environments]
        held = coverage(suite, environments, rules.seeds, pipeline=card.pipeline)
        if stated not in (held.kind, CUSTOM, UNKNOWN):
            raise CardError(
                f"{source} calls itself {one_line(stated)}, but holds {one_line(held.text)} of {suite.name}; {BY_HAND}"
            )
        if card.proved:
            _check_suite_s(card, suite, held, source)


def _check_suite_s(card: Result, suite: Suite, held: Coverage, source: str) -> None:
    """Check that coverage, columns, groups, sub-commands and solver are those of the suite; raise ``CardError`` where they are not."""
    run = next((run for row in card.environments for run in row.runs.values()), None)
    goals = [goal.name for goal in suite.goals if goal.name != TARGET]
    commands = {command_name(goal, part) for goal in goals for part in range(count_sub_commands(suite, goal))}
    # what of a suite was changed for a policy is no part of its matrix, and takes the card's rank
    own = {name: card.coverage.to_data()[name] for name in ("kind", "text") if card.coverage.kind == CUSTOM}
    pairs: dict[str, tuple[Any, Any]] = {
        "suite.title": (card.suite.title, suite.title),
        "coverage": (card.coverage.to_data(), held.to_data() | own),
        "group_metrics": (
            {g: list(m) for g, m in card.group_metrics.items()},
            {g: list(m) for g, m in suite.scoring.groups.items()},
        ),
    }
    if run is not None:
        pairs["the list of metrics"] = (sorted(run.columns), sorted([*suite.metrics.weights, QUALITY]))
        pairs["the list of sub-commands"] = (sorted(run.commands), sorted(commands))
    with suppress(BackendError):  # an engine that is not here is asked by whoever replays the card
        pairs["solver"] = (dict(card.solver), dict(engine_class(card.backend).solver_settings(suite.physics)))
    for name, (stated, expected) in pairs.items():
        if stated != expected:
            raise CardError(
                f"{source}: {name} is {shown(stated)}, but that of {suite.name} is {shown(expected)}; {BY_HAND}"
            )


def with_fresh_seeds(prepared: Prepared, number: int) -> Prepared:
    """Return the same evaluation with other seeds, which the makers of the policy could not know.

    Args:
        prepared: an evaluation with the suite's own seeds.
        number: chosen by whoever checks, 1 to 1000000; other numbers make other seeds.

    Raises:
        CardError: the number is out of range.
    """
    if not 1 <= number <= 1_000_000:
        raise CardError(f"fresh seeds are made from a number of 1 to 1000000, not {number}; give another with --fresh")

    def moved(seeds: Sequence[int]) -> tuple[int, ...]:
        return tuple(_APART * number + seed for seed in seeds)

    matrix = prepared.suite.matrix
    own = replace(matrix, seeds=moved(matrix.seeds), search_seeds=moved(matrix.search_seeds))
    return replace(prepared, suite=replace(prepared.suite, matrix=own), seeds=moved(prepared.seeds))


def verify(
    card: Result,
    prepared: Prepared,
    folder: Path,
    *,
    fresh: int | None = None,
    command: Sequence[str] = (),
    watch: Callable[[Status], None] | None = None,
) -> dict[str, Any]:
    """Play what ``prepare_replay`` chose, into a folder that keeps finished episodes, and compare.

    Returns:
        Plain data of ``judge``, and the number that ``fresh`` seeds were made from.
    """
    replay = evaluate(prepared, folder, resume=True, command=command, watch=watch)
    return judge(card, replay, fresh=fresh is not None) | {"fresh": fresh}


@edited("the card", CardError)
def judge(card: Result, replay: Result, *, fresh: bool = False) -> dict[str, Any]:
    """Judge whether a card holds, given the result of a replay of all or some of its environments.

    Where all outcomes are the same, all figures made of them must be. Where most runs differ, as on a processor of another kind,
    the replay's score must lie within a band around the card's (``tolerance_band``), whose width is that of the replay's interval,
    and every other figure within what chance explains (``agreement``). Where most runs are the same and some are not, those were
    edited. Where the replay has no interval (one seed, or levels alone) only the same outcome holds. Solver, motors, feet and
    all that is said of the policy must be the same in any case.

    Args:
        fresh: whether the replay had other seeds than the card. Then a score or figure above the band holds as well: it owes
            nothing to the card's seeds.

    Returns:
        ``holds``, ``equal`` (every outcome, and every figure made of them, the same to rounding), ``quick``, ``environments``
        (played, of the card), ``runs`` (the same, of those played), ``score``, ``interval`` and ``band`` of the card and the
        ``replayed`` score over what was played; ``levels``: for each environment whose level differs its terrain, friction,
        payload, ``card`` and ``here``; ``figures``: names of those that are off; ``edited``: environments that differ though
        most are the same; ``settings``: ``name``, ``card`` and ``here`` of what was not played alike; ``unlike``: versions that
        differ, in words.
    """
    by_key = {row.key: row for row in card.environments}
    pairs = [(by_key[row.key], row) for row in replay.environments]
    quick, stated = len(pairs) < len(by_key), card.entries()
    tables = [(old, old.entries(), new.entries()) for old, new in pairs]
    same = not any(_differs(stated_here, found, by=0.0) for _, stated_here, found in tables)
    other = [row for row, stated_here, found in tables if _differs(stated_here, found, by=_SAME)]
    runs, same_runs = _count_runs(pairs)
    figures, whole = [], not other and not quick and not fresh
    if other:
        figures = figures_that_are_off(pairs, replay.chance, flattering=fresh)
    elif whole:
        figures = [name for name in _SCORES if name in stated and _says_other(stated[name], getattr(replay, name))]
    equal = same and not (
        whole and any(_says_other(stated.get(name), getattr(replay, name), by=0.0) for name in _SCORES)
    )
    # a processor of another kind changes nearly all runs where the robot moves, and no run comes back in another place
    edited = [] if fresh or 2 * same_runs <= runs else [_place(row) for row in other]
    score, interval, here = card.score, None, replay.score
    if score is not None:
        weights = environment_weights([old.terrain for old, _ in pairs])
        if quick:
            score = round(float(weights @ np.array([old.score for old, _ in pairs])), 6)
        interval = Evidence([new for _, new in pairs], replay.chance).chance(weights).interval(score)
    band = tolerance_band(score, interval)
    within = band is not None and here is not None and band[0] <= here and (fresh or here <= band[1])
    settings = _unlike_settings(card, replay)
    return {
        "holds": not settings and not figures and not edited and (same or within),
        "equal": equal,
        "quick": quick,
        "environments": [len(pairs), len(by_key)],
        "runs": [same_runs, runs],
        "score": score,
        "interval": None if interval is None else [round(float(end), 6) for end in interval],
        "band": band,
        "replayed": here,
        "levels": [
            dict(zip(("terrain", "friction", "payload"), old.key, strict=True), card=old.level, here=new.level)
            for old, new in pairs
            if old.level != new.level
        ],
        "figures": figures,
        "edited": edited,
        "settings": settings,
        "unlike": unlike([card.versions, replay.versions]),
    }


def _place(row: EnvironmentRow) -> str:
    return f"{row.terrain}, friction {row.friction:g}, payload {row.payload:g} kg"


def _differs(stated: Mapping[str, Any], found: Mapping[str, Any], *, by: float) -> bool:
    """Return whether a row states anything that is off by more than so much; its interval follows from the rest."""
    return any(_says_other(value, found.get(name), by=by) for name, value in stated.items() if name != "interval")


def _count_runs(pairs: Sequence[tuple[EnvironmentRow, EnvironmentRow]]) -> tuple[int, int]:
    """Return the number of runs that the card has, and of those that came out here: in half of their figures, or elsewhere."""
    here = {tuple(_figures_of(run)) for _, new in pairs for run in new.runs.values()}
    count = same = 0
    for row, new in pairs:
        for seed, run in row.runs.items():
            mine, other = _figures_of(run), _figures_of(new.runs[seed]) if seed in new.runs else []
            count += 1
            same += tuple(mine) in here or 2 * sum(a == b for a, b in zip(mine, other, strict=False)) >= len(mine)
    return count, same


def _figures_of(run: Run) -> list[float]:
    """Return mean@50 of all columns and sub-commands of a run, up to rounding."""
    return [round(value, 5) for table in (run.columns, run.commands) for _, value in sorted(table.items())]


def _says_other(stated: Any, found: Any, *, by: float = 1e-4) -> bool:
    """Return whether a figure, or one in a table or pair of them, is off by more than so much; one that is not stated is not."""
    if isinstance(stated, Run) and stated.health is None:  # schema 2
        return _says_other((stated.columns, stated.commands), (found.columns, found.commands), by=by)
    if isinstance(stated, Table):
        return any(_says_other(value, getattr(found, name), by=by) for name, value in stated.entries().items())
    if isinstance(stated, Mapping):
        return stated.keys() != (found or {}).keys() or any(
            _says_other(value, found[key], by=by) for key, value in stated.items()
        )
    if isinstance(stated, tuple):
        return len(stated) != len(found or ()) or any(
            _says_other(a, b, by=by) for a, b in zip(stated, found, strict=True)
        )
    if isinstance(stated, float | int) and isinstance(found, float | int):
        return abs(stated - found) > by
    return stated is not None and stated != found


def _settings(result: Result | Description, lacking: Collection[str] = ()) -> dict[str, Any]:
    """Return what was played, with what and by which policy, as far as the result states it, as plain data by name."""
    policy = result.policy.to_data()
    found: dict[str, Any] = {}
    for name in ("motors", "feet", "commands", "training"):
        if name not in lacking:
            found |= {f"{name}.{key}": value for key, value in getattr(result, name).to_data().items() if value != []}
    found |= {f"solver.{name}": value for name, value in result.solver.items()}
    found |= {
        f"policy.{name}": policy[name]
        for name in ("contract_hash", "file_sha256", "observations", "kind_of_observations", "assumptions")
        if name in policy
    }
    origin = {f"policy.provenance.{k}": v for k, v in result.policy.provenance.items() if k not in _OF_THE_PLACE}
    return found | origin | {"robot": result.robot}


def _unlike_settings(card: Result, used: Result | Description) -> list[dict[str, Any]]:
    """Return ``name``, ``card`` and ``here`` of each setting that is not the card's; schema 2 may state fewer."""
    asked, here = _settings(card, card.lacking), _settings(used)
    names = {**asked, **here} if card.proved else asked
    return [
        {"name": name, "card": asked.get(name), "here": here.get(name)}
        for name in names
        if asked.get(name) != here.get(name)
    ]


def check_policy(card: Result, suite: Suite, policy: FilePolicy, robot: Robot, source: str) -> None:
    """Check what a card says of its policy, robot and physics against the policy's file.

    Raises:
        CardError: the file says otherwise, or the robot is another one.
        BackendError: the card's engine is not here.
    """
    terrains = {row.terrain for row in card.environments}
    for item in _unlike_settings(card, describe(suite, robot, policy, engine_class(card.backend), terrains)):
        raise CardError(
            f"{source}: {item['name']} is {shown(item['card'])}, but its policy and suite give {shown(item['here'])}; {BY_HAND}"
        )
    if card.robot_digest not in (None, robot_digest(robot)):
        raise CardError(
            f"{source}: the files of robot '{card.robot}' are not the card's; check out the commit that made the card"
        )


def tolerance_band(score: float | None, interval: Sequence[float] | None) -> list[float] | None:
    """Return the band in which the score of a replay must lie; None where there is no interval.

    Another machine's rounding makes other episodes of the same seeds, so card and replay are two draws: what two may differ by is
    √2 times what one may be off.
    """
    if score is None or interval is None:
        return None
    low, high = (score + math.sqrt(2.0) * (end - score) for end in interval)
    return [round(max(float(low), 0.0), 6), round(min(float(high), 1.0), 6)]


def _sample(rows: Sequence[EnvironmentRow], suite: Suite) -> list[EnvironmentRow]:
    """Return one row of each terrain, at nominal friction and payload where there is one."""
    nominal = (suite.matrix.nominal_friction, suite.matrix.nominal_payload)
    chosen: dict[str, EnvironmentRow] = {}
    for row in rows:
        if row.terrain not in chosen or (row.friction, row.payload) == nominal:
            chosen[row.terrain] = row
    return list(chosen.values())


def _environment(row: EnvironmentRow) -> Environment:
    given = 0 if row.flat else None if row.search is not None else row.level
    return Environment(terrain=row.terrain, friction=row.friction, payload=row.payload, level=given)
