"""Forge a score card in many ways, and print which forgeries the board and the judge of ``verify`` refuse.

    python benchmarks/forgeries.py CARD.json.gz [--policy FILE]

The card must be an honest one of a suite that ships. Each kind of forgery is made from it and tried on ``gaitgauge board`` and on
``gaitgauge verify``, where the card itself stands for the replay: nothing is played. Kinds whose figures were all made anew
(``consistent``) contradict nothing in the card, so that only a replay tells them; the board cannot. Nor can it tell what is false
of a policy that is not here: it marks such a card, as it marks the honest one (``unseen``). ``--policy`` puts the file of a policy
that does not ship beside the card. Exit code 1 where the judge accepts a forgery, or the board one that it could tell.
"""

from __future__ import annotations

import argparse
import copy
import gzip
import json
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from gaitgauge.gauge.result import Result
from gaitgauge.gauge.suite import load_suite
from gaitgauge.gauge.totals import health_of, totals, whole_row
from gaitgauge.studies.cards.board import write_board
from gaitgauge.studies.cards.verify import check_card, judge
from gaitgauge.studies.compare.comparison import load_result

Data = dict[str, Any]
Forger = Callable[[Data], Data | None]
"""Changes a card in place, or returns another one."""
REPLAY = "consistent"
MARKED = "marked"
UNSEEN = "it is marked: policy unseen"
KINDS: dict[str, Forger] = {}


def kind(name: str) -> Callable[[Forger], Forger]:
    """Register a kind of forgery."""

    def register(forger: Forger) -> Forger:
        KINDS[name] = forger
        return forger

    return register


def setting(name: str, *path: str | int, to: Any) -> None:
    """Register a forgery that puts another value, or what a function makes of the old one, at a place."""

    def forger(card: Data) -> None:
        *steps, last = path
        table: Any = card
        for step in steps:
            table = table[step]
        table[last] = to(table[last]) if callable(to) else to

    KINDS[name] = forger


def without(name: str, *path: str | int) -> None:
    """Register a forgery that removes an entry."""

    def forger(card: Data) -> None:
        table: Any = card
        for step in path[:-1]:
            table = table[step]
        del table[path[-1]]

    KINDS[name] = forger


def made_anew(card: Data, intervals: bool = True) -> Data:
    """Return a card whose figures were all made anew of its rows, as a forger with this program would."""
    result = Result.from_data(card, "it", ValueError)
    columns = next(run for row in result.environments for run in row.runs.values()).columns
    scores = totals(
        [whole_row(row, result.chance) for row in result.environments],
        result.chance,
        suite=result.suite,
        groups=result.group_metrics,
        metrics=[name for name in columns if name != "quality"],
        evaluated=True,
        intervals=intervals,
    )
    return replace(
        result, **vars(scores) | {"health": health_of(scores.environments), "lacking": frozenset()}
    ).to_data()


def rows(card: Data) -> list[Data]:
    """Return the environments."""
    found: list[Data] = card["environments"]
    return found


def searched(card: Data) -> list[Data]:
    """Return the environments with a level that was searched for, and is below the highest where there are such."""
    found = [row for row in rows(card) if row.get("search")]
    return [row for row in found if row["level"] < card["chance"]["levels"]] or found


def runs(card: Data) -> Iterator[Data]:
    """Yield all runs, those beside an expected level too."""
    for row in rows(card):
        for table in (row.get("runs", {}), *row.get("runs_by_level", {}).values()):
            yield from table.values()


def worst(card: Data) -> Data:
    """Return the environment with the lowest score."""
    return min(rows(card), key=lambda row: row["score"])


def best(card: Data) -> Data:
    """Return the environment with the highest score."""
    return max(rows(card), key=lambda row: row["score"])


def raise_column(run: Data, column: str, by: float) -> None:
    """Raise the statistics of a column in a run, within 0 and 1."""
    for table in (run, run["mean"], run["mean25"]):
        table[column] = max(0.0, min(table[column] + by, 1.0))


# ---- figures --------------------------------------------------------------------------------------------------------


