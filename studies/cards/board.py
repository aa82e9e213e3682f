"""A leaderboard: one static page made of a folder of score cards. It loads nothing from anywhere."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import jinja2

from ...backends.base import BackendError
from ...files.parsing import edited, one_line
from ...files.writing import make_folder, write_atomically
from ...gauge.chance.intervals import Evidence
from ...gauge.report.pages import page_template
from ...gauge.result import Result
from ...gauge.suite import load_suite, suite_names
from ...gauge.suited import suited
from ...gauge.totals import environment_weights
from ...policy.base import PolicyError
from ...policy.contract import EXTEROCEPTIVE_TERMS, PRIVILEGED_TERMS, ContractError
from ...policy.finding import shipped_policies
from ...policy.loading import load_policy, own_contract
from ...policy.native import FilePolicy
from ...policy.robot_of import robot_for
from ...robots import RobotError
from ...robots.loading import robot_digest
from ..compare.comparison import load_result
from ..naming import distinct_names
from ..policies import file_digest
from .verify import CardError, check_card, check_policy


def write_board(folder: Path, page: Path) -> Path:
    """Write the board of a folder's cards, all or nothing, into a folder that is created.

    Cards are ``*.json``, ``*.json.gz`` and folders of evaluations; an evaluation's own folder is a board of one.

    Raises:
        CardError: there is no card, one does not hold what it says it holds of a suite that ships, or names such a one and is not
            of it; or the page cannot be written.
        ComparisonError: a file that is none, or a damaged one; nothing is left out in silence.
    """
    files = sorted(file for kind in ("*.json", "*.json.gz", "*/results.json") for file in folder.glob(kind))
    if folder / "results.json" in files:  # an evaluation also writes down what it was asked
        files = [file for file in files if file != folder / "request.json"]
    if not files:
        raise CardError(f"'{folder}' holds no score cards; put results.json files or folders of evaluations there")
    cards = {str(file.relative_to(folder)): load_result(file) for file in files}
    shipped = {name: load_suite(name) for name in suite_names()}
    by_digest = {suite.digest: suite for suite in shipped.values()}
    seen = set()
    for file, card in cards.items():
        named, source = card.suite, f"the card '{one_line(file)}'"
        if named.digest not in by_digest and (suite := shipped.get(named.name)):
            raise CardError(
                f"{source} is of {named} with digest {named.digest[:12]}…, but {suite.name} here is "
                f"{suite.version} with {suite.digest[:12]}…; evaluate its policy again, or take the card away"
            )
        check_card(card, by_digest.get(named.digest), source)
        if named.digest in by_digest and (policy := _own_policy(card, (folder / file).parent)):
            # without the card's engine or robot nothing can be said; whoever replays the card is told
            with suppress(BackendError, RobotError, ContractError):
                robot = robot_for(policy.contract, None)
                if policy.path in shipped_policies() or card.robot_digest in (None, robot_digest(robot)):
                    check_policy(card, suited(by_digest[named.digest], policy.contract), policy, robot, source)
                    seen.add(file)
    with edited(f"a card in '{one_line(folder)}'", CardError, jinja2.TemplateError):
        text = render_board(board_data(cards, folder, seen))
    make_folder(page.parent, CardError)
    write_atomically(page, text, CardError)
    return page


def board_data(cards: Mapping[str, Result], folder: Path = Path(), seen: Collection[str] = ()) -> list[dict[str, Any]]:
    """Return the tables of a board, one for each suite and robot, both by digest, and engine, those with most cards first. Policies
    that see the ground have tables of their own.

    Args:
        folder: the folder in which the command that checks a card finds the files.
        seen: cards with a policy that is here and holds all that they say of it.

    Returns:
        For each table ``suite``, ``backend``, ``robot``, ``robot_digest`` (None where cards do not say), ``exteroceptive`` (its
        policies see the ground), ``ranked`` (complete cards, best first, with their ``rank``) and ``others`` (parts, custom runs,
        levels alone and policies with privileged observations, which have no rank). Intervals of ranked cards cover all their
        scores at once with 95 %, the first one's included, which is first by luck as well; ``ranks`` are the ranks that they leave
        possible.
    """
    tables: dict[tuple[str, str, str, str, str, str | None, bool], dict[str, Result]] = {}
    for name, card in cards.items():
        of = card.suite
        key = (of.digest, of.name, of.version, card.backend, card.robot, card.robot_digest, _sees_ground(card))
        tables.setdefault(key, {})[name] = card
    found = []
    for key, rows in sorted(tables.items(), key=lambda item: -len(item[1])):
        # a card's own name and folder are part of the path: they stand for a policy whose file is called as any other
        names = distinct_names([f"{folder.absolute() / name}/{card.policy.path}" for name, card in rows.items()])
        entries = [
            _entry(name, card, folder, policy, name in seen)
            for (name, card), policy in zip(rows.items(), names, strict=True)
        ]
        entries.sort(key=lambda e: -1.0 if e["score"] is None else e["score"], reverse=True)
        ranked = [e for e in entries if e["ranked"]]
        for entry in ranked:  # equal scores share a rank
            entry["rank"] = 1 + sum(other["score"] > entry["score"] for other in ranked)
            entry["interval"] = _interval(rows[entry["card"]], len(ranked))
        for entry in ranked:
            entry["ranks"] = _possible_ranks(entry, ranked)
        others = [e for e in entries if not e["ranked"]]
        digest, called, version, backend, robot, files, sees_ground = key
        place = {
            "suite": {"name": called, "version": version, "digest": digest},
            "backend": backend,
            "robot": robot,
            "robot_digest": files,
            "exteroceptive": sees_ground,
        }
        found.append({**place, "ranked": ranked, "others": others})
    return found


def render_board(tables: Sequence[Mapping[str, Any]]) -> str:
    """Return the page, as HTML text. The texts of cards are shown as text and never becomes markup."""
    return page_template(__file__, "board.html.j2").render(tables=tables)


def _sees_ground(card: Result) -> bool:
    """Return whether a policy observes the ground."""
    stated = card.policy.kind_of_observations == "exteroceptive"
    return stated or bool(set(card.policy.observations or ()) & set(EXTEROCEPTIVE_TERMS))


def _file_of(card: Result, folder: Path) -> str | None:
    """Return the file, or the name, of a card's policy: one that ships, one at the card's path or from its folder; None for none."""
    for path in (card.policy.path, str(folder / card.policy.path)):
        with suppress(PolicyError, OSError):
            if file_digest(path) == card.policy.file_sha256:
                return path
    return None


def _own_policy(card: Result, folder: Path) -> FilePolicy | None:
    """Return a card's policy where it is here with its contract inside; others may have been played with a contract of their own."""
    with suppress(PolicyError):
        file = _file_of(card, folder)
        return None if file is None or own_contract(file, "another") else load_policy(file)
    return None


