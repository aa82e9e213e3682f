"""Whether a policy scores more on ``gaitgauge-1`` by doing less than is asked: its commands are filtered before it sees them.

    python benchmarks/cheats.py pretrained --folder /tmp/cheats --threads 32 --filters 200 --fresh 20

Seven terrains at one level, frictions 0.3, 0.6 and 0.9. Listed cheats (slower, capped along an axis, later, turning less,
standing between) are played on the first five of the fresh seeds (``--listed`` for more). A gain is the score with the filter
minus the score without it, on the same seeds. Lower bounds are Student's over seeds, 95 % one-sided, with Holm's correction among
the filters of a table.

Random filters are screened on one seed, whole episodes throughout, in two rounds of a successive halving (Jamieson and Talwalkar
2016): all of them play a third of the places, each terrain at one friction in turn and the same for every filter; the best quarter
plays the other two thirds too. The ten best over all places are played again on the fresh seeds, which no choice has seen. The
rounds leave the test as it is and cost half of a full screen; ``--by-thirds`` prints how well gains on a third of the places tell
those on the other two thirds, among all filters that the folder has whole, and how many of the ten best a first round would lose.

A sub-command that a filter does not change is not played again: it gets the unfiltered policy's samples, to the last bit the same,
since each begins with a reset and has noise of its own. Random filters that change no command at all are not counted.

At every terrain and friction the lower bound of a listed cheat must be at most 0, or 0.002 where the unfiltered policy falls; that of a
random filter must be at most 0. Else the exit code is 1. What the folder holds is not played again. 200 filters take about 2,100
episodes for the screen and 4,600 for the fresh seeds, 4 to 9 s of a core each where every sub-command is played.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import multiprocessing
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gaitgauge.backends import make_backend
from gaitgauge.gauge.episodes import MOTION, QUALITY, Episode, Record
from gaitgauge.gauge.evaluate import Prepared, Request, prepare
from gaitgauge.gauge.goals import TARGET
from gaitgauge.gauge.play.rollout import Rollout
from gaitgauge.gauge.play.segments import SegmentOutcome, count_segments
from gaitgauge.gauge.play.workers import Job
from gaitgauge.gauge.scoring import level_score, run_statistics
from gaitgauge.policy.observation import ObservationBuilder
from scipy import special

FRICTIONS = (0.3, 0.6, 0.9)
_FRESH, _SCREEN = 9000, 8000
"""First of the fresh seeds, and the seed of the screen."""
_CHUNK = 2
"""Seeds of one job: few, so that no core idles for long at the end."""
_LISTED_SEEDS, _BEST = 5, 10
_KEPT = 4
"""One filter of so many plays the second round of the screen."""
_ALLOWED = 0.002
"""Lower bound that a gain may have where the unfiltered policy falls."""
_MEAN50 = 2
Goals = dict[tuple[int, int], SegmentOutcome]
"""Outcomes of the sub-commands of one episode, by goal and sub-command."""


@dataclass(frozen=True, kw_only=True)
class Filter:
    """A change of the command that a policy sees."""

    name: str
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors on forward, lateral and yaw speed."""
    cap: tuple[float, float, float] = (math.inf, math.inf, math.inf)
    """Largest absolute values [m/s, m/s, rad/s]."""
    delay: float = 0.0
    """[s]."""
    lag: float = 0.0
    """Time constant of a first-order lag [s]."""
    walk: float = math.inf
    stand: float = 0.0
    """Lengths of walking and of standing, in turns [s]."""


LISTED = (
    Filter(name="slower, 0.9", scale=(0.9, 0.9, 0.9)),
    Filter(name="slower, 0.8", scale=(0.8, 0.8, 0.8)),
    Filter(name="forward at most 0.7 m/s", cap=(0.7, math.inf, math.inf)),
    Filter(name="sideways at most 0.7 m/s", cap=(math.inf, 0.7, math.inf)),
    Filter(name="turning at most 1 rad/s", cap=(math.inf, math.inf, 1.0)),
    Filter(name="0.3 s later", delay=0.3),
    Filter(name="turning less, 0.7", scale=(1.0, 1.0, 0.7)),
    Filter(name="standing between", walk=1.5, stand=0.3),
)
NONE = Filter(name="none")