def raised(value: float) -> float:
    """Return a better value of a figure."""
    return min(value + 0.1, 1.0)


def wider(ends: list[float]) -> list[float]:
    """Return a wider interval."""
    return [max(ends[0] - 0.1, 0.0), min(ends[1] + 0.1, 1.0)]


def register_figures(card: Data) -> None:
    """Register forgeries of single figures."""
    terrain, metric = next(name for name in card["terrains"] if name != "flat"), next(iter(card["metrics"]))
    group = next(iter(card["groups"]))
    setting("score raised", "score", to=raised)
    setting("score of 1", "score", to=1.0)
    setting("score of nothing", "score", to=None)
    setting("score is NaN", "score", to=float("nan"))
    setting("score is infinite", "score", to=float("inf"))
    setting("score is a text", "score", to=str)
    setting("score is true", "score", to=True)
    if card["score_interval"]:
        setting("interval of the score wider", "score_interval", to=wider)
        setting("interval of the score a point", "score_interval", to=lambda ends: [sum(ends) / 2] * 2)
        setting("interval of the score removed", "score_interval", to=None)
        setting("intervals of groups wider", "groups_interval", group, to=wider)
        setting("interval of a terrain wider", "terrains", terrain, "interval", to=wider)
        setting("interval of a metric wider", "metrics", metric, "interval", to=wider)
        setting("interval of an environment wider", "environments", 0, "interval", to=wider)
        setting("interval of the level wider", "level_interval", to=lambda ends: [0.0, 10.0] if ends else [1.0, 2.0])
    setting("mean level raised", "level", to=lambda level: level + 0.5)
    setting("terrain's score raised", "terrains", terrain, "score", to=raised)
    setting("terrain's level raised", "terrains", terrain, "level", to=lambda level: (level or 0) + 1)
    setting("terrain's mean raised", "terrains", terrain, "mean", to=raised)
    setting("terrain's mean@25 raised", "terrains", terrain, "mean25", to=raised)
    without("a terrain removed", "terrains", terrain)
    setting("metric of 1", "metrics", metric, "mean50", to=1.0)
    setting("metric's mean@25 of 1", "metrics", metric, "mean25", to=1.0)
    without("a metric removed", "metrics", metric)
    setting("group raised", "groups", group, to=raised)
    setting("groups of other metrics", "group_metrics", group, to=lambda names: names[:1])
    setting("environment's score raised", "environments", 0, "score", to=raised)
    setting("quality of 3", "environments", 0, "quality", to=lambda _: dict.fromkeys(("mean", "mean25", "mean50"), 3.0))
    setting("quality's mean of 1", "environments", 0, "quality", "mean", to=1.0)
    setting("environment's metric of 1", "environments", 0, "metrics", metric, "mean25", to=1.0)
    setting("episodes fewer", "health", "episodes", to=lambda count: count - 1)
    setting("self-contact none", "health", "self_contact", to=lambda share: 0.0 if share else 0.5)
    setting("self-contact none in a row", "environments", 0, "self_contact", to=lambda share: 0.0 if share else 0.5)
    setting("restarts in a row", "environments", 0, "restarted", to=lambda count: count + 1)


@kind("all metrics 1")
def all_metrics(card: Data) -> None:
    """Make every metric perfect, in the totals alone."""
    for table in card["metrics"].values():
        table |= {"mean": 1.0, "mean25": 1.0, "mean50": 1.0}


@kind("all metrics 1, in rows too")
def all_metrics_in_rows(card: Data) -> None:
    """Make every metric perfect, in rows and totals."""
    all_metrics(card)
    for row in rows(card):
        for table in row.get("metrics", {}).values():
            table |= {"mean": 1.0, "mean25": 1.0, "mean50": 1.0}


def counted(row: Data, name: str) -> bool:
    """Return whether a row counts something."""
    return row.get(name) is not None


@kind("falls changed in the totals")
def falls_total(card: Data) -> None:
    """Change the number of falls."""
    card["health"]["falls"] = 0 if card["health"]["falls"] else 5


