"""Runs of a sweep whose trainings and gaugings are one-line programs."""

import gzip
import json
import sys
from pathlib import Path
from unittest.mock import patch

from gaitgauge.gauge.suite import load_suite
from gaitgauge.studies.policies import file_digest
from gaitgauge.training.sweep import jobs
from gaitgauge.training.sweep.file import Sweep, SweepEntry
from gaitgauge.training.sweep.jobs import Jobs
from gaitgauge.training.sweep.runs import SweepRun

ROOT = Path(__file__).parents[2]
CARD = ROOT / "docs" / "data" / "scorecards" / "standing-robogauge-1.1.json.gz"
ENTRY = SweepEntry(name="one", task="go2-cts")
SWEEP = Sweep(name="toy", title="A toy", entry=(ENTRY,), backend="fake", training_suite="none")


class Scripted(SweepRun):
    """A run whose training and gauging are small programs."""

    def training_command(self, sweep, *, seconds, score_threads):
        program = f"""
import json, os, sys, time, pathlib
folder = pathlib.Path({str(self.folder)!r})
with open(folder.parents[2] / "order", "a") as file: file.write(f"{self.label} on {{os.environ['CUDA_VISIBLE_DEVICES']}}\\n")
(folder / "new").write_text(str(os.getpid()))
(folder / "new").rename(folder / "pid")
if {self.entry.name!r} == "deaf":
    import signal
    for number in (signal.SIGTERM, signal.SIGINT): signal.signal(number, signal.SIG_IGN)
    (folder / "is-deaf").touch()
time.sleep({0.3 if "slow" in self.entry.name else 60.0 if self.entry.name in ("long", "deaf") else 0.0})
if {self.entry.name!r} == "killed":
    print("iteration 60 of 1530, 23 min left", flush=True)
    os.kill(os.getpid(), 9)
if {self.entry.name!r} == "broken":
    sys.exit("gaitgauge: the physics has diverged")
run = folder / "logs" / "x" / "2026"
run.mkdir(parents=True, exist_ok=True)
if {self.entry.name!r} == "asked" and not (run / "model_1.pt").exists():
    (run / "model_1.pt").touch()
    print("go on with: gaitgauge train --resume", flush=True)
    sys.exit(128 + 15)
if {self.entry.name!r} == "asked-early":
    sys.exit(128 + 15)
(run / "model_3.pt").touch()
(run / "run.json").write_text(json.dumps(dict(outcome="finished", iteration={self.iterations})))
if {self.entry.name!r} == "damaged": (run / "run.json").write_text("{{")
"""
        return [sys.executable, "-S", "-c", program]

    def gauging_command(self, sweep, *, where):
        card = json.loads(gzip.decompress(CARD.read_bytes()))
        card["suite"]["digest"] = load_suite(sweep.suite).digest
        card["policy"]["file_sha256"] = file_digest(str(self.policy(sweep)))
        (self.folder / "card.json").write_text(json.dumps(card))
        program = f"""
import pathlib, shutil
target = pathlib.Path({str(self.results(sweep))!r})
target.mkdir(parents=True, exist_ok=True)
shutil.copy({str(self.folder / "card.json")!r}, target / "results.json")
"""
        return [sys.executable, "-S", "-c", program]


def scripted(folder: Path, name: str, *, seed: int = 0, on_gpu: bool = True) -> Scripted:
    return Scripted(
        entry=SweepEntry(name=name, task="go2-cts"),
        seed=seed,
        settings=(),
        backend="fake",
        on_gpu=on_gpu,
        iterations=3,
        folder=folder / "runs" / name / f"seed-{seed}",
        suite_digest=load_suite(SWEEP.suite).digest,
    )


def work(runs, *, gpus=("3", "5"), per_gpu=1, deadline=None):
    said = []
    with patch.object(jobs, "_POLL", 0.01):  # the programs end sooner than it looks at them otherwise
        outcome = Jobs(SWEEP, threads=1, deadline=deadline, say=said.append, gpus=gpus, per_gpu=per_gpu).work(runs)
    return outcome, said
