"""Print how well terrains and commands can be told apart inside policies (``gaitgauge latent``)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..studies.latent.figures import SPACES, label
from ..studies.latent.request import LatentRequest
from ..studies.latent.study import PAIRS, study_latents
from .console import Terminal, make_table
from .studies import make_study


def run_latent(request: LatentRequest, *, out: Path | None, json_output: bool) -> None:
    """Walk, look, print tables and where the files are; exit code 1 where something was left out."""
    names = ("latent", "latent.json", "looking")
    make_study(*names, study_latents, print_latents, request, out=out, json_output=json_output)


def print_latents(console: Terminal, results: Mapping[str, Any]) -> None:
    """Print a table for terrains and one for commands, then a sentence on the experts of each policy."""
    for pair, words in PAIRS.items():
        columns = ("policy", "of what", "silhouette", "probe", "guessing", *map(label, results[pair]))
        table = make_table(f"{pair} told apart: {words}", *columns, numbers=True)
        table.columns[1].justify = "left"
        for entry in results["policies"]:
            for space, name in SPACES.items():
                if (found := entry[pair].get(space)) is not None:
                    numbers = (found["silhouette"], found["probe"], found["chance"], *found["recall"].values())
                    table.add_row(entry["label"], name, *(f"{n:.2f}" for n in numbers))
        if table.row_count:
            console.print(table)
    for entry in results["policies"]:
        if (experts := entry["experts"]) is None:
            console.say(f"{entry['label']} has no experts, so there are no weights of them to show")
        else:
            count = len(next(iter(experts["terrains"].values())))
            shares = f"{experts['at_once']:.1f} of {count} experts count at once, {experts['in_all']:.1f} in all"
            console.say(f"{entry['label']}: {shares}")
        if entry["falls"]:
            fell = f"{entry['falls']} of {entry['walkers']} robots fell"
            console.say(f"{entry['label']}: {fell}, and were not watched further")
