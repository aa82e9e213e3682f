"""The gap between the training engine and MuJoCo over the course of a training run: a table, a picture, rank correlations.

    python benchmarks/gap_over_training.py RUN [RUN ...] --csv gap.csv --svg gap.svg

Every checkpoint is gauged with one suite on two engines: on MuJoCo, and on mujoco-warp with the physics that training had
(``--physics suite``: with the suite's). Beside the two scores stand what training itself says of the checkpoint: mean reward and
mean terrain level. If these rise while the score in MuJoCo does not, they mislead.

A RUN is a run directory with ``model_<n>.pt``, or a folder of exported policies of one run. Several are stretches of one
training, in order. The engines can be scored at different times and on different machines; ``--before`` merges the tables:

    python benchmarks/gap_over_training.py RUN --scores-only mujoco --threads 8 --csv cpu.csv
    python benchmarks/gap_over_training.py RUN --scores-only mujoco-warp --before cpu.csv --csv gap.csv --svg gap.svg

A run that was interrupted goes on where it stopped if it is given the same ``--out``.
"""

from __future__ import annotations

import argparse
import csv
import io
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from gaitgauge.backends.base import PhysicsOptions
from gaitgauge.files.writing import write_atomically
from gaitgauge.gauge.evaluate import Request, evaluate, prepare
from gaitgauge.gauge.store import StoreError
from gaitgauge.gauge.suite import Suite, SuiteError, load_suite
from gaitgauge.policy.base import PolicyError
from gaitgauge.policy.loading import load_policy
from gaitgauge.studies.policies import file_digest
from gaitgauge.training.tasks import TaskError, find_task

ENGINES = ("mujoco", "mujoco-warp")
SCORE_FIELDS = ("score", "low", "high", "level", "fallen")
"""Of each engine: mean@50 and its 95 % interval, mean level, falls for each quality episode."""
TRAINING_FIELDS = ("mean_reward", "mean_terrain_level")
TAGS = {"mean_reward": "Train/mean_reward", "mean_terrain_level": "Curriculum/mean_level"}
WHO = ("stretch", "iteration", "environment_steps_millions", "policy_sha256", "protocol", "training_physics")
FIELDS = (*WHO, *(f"{e.replace('-', '_')}_{f}" for e in ENGINES for f in SCORE_FIELDS), *TRAINING_FIELDS)
COMPARED = {"score on mujoco-warp": "mujoco_warp_score", **{f.replace("_", " "): f for f in TRAINING_FIELDS}}
"""What the score in MuJoCo is compared with: title and column."""
OWN_PHYSICS = ("watch_tilt", "watch_penetration", "contacts_per_world", "deterministic")
"""Fields of ``PhysicsOptions`` that stay the suite's: what it looks for and how it is calculated."""

Row = dict[str, str]
Series = list[tuple[float, float]]
"""Million environment steps and value."""


class GapError(ValueError):
    """What was asked for cannot be done; one sentence."""


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """One policy of a training run."""

    path: Path
    stretch: int
    iteration: int
    steps: float
    """Million environment steps before it, earlier stretches included."""

    @property
    def key(self) -> tuple[str, str]:
        """What tells rows apart."""
        return str(self.stretch), str(self.iteration)


def find_checkpoints(folders: Sequence[Path], before: Sequence[float] | None, every: int = 1) -> list[Checkpoint]:
    """The checkpoints of all stretches, in order.

    Args:
        folders: one for each stretch.
        before: million environment steps before each folder's own count; None: a count that starts over is added to the
            steps so far, a count that goes on is taken as it is.
        every: keep iterations that are multiples of this.

    Raises:
        GapError: a folder without policies, or policies that do not say when they were saved.
    """
    if before is not None and len(before) != len(folders):
        raise GapError(f"--steps-before has {len(before)} numbers for {len(folders)} folders; give one for each")
    found: list[Checkpoint] = []
    offset, last_own = 0.0, 0.0
    for number, folder in enumerate(folders, 1):
        files = [p for p in folder.glob("model_*.pt") if re.fullmatch(r"model_\d+\.pt", p.name)]
        files = files or sorted(folder.glob("*.pt"))
        told = []
        for file in files:
            provenance = load_policy(file).contract.provenance
            if not {"iteration", "environment_steps"} <= provenance.keys():
                raise GapError(
                    f"'{file}' does not say after how many environment steps it was saved; name run directories"
                )
            told.append((int(str(provenance["iteration"])), float(str(provenance["environment_steps"])) / 1e6, file))
        if not told:
            raise GapError(f"there is no checkpoint model_<n>.pt and no other policy in '{folder}'")
        told.sort()
        if before is not None:
            offset = before[number - 1]
        elif told[0][1] <= last_own:
            offset += last_own
        last_own = told[-1][1]
        found += [
            Checkpoint(path=file, stretch=number, iteration=iteration, steps=offset + steps)
            for iteration, steps, file in told
            if iteration % every == 0
        ]
    return found


