"""Whether 95 % intervals hold the truth in 95 % of all cases: on whole evaluations that were repeated with fresh seeds, and on
synthetic ones whose truth is known. And how often a policy is told apart from itself.

    python benchmarks/interval_coverage.py                                    # judge docs/data/repeated_evaluations.json.gz
    python benchmarks/interval_coverage.py --synthetic 1000                   # and 1000 synthetic evaluations of each kind
    python benchmarks/interval_coverage.py --shapes 1000                      # 1000 of gaitgauge-1 for each shape of the pass curve
    python benchmarks/interval_coverage.py --record 30 --folder /tmp/repeated # play the evaluations again, and write the data

Recorded are evaluations of a policy that was ``pretrained`` once (the data hold its digest), by the rules of ``robogauge-1.1``,
on waves and obstacles at friction 0.6. They differ in their seeds alone: evaluation k has the quality seeds 10k, 10k+1, 10k+2 and
the search seeds 10k … 10k+4. One takes about a minute of one core; what the folder holds is not played again. Their truth is
their mean.
"""

from __future__ import annotations

import argparse
import gzip
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gaitgauge.files.parsing import read_text
from gaitgauge.files.writing import write_atomically
from gaitgauge.gauge.chance.intervals import Chance, Evidence
from gaitgauge.gauge.chance.level_area import follow_area
from gaitgauge.gauge.chance.level_chance import bisect
from gaitgauge.gauge.chance.level_curve import follow
from gaitgauge.gauge.episodes import QUALITY
from gaitgauge.gauge.evaluate import Request, evaluate
from gaitgauge.gauge.result import (
    ChanceRules,
    EnvironmentRow,
    PolicyName,
    Provenance,
    Result,
    Run,
    SuiteName,
    TerrainScore,
)
from gaitgauge.gauge.store import StoreError
from gaitgauge.gauge.totals import environment_weights
from gaitgauge.studies.compare.comparison import ComparisonError, compare
from numpy.typing import NDArray

DATA = Path(__file__).parents[1] / "docs" / "data" / "repeated_evaluations.json.gz"
RULES = ChanceRules(
    level_weight=0.09,
    quality_weight=0.19,
    pass_rate=0.8,
    levels=10,
    seeds=(0, 1, 2),
    search_seeds=(0, 1, 2, 3, 4),
    shared_noise=True,
    resamples=1000,
)
"""Those of ``robogauge-1.1``."""
AREA = replace(RULES, shared_noise=False, level="area", search_seeds=tuple(range(6)))
"""Those of ``gaitgauge-1``."""
CURVE = replace(AREA, level="curve")
"""Those of ``gaitgauge-1`` 1.0.0 and of ``demo``."""
_LEVELS = np.arange(1, 11)
SUITE = """
extends = "robogauge-1.1"
name = "repeated-{index}"

[matrix]
terrains = ["wave", "obstacle"]
frictions = [0.6]
seeds = {seeds}
search_seeds = {search_seeds}
"""


# ---- recorded -------------------------------------------------------------------------------------------------------


def record(count: int, policy: str, folder: Path, threads: int) -> list[Result]:
    """Play whole evaluations with fresh seeds, and keep what intervals and comparisons read."""
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    for index in range(1, count + 1):
        suite = folder / f"repeated-{index}.toml"
        seeds = [10 * index + s for s in range(5)]
        suite.write_text(SUITE.format(index=index, seeds=seeds[:3], search_seeds=seeds))
        request = Request(policy=policy, suite=str(suite), threads=threads)
        result = evaluate(request, folder / f"run-{index}", resume=True)
        print(f"{index}: {result.score:.4f}", flush=True)
        found.append(trimmed(result))
    return found


def trimmed(result: Result) -> Result:
    """Return the parts that intervals and comparisons read, without sub-commands. Suites that differ in seeds alone count as one."""
    rows = tuple(
        replace(row, runs={seed: replace(run, commands={}) for seed, run in row.runs.items()}, runs_by_level={})
        for row in result.environments
    )
    suite = SuiteName(name="repeated", version=result.suite.version, digest="recorded")
    # the interval follows from the rows, by the code of today
    return replace(result, suite=suite, environments=rows, score_interval=None, provenance=Provenance())