def random_filter(index: int) -> Filter:
    """Return the random filter of a number: one kind of change or several, most of them mild, as a cheat would be."""
    generator = np.random.default_rng([7, index])
    part = generator.random(9) < 0.3
    part[generator.integers(9)] = True
    less = np.where(part, generator.random() ** 2 * generator.random(9), 0.0).round(3).tolist()
    on = part.tolist()
    return Filter(
        name=f"random {index}",
        scale=(round(1.0 - 0.5 * less[0], 3), round(1.0 - 0.5 * less[1], 3), round(1.0 - 0.5 * less[2], 3)),
        cap=(
            round(1.0 - 0.6 * less[3], 3) if on[3] else math.inf,
            round(1.0 - 0.6 * less[4], 3) if on[4] else math.inf,
            round(1.5 - 0.9 * less[5], 3) if on[5] else math.inf,
        ),
        delay=round(0.5 * less[6], 3),
        lag=less[7],
        walk=1.5 if on[8] else math.inf,
        stand=round(0.6 * less[8], 3),
    )


class FilteredBuilder:
    """An observation builder that tells its policy filtered commands."""

    def __init__(self, builder: ObservationBuilder, change: Filter, period: float) -> None:
        self._builder, self._change, self._period = builder, change, period
        worlds = builder.num_episodes
        self._past = torch.zeros(worlds, round(change.delay / period) + 1, 3)
        self._lagged = torch.zeros(worlds, 3)
        self._step = torch.zeros(worlds, 1)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._builder, name)

    def reset(self, episodes: torch.Tensor | None = None) -> None:
        """Forget past commands of the masked worlds, (N,) bool, None for all."""
        for memory in (self._past, self._lagged, self._step):
            memory[... if episodes is None else episodes] = 0.0
        self._builder.reset(episodes)

    def build(self, state: Any, command: torch.Tensor, *arguments: Any) -> torch.Tensor:
        """Return the observations of filtered commands."""
        return self._builder.build(state, self.filtered(command.to(torch.float32)), *arguments)

    def filtered(self, command: torch.Tensor) -> torch.Tensor:
        """Return the commands that the policy is told in this control step, (N, 3)."""
        change, period = self._change, self._period
        cap = torch.tensor(change.cap)
        told = torch.clamp(command * torch.tensor(change.scale), -cap, cap)
        self._past = torch.cat((told[:, None], self._past[:, :-1]), 1)
        told = self._past[:, -1]
        if change.lag:
            self._lagged += (told - self._lagged) * (period / (change.lag + period))
            told = self._lagged.clone()
        if change.stand:
            walk, stand = round(change.walk / period), round(change.stand / period)
            told = told * (self._step % (walk + stand) < walk)
        self._step += 1.0
        return told


# ---- playing --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Play:
    """Episodes of one filter on one terrain."""

    change: Filter
    terrain: str
    seeds: tuple[int, ...]
    frictions: tuple[float, ...] = FRICTIONS

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self.frictions) * len(self.seeds)

    @property
    def key(self) -> str:
        """Unique name."""
        frictions = ",".join(map("{:g}".format, self.frictions))
        return f"{self.change.name} | {self.terrain} {frictions} | {self.seeds[0]}-{self.seeds[-1]}"


@dataclass
class Scores:
    """Scores and falls of what was played, by filter, terrain, friction and seed."""

    frictions: tuple[float, ...] = FRICTIONS
    found: dict[tuple[str, str, float, int], tuple[float, int]] = field(default_factory=dict)

    def gain(self, change: str, terrain: str, friction: float, seeds: Sequence[int]) -> np.ndarray:
        """Return the gains of a filter on some seeds, (S,)."""
        return np.array(
            [self.found[change, terrain, friction, s][0] - self.found["none", terrain, friction, s][0] for s in seeds]
        )

    def gains(self, change: str, terrains: Sequence[str], seeds: Sequence[int]) -> np.ndarray:
        """Return the gains of a filter, the mean over terrains and frictions, by seed, (S,)."""
        return np.mean([self.gain(change, t, f, seeds) for t in terrains for f in self.frictions], axis=0)

    def third(self, change: str, terrains: Sequence[str], turn: int, seed: int) -> float:
        """Return the gain on a third of the places: each terrain at one friction, a turn further for the next one."""
        places = thirds(terrains, self.frictions, turn)
        return float(np.mean([self.gain(change, t, f, [seed])[0] for t, f in places]))

    def falls(self, terrain: str, friction: float, seeds: Sequence[int]) -> int:
        """Return the falls of the unfiltered policy."""
        return sum(self.found["none", terrain, friction, s][1] for s in seeds)


