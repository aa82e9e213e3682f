"""Asks whether scores in some engines predict what a policy does in an engine that nobody looked at.

    python benchmarks/leave_one_engine_out.py gather POLICIES --public FOLDER    # our policies from the history, public ones from FOLDER
    for p in POLICIES/*; do gaitgauge jury $p --out JURIES/$(basename $p); done  # resumable
    python benchmarks/leave_one_engine_out.py collect JURIES docs/data/leave-one-engine-out.json
    python benchmarks/leave_one_engine_out.py analyse docs/data/leave-one-engine-out.json

The analysis was written down before the games were played: docs/reports/2026-11-28-leave-one-engine-out-plan.md.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from fetch_policies import ROOT, fetch, listed
from numpy.typing import NDArray

Array = NDArray[np.float64]
FAMILIES = {
    "mujoco": ("mujoco",),
    "newton": ("newton:steel",),
    "drake": ("drake",),
    "physx": ("physx",),
}
"""Families and their engines. ``mujoco@foot_condim=3``, the contacts of training, predicts alone and is in no family."""
TRAINING = "mujoco@foot_condim=3"
GROUPS = {
    "tracking": ("lin_vel_err", "ang_vel_err"),
    "effort": ("dof_power", "torque_smoothness", "dof_limits"),
    "posture": ("orientation_stability",),
}
TARGETS = ("score", "survival", "tracking")
RESAMPLES = 10_000
SHIPPED = {"shipped-first": "2fd2ad75", "shipped-middle": "2c6f239b", "pretrained": "50f33aa7"}
"""Files of the shipped training, by commit; another policy ships as ``pretrained`` since the study."""
PUBLIC = {
    "katari16-dc": "katari16_policy_dc_cfg_comparasion/policy_dc_cfg_comparasion.pt",
    "katari16-pace-cfg": "katari16_policy_pace_cfg_comparasion/policy_pace_cfg_comparasion.pt",
    "katari16-pace-isaaclab": "katari16_policy_pace_isaaclab/policy_pace_isaaclab.pt",
    "katari16-history": "katari16_policy_isaaclab_propioceptive_history/policy_isaaclab_propioceptive_history.pt",
    "kms1115-dreamwaq": "kms1115_go2_dreamwaq/policy.onnx",
    "rl_sar-himloco": "rl_sar_go2_himloco/himloco.pt",
    "rl_sar-robot_lab": "rl_sar_go2_robot_lab/policy.pt",
    "rl_lab-fork": "unitree_rl_lab_fork_go2_velocity_v0/policy.onnx",
    "rl_mjlab-fork": "unitree_rl_mjlab_fork_go2_velocity_v0/policy.onnx",
}
"""Files of other people, by their place in the folder of public policies."""


def training_of(name: str) -> str:
    """Return the training or project that a policy comes from: policies of one are not independent."""
    for start in ("shipped", "katari16", "rl_sar", "from-nothing", "more-level-ground"):
        if name.startswith(start):
            return start
    return "shipped" if name == "pretrained" else name


def gather(folder: Path, public: Path) -> None:
    """Write all policies into a folder, each under its name."""
    folder.mkdir(parents=True, exist_ok=True)
    for pattern in ("baselines-*", "from-nothing-*", "more-level-ground-*"):
        for entry in listed(pattern):
            fetch(entry, folder)
    for name, commit in SHIPPED.items():
        path = f"{commit}:policy/pretrained/go2.gauge.pt"
        shown = subprocess.run(["git", "-C", str(ROOT), "show", path], capture_output=True, check=True)
        (folder / f"{name}.gauge.pt").write_bytes(shown.stdout)
    for name, file in PUBLIC.items():
        shutil.copy(public / file, folder / f"{name}{Path(file).suffix}")


def collect(juries: Path) -> dict[str, Any]:
    """Return what the analysis reads of all juries in a folder: by policy and engine the targets and metric groups."""
    found = {}
    for path in sorted(juries.glob("*/jury.json")):
        results = json.loads(path.read_text())
        (block,) = results["policies"]
        name = path.parent.name.removesuffix(".pt").removesuffix(".onnx").removesuffix(".gauge")
        found[name] = {label: _figures(block, label) for label in block["engines"]} | {"return": _return(name)}
    return {"suite": results["suite"], "part": results["part"], "policies": found}


def _figures(block: dict[str, Any], label: str) -> dict[str, float]:
    """Return the targets and the metric groups of a policy in an engine, each larger for better."""
    engine = block["engines"][label]
    shares = [row["shares"][label] for row in block["speeds"]]
    groups = {g: float(np.mean([engine["metrics"][m] for m in metrics])) for g, metrics in GROUPS.items()}
    return {f"metrics: {g}": value for g, value in groups.items()} | {
        "score": engine["score"]["value"],
        "survival": 1.0 - engine["falls"] / engine["segments"],
        "tracking": float(np.mean([0.0 if s is None else 1.0 - min(abs(s - 1.0), 1.0) for s in shares])),
    }


def _return(name: str) -> float | None:
    """Return the last mean reward of a policy's training; None where the sweep's curves do not hold it."""
    for sweep in ("baselines", "from-nothing", "more-level-ground"):
        if name.startswith(f"{sweep}-"):
            method, seed = name.removeprefix(f"{sweep}-").rsplit("-seed-", 1)
            with zipfile.ZipFile(ROOT / "docs" / "data" / "sweeps" / f"{sweep}.zip") as archive:
                text = archive.read(f"runs/{method}/seed-{seed}/kept/curves.csv").decode()
            rows = [line.split(",") for line in text.splitlines()]
            rewards = [float(row[2]) for row in rows if row[0] == "mean reward"]
            return rewards[-1] if rewards else None
    return None


def violation(predicted: Array, real: Array) -> float:
    """Return the mean maximum rank violation: for each policy the largest real difference that its order gets wrong, averaged."""
    wrong = (predicted[:, None] < predicted[None]) != (real[:, None] < real[None])
    return float((np.abs(real[:, None] - real[None]) * wrong).max(axis=1).mean())


def tau(predicted: Array, real: Array, counts: Array) -> Array:
    """Return Kendall's tau-b of samples in which each policy occurs so many times, (D, P) -> (D,); 0 where one side is all equal."""
    one, other = (np.sign(v[:, None] - v[None]) for v in (predicted, real))
    agree, pairs, others = (
        np.einsum("di,ij,dj->d", counts, m, counts) for m in (one * other, np.abs(one), np.abs(other))
    )
    root = np.sqrt(pairs * others)
    return np.divide(agree, root, out=np.zeros_like(root), where=root > 0.0)


