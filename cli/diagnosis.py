"""Examine how a policy is run (``gaitgauge doctor POLICY``)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..files.choices import cpu_threads
from ..files.writing import same_file, write_atomically
from ..policy.foreign.adapters import assumptions
from ..policy.foreign.described import toml_lines
from ..policy.foreign.readers import contract_beside
from ..studies.doctor.diagnosis import Diagnosis, Outcome, diagnose
from .console import Terminal, make_table, print_json
from .errors import UserError
from .policies import open_policy, policy_file
from .progress import ProgressDisplay
from .requests import DoctorRequest

_SHOWN = 8
"""Changes that the table shows."""
_SECONDS = 2.0
"""Time for which each description is played unless the user asks for another [s]."""


def examine_policy(choice: str, request: DoctorRequest) -> bool:
    """Play a policy as described and otherwise, print what looks wrong and how to mend it; return False where something does.

    Raises:
        UserError: ``out`` is no ``.toml``, is ``contract`` or ``robot``, or cannot be written.
    """
    out, contract = request.out, request.contract
    if out is not None:
        if out.suffix != ".toml":
            raise UserError(f"--out is '{out}'; give a file that ends in .toml")
        if any(same_file(out, given) for given in (contract, request.robot) if given):
            raise UserError(f"--out is '{out}', which is read as --contract or --robot; give another file")
        if (beside := contract_beside(policy_file(choice))) and same_file(out, beside):
            raise UserError(
                f"--out is '{out}', the contract that lies beside the policy and is read; give another file"
            )
        if not out.absolute().parent.is_dir():
            raise UserError(f"folder '{out.parent}' of --out does not exist; create it first")
    policy, body = open_policy(choice, request.robot, trust=request.trust, contract_file=contract)
    with ProgressDisplay(Terminal(stderr=True), "playing as described and otherwise") as display:

        def report(mistakes: int, count: int, played: int) -> None:
            things = "one thing" if mistakes == 1 else f"{mistakes} things"
            display.update(played / count, f"{played} of {count} contracts that differ in {things}")

        seconds, threads = request.seconds or _SECONDS, cpu_threads(request.threads)
        found = diagnose(policy, body, seconds=seconds, threads=threads, report=report)
    lines = toml_lines(found.best.contract, policy.contract)
    if out is not None:
        whole = "\n".join([f"# {found.verdict()}", *toml_lines(found.best.contract)])
        write_atomically(out, f"{whole}\n", UserError)
    if request.json_output:
        print_json(_as_data(found, lines, assumptions(policy.contract)))
        return found.sound
    console = Terminal()
    console.print(_table(choice, found))
    console.say(found.verdict())
    if lines:
        console.say("lines of contract.toml to change:")
        console.say("\n".join(f"  {line}" for line in lines))
        if out is None:
            again = "gaitgauge import POLICY NAME.gauge.pt --contract contract.toml"
            console.say(f"--out contract.toml writes the whole file; then: {again}")
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
