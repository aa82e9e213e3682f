"""Kills an evaluation again and again with SIGKILL, goes on with it each time, and says whether anything was lost.

    python benchmarks/torture.py --kills 100

A run of a few episodes is played once undisturbed. Then runs of the same are killed at random moments, the parent, its workers
or both, and resumed until they end; after the last kill every run is brought to its end. An episode is lost if its record goes
or changes, and played twice if its record is written again. At the end of each run its episodes and its ``results.json``, provenance
apart, must be those of the undisturbed run, with no process and no partial file left. Linux only: processes are found in ``/proc``.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

SUITE = """extends = "demo"
name = "torture"
version = "1.0.0"
title = "A few short episodes, to be killed"

[matrix]
terrains = ["slope_fd"]
frictions = [0.6]
payloads = [0.0]
seeds = [0, 1, 2]
search_seeds = [100, 101, 102]
"""
MODES = ("parent", "workers", "both")
GONE_WITHIN = 60.0
"""Seconds after a kill in which every process of the run must have ended."""
ENDS_WITHIN = 1800.0
"""Seconds that an undisturbed run may take."""
STARTED: list[subprocess.Popen[bytes]] = []
Records = dict[str, tuple[int, int, bytes]]
"""Inode, time of writing and content of every record."""


class DamageError(AssertionError):
    """Something was lost, played twice or left."""


def start(policy: str, folder: Path, threads: int, *, resume: bool) -> subprocess.Popen[bytes]:
    """An evaluation in a session of its own."""
    command = [sys.executable, "-c", "from gaitgauge.cli.main import main; main()", "evaluate", policy]
    command += ["--suite", "torture.toml", "--no-clip", "--threads", str(threads), "--out", folder.name]
    with (folder.parent / f"{folder.name}.log").open("ab") as log:
        run = subprocess.Popen(
            command + (["--resume"] if resume else []),
            cwd=folder.parent,
            start_new_session=True,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
        )
    STARTED.append(run)
    return run


def members(session: int) -> list[int]:
    """Processes of a session that run, its leader included."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue  # it has just ended
        if int(fields[3]) == session and fields[0] != "Z":
            found.append(int(entry.name))
    return found


def kill(run: subprocess.Popen[bytes], mode: str) -> bool:
    """Kill the parent, all its workers or both; False if nothing was left to kill."""
    everyone = members(run.pid)
    chosen = [p for p in everyone if mode == "both" or (p == run.pid) == (mode == "parent")]
    chosen = chosen or everyone  # it has no workers yet
    killed = 0
    for process in chosen:
        try:
            os.kill(process, signal.SIGKILL)
            killed += 1
        except ProcessLookupError:
            pass
    return killed > 0


def wait_for_the_end(run: subprocess.Popen[bytes]) -> None:
    """Wait until no process of a run is left.

    Raises:
        DamageError: one is.
    """
    deadline = time.monotonic() + GONE_WITHIN
    while run.poll() is None or members(run.pid):
        if time.monotonic() > deadline:
            left = members(run.pid)
            os.killpg(run.pid, signal.SIGKILL)
            raise DamageError(f"{GONE_WITHIN:g} s after the kill processes are left: {left}")
        time.sleep(0.05)


def records(folder: Path) -> Records:
    """The records that a run has written."""
    found = {}
    for path in sorted((folder / "episodes").glob("*.npz")):
        about = path.stat()
        found[path.name] = (about.st_ino, about.st_mtime_ns, path.read_bytes())
    return found


def compare_records(before: Records, after: Records, counted: set[str]) -> None:
    """What was there before is there still, and was not written again; speculative episodes may go at the end.

    Raises:
        DamageError: it is not.
    """
    for name, record in before.items():
        if name not in after:
            if name in counted:
                raise DamageError(f"the record {name} is lost")
        elif after[name][2] != record[2]:
            raise DamageError(f"the record {name} has changed")
        elif after[name] != record:
            raise DamageError(f"the episode {name} was played twice")


def outcome(folder: Path) -> dict[str, object]:
    """What must not depend on kills: results without their provenance, the table and the records."""
    results = json.loads((folder / "results.json").read_text())
    results.pop("provenance")
    episodes = {name: content for name, (_, _, content) in records(folder).items()}
    return {"results.json": results, "episodes.csv": (folder / "episodes.csv").read_bytes(), "episodes": episodes}