def predictors(values: dict[str, dict[str, Array]], hidden: str) -> Iterator[tuple[str, Callable[[str], Array]]]:
    """Yield each predictor that does not know the hidden family: its name, and its values for a target, (P,)."""
    seen = {f: [values[e] for e in engines] for f, engines in FAMILIES.items() if f != hidden}

    def mean_of(quantity: str) -> Array:
        return np.mean([np.mean([e[quantity] for e in engines], axis=0) for engines in seen.values()], axis=0)

    yield "jury: score", lambda _: mean_of("score")
    yield "jury: the target itself", mean_of
    for family, engines in seen.items():
        yield f"{family}: score", lambda _, own=engines: np.mean([e["score"] for e in own], axis=0)  # type: ignore[misc]
    yield f"{TRAINING}: score", lambda _: values[TRAINING]["score"]
    for group in GROUPS:
        yield f"jury, metrics: {group}", lambda _, g=group: mean_of(f"metrics: {g}")  # type: ignore[misc]


def analyse(data: dict[str, Any], *, walkers: bool = False) -> dict[str, Any]:
    """Return tau and violation with 95 % intervals for every hidden family, target and predictor, and jury minus MuJoCo alone.

    Intervals resample trainings, each with all its policies, since policies of one training are not independent.

    Args:
        walkers: leave out policies with less than half of the best score in MuJoCo.
    """
    needed = [TRAINING, *(e for engines in FAMILIES.values() for e in engines)]
    names = [n for n, engines in data["policies"].items() if all(e in engines for e in needed)]
    if walkers:
        best = max(data["policies"][n]["mujoco"]["score"] for n in names)
        names = [n for n in names if data["policies"][n]["mujoco"]["score"] >= 0.5 * best]
    values = {
        e: {q: np.array([data["policies"][n][e][q] for n in names]) for q in data["policies"][names[0]][e]}
        for e in needed
    }
    trainings = sorted({training_of(n) for n in names})
    members = {t: [i for i, n in enumerate(names) if training_of(n) == t] for t in trainings}
    generator = np.random.default_rng(20261128)
    draws = [
        np.concatenate([members[trainings[k]] for k in generator.integers(len(trainings), size=len(trainings))])
        for _ in range(RESAMPLES)
    ]
    counts = np.array([np.bincount(d, minlength=len(names)) for d in draws], dtype=np.float64)
    whole = np.ones((1, len(names)))
    table, differences = [], []
    for hidden, engines in FAMILIES.items():
        for target in TARGETS:
            real = np.mean([values[e][target] for e in engines], axis=0)
            kept = {}
            for name, predict in predictors(values, hidden):
                predicted = predict(target)
                taus = kept[name] = tau(predicted, real, counts)
                wrong = np.array([violation(predicted[d], real[d]) for d in draws])
                entry: dict[str, Any] = {"hidden": hidden, "target": target, "predictor": name}
                entry |= {"tau": float(tau(predicted, real, whole)[0]), "tau_interval": _interval(taus)}
                entry |= {"violation": violation(predicted, real), "violation_interval": _interval(wrong)}
                table.append(entry)
            if hidden != "mujoco":
                differences.append((target, kept["jury: score"] - kept["mujoco: score"]))
    gains = {}
    for target in TARGETS:
        mean = np.mean([d for t, d in differences if t == target], axis=0)
        rows = [r for r in table if r["target"] == target and r["hidden"] != "mujoco"]
        found = {p: np.mean([r["tau"] for r in rows if r["predictor"] == f"{p}: score"]) for p in ("jury", "mujoco")}
        gains[target] = {"value": float(found["jury"] - found["mujoco"]), "interval": _interval(mean)}
    returns = [i for i, n in enumerate(names) if data["policies"][n]["return"] is not None]
    reward = np.array([data["policies"][names[i]]["return"] for i in returns])
    scores = {h: np.mean([values[e]["score"][returns] for e in engines], axis=0) for h, engines in FAMILIES.items()}
    of_return = {h: float(tau(reward, score, np.ones((1, len(returns))))[0]) for h, score in scores.items()}
    return {"policies": names, "trainings": trainings, "table": table, "jury_minus_mujoco": gains} | {
        "return": {"policies": len(returns), "tau": of_return}
    }


