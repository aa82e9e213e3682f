"""Convert the weights of a published CTS policy from a NumPy archive into the project's own file, and check them.

The archive holds ``student_encoder.<layer>.*`` and ``actor.<layer>.*``, and one run from a reset as
``sample/observations`` (T, 45) and ``sample/actions`` (T, 12).

    python benchmarks/import_public_cts.py SOURCE.npz DESTINATION.gauge.pt
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import StoredNetwork, save_policy
from gaitgauge.robots import load_robot

TOLERANCE = 1e-5


def read_network(archive: np.lib.npyio.NpzFile) -> StoredNetwork:
    """The network in the archive."""
    state = {
        name.replace("student_encoder.", "encoder."): torch.from_numpy(archive[name])
        for name in archive.files
        if not name.startswith("sample/")
    }
    return StoredNetwork(architecture="cts", arguments={}, state_dict=state)


def largest_error(path: Path, observations: np.ndarray, actions: np.ndarray) -> float:
    """Largest difference between the policy's actions and the expected ones over one run from a reset."""
    session = load_policy(path).session(1)
    session.reset()
    frames = torch.from_numpy(observations)
    mine = torch.cat([session.act(frames[i : i + 1]) for i in range(len(frames))])
    return float((mine - torch.from_numpy(actions)).abs().max())


def main() -> None:
    """Convert, check, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("destination", type=Path)
    arguments = parser.parse_args()
    with np.load(arguments.source) as archive:
        contract = standard_contract(
            load_robot("go2"), provenance={"adapter": "published CTS weights", "file": arguments.source.name}
        )
        save_policy(arguments.destination, contract, read_network(archive))
        error = largest_error(arguments.destination, archive["sample/observations"], archive["sample/actions"])
    print(
        f"{arguments.destination}: largest difference from the published actions {error:.2e} (allowed {TOLERANCE:.0e})"
    )
    if error > TOLERANCE:
        raise SystemExit("the converted policy does not act as published")


if __name__ == "__main__":
    main()
