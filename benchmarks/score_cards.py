"""Make the score cards that ship: a robot that stands, the hand-made trot, a published CTS policy, those that ship, the zoo's.

    python benchmarks/score_cards.py --threads 13 --folder /tmp/cards --cts go2_cts_public.npz --out docs/data/scorecards
    python benchmarks/score_cards.py --threads 13 --folder /tmp/cards --public FOLDER --suite robogauge-1.1.8 --out cards

Each policy is evaluated on each suite, whole; what the folder holds is not played again. A card is the run's ``results.json``
with the policy's name in place of its path and without the machine's name, with the band in which the score of a replay on
another machine must lie, and with the repeatability of its suite (``--repeatability``). Weights of others are not written to
``--out``: of the CTS policy and the zoo's their cards alone. ``--public`` is a folder with public files that the zoo knows, under
any name, and takes those for the Go2. ``--only`` and ``--suite`` choose, so that several processes can share the work;
``--terrain`` and ``--friction`` take a part for a first try, whose card is named so.

``--made`` plays nothing: cards are made of the results that the folder holds, on this machine or on another that was given the
folder. ``--commit`` says which commit played, where the machine that played had the source without its repository.
"""

from __future__ import annotations

import argparse
import gzip
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import import_public_cts
import make_trot_policy
import numpy as np
import torch
from gaitgauge.files.parsing import read_text
from gaitgauge.files.writing import write_atomically
from gaitgauge.gauge.evaluate import Request, evaluate
from gaitgauge.gauge.report.page import write_report
from gaitgauge.gauge.result import Result
from gaitgauge.gauge.store import StoreError
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.finding import shipped_policies
from gaitgauge.policy.foreign.zoo import zoo
from gaitgauge.policy.native import StoredNetwork, save_policy
from gaitgauge.policy.networks.architectures import MlpNetwork
from gaitgauge.robots import load_robot
from gaitgauge.studies.cards.verify import tolerance_band
from gaitgauge.studies.compare.comparison import load_result
from gaitgauge.studies.policies import file_digest

NAMES = ("standing", "trotting", "cts", *shipped_policies())
ZOO = {known.name: known for known in zoo().values() if known.robot == "go2"}
SUITES = ("robogauge-1.1", "gaitgauge-1")
OWN_SUITES = {"pretrained-g1": ("gaitgauge-biped-1",)}
"""Suites of policies for other legs than four."""


def make_policy(name: str, path: Path, cts: Path | None) -> None:
    """Write a policy's file; the same bytes come out every time."""
    if name == "standing":
        save_constant(path, [0.0] * 12, kind="stands in its default pose")
    elif name == "trotting":
        contract, network = make_trot_policy.make()
        save_policy(path, contract, network)
    else:
        assert cts is not None
        with np.load(cts) as archive:
            provenance = {"adapter": "published CTS weights", "file": cts.name}
            contract = standard_contract(load_robot("go2"), provenance=provenance)
            save_policy(path, contract, import_public_cts.read_network(archive))


def save_constant(path: Path, action: list[float], *, kind: str) -> None:
    """Write a policy that always answers with one action, (12,)."""
    arguments: dict[str, Any] = {"frame_width": 45, "num_actions": 12, "hidden": [1]}
    state = {key: torch.zeros_like(value) for key, value in MlpNetwork(**arguments).state_dict().items()}
    last = [key for key, value in state.items() if value.shape == (12,)][-1]
    state[last] = torch.tensor(action)
    contract = standard_contract(load_robot("go2"), provenance={"made_by": "benchmarks/score_cards.py", "kind": kind})
    save_policy(path, contract, StoredNetwork(architecture="mlp", arguments=arguments, state_dict=state))


