"""The mean of the weights of some trained policies, teacher and critic included, as one policy.

    gaitgauge import RUN/model_1000.pt a.gauge.pt --trainable
    gaitgauge import RUN/model_1400.pt b.gauge.pt --trainable
    python benchmarks/mean_policy.py mean.gauge.pt a.gauge.pt b.gauge.pt

Checkpoints of one run, or of runs that went on from each other, lie close enough for that (``training/run/averaging.py``). A file that
is named twice weighs twice. ``--only encoder`` averages what has that in its name, and takes the rest from the last file. Contract, task
and progress are those of the last file; its provenance gets ``mean_of``, run and iteration of every file, and the physics of all.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from gaitgauge.policy.contract import PHYSICS, PolicyContract
from gaitgauge.training.run.checkpoint import learned_networks, read_checkpoint, student_state, write_checkpoint
from gaitgauge.training.run.resuming import joined_physics

State = Mapping[str, torch.Tensor]


def mean(states: Sequence[State], only: str) -> State:
    """Mean of each tensor of numbers that has ``only`` in its name; of others the last one's."""
    last = states[-1]
    return {
        name: torch.stack([state[name].double() for state in states]).mean(dim=0).to(value.dtype)
        if value.is_floating_point() and only in name
        else value
        for name, value in last.items()
    }


def main() -> None:
    """Read, average, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("policies", type=Path, nargs="+", help="files of gaitgauge import --trainable, or checkpoints")
    parser.add_argument("--only", default="", help="average the tensors with this in their names")
    arguments = parser.parse_args()
    files = [read_checkpoint(path, training_state=False, purpose="average") for path in arguments.policies]
    contracts = [PolicyContract.from_json(entries["contract"]) for entries in files]
    if len({(contract.hash, repr(entries["network"])) for contract, entries in zip(contracts, files, strict=True)}) > 1:
        parser.error("the policies differ in contract or network; give policies of one task")
    networks = [learned_networks(entries) for entries in files]
    if not any(arguments.only in name for name in networks[-1]["actor_state_dict"]):
        parser.error(f"no tensor of the actor has '{arguments.only}' in its name; try encoder or student")
    kinds = ("actor_state_dict", "critic_state_dict")
    actor, critic = (mean([n[kind] for n in networks], arguments.only) for kind in kinds)
    means = [{key: c.provenance.get(key) for key in ("run", "iteration")} for c in contracts]
    made = {"mean_of": means, **({"mean_of_part": arguments.only} if arguments.only else {})}
    unknown = {"note": "one of the averaged files does not say in which physics it was trained"}
    made[PHYSICS] = joined_physics(*(contract.provenance.get(PHYSICS) or unknown for contract in contracts))
    contract = replace(contracts[-1], provenance={**contracts[-1].provenance, **made})
    kept = {name: files[-1][name] for name in ("format", "version", "network", "iter", "training")}
    weights = {"state_dict": student_state(actor), "actor_state_dict": actor, "critic_state_dict": critic}
    write_checkpoint(arguments.out, kept | weights | {"contract": contract.to_json()})
    print(f"wrote {arguments.out}, the mean of {len(files)} policies")


if __name__ == "__main__":
    main()