@kind("falls changed in rows and totals")
def falls_rows(card: Data) -> None:
    """Change the number of falls in rows, too."""
    row = next(row for row in rows(card) if counted(row, "falls"))
    card["health"]["falls"] += 1
    row["falls"] += 1


@kind("falls changed in one run")
def falls_run(card: Data) -> None:
    """Change the falls of a run."""
    run = next(runs(card))
    run["health"]["falls"] = 0 if run["health"]["falls"] else 3


@kind("divergences hidden, or made up")
def divergences(card: Data) -> None:
    """Change the number of divergences."""
    card["health"]["diverged"] += 1 if not card["health"]["diverged"] else -1


# ---- levels and trials ------------------------------------------------------------------------------------------------


@kind("all levels 10, trials unchanged")
def levels_10(card: Data) -> None:
    """Raise all levels and leave the rest."""
    for row in searched(card):
        row["level"] = card["chance"]["levels"]


@kind("all levels 10, all figures made anew, trials unchanged")
def levels_10_anew(card: Data) -> Data:
    """Raise all levels and make all figures anew; runs that were played beside a level stay where they are."""
    for row in searched(card):
        row["level"] = card["chance"]["levels"]
        for table in [row.pop("runs_by_level", None)]:
            if table:
                row["runs"] = next(iter(table.values()))
    return made_anew(card)


@kind("one level raised")
def one_level(card: Data) -> None:
    """Raise the level of one environment."""
    row = searched(card)[0]
    row["level"] += 1 if row["level"] < card["chance"]["levels"] else -1


@kind("search outcomes turned")
def search_turned(card: Data) -> None:
    """Turn the outcomes of a search."""
    row = searched(card)[0]
    row["search"] = dict.fromkeys(row["search"], True)


@kind("failed trials turned, level unchanged")
def trials_turned(card: Data) -> None:
    """Turn failed trials into passed ones."""
    for row in searched(card):
        row["trials"] = {level: dict.fromkeys(table, True) for level, table in row["trials"].items()}


@kind("failed trials removed")
def trials_removed(card: Data) -> None:
    """Remove failed trials."""
    for row in searched(card):
        row["trials"] = {level: {s: True for s, ok in table.items() if ok} for level, table in row["trials"].items()}


@kind("all trials removed")
def all_trials_removed(card: Data) -> None:
    """Remove the trials and leave the search."""
    for row in searched(card):
        row["trials"] = {}


@kind("search and trials removed, as if the level were given")
def search_removed(card: Data) -> None:
    """Say that the level was given."""
    for row in searched(card):
        del row["search"], row["trials"]


@kind("trials of a seed that is none of the suite's")
def trial_seed(card: Data) -> None:
    """Rename the seed of trials."""
    row = searched(card)[0]
    row["trials"] = {
        level: {("999" if at == 0 else seed): ok for at, (seed, ok) in enumerate(table.items())}
        for level, table in row["trials"].items()
    }


@kind("trials of a level above the highest")
def trial_level(card: Data) -> None:
    """Add trials of a level that does not exist."""
    row = searched(card)[0]
    row["trials"]["11"] = dict.fromkeys(map(str, card["chance"]["search_seeds"]), True)


@kind("a level that flat ground does not have")
def flat_level(card: Data) -> None:
    """Give flat ground a level."""
    next(row for row in rows(card) if row["terrain"] == "flat")["level"] = 10


@kind("fitted curve raised")
def curve(card: Data) -> None:
    """Raise the fitted shares."""
    searched(card)[0]["curve"] = {"1": 1.0, "10": 1.0}


# ---- runs -----------------------------------------------------------------------------------------------------------


@kind("quality of one run raised")
def one_run(card: Data) -> None:
    """Raise the quality of one run and nothing else."""
    raise_column(next(runs(card)), "quality", 0.1)


@kind("quality of one run raised, its row made anew")
def one_run_row(card: Data) -> None:
    """Raise the quality of one run and of its row alone."""
    raise_column(next(runs(card)), "quality", 0.1)
    card["environments"][0] = made_anew(card, intervals=False)["environments"][0] | {
        "interval": card["environments"][0]["interval"]
    }