def play(prepared: Prepared, level: int, wanted: Play, folder: Path | None = None) -> list[list[Any]]:
    """Play a job in this process; returns friction, seed, score and falls of each episode.

    Args:
        folder: the unfiltered policy's samples are written there, and other filters take them; None to play every sub-command.
    """
    torch.set_num_threads(1)
    suite, flat = prepared.suite, wanted.terrain == "flat"
    level = 0 if flat else level
    goals = tuple(g.name for g in suite.goals if g.name != TARGET)
    episodes = [
        Episode(terrain=wanted.terrain, level=level, friction=f, payload=0.0, seed=s, stage="eval", goals=goals)
        for f in wanted.frictions
        for s in wanted.seeds
    ]
    job = Job(
        suite=suite,
        policy=prepared.policy,
        robot=prepared.robot,
        places=((wanted.terrain, level),),
        worlds=min(42, sum(count_segments(episode, suite) for episode in episodes)),
        build=lambda scene, **options: make_backend(prepared.request.backend, scene, device="cpu", **options),
    )
    rollout = job.rollout()
    _filter_commands(rollout, wanted.change, suite.physics.control_period)
    rollout.play(episodes)
    records = _take_unfiltered(rollout, wanted.change, folder) if folder is not None and wanted.change != NONE else []
    found = []
    while records or not rollout.idle:
        for record in records or rollout.advance():
            if folder is not None and wanted.change == NONE:
                write_samples(unfiltered_path(folder, record.episode), record)
            quality = run_statistics(record, record.columns.index(QUALITY))[_MEAN50]
            score = float(level_score(float(quality), level, suite.scoring, flat=flat))
            found.append([record.episode.friction, record.episode.seed, score, record.falls])
        records = []
    rollout.backend.close()
    return found


def _filter_commands(rollout: Rollout, change: Filter, period: float) -> None:
    step: Any = rollout._step  # no user of the gauge may change what a policy is told
    step.builder = FilteredBuilder(step.builder, change, period)


def changes(change: Filter, commands: torch.Tensor, period: float) -> bool:
    """Return whether a filter may change one of a sub-command's commands, (T, 3)."""
    if change.lag or round(change.stand / period) or round(change.delay / period):
        return True
    cap = torch.tensor(change.cap)
    return not torch.equal(torch.clamp(commands * torch.tensor(change.scale), -cap, cap), commands)


def _take_unfiltered(rollout: Rollout, change: Filter, folder: Path) -> list[Record]:
    """Give the rollout what the unfiltered policy did in sub-commands that a filter does not change; returns complete records."""
    queue: Any = rollout._queue
    suite, schedule, rules = rollout.suite, rollout._step.schedule, rollout._step.rules
    assert not (rules.fall_closes_goal or rules.restarts)  # else a sub-command could end the next one
    limits = torch.tensor(suite.command_limits(rollout.backend.scene.terrains[0].family), dtype=torch.float32)
    period = suite.physics.control_period
    same = {
        (goal, part): bool(commands)
        and not changes(change, torch.tensor(commands, dtype=torch.float32) * limits, period)
        for goal, parts in schedule.sub_commands.items()
        for part, commands in enumerate(parts)
    }
    taken, records = set(), []
    for episode, opened in list(queue._open.items()):
        held = read_samples(unfiltered_path(folder, episode), queue._columns)
        for segment in opened.started:
            outcome = held.get((segment.goal_index, segment.sub_command))
            if outcome is not None and same[segment.goal, segment.sub_command]:
                opened.outcomes[segment] = outcome
                taken.add(segment)
        if not opened.missing():
            records.append(queue._open.pop(episode).record(queue._columns))
    queue._waiting = type(queue._waiting)(segment for segment in queue._waiting if segment not in taken)
    return records


def unfiltered_path(folder: Path, episode: Episode) -> Path:
    """Return the file with the samples of an unfiltered episode."""
    return folder / f"unfiltered {episode.terrain} {episode.friction:g} {episode.seed}.npz"