def card_of(result: Result, name: str, repeated: dict[str, Any] | None, commit: str | None = None) -> dict[str, Any]:
    """Return a card that names no folder and no machine, with the figures of repeated evaluations by the same rules if there are any.

    Args:
        name: the policy's.
        repeated: what ``benchmarks/repeatability.py`` wrote.
        commit: the one that played, where the results do not know.
    """
    path = (
        name if name in shipped_policies() else f"{name}{Path(ZOO[name].file).suffix if name in ZOO else '.gauge.pt'}"
    )
    provenance = replace(
        result.provenance,
        command=f"gaitgauge evaluate {path} --suite {result.suite.name}",
        host="",
        commit=result.provenance.commit or commit,
        lacking=frozenset(),
    )
    named = replace(result, policy=replace(result.policy, path=path), provenance=provenance)
    card = named.to_data() | {"tolerance": tolerance_band(result.score, result.score_interval)}
    if repeated and repeated["suite"]["digest"] == result.suite.digest:
        figures = ("sigma", "interval", "by_environments", "mean", "coverage", "control_steps", "cost", "policy")
        card["repeatability"] = {k: repeated[k] for k in figures} | {"evaluations": len(repeated["evaluations"])}
    return card


def play(name: str, suite: str, run: Path, arguments: argparse.Namespace) -> Result:
    """Evaluate a policy on a suite."""
    policy = name
    if name in ZOO:
        files = (file for file in arguments.public.rglob("*") if file.is_file())
        found = next((file for file in files if file_digest(str(file)) == ZOO[name].sha256), None)
        if found is None:
            raise SystemExit(f"'{arguments.public}' holds no file of '{name}' (SHA-256 {ZOO[name].sha256})")
        policy = str(found)
    elif name not in shipped_policies():
        path = arguments.folder / f"{name}-{suite}.gauge.pt"
        make_policy(name, path, arguments.cts)
        policy = str(path)
    request = Request(
        policy=policy,
        suite=suite,
        threads=arguments.threads,
        terrains=tuple(arguments.terrain),
        frictions=tuple(arguments.friction),
    )
    result = evaluate(request, run, resume=True)
    write_report(run)
    return result


def main() -> None:
    """Make the policies, play, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--folder", type=Path, required=True, help="policies and runs stay here")
    parser.add_argument("--out", type=Path, required=True, help="where the cards go")
    parser.add_argument("--cts", type=Path, help="NumPy archive of the published CTS policy's weights")
    parser.add_argument(
        "--public", type=Path, help="folder of public files that the zoo knows; takes those for the Go2"
    )
    parser.add_argument(
        "--repeatability", type=Path, help="figures that benchmarks/repeatability.py wrote, for the cards"
    )
    parser.add_argument("--made", action="store_true", help="take the results that the folder holds, play nothing")
    parser.add_argument("--commit", help="commit of the source that played, where the results do not know it")
    parser.add_argument("--only", nargs="+", choices=(*NAMES, *ZOO))
    parser.add_argument("--suite", nargs="+", help="default: those of the cards that ship")
    parser.add_argument("--terrain", action="append", default=[])
    parser.add_argument("--friction", action="append", type=float, default=[])
    arguments = parser.parse_args()
    arguments.only = arguments.only or list(ZOO if arguments.public is not None else NAMES)
    if arguments.public is None and not arguments.made and set(arguments.only) & set(ZOO):
        parser.error("the cards of the zoo's policies need their files; give their folder as --public")
    if "cts" in arguments.only and arguments.cts is None and not arguments.made:
        parser.error("the card of 'cts' needs the archive of its weights; give --cts, or choose others with --only")
    repeated = None
    if arguments.repeatability is not None:
        repeated = json.loads(read_text(arguments.repeatability, "figures", StoreError))
    arguments.folder.mkdir(parents=True, exist_ok=True)
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.only:
        for suite in arguments.suite or OWN_SUITES.get(name, SUITES):
            run = arguments.folder / f"{name}-{suite}"
            result = load_result(run) if arguments.made else play(name, suite, run, arguments)
            card = card_of(result, name, repeated, arguments.commit)
            text = json.dumps(card, separators=(",", ":"), ensure_ascii=False) + "\n"
            file = f"{run.name}{'' if result.complete else '-part'}.json.gz"
            write_atomically(arguments.out / file, gzip.compress(text.encode(), mtime=0), StoreError)
            low, high = card["tolerance"] or (float("nan"),) * 2
            where = "" if result.complete else f" ({result.coverage.text})"
            print(f"{name} {suite}: {result.score:.4f}, a replay within {low:.4f} to {high:.4f}{where}", flush=True)


if __name__ == "__main__":
    main()