def training_series(folder: Path, offset: float) -> dict[str, Series]:
    """What a run directory's TensorBoard files say; empty without any.

    Args:
        folder: run directory.
        offset: million environment steps before its own count.
    """
    if not any(folder.glob("events.out.tfevents.*")):
        return {}
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    steps = {event.step: event.value / 1e6 for event in events.Scalars("Perf/total_steps")}
    return {
        name: [(offset + steps[e.step], e.value) for e in events.Scalars(tag) if e.step in steps]
        for name, tag in TAGS.items()
        if tag in events.Tags()["scalars"]
    }


def curve_series(path: Path) -> dict[str, Series]:
    """What a table of ``training_curve.py`` says."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        name: [(float(r["environment_steps_millions"]), float(r[name])) for r in rows if r.get(name)]
        for name in TRAINING_FIELDS
    }


def mean_before(series: Series, steps: float, window: float) -> float | None:
    """Mean over the window that ends at a checkpoint, None if the series has nothing there."""
    inside = [value for at, value in series if steps - window < at <= steps + 1e-3]
    return float(np.mean(inside)) if inside else None


def training_suite(suite: Suite, physics: PhysicsOptions, parameters: str, folder: Path) -> Path:
    """A suite file with everything of ``suite`` but the physics, which is that of training.

    Substep counts (noise, sampling) keep their time as nearly as the longer substep allows; motors are limited as in training.
    """
    step, old = physics.timestep, suite.physics.timestep
    settings = {f.name: getattr(physics, f.name) for f in fields(physics) if f.name not in OWN_PHYSICS}
    settings["substeps"] = round(suite.physics.control_period / step)
    lines = [
        f'extends = "{suite.name}"',
        f'name = "{suite.name}-training-physics"',
        f'version = "{suite.version}"',
        f'title = "{suite.title}; with the physics of training"',
        f'parameters = "{parameters}"',
        "[physics]",
        *(f"{k} = {_toml(v)}" for k, v in settings.items() if v is not None),
        "[noise]",
        f"latency = {round(suite.noise.latency * old / step)}",
        "[metrics]",
        f"interval = {round(suite.metrics.interval * old / step)}",
    ]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "training_physics.toml"
    write_atomically(path, "\n".join(lines) + "\n", StoreError)
    return path


def _toml(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else f'"{value}"' if isinstance(value, str) else repr(value)


def score(request: Request, folder: Path, engine: str) -> Row:
    """Gauge a checkpoint on an engine; the row's columns of that engine."""
    result = evaluate(request, folder, resume=True, command=["gap_over_training.py", *sys.argv[1:]])
    prefix, health = engine.replace("-", "_"), result.health
    row = {f"{prefix}_{name}": "" for name in SCORE_FIELDS}
    if result.score is not None:
        row[f"{prefix}_score"] = f"{result.score:.4f}"
        if result.score_interval is not None:  # one seed has none
            low, high = result.score_interval
            row |= {f"{prefix}_low": f"{low:.4f}", f"{prefix}_high": f"{high:.4f}"}
        row[f"{prefix}_fallen"] = f"{health.falls / max(health.episodes, 1):.3f}"
    if result.level is not None:
        row[f"{prefix}_level"] = f"{result.level:.2f}"
    return row


def read_table(path: Path) -> dict[tuple[str, str], Row]:
    """Rows of an earlier table by stretch and iteration."""
    with path.open(newline="") as file:
        return {(row["stretch"], row["iteration"]): dict(row) for row in csv.DictReader(file)}


def merge(old: Row, new: Row) -> Row:
    """A row with the figures of both; the new ones win.

    Raises:
        GapError: they are of different policies, or were gauged by different rules.
    """
    for field in ("policy_sha256", "protocol", "training_physics"):
        if old.get(field) and new.get(field) and old[field] != new[field]:
            raise GapError(
                f"stretch {new['stretch']}, iteration {new['iteration']}: {field} is '{old[field]}' in the earlier table and "
                f"'{new[field]}' here; they cannot be merged"
            )
    return old | {name: value for name, value in new.items() if value != ""}


def write_table(path: Path, rows: Mapping[tuple[str, str], Row]) -> None:
    """Write all rows in order, whole or not at all."""
    text = io.StringIO()
    writer = csv.DictWriter(text, FIELDS, lineterminator="\n", restval="", extrasaction="ignore")
    writer.writeheader()
    writer.writerows(ordered(rows))
    write_atomically(path, text.getvalue(), StoreError)


