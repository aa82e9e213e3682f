"""``gaitgauge verify``: plays a score card again and says whether it holds on this machine."""

from __future__ import annotations

import sys
from pathlib import Path

import typer

from ..backends.registry import choose_device
from ..files.parsing import shown
from ..studies.cards.verify import prepare_replay, verify
from ..studies.compare.comparison import load_result
from ..studies.naming import distinct_names, folder_name
from .console import Terminal, print_json
from .evaluate import shower
from .studies import resumable


def run_verification(
    card: Path,
    *,
    policy: str | None,
    suite: str | None,
    device: str | None,
    threads: int | None,
    quick: bool,
    fresh: int | None,
    out: Path | None,
    json_output: bool,
    trust: bool,
) -> None:
    """Replay, show progress, print whether the card holds; exit code 1 where it does not."""
    content = load_result(card)
    place = card.resolve()
    prepared = prepare_replay(
        content,
        policy=policy,
        beside=place if place.is_dir() else place.parent,
        suite=suite,
        device=choose_device(content.backend, device),
        threads=threads,
        quick=quick,
        fresh=fresh,
        trust=trust,
    )
    (name,) = distinct_names([str(place.parent if place.name == "results.json" else place)])
    stem = folder_name(name)
    folder = (
        out or Path("results") / f"verify-{stem}{'-quick' if quick else ''}{'' if fresh is None else f'-fresh-{fresh}'}"
    )
    with resumable(Terminal(stderr=True), "gauging", folder) as display:
        command = ["gaitgauge", *sys.argv[1:]]
        found = verify(content, prepared, folder, fresh=fresh, command=command, watch=shower(display))
    if json_output:
        print_json(found)
    else:
        console = Terminal()
        for item in found["levels"]:
            where = f"{item['terrain']}, friction {item['friction']:g}, payload {item['payload']:g} kg"
            console.say(f"{where}: level {item['card']} on the card, {item['here']} here")
        played, whole = found["environments"]
        seeds = "" if fresh is None else ", with other seeds"
        sample = ", one of each terrain" if quick else ""
        console.say(f"played {played} of the card's {whole} environments{sample}{seeds}")
        if found["score"] is not None:
            band = "no interval" if found["band"] is None else "a replay within {:.4f} to {:.4f}".format(*found["band"])
            console.say(f"score on the card {found['score']:.4f} ({band}), here {found['replayed']:.4f}")
        for item in found["settings"]:
            console.say(f"{item['name']}: {shown(item['card'])} on the card, {shown(item['here'])} here")
        if found["unlike"]:
            console.say(f"card and replay were made with other versions: {'; '.join(found['unlike'])}")
        if found["settings"]:
            console.say("the card does NOT hold: it was made with another solver or other motors")
        elif found["figures"]:
            console.say(f"the card does NOT hold: every outcome is the same, but not its {', '.join(found['figures'])}")
        elif found["equal"]:
            console.say("the card holds: every outcome is the same to the last digit")
        elif found["holds"] and found["band"] is not None and found["replayed"] > found["band"][1]:
            console.say("the card holds: with other seeds the score is higher still")
        elif found["holds"]:
            console.say("the card holds: the score lies within its band, single outcomes differ")
        elif fresh is not None:
            console.say(
                "the card does NOT hold with other seeds: its score owes something to those that everybody knows"
            )
        else:
            console.say("the card does NOT hold on this machine")
    if not found["holds"]:
        raise typer.Exit(1)