@kind("quality of runs raised, all but intervals made anew")
def runs_intervals(card: Data) -> Data:
    """Raise one run a lot and keep the old intervals."""
    raise_column(next(runs(card)), "quality", 0.3)
    if card["score_interval"] is None:
        raise KeyError("score_interval")
    new = made_anew(card)
    return new | {name: card[name] for name in ("score_interval", "groups_interval", "level_interval")}


@kind("quality of runs raised, all but groups made anew")
def runs_groups(card: Data) -> Data:
    """Raise metrics of one run and keep the old groups."""
    metric = next(iter(card["metrics"]))
    for run in runs(card):
        raise_column(run, metric, -0.05)
    return made_anew(card) | {"groups": card["groups"]}


@kind("a run is NaN")
def run_nan(card: Data) -> None:
    """Put NaN into a run."""
    next(runs(card))["quality"] = float("nan")


@kind("a run is 3")
def run_3(card: Data) -> None:
    """Put a value that no quality has into a run."""
    next(runs(card))["quality"] = 3.0


@kind("a run is negative")
def run_negative(card: Data) -> None:
    """Put a negative number of falls into a run."""
    next(runs(card))["health"]["falls"] = -1


@kind("runs of a seed removed")
def seed_removed(card: Data) -> None:
    """Remove the worst seed of an environment."""
    row = worst(card)
    table = row.get("runs") or next(row for row in rows(card) if row.get("runs"))["runs"]
    del table[min(table, key=lambda seed: table[seed]["quality"])]


@kind("runs of a seed removed everywhere")
def seed_removed_everywhere(card: Data) -> None:
    """Remove one seed of all environments and of the rules."""
    seed = str(card["chance"]["seeds"][0])
    for row in rows(card):
        for table in (row.get("runs", {}), *row.get("runs_by_level", {}).values()):
            table.pop(seed, None)
    card["chance"]["seeds"] = card["chance"]["seeds"][1:]


@kind("a seed that was not played")
def seed_added(card: Data) -> None:
    """Add a seed that is a copy of another."""
    row = next(row for row in rows(card) if row.get("runs"))
    row["runs"]["77"] = next(iter(row["runs"].values()))


@kind("columns of runs removed")
def column_removed(card: Data) -> None:
    """Remove the worst metric from runs, rows and totals."""
    metric = min(card["metrics"], key=lambda name: card["metrics"][name]["mean50"])
    for run in runs(card):
        for table in (run, run["mean"], run["mean25"]):
            table.pop(metric, None)
    for row in rows(card):
        row.get("metrics", {}).pop(metric, None)
    card["metrics"].pop(metric)


@kind("sub-commands of runs removed")
def commands_removed(card: Data) -> None:
    """Remove the worst sub-command."""
    first = next(runs(card))["commands"]
    name = min(first, key=first.__getitem__)
    for run in runs(card):
        run["commands"].pop(name, None)


@kind("proof of runs removed")
def proof_removed(card: Data) -> None:
    """Remove what mean and falls follow from."""
    for run in runs(card):
        for name in ("mean", "mean25", "health"):
            run.pop(name, None)


@kind("mean@25 above the mean")
def mean25_above(card: Data) -> Data:
    """Let the worst quarter be better than the mean."""
    for run in runs(card):
        run["mean25"]["quality"] = min(run["mean"]["quality"] + 0.1, 1.0)
    return made_anew(card)


@kind("runs removed, figures kept")
def runs_removed(card: Data) -> None:
    """Remove the runs of an environment."""
    next(row for row in rows(card) if row.get("runs"))["runs"] = {}


# ---- environments ---------------------------------------------------------------------------------------------------


@kind("worst environment dropped, figures made anew")
def dropped(card: Data) -> Data:
    """Drop the worst environment."""
    rows(card).remove(worst(card))
    return made_anew(card)


@kind("best environment twice")
def twice(card: Data) -> Data:
    """Copy the best environment over the worst."""
    rows(card)[rows(card).index(worst(card))] = copy.deepcopy(best(card))
    return made_anew(card)