def difference(one: object, other: object, place: str = "") -> str:
    """Where two contents first differ, and how."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in sorted(one.keys() | other.keys(), key=str):
            if one.get(key) != other.get(key):
                return difference(one.get(key), other.get(key), f"{place}/{key}")
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for number, pair in enumerate(zip(one, other, strict=True)):
            if pair[0] != pair[1]:
                return difference(*pair, f"{place}/{number}")
    return f"{place} {str(one)[:200]} became {str(other)[:200]}"


def check_end(folder: Path, expected: dict[str, object]) -> None:
    """A run that has ended is the undisturbed one.

    Raises:
        DamageError: it is not, or something is left.
    """
    found = outcome(folder)
    for part, value in expected.items():
        if found[part] != value:
            raise DamageError(
                f"{part} of {folder.name} differs from the undisturbed run: {difference(value, found[part])}"
            )
    if left := [str(p.relative_to(folder)) for p in folder.rglob("*") if "partial" in p.name]:
        raise DamageError(f"partial files are left: {', '.join(left)}")
    if not (folder / "report.html").is_file():
        raise DamageError("there is no report")


def torture(policy: str, kills: int, threads: int, seed: int, root: Path) -> None:
    """Play undisturbed once, then kill.

    Raises:
        DamageError: something was lost, played twice or left.
    """
    (root / "torture.toml").write_text(SUITE)
    generator = random.Random(seed)
    began = time.monotonic()
    reference = start(policy, root / "undisturbed", threads, resume=False)
    if reference.wait(ENDS_WITHIN) != 0:
        raise DamageError(f"the undisturbed run failed: {(root / 'undisturbed.log').read_text()[-2000:]}")
    lasts = time.monotonic() - began
    expected = outcome(root / "undisturbed")
    counted = set(records(root / "undisturbed"))
    print(f"undisturbed: {len(counted)} episodes in {lasts:.1f} s", flush=True)
    done, runs, modes, kept = 0, 0, Counter[str](), 0
    while done < kills:
        runs += 1
        folder, attempt, ended, before, within = root / f"run-{runs}", 0, False, Records(), lasts
        while not ended:
            run = start(policy, folder, threads, resume=attempt > 0)
            attempt += 1
            mode = generator.choice(MODES)
            started = time.monotonic()
            moment = started + generator.uniform(0.0, within)
            while done < kills and run.poll() is None and time.monotonic() < moment:
                time.sleep(0.01)
            if done < kills and run.poll() is None and kill(run, mode):
                done, modes[mode] = done + 1, modes[mode] + 1
                wait_for_the_end(run)
                ended = (folder / "report.html").is_file() and run.returncode == 0
            else:
                ended = run.wait(ENDS_WITHIN) == 0
                if attempt == 1:  # a faster machine than it seemed: kills are meant to come before the end
                    lasts = min(lasts, time.monotonic() - started)
                if not ended:
                    raise DamageError(f"{folder.name} failed: {(root / f'{folder.name}.log').read_text()[-2000:]}")
            wait_for_the_end(run)
            after = records(folder)
            compare_records(before, after, counted)
            kept += len(before)
            # a machine that has become slower: kills are meant to come at every stage of a run
            within = lasts if len(after) > len(before) else 1.5 * within
            before = after
            print(f"kill {done} of {kills}, run {runs}: {len(after)} episodes", flush=True)
        check_end(folder, expected)
    rate = ", ".join(f"{modes[m]} of {m}" for m in MODES)
    print(f"{done} kills ({rate}) in {runs} runs, {time.monotonic() - began:.0f} s, seed {seed}")
    print(f"records that were there before a resume and the same after it: {kept}; lost 0, played twice 0")
    print("results, tables and episodes are those of the undisturbed run; no process and no partial file is left")


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default="pretrained")
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("torture: ended by a signal"))
    policy = options.policy if not Path(options.policy).exists() else str(Path(options.policy).resolve())
    with tempfile.TemporaryDirectory(prefix="torture-") as folder:
        try:
            torture(policy, options.kills, options.threads, options.seed, Path(folder))
        except DamageError as damage:
            sys.exit(f"torture: {damage}")
        finally:
            for run in STARTED:
                for process in members(run.pid):  # nothing outlives this program
                    os.kill(process, signal.SIGKILL)


if __name__ == "__main__":
    main()
