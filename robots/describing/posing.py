"""Guess a pose in which a surveyed robot stands: one that is said, a keyframe in which it stands, else bent knees."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ...files.parsing import did_you_mean, one_line
from ..checks.standing import FOLDED
from ..loading import RobotError, fits
from .surveying import Leg, Survey

BENDS = {True: (0.95, 0.98, 0.99), False: (0.8,)}
"""Distances from hip to foot of a standing leg over that of a stretched one, for two legs and for more: 0.96 for the G1, 0.73 for
the Go2, 0.85 for ANYmal C. The later ones are for two legs that the model's own gains do not hold with more bent knees."""
_BEHIND = 0.1
"""Offset of a standing foot from its hip, away from the knee, over leg length: under load knees yield and hips follow."""
_WIDEST = 2.8
"""Largest joint angle of a pose [rad]."""


def standing_pose(survey: Survey, bend: float) -> tuple[dict[int, float], str]:
    """Return an angle for each hinge, and its origin; raise ``RobotError`` where a pose or keyframe that was asked for cannot be.

    Args:
        bend: of ``BENDS``, for a pose that has to be guessed.
    """
    angles, origin = _unasked_pose(survey, bend)
    angles = {joint: _short(survey, joint, angle) for joint, angle in angles.items()}
    if not survey.answers.pose:
        return angles, origin
    names = {joint: survey.model.joint(joint).name for joint in survey.hinges}
    said = survey.answers.pose
    for word in said:
        if not any(fits(word, name) for name in names.values()):
            hint = did_you_mean(word, list(names.values()))
            raise RobotError(
                f"the pose names '{one_line(word, 80)}', which is neither a joint nor words of its name{hint}"
            )
    for joint, name in names.items():
        if fitting := [word for word in said if fits(word, name)]:
            angles[joint] = angle = float(said[max(fitting, key=len)])
            low, high = survey.model.jnt_range[joint]
            if survey.model.jnt_limited[joint] and not low <= angle <= high:
                raise RobotError(
                    f"the pose has '{name}' at {angle:g} rad, outside its range {low:g} to {high:g} rad; give an angle within it"
                )
    every = all(any(fits(word, name) for word in said) for name in names.values())
    return angles, "as said" if every else f"as said for {', '.join(said)}; else {origin}"


def _unasked_pose(survey: Survey, bend: float) -> tuple[dict[int, float], str]:
    model, asked = survey.model, survey.answers.keyframe
    names = [model.key(key).name or str(key) for key in range(model.nkey)]
    if asked is not None and asked not in names:
        choice = f"it has {', '.join(names)}" if names else "it has none"
        raise RobotError(f"'{one_line(survey.path)}' has no keyframe '{one_line(asked, 80)}'; {choice} (--keyframe)")
    usual = [name for name in names if any(word in name.lower() for word in ("home", "stand", "default"))]
    lying: list[str] = []
    for name in (asked,) if asked is not None else dict.fromkeys((*usual, *names)):
        key = names.index(name)
        angles = within(survey, {j: float(model.key_qpos[key, model.jnt_qposadr[j]]) for j in survey.hinges})
        folded = folded_legs(survey, angles)
        if not folded or asked is not None:
            left = f"; not of {', '.join(lying)}, in which the robot lies" if lying else ""
            return angles, f"of the model's keyframe '{name}'{left}"
        lying.append(f"'{name}'")
    angles = within(survey, dict.fromkeys(survey.hinges, 0.0))
    for _ in range(3):  # the legs move the centre of mass, over which two feet stand
        bent = dict(angles)
        for leg in survey.legs:
            bent |= _bent(survey, leg, angles, bend)
        angles = bent
        if len(survey.legs) > 2:
            break
    where = (
        "feet below the centre of mass"
        if len(survey.legs) == 2
        else "feet below the hips, a little behind them where knees are behind"
    )
    left = f"; the robot lies in {', '.join(lying)}, its keyframes" if lying else ""
    return angles, f"guessed: knees bent, {where}{left}"


def folded_legs(survey: Survey, angles: dict[int, float]) -> list[int]:
    """Return the legs, by place, with a hip under half of the leg's length above the foot's lowest point in a pose."""
    survey.place(angles)
    lowest, data = -survey.feet_depth(), survey.data
    return [
        place
        for place, leg in enumerate(survey.legs)
        if float(data.xanchor[leg.joints[0], 2]) - lowest < FOLDED * survey.leg_length(leg)
    ]


