"""The mean of the weights of several policies of one training, as one policy.

    python benchmarks/average_policies.py OUT.gauge.pt model_600.gauge.pt model_750.gauge.pt model_900.gauge.pt

Checkpoints that lie a few hundred iterations apart at the end of a run differ by chance; their mean often is better than each of
them (Izmailov et al., "Averaging Weights Leads to Wider Optima and Better Generalization", 2018). Teacher and critic are averaged too
where all files have them (``gaitgauge import model_<n>.pt OUT.gauge.pt --trainable``), so that training can go on from the result.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from gaitgauge.policy.contract import PolicyContract
from gaitgauge.policy.native import StoredNetwork, load_entries, save_policy

TRAINABLE = ("actor_state_dict", "critic_state_dict")
State = Mapping[str, torch.Tensor]


def mean_state(states: Sequence[State], name: str, done: dict[int, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Mean of every floating-point tensor; the others must be equal.

    Args:
        states: one of each file.
        name: of the entry, for messages.
        done: means by the address of the first file's tensor: what several entries share is stored once.

    Raises:
        SystemExit: the files have different tensors.
    """
    first = states[0]
    for state in states[1:]:
        if {k: v.shape for k, v in state.items()} != {k: v.shape for k, v in first.items()}:
            raise SystemExit(
                f"{name} of the files has different tensors; only policies of one training can be averaged"
            )
    result = {}
    for key, value in first.items():
        same = [state[key] for state in states]
        if value.data_ptr() in done and done[value.data_ptr()].shape == value.shape:
            result[key] = done[value.data_ptr()]
        elif value.is_floating_point():
            result[key] = done[value.data_ptr()] = torch.stack([v.double() for v in same]).mean(dim=0).to(value.dtype)
        elif all(torch.equal(value, v) for v in same):
            result[key] = value.clone()
        else:
            raise SystemExit(f"{name} of the files differs in '{key}', which is no number to be averaged")
    return result


def average(files: Sequence[Path], out: Path) -> None:
    """Write the mean of the files' weights.

    Raises:
        SystemExit: they are not of one network and one contract.
    """
    found = [load_entries(file.read_bytes(), source=str(file)) for file in files]
    contracts = [PolicyContract.from_json(entries["contract"]) for entries in found]
    networks = [(entries["network"].get("architecture"), entries["network"].get("arguments")) for entries in found]
    if len({json.dumps(n) for n in networks}) > 1 or len({replace(c, provenance={}).to_json() for c in contracts}) > 1:
        raise SystemExit(
            "the files hold different networks or contracts; only policies of one training can be averaged"
        )
    last = max(range(len(found)), key=lambda i: int(str(contracts[i].provenance.get("iteration", 0))))
    iterations = sorted(int(str(c.provenance.get("iteration", 0))) for c in contracts)
    provenance = {**contracts[last].provenance, "mean_of_iterations": ", ".join(map(str, iterations))}
    done: dict[int, torch.Tensor] = {}
    state = mean_state([entries["state_dict"] for entries in found], "state_dict", done)
    extra: dict[str, Any] = {}
    if all(set(TRAINABLE) <= entries.keys() for entries in found):
        extra = {key: mean_state([entries[key] for entries in found], key, done) for key in TRAINABLE}
        extra |= {key: found[last][key] for key in ("iter", "training") if key in found[last]}
    architecture, arguments = networks[0]
    network = StoredNetwork(architecture=architecture, arguments=json.loads(arguments), state_dict=state)
    save_policy(out, replace(contracts[last], provenance=provenance), network, extra=extra)


def main(arguments: Sequence[str] | None = None) -> None:
    """Average the files named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("policies", type=Path, nargs="+")
    chosen = parser.parse_args(arguments)
    average(chosen.policies, chosen.out)
    print(f"mean of {len(chosen.policies)} policies: {chosen.out}")


if __name__ == "__main__":
    main()