def write_samples(path: Path, record: Record) -> None:
    """Write the samples that an episode's score is made of."""
    with path.open("wb") as file:
        np.savez_compressed(
            file,
            samples=record.samples[:, [record.columns.index(name) for name in (QUALITY, MOTION)]],
            parts=np.stack((record.goal_index, record.part_index), axis=1),
            fallen=np.array(record.fallen, dtype=np.int64).reshape(-1, 2),
        )


def read_samples(path: Path, columns: Sequence[str]) -> Goals:
    """Read what ``write_samples`` wrote, as outcomes with all columns; those that a score does not need are NaN."""
    with np.load(path) as file:
        samples, parts, fallen = file["samples"], file["parts"], file["fallen"]
    wide = np.full((len(samples), len(columns)), np.nan, dtype=np.float32)
    wide[:, [columns.index(QUALITY), columns.index(MOTION)]] = samples
    found: Goals = {}
    for goal, part in np.unique(parts, axis=0).tolist():
        mine = (parts == (goal, part)).all(1)
        falls = int((fallen == (goal, part)).all(1).sum())
        touching = np.zeros(int(mine.sum()), dtype=np.bool_)
        found[goal, part] = SegmentOutcome(
            samples=wide[mine], touching=touching, control_steps=0, physics_steps=0, falls=falls
        )
    return found


_shared: dict[str, Any] = {}
"""What forked processes have from their parent."""


def _play_shared(wanted: Play) -> tuple[Play, list[list[Any]]]:
    return wanted, play(_shared["prepared"], _shared["level"], wanted, _shared["folder"])


def play_all(wanted: Sequence[Play], folder: Path, threads: int, scores: Scores) -> None:
    """Play what the folder does not hold, side by side, each job on disk as soon as it has ended; fill in ``scores``."""
    path = folder / "played.jsonl"
    done: dict[str, list[list[Any]]] = {}
    if path.exists():
        text = path.read_text()
        whole = text[: text.rfind("\n") + 1]  # a killed run may have cut its last line
        path.write_text(whole)
        done = {row["key"]: row["episodes"] for row in map(json.loads, whole.splitlines())}
    missing = [p for p in wanted if p.key not in done]
    began = time.perf_counter()
    if missing:
        context = multiprocessing.get_context("fork")
        with context.Pool(threads) as pool, path.open("a") as file:
            total, ended = sum(p.episodes for p in missing), 0
            for count, (each, episodes) in enumerate(pool.imap_unordered(_play_shared, missing), 1):
                done[each.key] = episodes
                file.write(json.dumps({"key": each.key, "episodes": episodes}) + "\n")
                file.flush()
                ended += each.episodes
                if count % 10 == 0 or count == len(missing):
                    left = (time.perf_counter() - began) / ended * (total - ended)
                    words = f"{ended} of {total} episodes, {left:.0f} s left"
                    print(f"\r{words}   ", end="", file=sys.stderr, flush=True)
        print(file=sys.stderr)
    for each in wanted:
        for friction, seed, score, falls in done[each.key]:
            scores.found[each.change.name, each.terrain, friction, seed] = score, falls


def held_whole(folder: Path, scores: Scores, terrains: Sequence[str]) -> list[tuple[str, int]]:
    """Read what a folder holds; returns the filters and seeds that were played at all places, and without a filter too."""
    for row in map(json.loads, (folder / "played.jsonl").read_text().splitlines()):
        change, place, _ = row["key"].split(" | ")
        for friction, seed, score, falls in row["episodes"]:
            scores.found[change, place.split()[0], friction, seed] = score, falls
    pairs = sorted({(change, seed) for change, _, _, seed in scores.found})
    return [
        (change, seed)
        for change, seed in pairs
        if change != NONE.name
        and all(
            (name, t, f, seed) in scores.found
            for name in (change, NONE.name)
            for t in terrains
            for f in scores.frictions
        )
    ]


def chunks(seeds: Sequence[int]) -> Iterator[tuple[int, ...]]:
    """Yield the seeds of jobs."""
    for begin in range(0, len(seeds), _CHUNK):
        yield tuple(seeds[begin : begin + _CHUNK])


def thirds(terrains: Sequence[str], frictions: Sequence[float], turn: int) -> list[tuple[str, float]]:
    """Return a third of the places: each terrain at one friction, a turn further for the next one."""
    return [(t, frictions[(at + turn) % len(frictions)]) for at, t in enumerate(terrains)]


# ---- judging --------------------------------------------------------------------------------------------------------


