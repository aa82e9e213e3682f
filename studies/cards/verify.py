"""Check whether a score card holds here: its environments are played again, by the same policy under the same rules, and compared."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...files.parsing import edited, one_line, shown
from ...gauge.chance.intervals import Evidence
from ...gauge.coverage import coverage
from ...gauge.evaluate import Prepared, Request, Status, evaluate, prepare
from ...gauge.pipelines import Environment
from ...gauge.result import BY_HAND, UNKNOWN, EnvironmentRow, Result, Table, unlike
from ...gauge.result_figures import check_interval
from ...gauge.results import chance_rules, environment_weights
from ...gauge.suite import Suite, load_suite
from ...policy.finding import shipped_policies
from ...robots import robot_names
from ...robots.loading import robot_digest
from ..policies import file_digest

_APART = 1_000_000
"""Distance of fresh seeds from those of the next number."""
_OUTCOME = ("level", "score", "quality", "metrics", "trials", "runs", "falls", "diverged", "overflowed", "restarted")
"""Entries of an environment's row that must be the same to the last digit for a replay to be called equal."""
_FIGURES = (
    "score",
    "score_interval",
    "level",
    "level_interval",
    "terrains",
    "metrics",
    "groups",
    "groups_interval",
    "health",
)
"""Figures that must be the same as well, where all environments are replayed."""


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
        beside: the card's folder, where its policy is looked for as well.
        suite: name or ``.toml`` file, where the suite is one of the user's own.
        contract: description of the policy, where the card was made with one.
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
    stated, observed = card.policy.observations, [t.name for t in prepared.policy.contract.observation]
    if stated is not None and list(stated) != observed:
        raise CardError(
            f"the card says that the policy observes {shown(list(stated))}, its file says {shown(observed)}; the card was changed "
            "by hand, so ask its maker for the results.json of the run"
        )
    if card.robot_digest not in (None, robot_digest(prepared.robot)):
        raise CardError(
            f"the files of robot '{card.robot}' are not the card's; check out the commit that made the card"
        )
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
        if stated not in (held.kind, UNKNOWN):
            raise CardError(
                f"{source} calls itself {one_line(stated)}, but holds {one_line(held.text)} of {suite.name}; {BY_HAND}"
            )
    check_interval(card, source, CardError)


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

    It holds where the replay's score lies within a band around the card's (``tolerance_band``), whose width is that of the replay's
    interval: what the card says of its own does not count. Where the replay has none (one seed, or levels alone) only the same
    outcome holds. Where all outcomes are the same, so must be the figures made of them; solver and motors must be in any case.

    Args:
        fresh: whether the replay had other seeds than the card. Then a score above the band holds as well: it owes nothing to
            the card's seeds.

    Returns:
        ``holds``, ``equal`` (every outcome, and every figure made of them, the same to the last digit), ``quick``, ``environments``
        (played, of the card), ``score``, ``interval`` and ``band`` of the card and the ``replayed`` score over what was played;
        ``levels``: for each environment whose level differs its terrain, friction, payload, ``card`` and ``here``; ``figures``:
        names of those that are off though all outcomes are the same; ``settings``: ``name``, ``card`` and ``here`` of each of the
        solver or the motors that differs; ``unlike``: versions that differ, in words.
    """
    by_key = {row.key: row for row in card.environments}
    pairs = [(by_key[row.key], row) for row in replay.environments]
    same = all(getattr(old, name) == getattr(new, name) for old, new in pairs for name in _OUTCOME)
    quick = len(pairs) < len(by_key)
    whole = same and not quick and not fresh
    stated = card.entries()
    figures = [name for name in _FIGURES if whole and _says_other(stated.get(name), getattr(replay, name))]
    equal = same and not (
        whole and any(_says_other(stated.get(name), getattr(replay, name), by=0.0) for name in _FIGURES)
    )
    score, interval, here = card.score, None, replay.score
    if score is not None:
        weights = environment_weights([old.terrain for old, _ in pairs])
        if quick:
            score = round(float(weights @ np.array([old.score for old, _ in pairs])), 6)
        interval = Evidence([new for _, new in pairs], replay.chance).chance(weights).interval(score)
    band = tolerance_band(score, interval)
    within = band is not None and here is not None and band[0] <= here and (fresh or here <= band[1])
    asked, used = _settings(card), _settings(replay)
    settings = [
        {"name": name, "card": value, "here": used[name]}
        for name, value in asked.items()
        if name in used and value != used[name]
    ]
    return {
        "holds": not settings and (not figures if same else within),
        "equal": equal,
        "quick": quick,
        "environments": [len(pairs), len(by_key)],
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
        "settings": settings,
        "unlike": unlike([card.versions, replay.versions]),
    }


def _says_other(stated: Any, found: Any, *, by: float = 1e-4) -> bool:
    """Return whether a figure, or one in a table or pair of them, is off by more than so much; one that is not stated is not."""
    if isinstance(stated, Table):
        return any(_says_other(value, getattr(found, name), by=by) for name, value in stated.entries().items())
    if isinstance(stated, Mapping):
        return any(_says_other(value, (found or {}).get(key), by=by) for key, value in stated.items())
    if isinstance(stated, tuple):
        return len(stated) != len(found or ()) or any(
            _says_other(a, b, by=by) for a, b in zip(stated, found, strict=True)
        )
    return stated is not None and (found is None or abs(stated - found) > by)


def _settings(result: Result) -> dict[str, Any]:
    """Return settings of solver and motors, as far as the result states them."""
    gains = {"motors.stiffness": list(result.motors.stiffness), "motors.damping": list(result.motors.damping)}
    return {f"solver.{name}": value for name, value in result.solver.items()} | {n: g for n, g in gains.items() if g}


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