@kind("best environment again at a friction of no suite")
def other_friction(card: Data) -> Data:
    """Add a copy of the best environment."""
    rows(card).append(copy.deepcopy(best(card)) | {"friction": 0.65})
    return made_anew(card)


@kind("all environments dropped")
def all_dropped(card: Data) -> None:
    """Leave no environment."""
    card["environments"] = []


@kind("a terrain that is none")
def renamed_terrain(card: Data) -> Data:
    """Rename a terrain."""
    for row in rows(card):
        row["terrain"] = "lawn" if row["terrain"] != "flat" else "flat"
    return made_anew(card)


# ---- names and rules ------------------------------------------------------------------------------------------------


def register_names(card: Data) -> None:
    """Register forgeries of names, rules and statements."""
    for name, value in {
        "confidence": 0.5,
        "level_weight": 0.2,
        "quality_weight": 0.9,
        "pass_rate": 0.01,
        "levels": 5,
        "resamples": 10,
        "shared_noise": lambda shared: not shared,
        "decimals": lambda places: 2 if places is None else None,
        "search_seeds": lambda seeds: seeds[:1],
        "seeds": lambda seeds: [*seeds[::-1], 99],
        "note": "computed with care",
    }.items():
        setting(f"rule {name} changed", "chance", name, to=value)
    setting("version of the suite renamed", "suite", "version", to="9.9.9")
    setting("suite renamed", "suite", "name", to="mine")
    setting("title of the suite changed", "suite", "title", to="the best")
    setting("digest of the suite changed", "suite", "digest", to="ab" * 32)
    setting("digest of the suite in the provenance changed", "provenance", "digests", "suite", to="ab" * 32)
    setting("pipeline renamed", "pipeline", to="best")
    setting("pipeline level", "pipeline", to="level")
    setting("robot renamed", "robot", to="anymal_c")
    setting("schema 1", "schema", to=1)
    setting("schema 9", "schema", to=9)
    setting("schema 2, as it stands", "schema", to=2)
    for name in (
        "motors",
        "provenance",
        "solver",
        "coverage",
        "health",
        "policy",
        "training",
        "commands",
        "feet",
        "chance",
    ):
        without(f"{name} removed", name)
        setting(f"{name} empty", name, to={})
    without("digests removed", "provenance", "digests")
    without("versions removed", "provenance", "versions")
    setting("motors weaker", "motors", "stiffness", to=lambda gains: [0.5 * gain for gain in gains])
    setting("motors' damping other", "motors", "damping", to=lambda gains: [2 * gain for gain in gains])
    setting("solver other", "solver", "iterations", to=5)
    setting(f"{REPLAY}: policy's file other", "policy", "file_sha256", to="cd" * 32)
    setting("policy's contract other", "policy", "contract_hash", to="cd" * 32)
    setting("policy's contract no hash", "policy", "contract_hash", to="none")
    setting("observations changed", "policy", "observations", to=lambda names: names[1:])
    setting("observations hidden", "policy", "observations", to=None)
    setting("kind of observations changed", "policy", "kind_of_observations", to="privileged")
    setting("provenance of the policy removed", "policy", "provenance", to={})
    setting("assumptions made up", "policy", "assumptions", to=["none at all"])
    setting(
        "training in another engine", "training", "trained", to=[{"engine": "reality", "version": None, "settings": {}}]
    )
    setting("training's note removed", "training", "note", to=None)
    setting("limits of commands wider", "commands", "limits", to=lambda limits: [2 * limit for limit in limits])
    setting("feet without torsion", "feet", to={"dimension": [3], "torsion": 0.0})
    setting("coverage of a part called complete", "coverage", to=lambda found: found | {"environments": [1, 1]})
    setting("coverage's text changed", "coverage", "text", to="more than complete")


# ---- consistent forgeries -------------------------------------------------------------------------------------------


@kind(f"{REPLAY}: quality of one run raised")
def consistent_run(card: Data) -> Data:
    """Raise one run and make everything anew."""
    for run in (card["environments"][0].get("runs") or {}).values():
        raise_column(run, "quality", 0.02)
        break
    return made_anew(card)