def restored(data: Mapping[str, Any]) -> Result:
    """Return an evaluation of the recorded ones, which state nothing that intervals and comparisons do not read."""
    whole = {
        **data,
        "suite": {**data["suite"], "digest": "recorded"},
        "provenance": {},
        "metrics": {name: {"mean": 0.0, "mean25": 0.0} | values for name, values in data["metrics"].items()},
    }
    return Result.from_data(whole, "a recorded evaluation", ComparisonError)


# ---- synthetic ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Known:
    """A policy whose chances are known."""

    terrains: tuple[str, ...]
    frictions: tuple[float, ...]
    success: NDArray[np.float64]
    """Chance to reach the target, (environments, levels); 1 on flat ground, where it plays no part."""
    quality: NDArray[np.float64]
    """Mean quality of a run at each level, (environments, levels)."""
    spread: float = 0.012
    """Standard deviation of a run's quality."""
    shared: float = 0.56
    """Share of its variance that all environments of a seed have in common, where they share its noise."""
    luck: float = 0.0
    """Correlation of a seed's luck in level tests, where environments share its noise."""

    @property
    def environments(self) -> list[tuple[str, float]]:
        """Terrain and friction of each."""
        return [(t, f) for t in self.terrains for f in self.frictions]


def make_policy(generator: np.random.Generator, terrains: Sequence[str], frictions: Sequence[float]) -> Known:
    """A policy like those that were measured: half of the seeds reach the target at level 4 to 9, the odds of a success fall by a
    factor e within 0.2 to 1.5 levels, and quality falls by 0.06 a level.
    """
    steps = np.arange(1, 11)
    success, quality = [], []
    for terrain in terrains:
        centre, width = generator.uniform(4.0, 9.0), np.clip(0.5 * np.exp(0.5 * generator.standard_normal()), 0.2, 1.5)
        for _ in frictions:
            own = centre + generator.uniform(-1.0, 1.0)
            success.append(1.0 / (1.0 + np.exp((steps - own) / width)) if terrain != "flat" else np.ones(10))
            quality.append(generator.uniform(0.3, 0.5) - 0.06 * (steps - own) * (terrain != "flat"))
    return Known(
        terrains=tuple(terrains),
        frictions=tuple(frictions),
        success=np.array(success),
        quality=np.clip(np.array(quality), 0.05, 0.95),
    )


def _lapsing(share: float) -> Callable[[NDArray[np.float64], np.random.Generator], NDArray[np.float64]]:
    return lambda chance, _: (1.0 - share) * chance


def _bumped(chance: NDArray[np.float64], generator: np.random.Generator) -> NDArray[np.float64]:
    """Half the chance at one level below the crossing."""
    easy = np.maximum((chance > 0.5).sum(1) - 1, 1)
    bump = generator.integers(0, easy)
    return np.where(np.arange(chance.shape[1]) == bump[:, None], 0.5 * chance, chance)