def within(survey: Survey, angles: dict[int, float]) -> dict[int, float]:
    """Return angles clipped to the joints' ranges."""
    return {j: float(np.clip(angle, *_bounds(survey, j))) for j, angle in angles.items()}


def _bounds(survey: Survey, joint: int) -> tuple[float, float]:
    model = survey.model
    low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-_WIDEST, _WIDEST)
    return float(max(low, -_WIDEST)), float(min(high, _WIDEST))


def _short(survey: Survey, joint: int, angle: float) -> float:
    """Return an angle with four digits, or with all where these lie beyond the joint's range."""
    low, high = _bounds(survey, joint)
    return short if low <= (short := round(angle, 4)) <= high else angle


def _bent(survey: Survey, leg: Leg, pose: dict[int, float], bend: float) -> dict[int, float]:
    """Return the leg's angles with the foot below the hip, or below the centre of mass of a biped, the knee behind rather than in
    front of four legs and in front of two, and the sole level.
    """
    survey.place(pose)
    two, bends = survey.plan in ("biped", "humanoid"), survey.bends(leg)
    if len(bends) < 2:
        return {}
    hip, knee = bends[:2]
    ankle = bends[2] if len(bends) > 2 else None
    data, level = survey.data, {}
    over = 0.0
    if two:
        survey.mujoco.mj_comPos(survey.model, data)
        over = float(data.subtree_com[survey.base, 0] - data.xanchor[hip, 0])

    grid = np.linspace(*_bounds(survey, knee), 181)
    across = data.xaxis[hip].copy()
    turned = {j: float(np.sign(data.xaxis[j] @ across)) for j in bends}

    def placed(swing: float, bent: float) -> dict[int, float]:
        made = {**pose, hip: swing, knee: bent}
        if ankle is not None:  # a level sole: the turns of hip, knee and ankle cancel out
            low, high = _bounds(survey, ankle)
            made[ankle] = float(np.clip(-turned[ankle] * (turned[hip] * swing + turned[knee] * bent), low, high))
        return made

    def reach(bent: float, swing: float) -> NDArray[np.float64]:
        level.update(placed(swing, bent))
        survey.place(level)
        return survey.foot_center(leg) - data.xanchor[hip]

    lengths = []
    for angle in grid:
        foot = reach(float(angle), pose[hip])
        lengths.append(float(np.linalg.norm(foot - across * (foot @ across))))
    stretched = int(np.argmax(lengths))
    wanted = bend * lengths[stretched]
    found: list[tuple[float, bool, dict[int, float]]] = []
    for side in (range(stretched + 1), range(stretched, len(grid))):
        nearest = min(side, key=lambda i: abs(lengths[i] - wanted))
        bent = float(grid[nearest])
        for in_front, aside in ((False, -_BEHIND), (True, _BEHIND)):
            way = over if two else aside * lengths[stretched]
            swing, apart = _below(survey, hip, partial(reach, bent), way)
            reach(bent, swing)
            if in_front == bool(data.xanchor[knee][0] > data.xanchor[hip][0]):
                break
        wrong = in_front is not two
        found.append(
            (round(apart + abs(lengths[nearest] - wanted), 2), wrong, {j: level[j] for j in bends[:3] if j in level})
        )
    # a leg that cannot bend so, or a foot that cannot come below its hip, is worse than a knee on the other side
    return min(found, key=lambda each: each[:2])[2]


def _below(
    survey: Survey, hip: int, reach: Callable[[float], NDArray[np.float64]], aside: float
) -> tuple[float, float]:
    """Return the hip's angle that puts the foot below it and ``aside`` before it [m], and the distance that remains [m]."""
    low, high = _bounds(survey, hip)
    found = (0.5 * (low + high), np.inf)
    for _ in range(3):  # finer each time
        feet = [(float(angle), reach(float(angle))) for angle in np.linspace(low, high, 101)]
        below = [(angle, abs(float(foot[0]) - aside)) for angle, foot in feet if foot[2] < 0.0]
        found = min([found, *below], key=lambda each: each[1])
        step = (high - low) / 50
        low, high = max(found[0] - step, low), min(found[0] + step, high)
    return found