@kind(f"{REPLAY}: quality of all runs raised")
def consistent_runs(card: Data) -> Data:
    """Raise all runs and make everything anew."""
    for run in runs(card):
        raise_column(run, "quality", 0.1)
    return made_anew(card)


@kind(f"{REPLAY}: a metric of all runs raised")
def consistent_metric(card: Data) -> Data:
    """Raise a metric in all runs."""
    metric = min(card["metrics"], key=lambda name: card["metrics"][name]["mean50"])
    for run in runs(card):
        raise_column(run, metric, 0.1)
    return made_anew(card)


@kind(f"{REPLAY}: falls changed in all runs")
def consistent_falls(card: Data) -> Data:
    """Change the falls of all runs."""
    fell = card["health"]["falls"] > 0
    for run in runs(card):
        run["health"] |= {"falls": 0 if fell else 1, "diverged": 0}
    return made_anew(card)


@kind(f"{REPLAY}: self-contact removed from all runs")
def consistent_contact(card: Data) -> Data:
    """Change the self-contact of all runs."""
    for run in runs(card):
        run["health"]["self_contact"] = 0.0 if card["health"]["self_contact"] else 0.3
    return made_anew(card)


def one_more_level(card: Data, chosen: list[Data]) -> Data:
    """Let every trial of some searches of a bisection pass, with the trials that such a search asks for."""
    top = card["chance"]["levels"]
    for row in chosen:
        low, path = 0, []
        while low < top:
            low = (low + top + 1) // 2
            path.append(low)
        count = len(next(iter(row["trials"].values())))
        seeds = [str(seed) for seed in card["chance"]["search_seeds"]]
        needed = seeds[: count if card["chance"]["level"] != "bisection" else max(round(0.6 * len(seeds)), 1)]
        row |= {
            "level": top,
            "search": dict.fromkeys(map(str, sorted(path)), True),
            "trials": {str(level): dict.fromkeys(needed, True) for level in sorted(path)},
        }
        if beside := row.pop("runs_by_level", None):
            row["runs"] = next(iter(beside.values()))
    return made_anew(card)


@kind(f"{REPLAY}: all trials of one environment passed")
def consistent_trials_of_one(card: Data) -> Data:
    """Let the trials of one environment pass."""
    return one_more_level(card, searched(card)[:1])


@kind(f"{REPLAY}: all trials passed")
def consistent_trials(card: Data) -> Data:
    """Let all trials pass."""
    return one_more_level(card, searched(card))


@kind(f"{REPLAY}: seeds of all runs swapped")
def consistent_seeds(card: Data) -> Data:
    """Swap the runs of two seeds in all environments."""
    first, second, *_ = map(str, [*card["chance"]["seeds"], card["chance"]["seeds"][0]])
    for row in rows(card):
        for table in (row.get("runs", {}), *row.get("runs_by_level", {}).values()):
            if table:
                table[first], table[second] = table[second], table[first]
    return made_anew(card)


@kind(f"{REPLAY}: worst environment a copy of the best")
def consistent_copy(card: Data) -> Data:
    """Put the best runs of a terrain in the place of its worst."""
    bad = worst(card)
    good = max((row for row in rows(card) if row["terrain"] == bad["terrain"]), key=lambda row: row["score"])
    place = {name: bad[name] for name in ("terrain", "friction", "payload")}
    rows(card)[rows(card).index(bad)] = copy.deepcopy(good) | place
    return made_anew(card)


@kind(f"{MARKED}: schema 2 without the proof, falls changed")
def downgraded(card: Data) -> Data:
    """Give the card the older form, in which falls follow from nothing."""
    proof_removed(card)
    for name in ("training", "commands", "feet"):
        del card[name]
    card["schema"] = 2
    del card["chance"]["decimals"]
    row = next(row for row in rows(card) if counted(row, "falls"))
    row["falls"] += 1
    card["health"]["falls"] += 1
    return card


# ---- trying ---------------------------------------------------------------------------------------------------------


