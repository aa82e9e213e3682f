"""Results, score cards, studies, tables of measurements, descriptions of runs, and checkpoints of training."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from fuzzing import SEEDS, register
from gaitgauge.api import ResultsError, load_results
from gaitgauge.files.parsing import edited
from gaitgauge.gauge.report.page import write_report
from gaitgauge.gauge.result import Result
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.foreign.described import described_contract
from gaitgauge.policy.foreign.fence.archive import packed, read_archive
from gaitgauge.policy.native import StoredNetwork
from gaitgauge.policy.networks.architectures import MlpNetwork
from gaitgauge.robots import load_robot
from gaitgauge.studies.cards.board import write_board
from gaitgauge.studies.cards.verify import judge
from gaitgauge.studies.compare.comparison import compare, load_result
from gaitgauge.studies.compare.report import write_comparison
from gaitgauge.studies.consistency.page import write_page
from gaitgauge.studies.validate.validation import read_measurements, validate
from gaitgauge.training.run.checkpoint import checkpoint_entries, read_checkpoint, run_numbers
from gaitgauge.training.run.run_directory import read_run_json
from gaitgauge.training.run.scoring import scores_of

CARD = (SEEDS / "results" / "results.json").read_bytes()
ROBOT = load_robot("go2")
TRUE = Result.from_data(json.loads(CARD), "the seed", ValueError)
OTHER = replace(TRUE, policy=replace(TRUE.policy, path="other.pt"))


def _into(name: str, read: Callable[[Path], Any]) -> Callable[[bytes, Path], None]:
    """Writes the content under a name and has it read."""

    def feed(content: bytes, folder: Path) -> None:
        (folder / name).write_bytes(content)
        read(folder)

    return feed


def _results(folder: Path) -> None:
    found = load_results(folder)
    _ = found.complete, found.terrains, found.metrics
    with edited("it", ResultsError):
        scores_of(found)


def _compared(folder: Path) -> None:
    found = compare([load_result(folder), OTHER], ["one", "two"])
    write_comparison(folder / "comparison", found)


def _card(folder: Path) -> None:
    judge(load_result(folder), TRUE)


def _tables(folder: Path) -> None:
    measured = read_measurements(folder / "real.csv")
    validate(measured, [measured])


def _checkpoint(folder: Path) -> None:
    path = folder / "model_1.pt"
    run_numbers(read_checkpoint(path), path)


def _entries() -> bytes:
    """A checkpoint of a run without its networks."""
    small = {"frame_width": 45, "num_actions": 12, "hidden": [4]}
    mlp = StoredNetwork(architecture="mlp", arguments=small, state_dict=MlpNetwork(**small).state_dict())
    training = {"version": 1, "task": "go2-flat", "num_envs": 8, "world_size": 1, "progress": 0.5}
    training |= {"best_score": None, "best_iteration": None, "settings": {"backend": "fake"}, "log": {"returns": [1.0]}}
    made = io.BytesIO()
    torch.save(checkpoint_entries(standard_contract(ROBOT), mlp, {"iter": 1, "training": training}), made)
    return made.getvalue()


def _inside(content: bytes, folder: Path) -> None:
    (folder / "model_1.pt").write_bytes(packed({**RECORDS, "data.pkl": content}))
    _checkpoint(folder)


MADE = _entries()
RECORDS = read_archive(MADE, source="model_1.pt")
RUN = {"task": "go2-flat", "best_score": 0.5, "best_iteration": 2, "resumed": [{"started": "2026"}], "outcome": "time"}
TABLE = b"policy,motion,command,lin_vel_err,dof_power\na,vx+,linear,0.5,0.25\na,vy+,linear,0.5,1\nb,vx+,linear,1,0\nb,vy+,linear,0,0\n"
CONTRACT = b'action_clip = 10.0\n[history]\nlength = 5\norder = "frame-major"\nstart = "repeat"\n'
PICKLE = (b"cos\nsystem\n", b"R", b"Q", b"}", b"(", b"\x8a\xff", b"G\x7f\xf8" + bytes(6))

register("results", _into("results.json", _results), seeds=[CARD], json=True)
register("results-report", _into("results.json", write_report), seeds=[CARD], json=True)
register("results-compared", _into("results.json", _compared), seeds=[CARD], json=True)
register("score-card", _into("results.json", _card), seeds=[CARD], json=True)
register(
    "board", _into("card.json", lambda folder: write_board(folder, folder / "board.html")), seeds=[CARD], json=True
)
register("consistency", _into("consistency.json", write_page), json=True)
register("run-description", _into("run.json", read_run_json), seeds=[json.dumps(RUN).encode()], json=True)
register("measurements", _into("real.csv", _tables), seeds=[TABLE], words=(b",", b'"', b"nan"), text=True)
register(
    "contract-toml",
    _into("contract.toml", lambda folder: described_contract(folder / "contract.toml", ROBOT)),
    seeds=[CONTRACT],
    words=(b" = ", b"[", b"inf"),
    text=True,
)
register("checkpoint", _into("model_1.pt", _checkpoint), seeds=[MADE])
register("checkpoint-pickle", _inside, seeds=[RECORDS["data.pkl"]], words=PICKLE)