def _interval(card: Result, together: int) -> tuple[float, float] | None:
    """Return the interval of a score that covers it together with those of the other cards of its table."""
    if card.score is None or not card.environments:
        return card.score_interval
    weights = environment_weights([row.terrain for row in card.environments])
    return Evidence(card.environments, card.chance).chance(weights).interval(card.score, together=together)


def _possible_ranks(entry: Mapping[str, Any], ranked: Sequence[Mapping[str, Any]]) -> tuple[int, int]:
    """Return the best and the worst rank that a card may have in truth: intervals that do not meet are told apart."""
    low, high = entry["interval"] or (0.0, 1.0)
    known = [other["interval"] or (0.0, 1.0) for other in ranked if other is not entry]
    return 1 + sum(other[0] > high for other in known), len(ranked) - sum(other[1] < low for other in known)


def _entry(name: str, card: Result, folder: Path, policy: str, seen: bool) -> dict[str, Any]:
    """Return a line of the board."""
    terms, found = card.policy.observations, _file_of(card, (folder / name).parent)
    privileged = bool(set(terms or ()) & set(PRIVILEGED_TERMS))
    kind = "privileged" if privileged else "exteroceptive" if _sees_ground(card) else "measurable"
    return {
        "card": name,
        "policy": policy,
        "hash": card.policy.file_sha256,
        "score": card.score,
        "interval": card.score_interval,
        "note": card.chance.note,
        "level": card.level,
        "observations": "not stated" if terms is None else kind,
        "terms": list(terms or ()),
        "coverage": card.coverage.words,
        "proved": card.proved,
        "seen": seen,
        "ranked": card.complete and card.score is not None and not privileged,
        "rank": None,
        "ranks": None,
        "command": f"gaitgauge verify {shlex.quote(str(folder / name))}{'' if found else ' --policy FILE'}",
    }
