"""The latents of several policies: ``latent.json``, ``points.csv``, three figures and ``latent.html``."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...backends.base import BackendError
from ...backends.registry import find_backend
from ...files.choices import cpu_threads
from ...files.provenance import provenance
from ...files.writing import csv_text, json_text, write_files
from ...gauge.pipelines import check_friction
from ...gauge.play.remaining import Stage
from ...gauge.suite import Suite, SuiteError, load_suite
from ...policy.base import PolicyError
from ...policy.contract import ContractError
from ...robots import RobotError
from ...terrains.base import Terrain
from ...terrains.registry import gauge_terrain_names, make_terrain
from ..policies import Loaded, describe, load_policies
from ..turns import Turns, Watch
from .collecting import COMMANDS, Notes, collect
from .figures import FIGURES, Points, draw, render_figure, render_page
from .request import LatentRequest
from .separation import Separation, principal_components, separation

PAIRS = {"terrains": "forward on every terrain", "commands": "every command on all terrains"}
"""Classes of the two figures, as in the paper."""
_WALKING = 0.8
"""Share of the time of a policy in which it walks; then its latents are told apart and drawn."""
STRIDES = 10
"""Notes that a mean is taken over: a second, in which a robot takes two to three strides."""


class LatentError(ValueError):
    """Nothing of what was asked for can be looked at."""


def study_latents(
    request: LatentRequest, folder: Path, *, command: Sequence[str] = (), watch: Watch = lambda _: None
) -> dict[str, Any]:
    """Look at the latents of some policies. What cannot be looked at is said under ``refused``; the others are.

    Returns the content of ``latent.json`` (docs/guides/latent.md).

    Raises:
        LatentError: no policy has anything to look at.
        BackendError, RobotError, SuiteError, TerrainError: no such engine, robot, suite or terrain.
    """
    began = time.perf_counter()
    find_backend(request.backend, "cpu")
    suite, terrains = _ground(request)
    policies, refused = load_policies(
        request.policies, request.robot, trust=request.trust, contract_file=request.contract
    )
    entries: list[dict[str, Any]] = []
    points: list[tuple[str, Notes, dict[str, NDArray[np.float64]]]] = []
    turns = Turns(watch, [Stage(label, 1.0) for label in policies])
    for label, loaded in policies.items():
        turns.begin(label)
        try:
            notes = collect(
                loaded.policy, loaded.robot, request, suite, terrains, told=lambda done: turns.step(_WALKING * done)
            )
            entry, places = look(label, loaded, notes, [t.name for t in terrains])
        except (PolicyError, ContractError, BackendError, RobotError, SuiteError, LatentError) as error:
            refused.append({"what": label, "reason": str(error)})
        else:
            entries.append(entry)
            points.append((label, notes, places))
    if not entries:
        raise LatentError("; ".join(r["reason"] for r in refused) or "there is nothing to look at; name a policy")
    if len(terrains) == 1:
        only = f"'{terrains[0].name}' is the only terrain, so there is nothing to tell it from"
        refused.append({"what": "telling terrains apart", "reason": f"{only}; name more of them with --terrain"})
    results = {
        "schema": 1,
        "policies": entries,
        "terrains": [t.name for t in terrains],
        "commands": list(COMMANDS),
        "level": request.level,
        "friction": request.friction,
        "seconds": request.seconds,
        "robots": request.robots,
        "suite": {"name": suite.name, "version": suite.version, "digest": suite.digest},
        "refused": refused,
        "backend": request.backend,
        "provenance": provenance(
            command=command, threads=cpu_threads(request.threads), seconds=round(time.perf_counter() - began, 2)
        ),
    }
    drawings = {name: drawing for name in FIGURES if (drawing := draw(name, results, points))}
    texts = {f"latent-{name}.svg": render_figure(drawing) for name, drawing in drawings.items()}
    texts |= {"points.csv": as_csv(results, points), "latent.html": render_page(results, drawings)}
    write_files(folder, texts | {"latent.json": json_text(results)}, LatentError)
    return results


def _ground(request: LatentRequest) -> tuple[Suite, tuple[Terrain, ...]]:
    """The rules, and what is walked on."""
    suite = load_suite(request.suite)
    if suite.ground is not None:
        raise SuiteError(
            f"suite '{suite.name}' builds its ground in each robot's own measure, and latents are compared on one ground; give "
            "another --suite"
        )
    check_friction(request.friction)
    names = request.terrains or tuple(gauge_terrain_names())
    terrains = tuple(make_terrain(n, None if n == "flat" else request.level) for n in dict.fromkeys(names))
    for terrain in terrains:
        if "level_eval" not in terrain.spawns:
            raise SuiteError(f"terrain '{terrain.name}' has no spawn 'level_eval'; add it, or choose another terrain")
    return suite, terrains


def look(
    label: str, loaded: Loaded, notes: Notes, terrains: Sequence[str]
) -> tuple[dict[str, Any], dict[str, NDArray[np.float64]]]:
    """What ``latent.json`` says of a policy, and its points on the principal axes by figure, (N, 2); NaN where a point is not
    part of it.

    Raises:
        LatentError: on some terrain, or with some command, every robot fell before anything could be noted; or all but one did
            everywhere.
    """
    forward = notes.command == list(COMMANDS).index("forward")
    chosen = {"terrains": forward, "commands": np.ones(len(notes.time), dtype=bool)}
    classes = {"terrains": notes.terrain, "commands": notes.command}
    names = {"terrains": terrains, "commands": list(COMMANDS)}
    spaces = {"latent": notes.latent, "experts": notes.weights, "input": notes.history}
    blocks = _blocks(notes, STRIDES)
    counts = {"walkers": notes.walkers, "falls": notes.falls, "samples": len(notes.time)}
    entry: dict[str, Any] = describe(label, loaded) | counts
    places: dict[str, NDArray[np.float64]] = {}
    for pair, rows in chosen.items():
        found: dict[str, Any] = entry.setdefault(pair, {})
        if len(names[pair]) < 2:
            continue
        seen = np.bincount(classes[pair][rows], minlength=len(names[pair]))
        if not seen.all():
            raise LatentError(
                f"'{loaded.policy.path}' fell at once on '{names[pair][int(seen.argmin())]}', so there is nothing to look at; choose "
                "other terrains or a lower --level"
            )
        left = np.unique(notes.robot[rows])
        if len(left) < 2:
            raise LatentError(
                f"with '{loaded.policy.path}' all robots but number {left[0] + 1} fell at once, and telling {pair} apart takes two, to "
                "learn from and to be tried on; choose other terrains, a lower --level or more --robots"
            )
        for space, values in spaces.items():
            if values is None:
                continue
            found[space] = _plain(separation(values[rows], classes[pair][rows], notes.robot[rows]), names[pair])
            whole = blocks[rows[blocks[:, 0]]]
            kinds, robots = classes[pair][whole[:, 0]], notes.robot[whole[:, 0]]
            if len(set(kinds)) == len(names[pair]) and len(set(robots)) > 1:
                found[f"{space}_mean"] = _plain(separation(values[whole].mean(axis=1), kinds, robots), names[pair])
        if notes.latent is not None:
            spread, shares = principal_components(notes.latent[rows])
            found["explained"] = shares.tolist()
            places[pair] = np.full((len(rows), 2), np.nan)
            places[pair][rows] = spread
    entry["experts"] = None if notes.weights is None else _experts(notes, names, chosen, classes)
    return entry, places


def _blocks(notes: Notes, count: int) -> NDArray[np.int64]:
    """Rows of ``count`` notes that follow each other of one robot, (B, count); what is left of a robot's notes is in none."""
    order = np.lexsort((notes.time, notes.robot, notes.command, notes.terrain))
    keys = np.stack((notes.terrain, notes.command, notes.robot))[:, order]
    begins = np.flatnonzero(np.append(True, (np.diff(keys) != 0).any(axis=0)))
    parts = np.split(order, begins[1:])
    return np.concatenate([part[: len(part) // count * count].reshape(-1, count) for part in parts])


def _plain(found: Separation, names: Sequence[str]) -> dict[str, Any]:
    recall = dict(zip(names, found.recall, strict=True))
    return {**asdict(found), "probe_range": list(found.probe_range), "recall": recall}


def _experts(
    notes: Notes,
    names: Mapping[str, Sequence[str]],
    chosen: Mapping[str, NDArray[np.bool_]],
    classes: Mapping[str, NDArray[np.int64]],
) -> dict[str, Any]:
    """Mean weights by terrain and by command, and how many experts are at work.

    ``at_once`` is the exponential of the mean entropy of their shares: 1 where a single expert decides at every moment, K where all
    of them always count the same. ``in_all`` is that of the mean shares' entropy: how many are used at all. A share is a weight
    divided by the sum of all, which is not 1 where experts are multiplied (MCP).
    """
    weights = notes.weights
    assert weights is not None
    shares = weights / np.maximum(weights.sum(axis=-1, keepdims=True), 1e-12)

    def entropy(parts: NDArray[np.float64]) -> NDArray[np.float64]:
        found: NDArray[np.float64] = -(parts * np.log(np.maximum(parts, 1e-12))).sum(axis=-1)
        return found

    found: dict[str, Any] = {}
    for pair, rows in chosen.items():
        masks = {name: rows & (classes[pair] == i) for i, name in enumerate(names[pair])}
        found[pair] = {name: weights[mask].mean(axis=0).tolist() for name, mask in masks.items()}
    at_once, in_all = entropy(shares).mean(), entropy(shares.mean(axis=0))
    return found | {"at_once": float(np.exp(at_once)), "in_all": float(np.exp(in_all))}


def as_csv(results: Mapping[str, Any], points: Points) -> str:
    """One row for each robot and moment: where it was, its places in both figures, its latent and the experts' weights."""
    latents = max((n.latent.shape[1] for _, n, _ in points if n.latent is not None), default=0)
    experts = max((n.weights.shape[1] for _, n, _ in points if n.weights is not None), default=0)
    axes = [f"{pair}_pc{i}" for pair in PAIRS for i in (1, 2)]
    numbered = [f"latent_{i}" for i in range(latents)] + [f"expert_{i}" for i in range(experts)]
    rows: list[Sequence[object]] = [("policy", "terrain", "command", "robot", "time", *axes, *numbered)]
    for label, notes, places in points:
        columns = [*(places.get(pair) for pair in PAIRS), notes.latent, notes.weights]
        for row in range(len(notes.time)):
            values: list[str] = []
            for column, width in zip(columns, (2, 2, latents, experts), strict=True):
                own = [] if column is None else ["" if np.isnan(v) else f"{v:.4f}" for v in column[row]]
                values += own + [""] * (width - len(own))
            terrain, told = results["terrains"][notes.terrain[row]], results["commands"][notes.command[row]]
            rows.append((label, terrain, told, notes.robot[row], f"{notes.time[row]:.2f}", *values))
    return csv_text(rows)