def _stepped(chance: NDArray[np.float64], _: np.random.Generator) -> NDArray[np.float64]:
    """Certain success, then one half, then none: the half begins midway."""
    crossing = (chance > 0.5).sum(1, keepdims=True)
    at = np.arange(chance.shape[1])
    return np.where(at < (crossing + 1) // 2, 1.0, np.where(at <= crossing, 0.5, 0.0))


SHAPES: Mapping[str, Callable[[NDArray[np.float64], np.random.Generator], NDArray[np.float64]]] = {
    "logistic": lambda chance, _: chance,
    "lapses of 10 %": _lapsing(0.1),
    "lapses of 20 %": _lapsing(0.2),
    "bump": _bumped,
    "steps": _stepped,
}
"""Shapes of the pass curve, each made from a logistic one, (environments, levels)."""


def shaped(policy: Known, shape: str, generator: np.random.Generator) -> Known:
    """Return the policy with pass curves of another shape; flat ground stays as it is."""
    flat = np.array([t == "flat" for t, _ in policy.environments])[:, None]
    return replace(policy, success=np.where(flat, 1.0, SHAPES[shape](policy.success, generator)))


def synthetic(policy: Known, rules: ChanceRules, generator: np.random.Generator) -> Result:
    """Return one evaluation of a policy whose chances are known."""
    common = rules.shared_noise
    luck, shared = policy.luck * common, policy.shared * common
    lucky = np.sqrt(luck) * generator.standard_normal(len(rules.search_seeds))
    noise = np.sqrt(shared) * generator.standard_normal(len(rules.seeds))
    needed = round(rules.pass_rate * len(rules.search_seeds))
    rows = []
    for at, (terrain, friction) in enumerate(policy.environments):
        row = EnvironmentRow(terrain=terrain, friction=friction, payload=0.0)
        if not row.flat:
            draws = np.sqrt(1.0 - luck) * generator.standard_normal((10, len(rules.search_seeds))) + lucky
            reached = draws < _quantile(policy.success[at])[:, None]
            if rules.level != "bisection":
                level, trials = _expected(reached, rules)
            else:
                level, trials = int(bisect(reached.sum(1) >= needed)), dict(_trials(reached, rules, needed))
            row = replace(row, level=level, trials=trials)
        if row.flat or row.level:
            own = np.sqrt(1.0 - shared) * generator.standard_normal(len(rules.seeds))
            runs = np.interp(max(row.reached, 1), _LEVELS, policy.quality[at]) + policy.spread * (noise + own)
            row = replace(row, runs={s: Run(columns={QUALITY: q}) for s, q in zip(rules.seeds, runs, strict=True)})
        rows.append(row)
    evidence = Evidence(rows, rules)
    names = np.array([row.terrain for row in rows])
    weights = environment_weights(names.tolist())
    score = evidence.value(weights)
    scores = {t: evidence.value((names == t) / (names == t).sum()) for t in policy.terrains}
    levels = [row.level for row in rows if row.level is not None]
    return Result(
        suite=SuiteName(name="synthetic", version="1", digest="synthetic"),
        policy=PolicyName(path="synthetic.pt", file_sha256="synthetic"),
        chance=rules,
        score=score,
        score_interval=evidence.chance(weights).interval(score),
        level=float(np.mean(levels)) if levels else None,
        terrains={terrain: TerrainScore(score=value) for terrain, value in scores.items()},
        environments=tuple(rows),
        pipeline="stress",
        backend="mujoco",
        robot="go2",
        provenance=Provenance(),
    )


def _trials(reached: NDArray[np.bool_], rules: ChanceRules, needed: int) -> Iterator[tuple[int, dict[int, bool]]]:
    """The trials that a search plays: levels on its way, in rounds that end as soon as the outcome is certain."""
    low, high = 0, rules.levels
    while low < high:
        level = (low + high + 1) // 2
        played: list[bool] = []
        while sum(played) < needed <= len(rules.search_seeds) - played.count(False):
            played += reached[level - 1, len(played) : len(played) + needed - sum(played)].tolist()
        yield level, dict(zip(rules.search_seeds, played, strict=False))
        low, high = (level, high) if sum(played) >= needed else (low, level - 1)


def _expected(reached: NDArray[np.bool_], rules: ChanceRules) -> tuple[float, dict[int, dict[int, bool]]]:
    """The expected level, and the trials that its design plays."""
    seeds, rows = rules.search_seeds, reached.tolist()

    def outcomes(level: int) -> list[bool]:
        return rows[level - 1]

    if rules.level == "area":
        area = follow_area(outcomes, rules.levels, len(seeds))
        counts, found = area.seeds, area.level
    else:
        curve = follow(outcomes, rules.levels, len(seeds), rules.bracket_seeds)
        counts, found = curve.seeds, curve.level
    assert found is not None
    return found, {level: dict(zip(seeds[:count], rows[level - 1], strict=False)) for level, count in counts.items()}


def _quantile(chance: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.stats import norm

    found: NDArray[np.float64] = norm.ppf(np.clip(chance, 1e-9, 1.0 - 1e-9))
    return found


def expected_score(policy: Known, rules: ChanceRules) -> float:
    """The true score: of the area under the pass curve, or the mean of bisections over all seeds. A seed's luck must be zero."""
    from scipy.stats import binom

    if rules.level != "bisection":
        levels = policy.success.sum(1)
        quality = [np.interp(max(x, 1.0), _LEVELS, q) for x, q in zip(levels, policy.quality, strict=True)]
        of_quality = rules.quality_weight * np.minimum(levels, 1.0) * quality
        scores = rules.level_weight * np.maximum(levels - 1.0, 0.0) + of_quality
        flat = [t == "flat" for t, _ in policy.environments]
        return float(
            environment_weights([t for t, _ in policy.environments]) @ np.where(flat, policy.quality[:, 0], scores)
        )
    seeds = len(rules.search_seeds)
    passed = binom.sf(round(rules.pass_rate * seeds) - 1, seeds, policy.success)
    scores = []
    for at, (terrain, _) in enumerate(policy.environments):
        if terrain == "flat":
            scores.append(policy.quality[at, 0])
            continue
        total, ranges = 0.0, [(0, rules.levels, 1.0)]
        while ranges:
            low, high, share = ranges.pop()
            if low < high:
                middle = (low + high + 1) // 2
                chance = passed[at, middle - 1]
                ranges += [(middle, high, share * chance), (low, middle - 1, share * (1.0 - chance))]
            elif low:
                total += share * (rules.level_weight * (low - 1) + rules.quality_weight * policy.quality[at, low - 1])
        scores.append(total)
    return float(environment_weights([t for t, _ in policy.environments]) @ scores)


NINE = tuple(0.1 * n for n in range(2, 11))
ALL = ("flat", "a", "b", "c", "d", "e", "f")
KINDS = {
    "flat alone": (("flat",), (0.6,), RULES),
    "one terrain, one friction": (("wave",), (0.6,), RULES),
    "waves and obstacles, one friction": (("wave", "obstacle"), (0.6,), RULES),
    "one terrain, nine frictions": (("wave",), NINE, RULES),
    "all terrains, one friction": (ALL, (0.6,), RULES),
    "all terrains, nine frictions": (ALL, NINE, RULES),
    "the same, noise not shared": (ALL, NINE, replace(RULES, shared_noise=False)),
    "areas, one friction": (ALL, (0.6,), AREA),
    "areas, thirteen environments a terrain": (ALL, tuple(0.05 * n for n in range(8, 21)), AREA),
}
"""Synthetic evaluations: terrains, frictions, and rules."""


def coverage(kind: str, count: int, seed: int = 0) -> float:
    """Share of the intervals of ``count`` synthetic evaluations, each of another policy, that hold the expected score."""
    terrains, frictions, rules = KINDS[kind]
    generator = np.random.default_rng(seed)
    hits = 0
    for _ in range(count):
        policy = make_policy(generator, terrains, frictions)
        low, high = synthetic(policy, rules, generator).score_interval or (0.0, 0.0)
        hits += low <= expected_score(policy, rules) <= high
    return hits / count


def false_alarms(kind: str, count: int, seed: int = 1) -> tuple[float, float]:
    """Shares of synthetic policies that are told apart from themselves with other seeds: by the score, and by any detail."""
    terrains, frictions, rules = KINDS[kind]
    generator = np.random.default_rng(seed)
    other = replace(rules, seeds=(10, 11, 12), search_seeds=tuple(10 + s for s in rules.search_seeds))
    alarms = np.zeros(2)
    for _ in range(count):
        policy = make_policy(generator, terrains, frictions)
        alarms += alarm([synthetic(policy, rules, generator), synthetic(policy, other, generator)])
    return float(alarms[0] / count), float(alarms[1] / count)


class Judged(NamedTuple):
    """Figures of the synthetic evaluations of one shape."""

    bias: float
    """Mean of score minus truth."""
    sigma: float
    """Root of the mean square of score minus truth, the bias left out."""
    trials: float
    """Level trials of an environment that has levels."""
    covered: float
    """Share of the 95 % intervals that hold the truth."""
    alarms: float
    """Share of the pairs of evaluations of one policy that a comparison tells apart by the score."""
    before: float
    """Level trials of the design of ``gaitgauge-1`` 1.0.0."""
    least: float
    """σ of 1.2 times as many trials, spread as well as one could who knew all chances: no design has less without bias."""


def least_variance(policy: Known, trials: float, rules: ChanceRules) -> float:
    """Return the variance of the score that is left of the levels alone where trials go to levels in proportion to what they bring.

    Shares of independent trials, with n_l of N trials at a level: the sum of c_l² p_l (1 - p_l) / n_l is least for n_l in proportion
    to c_l √(p_l (1 - p_l)) (Neyman 1934), and then the square of their sum, over N.

    Args:
        trials: of an environment that has levels, on average.
    """
    terrains = [t for t, _ in policy.environments]
    rough = np.array([t != "flat" for t in terrains])
    levels = policy.success.sum(1)
    ends = [np.interp(levels + d, _LEVELS, _LEVELS) for d in (-0.5, 0.5)]
    quality = [[np.interp(x, _LEVELS, q) for x, q in zip(end, policy.quality, strict=True)] for end in ends]
    slope = rules.level_weight + rules.quality_weight * (np.array(quality[1]) - quality[0]) / (ends[1] - ends[0])
    spread = np.sqrt(policy.success * (1.0 - policy.success)).sum(1)
    return float((environment_weights(terrains) * slope * spread)[rough].sum() ** 2 / (trials * rough.sum()))


def judge_shape(shape: str, count: int, seed: int = 2, environments: int = 13) -> Judged:
    """Judge pairs of whole evaluations of ``count`` policies by the rules of ``gaitgauge-1``, each pair of another policy.

    Args:
        shape: one of ``SHAPES``.
        count: policies.
        seed: of the generator.
        environments: of each terrain.
    """
    generator = np.random.default_rng(seed)
    other = replace(AREA, seeds=(10, 11, 12), search_seeds=tuple(10 + s for s in AREA.search_seeds))
    off, held, alarms, trials, before, policies = [], [], [], [], [], []
    for _ in range(count):
        policy = make_policy(generator, ALL, [0.05 * (8 + n) for n in range(environments)])
        policy = shaped(policy, shape, generator)
        truth = expected_score(policy, AREA)
        pair = [synthetic(policy, rules, generator) for rules in (AREA, other)]
        for found in pair:
            low, high = found.score_interval or (0.0, 0.0)
            off.append((found.score or 0.0) - truth)
            held.append(low <= truth <= high)
            trials += [sum(map(len, row.trials.values())) for row in found.environments if not row.flat]
        alarms.append(alarm(pair)[0])
        chance = policy.success[generator.integers(environments, len(policy.success)), :, None]
        _, played = _expected(generator.uniform(size=(10, len(CURVE.search_seeds))) < chance, CURVE)
        before.append(sum(map(len, played.values())))
        policies.append(policy)
    usual = float(np.mean(before))
    return Judged(
        bias=float(np.mean(off)),
        sigma=float(np.std(off)),
        trials=float(np.mean(trials)),
        covered=float(np.mean(held)),
        alarms=float(np.mean(alarms)),
        before=usual,
        least=float(np.sqrt(np.mean([least_variance(p, 1.2 * usual, AREA) for p in policies]))),
    )


def alarm(pair: Sequence[Result]) -> NDArray[np.float64]:
    """Whether a comparison finds the score real, and any detail."""
    found = compare(pair, ["first", "second"]).differences
    return np.array([any(d.real for d in found if (d.kind == "score") is s) for s in (True, False)], dtype=float)


# ---- judging --------------------------------------------------------------------------------------------------------


Figures = tuple[float, float, float, float]


def judge(recorded: Sequence[Result]) -> dict[str, Figures]:
    """Of each quantity: mean, 1.96 σ over the evaluations, median half width of the intervals, share that holds the mean."""

    def figures(pairs: Sequence[tuple[float, Any]]) -> Figures:
        values, ends = np.array([v for v, _ in pairs]), np.array([e for _, e in pairs])
        held = (ends[:, 0] <= values.mean()) & (values.mean() <= ends[:, 1])
        return values.mean(), 1.96 * values.std(ddof=1), float(np.median(np.ptp(ends, axis=1) / 2)), held.mean()

    evidence = [Evidence(r.environments, r.chance) for r in recorded]
    terrains = [row.terrain for row in recorded[0].environments]
    even = environment_weights(terrains)

    def measured(value: Callable[[Result], float], chance: Callable[[Evidence], Chance], most: float = 1.0) -> Figures:
        values = [value(r) for r in recorded]
        return figures([(v, chance(e).interval(v, (0.0, most))) for v, e in zip(values, evidence, strict=True)])

    found = {"score": measured(lambda r: r.score or 0.0, lambda e: e.chance(even))}
    found["level"] = measured(lambda r: r.level or 0.0, lambda e: e.level_chance(even), 10.0)
    for at, terrain in enumerate(terrains):
        one = np.eye(len(terrains))[at]
        found[terrain] = measured(lambda r, t=terrain: r.terrains[t].score, lambda e, w=one: e.chance(w))
        level = measured(lambda r, t=terrain: r.terrains[t].level, lambda e, w=one: e.level_chance(w), 10.0)
        found[f"{terrain}, level"] = level
    for metric in recorded[0].metrics:
        found[metric] = measured(lambda r, m=metric: r.metrics[m].mean50, lambda e, m=metric: e.chance(even, (m,)))
    return found


def fixed_levels(recorded: Sequence[Result]) -> int:
    """How many intervals of the score would hold the mean score if the levels found were taken for certain."""
    mean, held = np.mean([r.score for r in recorded]), 0
    for result in recorded:
        rows = [replace(row, trials={}) for row in result.environments]
        chance = Evidence(rows, result.chance).chance(environment_weights([r.terrain for r in rows]))
        low, high = chance.interval(result.score or 0.0) or (0.0, 1.0)
        held += low <= mean <= high
    return held


def quality_by_level(recorded: Sequence[Result]) -> dict[str, float]:
    """Mean quality of all runs on a terrain at a level."""
    found: dict[str, list[float]] = {}
    for row in (row for result in recorded for row in result.environments):
        found.setdefault(f"{row.terrain} {row.level}", []).extend(r.columns[QUALITY] for r in row.runs.values())
    return {place: float(np.mean(values)) for place, values in sorted(found.items())}


def main() -> None:
    """Record if asked to, judge, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--record", type=int, metavar="COUNT", help="play so many evaluations and write the data")
    parser.add_argument("--policy", default="pretrained", help="which is played")
    parser.add_argument("--folder", type=Path, help="where they are played")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--data", type=Path, default=DATA, help="a .json.gz file")
    parser.add_argument("--synthetic", type=int, default=0, metavar="COUNT")
    parser.add_argument(
        "--shapes", type=int, default=0, metavar="COUNT", help="judge shapes of the pass curve, and nothing else"
    )
    arguments = parser.parse_args()
    if arguments.shapes:
        print(f"pairs of whole evaluations of {arguments.shapes} policies, 91 environments each\n")
        print(f"{'pass curve':16}{'bias':>9}{'σ':>9}{'covered':>9}{'alarms':>9}{'trials':>9}{'1.0.0':>9}{'least σ':>9}")
        for shape in SHAPES:
            f = judge_shape(shape, arguments.shapes)
            print(
                f"{shape:16}{f.bias:+9.4f}{f.sigma:9.5f}{f.covered:9.3f}{f.alarms:9.3f}{f.trials:9.1f}{f.before:9.1f}{f.least:9.5f}",
                flush=True,
            )
        return
    if arguments.record:
        if arguments.folder is None:
            parser.error("--record needs a --folder to play in")
        recorded = record(arguments.record, arguments.policy, arguments.folder, arguments.threads)
        text = json.dumps([result.to_data() for result in recorded], separators=(",", ":"))
        write_atomically(arguments.data, gzip.compress(text.encode(), mtime=0), StoreError)
    recorded = [restored(data) for data in json.loads(read_text(arguments.data, "data", StoreError))]
    print(f"{len(recorded)} whole evaluations with fresh seeds\n")
    print(f"{'':24}{'mean':>9}{'1.96 σ':>9}{'printed':>9}{'covered':>9}")
    for name, (mean, reach, printed, held) in judge(recorded).items():
        print(f"{name:24}{mean:9.4f}{reach:9.4f}{printed:9.4f}{held:9.3f}")
    print("\nmean quality by level: " + ", ".join(f"{k} {v:.3f}" for k, v in quality_by_level(recorded).items()))
    print(f"levels held fixed: {fixed_levels(recorded)} of {len(recorded)} intervals of the score hold its mean")
    pairs = list(zip(recorded[::2], recorded[1::2], strict=False))
    alarms = np.sum([alarm(pair) for pair in pairs], axis=0)
    print(f"\ntold apart from itself: {alarms[0]:.0f} of {len(pairs)} by the score, {alarms[1]:.0f} by a detail")
    if arguments.synthetic:
        print(f"\n{arguments.synthetic} synthetic evaluations of each kind")
        print(f"{'':36}{'covered':>9}{'alarms':>9}{'in detail':>11}")
        for kind in KINDS:
            by_score, by_detail = false_alarms(kind, arguments.synthetic)
            print(f"{kind:36}{coverage(kind, arguments.synthetic):9.3f}{by_score:9.3f}{by_detail:11.3f}", flush=True)


if __name__ == "__main__":
    main()
