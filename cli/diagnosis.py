"""``gaitgauge doctor POLICY``: what looks wrong with how a policy is run."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..files.writing import same_file, write_atomically
from ..policy.foreign.adapters import assumptions
from ..policy.loading import load_policy
from ..policy.robot_of import robot_for
from ..robots import load_robot
from ..studies.doctor.alternatives import toml_lines
from ..studies.doctor.diagnosis import Diagnosis, Outcome, diagnose
from .console import Terminal, make_table, print_json
from .errors import UserError
from .policies import policy_file
from .progress import ProgressDisplay

_SHOWN = 8
"""Changes that the table shows."""


_SECONDS = 2.0
"""How long each description is played unless the user says so [s]."""


def examine_policy(
    choice: str,
    *,
    contract: Path | None,
    robot: str | None,
    seconds: float | None,
    threads: int | None,
    out: Path | None,
    json_output: bool,
    trust: bool,
) -> bool:
    """Play a policy as described and otherwise, print what looks wrong and how to mend it; False where something does.

    Arguments are ``doctor``'s options.

    Raises:
        UserError: ``out`` is no ``.toml``, is ``contract`` or ``robot``, or cannot be written.
    """
    if out is not None and out.suffix != ".toml":
        raise UserError(f"--out is '{out}'; give a file that ends in .toml")
    if out is not None and any(same_file(out, given) for given in (contract, robot) if given):
        raise UserError(f"--out is '{out}', which is read as --contract or --robot; give another file")
    if out is not None and not out.absolute().parent.is_dir():
        raise UserError(f"folder '{out.parent}' of --out does not exist; create it first")
    asked = None if robot is None else load_robot(robot)
    policy = load_policy(policy_file(choice), asked, trust=trust, contract_file=contract)
    body = robot_for(policy.contract, robot)
    with ProgressDisplay(Terminal(stderr=True), "playing as described and otherwise") as display:

        def report(mistakes: int, played: int, count: int) -> None:
            text = (
                f"{played} of {count} contracts that differ in {'one thing' if mistakes == 1 else f'{mistakes} things'}"
            )
            display.update(played / count, text)

        found = diagnose(
            policy, body, seconds=seconds or _SECONDS, threads=threads or os.cpu_count() or 1, report=report
        )
    lines = toml_lines(found.best.contract, policy.contract)
    if out is not None:
        lines_of_file = [f"# {found.verdict()}", *toml_lines(found.best.contract)]
        write_atomically(out, "\n".join(lines_of_file) + "\n", UserError)
    if json_output:
        print_json(_as_data(found, lines, assumptions(policy.contract)))
        return found.sound
    console = Terminal()
    console.print(_table(choice, found))
    console.say(found.verdict())
    if lines:
        console.say("lines of contract.toml to change:")
        for line in lines:
            console.say(f"  {line}")
        if out is None:
            console.say(
                "--out contract.toml writes the whole file; then: gaitgauge import POLICY NAME.gauge.pt --contract contract.toml"
            )
    if out is not None:
        console.say(f"wrote {out}")
    return found.sound


def _table(choice: str, found: Diagnosis) -> Any:
    rows: Sequence[tuple[str, Outcome]] = [
        ("as described", found.described),
        *((f"{o.kind}: {o.text}", o) for o in found.others[:_SHOWN]),
        *((f"… and {o.kind}: {o.text}", o) for o in found.mistakes[1:]),
    ]
    table = make_table(choice, "contract", "score", "stays up", "does as told", "smooth", numbers=True)
    for text, outcome in rows:
        values = (outcome.score, outcome.survival, outcome.tracking, outcome.smoothness)
        table.add_row(text, *(f"{v:.2f}" for v in values))
    return table


def _as_data(found: Diagnosis, lines: Sequence[str], assumed: str | None) -> dict[str, Any]:
    def row(outcome: Outcome) -> dict[str, Any]:
        names = ("kind", "text", "score", "survival", "tracking", "smoothness")
        return {name: getattr(outcome, name) for name in names}

    return {
        "sound": found.sound,
        "verdict": found.verdict(),
        "assumed": assumed,
        "described": row(found.described),
        "mistakes": [row(o) for o in found.mistakes],
        "others": [row(o) for o in found.others],
        "contract_lines": list(lines),
        "contract": found.best.contract.to_dict(),
    }