def ordered(rows: Mapping[tuple[str, str], Row]) -> list[Row]:
    """Rows in the order of training."""
    return [rows[key] for key in sorted(rows, key=lambda k: (int(k[0]), int(k[1])))]


def column(rows: Sequence[Row], name: str) -> list[float | None]:
    """Numbers of a column, None where there is none."""
    return [float(row[name]) if row.get(name) else None for row in rows]


def correlations(rows: Sequence[Row]) -> list[str]:
    """Sentences on how well each figure ranks the checkpoints as MuJoCo does (Spearman), and on what choosing by it costs."""
    from scipy.stats import spearmanr

    truth = column(rows, "mujoco_score")
    sentences = []
    for title, name in COMPARED.items():
        pairs = [(t, v) for t, v in zip(truth, column(rows, name), strict=True) if t is not None and v is not None]
        if len({t for t, _ in pairs}) < 2 or len({v for _, v in pairs}) < 2:
            sentences.append(f"{title:<22} too few different values")
            continue
        judged, said = zip(*pairs, strict=True)
        rank = float(spearmanr(judged, said).statistic)
        chosen, best = judged[int(np.argmax(said))], max(judged)
        sentences.append(
            f"{title:<22} rank correlation with the score in MuJoCo {rank:+.3f} ({len(pairs)} checkpoints); the one it calls best "
            f"scores {chosen:.4f}, the best {best:.4f}"
        )
    return sentences


def show(rows: Sequence[Row]) -> None:
    """Print the table and the correlations, of all and of each stretch."""
    names = ("stretch", "iteration", "environment_steps_millions", *FIELDS[len(WHO) :])
    names = tuple(n for n in names if any(row.get(n) for row in rows))
    short = [
        n.replace("environment_steps_millions", "M steps").replace("mujoco_warp_", "warp ").replace("_", " ")
        for n in names
    ]
    print("  ".join(f"{s:>10}" for s in short))
    for row in rows:
        print("  ".join(f"{row.get(n, ''):>{max(10, len(s))}}" for n, s in zip(names, short, strict=True)))
    print()
    print("\n".join(correlations(rows)))
    stretches = list(dict.fromkeys(row["stretch"] for row in rows))
    for stretch in stretches if len(stretches) > 1 else []:
        own = [row for row in rows if row["stretch"] == stretch]
        print(f"\nstretch {stretch} alone")
        print("\n".join(correlations(own)))


def draw(rows: Sequence[Row], path: Path) -> None:
    """Both scores with their intervals, and reward and level as shares of their own range, over environment steps."""
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7.5, 4.0))
    shares = axes.twinx()
    steps = np.array([float(row["environment_steps_millions"]) for row in rows])
    for engine, title in zip(ENGINES, ("MuJoCo", "training engine"), strict=True):
        prefix = engine.replace("-", "_")
        values, low, high = (_array(rows, f"{prefix}_{part}") for part in ("score", "low", "high"))
        known = ~np.isnan(values)
        if known.any():
            (line,) = axes.plot(steps[known], values[known], "o-", label=title)
            axes.fill_between(steps[known], low[known], high[known], color=line.get_color(), alpha=0.2, linewidth=0)
    for name, style, title in zip(
        TRAINING_FIELDS, ("--", ":"), ("reward in training", "terrain level in training"), strict=True
    ):
        values = _array(rows, name)
        known = ~np.isnan(values)
        if known.any():
            low, span = values[known].min(), np.ptp(values[known]) or 1.0
            shares.plot(
                steps[known], (values[known] - low) / span, style, color="0.6", linewidth=1, label=title, zorder=0
            )
    for number in dict.fromkeys(row["stretch"] for row in rows):
        axes.axvline(
            max(s for s, row in zip(steps, rows, strict=True) if row["stretch"] == number), color="0.9", linewidth=1
        )
    axes.set_xlabel("environment steps [million]")
    axes.set_ylabel("score, bands: 95 % interval")
    shares.set_ylabel("share of its own range (grey)")
    handles, labels = axes.get_legend_handles_labels()
    more, names = shares.get_legend_handles_labels()
    axes.legend(handles + more, labels + names, loc="lower right", fontsize="small")
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})


def _array(rows: Sequence[Row], name: str) -> np.ndarray:
    return np.array([np.nan if v is None else v for v in column(rows, name)])


