"""Fetches policies that the tree no longer holds from the git history, and checks their SHA-256.

    python benchmarks/fetch_policies.py                            # list the names
    python benchmarks/fetch_policies.py NAME … [--out policies]    # write NAME.gauge.pt; a name may be a pattern, such as 'baselines-*'

The names are in ``docs/data/policies.toml``. ``trainable-go1`` and ``trainable-anymal_c`` are the shipped policies with their
teacher and critic inside, for ``train --init-from``.
"""

from __future__ import annotations

import argparse
import hashlib
import subprocess
import tomllib
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "docs" / "data" / "policies.toml"


def listed(pattern: str = "*") -> list[dict[str, Any]]:
    """Return the entries of the table with a name that fits a pattern."""
    return [each for each in tomllib.loads(TABLE.read_text())["policy"] if fnmatch(each["name"], pattern)]


def fetch(entry: dict[str, Any], folder: Path) -> Path:
    """Write one policy into a folder and return its path.

    Raises:
        SystemExit: the history of this clone lacks it, or its content is another one.
    """
    show = ["git", "-C", str(ROOT), "show", f"{entry['commit']}:{entry['path']}"]
    shown = subprocess.run(show, capture_output=True, check=False)
    if shown.returncode:
        raise SystemExit(f"'{entry['name']}' is not in this clone's history; run git fetch --unshallow")
    found = hashlib.sha256(shown.stdout).hexdigest()
    if found != entry["sha256"]:
        raise SystemExit(f"'{entry['name']}' has SHA-256 {found}, not {entry['sha256']}")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{entry['name']}.gauge.pt"
    path.write_bytes(shown.stdout)
    return path


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--out", type=Path, default=Path("policies"))
    arguments = parser.parse_args()
    for pattern in arguments.names:
        for entry in listed(pattern) or parser.error(f"no policy is named '{pattern}'"):
            print(fetch(entry, arguments.out))
    if not arguments.names:
        print("\n".join(f"{each['name']:40} {each['bytes'] / 1e6:5.1f} MB" for each in listed()))