def lower_bounds(gains: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return 95 % one-sided lower bounds of mean gains, with Holm's correction: the k-th best of m at level 0.05 / (m + 1 - k).

    Args:
        gains: of each filter by seed, (S,).
    """
    found: dict[str, float] = {}
    statistics = {
        name: (g.mean(), g.std(ddof=1) / math.sqrt(len(g)), len(g) - 1) for name, g in gains.items() if len(g) > 1
    }
    order = sorted(statistics, key=lambda n: -statistics[n][0] / (statistics[n][1] + 1e-12))
    for rank, name in enumerate(order):
        mean, error, freedom = statistics[name]
        found[name] = mean - float(special.stdtrit(freedom, 1.0 - 0.05 / (len(order) - rank))) * error
    return found


def judge_listed(scores: Scores, terrains: Sequence[str], seeds: Sequence[int]) -> bool:
    """Print the table of the listed cheats; returns whether none of them pays."""
    bounds = lower_bounds({f.name: scores.gains(f.name, terrains, seeds) for f in LISTED})
    print(f"\n{'listed cheat':28}{'gain':>9}{'bound':>9}{'lost at':>9}{'most gained':>13}  where")
    kept = True
    for change in LISTED:
        places = {(t, f): scores.gain(change.name, t, f, seeds).mean() for t in terrains for f in scores.frictions}
        place, most = max(places.items(), key=lambda item: item[1])
        fell = {p for p in places if scores.falls(*p, seeds)}
        by_place = lower_bounds({f"{t} {f:g}": scores.gain(change.name, t, f, seeds) for t, f in places})
        kept &= all(by_place[f"{t} {f:g}"] <= (_ALLOWED if (t, f) in fell else 0.0) for t, f in places)
        where = f"{place[0]} {place[1]:g}{', falls unfiltered' if place in fell else ''}"
        lost = sum(gain < 0 for gain in places.values())
        mean = np.mean(list(places.values()))
        print(f"{change.name:28}{mean:+9.4f}{bounds[change.name]:+9.4f}{lost:6}/{len(places)}{most:+13.4f}  {where}")
    return kept


def judge_random(scores: Scores, terrains: Sequence[str], best: Mapping[str, float], seeds: Sequence[int]) -> bool:
    """Print the table of the best random filters, ``best`` with their gains in the screen; returns whether no bound is above 0."""
    gains = {name: scores.gains(name, terrains, seeds) for name in best}
    bounds = lower_bounds(gains)
    print(f"\n{'random filter':28}{'screen':>9}{'fresh':>9}{'bound':>9}")
    for name, screened in best.items():
        print(f"{name:28}{screened:+9.4f}{gains[name].mean():+9.4f}{bounds[name]:+9.4f}  {_words(name)}")
    return all(bound <= 0.0 for bound in bounds.values())


def _words(name: str) -> str:
    """Return what a random filter changes."""
    change, plain = random_filter(_number(name)), vars(NONE)
    return ", ".join(f"{key} {value}" for key, value in vars(change).items() if key != "name" and value != plain[key])


def _number(name: str) -> int:
    return int(name.rpartition(" ")[2])


def judge_screen(scores: Scores, terrains: Sequence[str], whole: Sequence[tuple[str, int]]) -> None:
    """Print how well gains on a third of the places tell the others.

    Args:
        whole: filters and seeds that were played at all places.
    """
    count = len(scores.frictions)
    full = np.array([scores.gains(name, terrains, [seed])[0] for name, seed in whole])
    kept, few = -(-len(whole) // _KEPT), -(-len(whole) // (2 * _KEPT))
    best = set(np.argsort(-full)[:few].tolist())
    print(f"\n{'a third':10}{'correlation':>13}{'best lost':>14}   of {len(whole)} filters and seeds")
    for turn in range(count):
        part = np.array([scores.third(name, terrains, turn, seed) for name, seed in whole])
        rest = (full * count - part) / (count - 1)
        lost = len(best - set(np.argsort(-part)[:kept].tolist()))
        print(f"{turn + 1:<10}{np.corrcoef(part, rest)[0, 1]:13.3f}{f'{lost} of {few}':>14}")


def main() -> int:
    """Play, print the tables; returns 1 where a cheat pays."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy")
    parser.add_argument("--folder", type=Path, required=True, help="what was played is kept there")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--filters", type=int, default=200, help="random filters")
    parser.add_argument("--fresh", type=int, default=20, help="seeds on which the ten best are played again")
    parser.add_argument("--listed", type=int, default=_LISTED_SEEDS, help="of these seeds, those of the listed cheats")
    parser.add_argument(
        "--by-thirds", action="store_true", help="judge the screen by what the folder holds; play nothing"
    )
    parser.add_argument("--level", type=int, default=5, help="of the terrains that have levels")
    parser.add_argument("--terrain", action="append", help="instead of all of the suite; more than once for several")
    parser.add_argument("--friction", type=float, action="append", help="instead of 0.3, 0.6 and 0.9")
    arguments = parser.parse_args()
    if min(arguments.listed, arguments.fresh) < 2:
        parser.error("--listed and --fresh must be 2 or more: a bound needs two seeds")
    arguments.folder.mkdir(parents=True, exist_ok=True)
    prepared = prepare(Request(policy=arguments.policy, suite="gaitgauge-1", frictions=(0.6,), payloads=(0.0,)))
    torch.set_num_threads(1)
    identity = f"{prepared.policy.digest} {prepared.suite.digest} {arguments.level}"
    stamp = arguments.folder / "played.txt"
    if stamp.exists() and stamp.read_text() != identity:
        parser.error(f"--folder {arguments.folder} holds another policy, suite or level; choose another folder")
    stamp.write_text(identity)
    _shared.update(prepared=prepared, level=arguments.level, folder=arguments.folder)
    terrains = arguments.terrain or list(prepared.suite.matrix.terrains)
    fresh = [_FRESH + s for s in range(max(arguments.fresh, arguments.listed))]
    frictions = tuple(arguments.friction or FRICTIONS)
    few, scores = fresh[: arguments.listed], Scores(frictions=frictions)

    def plays(
        changes: Sequence[Filter], seeds: Sequence[int], at: Mapping[str, tuple[float, ...]] | None = None
    ) -> list[Play]:
        places = [(t, at[t] if at else frictions, some) for t in terrains for some in chunks(seeds)]
        return [Play(change=c, terrain=t, seeds=some, frictions=f) for c in changes for t, f, some in places if f]

    def play_these(wanted: Sequence[Play]) -> None:
        play_all(wanted, arguments.folder, arguments.threads, scores)

    began = time.perf_counter()
    if arguments.by_thirds:
        judge_screen(scores, terrains, held_whole(arguments.folder, scores, terrains))
        return 0
    screen = [_SCREEN] if arguments.filters else []
    play_these(plays([NONE], screen) + plays([NONE], fresh if arguments.filters else few))
    play_these(plays(LISTED, few))
    kept = judge_listed(scores, terrains, few)
    limits = torch.tensor([prepared.suite.command_limits(family) for family in ("flat", "slope")])
    period = prepared.suite.physics.control_period
    drawn = (random_filter(index) for index in itertools.count())
    candidates = list(itertools.islice((c for c in drawn if changes(c, limits, period)), arguments.filters))
    if candidates:
        first = {t: (f,) for t, f in thirds(terrains, frictions, 0)}
        others = {t: tuple(f for f in frictions if f not in first[t]) for t in terrains}
        play_these(plays(candidates, [_SCREEN], first))
        gains = {c.name: scores.third(c.name, terrains, 0, _SCREEN) for c in candidates}
        most = max(_BEST, -(-len(candidates) // _KEPT))
        promising = sorted(candidates, key=lambda c: -gains[c.name])[:most]
        play_these(plays(promising, [_SCREEN], others))
        screened = {c.name: float(scores.gains(c.name, terrains, [_SCREEN])[0]) for c in promising}
        best = dict(sorted(screened.items(), key=lambda item: -item[1])[:_BEST])
        play_these(plays([random_filter(_number(name)) for name in best], fresh[: arguments.fresh]))
        kept &= judge_random(scores, terrains, best, fresh[: arguments.fresh])
        print(
            f"\nof {len(candidates)} random filters {sum(g > 0 for g in gains.values())} gained in the first round of the screen,"
            f" of its {len(promising)} best {sum(g > 0 for g in screened.values())} over all places"
        )
    suite, seconds = prepared.suite, time.perf_counter() - began
    print(f"{'no cheat pays' if kept else 'a cheat pays'} on {suite.name} {suite.version}; {seconds:.0f} s")
    return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())
