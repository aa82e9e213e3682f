"""Whether two runs of ``gaitgauge evaluate`` found the same, to the last bit.

    python benchmarks/same_results.py FOLDER OTHER [--ignore interval ...]

Compares the episodes, samples bit by bit, and ``results.json`` without its provenance and without fields whose name has one of
the ignored words in it. Prints what differs; the exit code is 1 if anything does.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np


def differences(one: Any, other: Any, ignored: Sequence[str], where: str = "") -> Iterator[str]:
    """Paths in plain data at which two values differ."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in sorted(one.keys() | other.keys()):
            if not any(word in key for word in ignored):
                yield from differences(one.get(key), other.get(key), ignored, f"{where}.{key}")
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for i, (a, b) in enumerate(zip(one, other, strict=True)):
            yield from differences(a, b, ignored, f"{where}[{i}]")
    elif one != other:
        yield f"{where}: {one} and {other}"


def episode(path: Path) -> dict[str, Any]:
    """What an episode's file holds, as plain data."""
    with np.load(path, allow_pickle=False) as data:
        arrays = {name: data[name] for name in data.files if name != "head"}
        head = json.loads(data["head"].tobytes())
    return head | {name: [str(a.dtype), list(a.shape), a.tobytes().hex()] for name, a in arrays.items()}


def compare(folder: Path, other: Path, ignored: Sequence[str]) -> list[str]:
    """Everything that differs between two runs."""
    files = [{p.name: p for p in (run / "episodes").glob("*.npz")} for run in (folder, other)]
    found = [f"episodes/{name}: in one run only" for name in sorted(files[0].keys() ^ files[1].keys())]
    both = sorted(files[0].keys() & files[1].keys())
    for name in both:
        pair = (episode(files[0][name]), episode(files[1][name]))
        found += [f"episodes/{name} {line[:100]}" for line in differences(*pair, ignored)]
    results = [json.loads((run / "results.json").read_text(encoding="utf-8")) for run in (folder, other)]
    return found + [f"results.json {line}" for line in differences(*results, ("provenance", *ignored))]


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("other", type=Path)
    parser.add_argument("--ignore", nargs="*", default=[], help="words of fields that do not matter")
    arguments = parser.parse_args()
    found = compare(arguments.folder, arguments.other, arguments.ignore)
    for line in found:
        print(line)
    print(f"{len(found)} differences")
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
