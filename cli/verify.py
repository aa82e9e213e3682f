"""``gaitgauge verify``: plays a score card again and says whether it holds on this machine."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import typer

from ..backends.registry import choose_device
from ..files.parsing import shown
from ..studies.cards.verify import prepare_replay, verify
from ..studies.compare.comparison import load_result
from ..studies.naming import distinct_names, folder_name
from .console import Terminal, print_json
from .evaluate import shower
from .requests import VerifyRequest
from .studies import resumable


def run_verification(asked: VerifyRequest) -> None:
    """Replay, show progress, print whether the card holds; exit code 1 where it does not."""
    content, place, fresh = load_result(asked.card), asked.card.resolve(), asked.fresh
    kept = {
        name: getattr(asked, name) for name in ("policy", "suite", "threads", "quick", "fresh", "trust", "contract")
    }
    beside, device = place if place.is_dir() else place.parent, choose_device(content.backend, asked.device)
    prepared = prepare_replay(content, beside=beside, device=device, **kept)
    (name,) = distinct_names([str(place.parent if place.name == "results.json" else place)])
    kind = "-quick" * asked.quick + ("" if fresh is None else f"-fresh-{fresh}")
    folder = asked.out or Path("results") / f"verify-{folder_name(name)}{kind}"
    with resumable(Terminal(stderr=True), "gauging", folder) as display:
        command = ["gaitgauge", *sys.argv[1:]]
        found = verify(content, prepared, folder, fresh=fresh, command=command, watch=shower(display))
    if asked.json_output:
        print_json(found)
    else:
        _print_verification(Terminal(), found, asked)
    if not found["holds"]:
        raise typer.Exit(1)


def _print_verification(console: Terminal, found: Mapping[str, Any], asked: VerifyRequest) -> None:
    """Print what was played, what differs, and whether the card holds."""
    for item in found["levels"]:
        where = f"{item['terrain']}, friction {item['friction']:g}, payload {item['payload']:g} kg"
        console.say(f"{where}: level {item['card']} on the card, {item['here']} here")
    played, whole = found["environments"]
    other_seeds = "" if asked.fresh is None else " with other seeds"
    if found["quick"]:
        console.say(f"{played} of {whole} rows were played{other_seeds}, none of the others was checked")
    else:
        console.say(f"all {whole} rows were played{other_seeds}")
    if found["score"] is not None:
        band = "no interval" if found["band"] is None else "a replay within {:.4f} to {:.4f}".format(*found["band"])
        of_rows = " of these rows" * found["quick"]
        console.say(f"score{of_rows} on the card {found['score']:.4f} ({band}), here {found['replayed']:.4f}")
    for item in found["settings"]:
        console.say(f"{item['name']}: {shown(item['card'])} on the card, {shown(item['here'])} here")
    if found["unlike"]:
        console.say(f"card and replay were made with other versions: {'; '.join(found['unlike'])}")
    higher = found["band"] is not None and found["replayed"] > found["band"][1]
    if found["settings"]:
        verdict = "does NOT hold: it says of policy or physics what is not so here"
    elif found["edited"]:
        same, runs = found["runs"]
        verdict = (
            f"does NOT hold: {same} of {runs} runs came out here as well, but not all of {_listed(found['edited'])}"
        )
    elif found["figures"]:
        verdict = f"does NOT hold: chance does not explain its {_listed(found['figures'])}"
        if found["runs"][0] == found["runs"][1]:
            verdict = f"does NOT hold: every outcome is the same, but not its {_listed(found['figures'])}"
    elif found["equal"]:
        verdict = "holds: every outcome is the same to the last digit"
    elif found["holds"]:
        same = "score and figures lie within their bands, single outcomes differ"
        verdict = f"holds: {'with other seeds the score is higher still' if higher else same}"
    elif asked.fresh is not None:
        verdict = "does NOT hold with other seeds: its score owes something to those that everybody knows"
    else:
        verdict = "does NOT hold on this machine"
    if found["quick"] and found["holds"]:
        verdict = verdict.replace("holds:", "holds in these rows:")
    console.say(f"the card {verdict}")


def _listed(names: Sequence[str]) -> str:
    """Return a few names in words."""
    return "; ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
