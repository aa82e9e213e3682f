"""Film failures that a search found: each is played once more and drawn."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..backends.base import PhysicsState
from ..files.parsing import read_results
from ..files.writing import json_text, write_atomically
from ..robots.anatomy.body_plan import body_plan
from ..robots.rotation import rotate_inverse
from ..studies.trials.running import run_each
from ..studies.trials.scenario import Scenario, load_scenario
from ..studies.worst.prepared import PreparedSearch
from .drawing import Shot, draw, processes_for
from .errors import UserError
from .overlay import annotate
from .picture import Follower, Quality, Tile
from .play_session import Command, Readout
from .recording import CLIP_SIZE
from .scenery import visual_model
from .video import film

_EVERY = 4
"""Control steps for each picture."""
_HELD = 6
"""Pictures for which the last one stays."""


def film_failures(
    prepared: PreparedSearch, folder: Path, quality: Quality, progress: Callable[[float, str], None]
) -> dict[str, Any]:
    """Film the gallery of a search that has ended, and note the films in its ``worst.json``; return that file's content.

    Films that are there are not made again.

    Raises:
        UserError: a film cannot be written.
    """
    results: dict[str, Any] = read_results(folder / "worst.json", "results", UserError)
    (folder / "films").mkdir(exist_ok=True)
    ranked = [failure for failure in results["failures"] if failure["rank"] is not None]
    for done, failure in enumerate(ranked):
        progress(done / len(ranked), f"film {done + 1} of {len(ranked)}")
        path = folder / "films" / f"{failure['name']}-{'-'.join(failure['factors'])}.webp"
        if not path.is_file():
            scenario = load_scenario(str(folder / failure["scenario"]))
            film_scenario(path, prepared, scenario, f"{failure['rank']}: {', '.join(failure['factors'])}", quality)
        failure["film"] = f"films/{path.name}"
    write_atomically(folder / "worst.json", json_text(results), UserError)
    return results


def film_scenario(path: Path, prepared: PreparedSearch, scenario: Scenario, place: str, quality: Quality) -> None:
    """Play a scenario with seed 0 and film it."""
    period = prepared.loaded.policy.contract.control_period
    label, robot = prepared.label, prepared.robot
    poses: list[np.ndarray] = []
    readouts: list[Readout] = []

    def watch(state: PhysicsState, moving: torch.Tensor) -> None:
        del moving
        parts = (state.base_position_w, state.base_quaternion_w, state.joint_position)
        poses.append(torch.cat([part[0].double() for part in parts]).cpu().numpy())
        forward, left, _ = rotate_inverse(state.base_quaternion_w, state.base_linear_velocity_w)[0].tolist()
        now = len(poses) * period
        readouts.append(
            Readout(
                label=label,
                place=f"{place} (pushed)" if is_pushed(scenario, now) else place,
                friction=round(friction_at(scenario, now), 2),
                time=now,
                command=command_at(scenario, now),
                speed=(forward, left, float(state.base_angular_velocity_b[0, 2])),
                falls=0,
                arrivals=0,
            )
        )

    make = partial(prepared.engine.worlds, threads=1)
    run_each(prepared.loaded.policy, robot, [(scenario, 0)], backend=make, device=prepared.engine.device, watch=watch)
    load = None if scenario.payload is None else (scenario.payload.kilograms, scenario.payload.place)
    model = visual_model(robot, scenario.terrain(), quality, load)
    tile = Tile(
        model=model,
        heading=scenario.start.yaw,
        leg_length=body_plan(robot).leg_length,
        ground_shadows=quality.ground_shadows,
    )
    follower, shots = Follower(), []
    for pose, readout in list(zip(poses, readouts, strict=True))[::_EVERY]:
        shots.append(Shot(poses=[(pose, follower.follow(pose, _EVERY * period))], note=readout))
    with (
        film(path, fps=1.0 / (_EVERY * period), size=CLIP_SIZE) as add,
        closing(draw([tile], CLIP_SIZE, [*shots, *[shots[-1]] * _HELD], processes_for(len(shots), quality))) as drawn,
    ):
        for picture, readout in drawn:
            add(annotate(picture, [readout]))


def command_at(scenario: Scenario, time: float) -> Command:
    """Return the command at a time after the start [s] of a scenario in which every phase takes its whole time."""
    for phase in scenario.commands:
        time -= phase.seconds
        if time <= 1e-9:
            return phase.velocity
    return 0.0, 0.0, 0.0


def friction_at(scenario: Scenario, time: float) -> float:
    """Return the friction of the ground at a time after the start [s]."""
    acting = [p.friction for p in scenario.patches if p.begin < time <= p.begin + p.seconds]
    return acting[-1] if acting else scenario.friction


def is_pushed(scenario: Scenario, time: float) -> bool:
    """Return whether a push of fixed time acts at a time after the start [s]."""
    return any(force.begin[0] < time <= force.begin[0] + force.seconds[0] for force in scenario.forces)