def try_board(card: Data, folder: Path) -> str | None:
    """Return the sentence with which the board refuses or marks a card, None where it shows it as a proved one."""
    (folder / "card.json").write_text(json.dumps(card))
    try:
        page = write_board(folder, folder / "board.html").read_text()
    except ValueError as error:
        return str(error)
    return "it is marked as unproved" if ">unproved<" in page else UNSEEN if ">policy unseen<" in page else None


def try_judge(card: Data, honest: Result, folder: Path) -> str | None:
    """Return why the judge of ``verify`` refuses a card, None where it holds; the honest card stands for the replay."""
    file = folder / "card.json"
    file.write_text(json.dumps(card))
    try:
        found = load_result(file)
        suite = load_suite(found.suite.name)
        if suite.digest != found.suite.digest:
            return "its suite is another one here"
        check_card(found, suite, "the card")
        verdict = judge(found, honest)
    except ValueError as error:
        return str(error)
    reasons = {name: verdict[name] for name in ("settings", "edited", "figures") if verdict[name]}
    if not found.proved and verdict["holds"]:
        return "it is called unproved"
    return None if verdict["holds"] else str(reasons or "its score lies outside the band")


def forge(card: Data) -> dict[str, Forger]:
    """Return all kinds of forgeries of a card."""
    register_figures(card)
    register_names(card)
    return KINDS


def tried(card: Data, folder: Path, only: str = "") -> Iterator[tuple[str, str | None, str | None]]:
    """Yield each kind with the sentences of board and judge, None where it is accepted; kinds that change nothing are left out."""
    honest = Result.from_data(copy.deepcopy(card), "the card", ValueError)
    unchanged = (card, made_anew(copy.deepcopy(card)))
    for name, forger in forge(card).items():
        if only not in name:
            continue
        forged = copy.deepcopy(card)
        try:
            forged = forger(forged) or forged
        except (KeyError, IndexError, StopIteration, TypeError) as error:
            print(f"{name}: not possible with this card ({error!r})", file=sys.stderr)
            continue
        if forged not in unchanged:
            yield name, try_board(forged, folder), try_judge(forged, honest, folder)


def main() -> None:
    """Forge, try, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("card", type=Path)
    parser.add_argument("--policy", type=Path, help="the file of a policy that does not ship")
    parser.add_argument("--only", default="", help="kinds with this text in their name")
    parser.add_argument("--sentences", action="store_true", help="say why, too")
    arguments = parser.parse_args()
    raw = arguments.card.read_bytes()
    card = json.loads(gzip.decompress(raw) if arguments.card.suffix == ".gz" else raw)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        load_result(arguments.card)
        if arguments.policy:
            shutil.copyfile(arguments.policy, place / Path(card["policy"]["path"]).name)
        honest = try_board(card, place)
        if honest not in (None, UNSEEN) or (arguments.policy and honest):
            sys.exit(f"the honest card is refused: {honest}")
        accepted, unseen, count = [], [], 0
        print(f"{'forgery':56}  {'board':11}  judge")
        for name, board, judged in tried(card, place, arguments.only):
            count += 1
            needs_replay = name.startswith(REPLAY)
            if judged is None or (board is None and not needs_replay):
                accepted.append(name)
            if board == UNSEEN and not needs_replay and judged:
                unseen.append(name)
            marked = UNSEEN.rpartition(" ")[2] if board == UNSEEN else "refused"
            told = "cannot tell" if needs_replay and board in (None, UNSEEN) else marked if board else "ACCEPTED"
            print(f"{name[:56]:56}  {told:11}  {'refused' if judged else 'ACCEPTED'}", flush=True)
            if arguments.sentences:
                print(f"    board: {board}\n    judge: {judged}")
    print(
        f"{count} kinds, {len(accepted)} accepted, {len(unseen)} refused by the judge and marked by the board as unseen alone"
    )
    print("\n".join([f"accepted: {name}" for name in accepted] + [f"unseen: {name}" for name in unseen]))
    sys.exit(bool(accepted))


if __name__ == "__main__":
    main()