def main() -> None:
    """Score, write, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="*", help="run directories or folders of policies, in order")
    parser.add_argument("--csv", type=Path, required=True)
    parser.add_argument("--svg", type=Path)
    parser.add_argument("--before", type=Path, nargs="+", default=[], help="earlier tables to merge")
    parser.add_argument("--scores-only", choices=ENGINES, help="score on this engine alone")
    parser.add_argument("--no-scores", action="store_true", help="score nothing: training figures, merging and drawing")
    parser.add_argument("--suite", default="robogauge-1.1")
    parser.add_argument("--pipeline", default="stress")
    parser.add_argument("--terrain", nargs="+", default=[], help="default: the suite's")
    parser.add_argument("--level", type=int)
    parser.add_argument("--friction", type=float, nargs="+", default=[0.6])
    parser.add_argument("--seed", type=int, nargs="+", default=[], help="default: the suite's")
    parser.add_argument("--physics", choices=("training", "suite"), default="training", help="physics on mujoco-warp")
    parser.add_argument("--task", default="go2-moe-cts", help="task whose physics training had")
    parser.add_argument("--set", nargs="+", default=[], dest="overrides", help="settings of that task, key=value")
    parser.add_argument("--device", default="cuda", help="of mujoco-warp")
    parser.add_argument("--threads", type=int, default=1, help="of MuJoCo")
    parser.add_argument("--every", type=int, default=1, help="score iterations that are multiples of this")
    parser.add_argument(
        "--steps-before", type=float, nargs="+", help="million environment steps before each run's own count"
    )
    parser.add_argument("--curve", type=Path, help="table of training_curve.py, where a run has no TensorBoard files")
    parser.add_argument(
        "--window", type=float, default=10.0, help="million steps over which training figures are averaged"
    )
    parser.add_argument("--out", type=Path, default=Path("results/gap"), help="folder of the evaluations")
    try:
        run(parser.parse_args())
    except (GapError, TaskError, SuiteError, PolicyError, StoreError) as error:
        sys.exit(f"error: {error}")


def run(options: argparse.Namespace) -> None:
    """Do what the options say."""
    rows: dict[tuple[str, str], Row] = {}
    for table in options.before:
        for key, row in read_table(table).items():
            rows[key] = merge(rows.get(key, {}), row)
    checkpoints = find_checkpoints(options.runs, options.steps_before, options.every)
    task = find_task(options.task, options.overrides)
    plain = load_suite(options.suite)
    training = options.suite
    if options.physics == "training":
        joints = task.environment.joints.parameters
        training = str(training_suite(plain, task.environment.physics, joints, options.out))
    engines = [] if options.no_scores else [e for e in ENGINES if options.scores_only in (None, e)]
    requests = {
        (checkpoint, engine): Request(
            policy=str(checkpoint.path),
            suite=options.suite if engine == "mujoco" else training,
            pipeline=options.pipeline,
            backend=engine,
            device="cpu" if engine == "mujoco" else options.device,
            terrains=tuple(options.terrain),
            level=options.level,
            frictions=tuple(options.friction),
            seeds=tuple(options.seed),
            threads=options.threads,
        )
        for engine in engines
        for checkpoint in checkpoints
    }
    for request in requests.values():
        prepare(request)  # before hours go by
    words = [
        plain.name,
        plain.version,
        options.pipeline,
        *options.terrain,
        *(f"level {n}" for n in [options.level] if n),
    ]
    words += [f"friction {f:g}" for f in options.friction] + [f"seed {s}" for s in options.seed]
    said = curve_series(options.curve) if options.curve else {}
    for checkpoint in checkpoints:
        row = dict.fromkeys(FIELDS, "") | {
            "stretch": str(checkpoint.stretch),
            "iteration": str(checkpoint.iteration),
            "environment_steps_millions": f"{checkpoint.steps:.2f}",
            "policy_sha256": file_digest(str(checkpoint.path)),
            "protocol": " ".join(words),
            "training_physics": load_suite(training).digest[:12] if "mujoco-warp" in engines else "",
        }
        own = float(str(load_policy(checkpoint.path).contract.provenance["environment_steps"])) / 1e6
        series = training_series(checkpoint.path.parent, checkpoint.steps - own) or said
        for name in TRAINING_FIELDS:
            value = mean_before(series.get(name, []), checkpoint.steps, options.window)
            row[name] = "" if value is None else f"{value:.4g}"
        rows[checkpoint.key] = merge(rows.get(checkpoint.key, {}), row)
    write_table(options.csv, rows)
    for (checkpoint, engine), request in requests.items():
        folder = options.out / f"{checkpoint.stretch}-{checkpoint.iteration}-{engine}"
        found = score(request, folder, engine)
        rows[checkpoint.key] |= found
        write_table(options.csv, rows)
        shown = ", ".join(f"{name} {value}" for name, value in found.items() if value)
        print(f"stretch {checkpoint.stretch}, iteration {checkpoint.iteration}, {engine}: {shown}", flush=True)
    show(ordered(rows))
    if options.svg:
        draw(ordered(rows), options.svg)


if __name__ == "__main__":
    main()