def _interval(values: Array) -> list[float]:
    """Return the 95 % interval of resampled values."""
    return [float(v) for v in np.quantile(values, (0.025, 0.975))]


def report(found: dict[str, Any]) -> None:
    """Print the tables."""
    print(f"{len(found['policies'])} policies of {len(found['trainings'])} trainings, {len(FAMILIES)} families")
    for target in TARGETS:
        print(f"\n{target}: Kendall's tau (violation) by hidden family")
        rows = [r for r in found["table"] if r["target"] == target]
        for name in dict.fromkeys(r["predictor"] for r in rows):
            cells = []
            for hidden in FAMILIES:
                row = next((r for r in rows if r["predictor"] == name and r["hidden"] == hidden), None)
                low, high = row["tau_interval"] if row else (0.0, 0.0)
                cells.append(f"{row['tau']:.2f} [{low:.2f}, {high:.2f}] ({row['violation']:.3f})" if row else "")
            print(f"| {name} | " + " | ".join(cells) + " |")
        gain = found["jury_minus_mujoco"][target]
        low, high = gain["interval"]
        print(f"jury minus MuJoCo alone, mean over the other families: {gain['value']:+.3f} [{low:+.3f}, {high:+.3f}]")
    print(
        f"\nreturn of training, {found['return']['policies']} policies of ours, tau with the score: {found['return']['tau']}"
    )


def main() -> None:
    """Carry out one of the three steps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    steps = parser.add_subparsers(dest="step", required=True)
    first = steps.add_parser("gather")
    first.add_argument("folder", type=Path)
    first.add_argument("--public", type=Path, required=True)
    second = steps.add_parser("collect")
    second.add_argument("juries", type=Path)
    second.add_argument("out", type=Path)
    third = steps.add_parser("analyse")
    third.add_argument("data", type=Path)
    asked = parser.parse_args()
    if asked.step == "gather":
        gather(asked.folder, asked.public)
    elif asked.step == "collect":
        asked.out.write_text(json.dumps(collect(asked.juries), indent=1) + "\n")
    else:
        data = json.loads(asked.data.read_text())
        for title, walkers in (
            ("all policies", False),
            ("policies with at least half of the best score in MuJoCo", True),
        ):
            print(f"\n## {title}")
            report(analyse(data, walkers=walkers))


if __name__ == "__main__":
    main()
