"""Checks of the flags of worlds in trouble: watches, divergence, overflow."""

from __future__ import annotations

import numpy as np

from ...terrains.base import Box, Terrain
from .bench import Bench, expect
from .check import check
from .contact import lay_on_back
from .kinematics import base_up
from .reference import Reference, level_stance
from .stepping import expect_same_motion, stand, twins, wave

_BOX = Box(center=(0.0, 0.0, 0.1), half_size=(0.6, 0.6, 0.1))
BLOCK = Terrain(name="conformance_block", family="block", boxes=(_BOX,))


@check("health/tilt_watch")
def tilt_watch(bench: Bench) -> str:
    """tilt_substep is the first substep of the last step at which the base leaned further than the watched angle."""
    limit = 0.3
    with bench.worlds(bench.stiff(), watch_tilt=limit) as worlds, bench.worlds(bench.stiff()) as single:
        rate = np.zeros((worlds.count, 3))
        rate[0, 0], rate[1, 1], rate[2, 0] = 8.0, -5.0, 0.5
        rate[3, 2] = 8.0  # a yaw is no tilt
        for each in (worlds, single):
            each.reset(base_angular_velocity=rate, base_position=(0.0, 0.0, 2.0), held_target=each.default_pose)
        watched, true = [], []
        for _ in range(4):
            worlds.step()
            watched.append(worlds.read().tilt_substep)
            for _ in range(10):
                single.step(substeps=1)
                true.append(np.arccos(np.clip(base_up(single.read().base_quaternion_w)[:, 2], -1.0, 1.0)) > limit)
        for row in (0, 1):
            first = int(np.argmax(np.array(true)[:, row])) + 1
            period = next((i for i, w in enumerate(watched) if w[row]), None)
            expect(period is not None, f"tilt_substep of a tumbling world never tripped; it must at substep {first}")
            assert period is not None
            found = 10 * period + int(watched[period][row])
            # one substep of slack: the watch may look before or after each substep
            expect(abs(found - first) <= 1, f"tilt_substep tripped at substep {found} since the start, must at {first}")
            after = [int(w[row]) for w in watched[period + 1 :]]
            expect(all(w == 1 for w in after), f"tilt_substep of a world that stays tilted is {after}, must be 1")
        quiet = np.array(watched)[:, 2:]
        expect(not quiet.any(), f"tilt_substep tripped in worlds that hardly tilt: {quiet.max(axis=0)}")
        worlds.reset()
        expect(not worlds.read().tilt_substep.any(), "tilt_substep is not cleared by a reset")
    return f"tripped at substep {found}, the tilt exceeded {limit} rad at {first}"


@check("health/penetration_watch", "penetration", "boxes", "per_world_terrain")
def penetration_watch(bench: Bench) -> str:
    """penetration_substep trips for a robot deep in a box, not for one that stands on it or is deep in the floor."""
    stance = level_stance(Reference(bench.robot, bench.soft()))
    terrains, index = (Terrain(name="conformance_flat", family="block"), BLOCK), (1, 1, 0, 0)
    with bench.worlds(bench.stiff(), terrains=terrains, terrain_index=index, watch_penetration=0.02) as worlds:
        position = np.zeros((worlds.count, 3))
        position[:, 2] = 0.2 * np.array(index) + stance.height + [0.002, -0.04, 0.002, -0.04]
        worlds.reset(base_position=position, base_quaternion=stance.quaternion, held_target=worlds.default_pose)
        worlds.step()
        found = worlds.read().penetration_substep
        expect(found[1] in (1, 2), f"penetration_substep of a robot 40 mm deep in a box is {found[1]}, must be 1 or 2")
        expect(found[0] == 0, f"penetration_substep of a robot that stands on a box is {found[0]}, must be 0")
        expect(not found[2:].any(), f"penetration_substep trips at the floor, which is no terrain: {found[2:]}")
        worlds.reset()
        worlds.step()
        expect(not worlds.read().penetration_substep.any(), "penetration_substep trips in the air")
    return f"watched depth 20 mm, 40 mm deep tripped at substep {found[1]}"


@check("health/divergence")
def divergence(bench: Bench) -> str:
    """An infinite velocity or a NaN target makes its world diverged; other worlds go on untouched, a reset heals the world."""
    with twins(bench) as (worlds, untouched):
        target = wave(worlds, 0)
        poisoned = target.copy()
        poisoned[1] = np.nan
        broken = np.array([True, True, False, False])
        if bench.supports("push"):
            push = np.full((worlds.count, 3), np.nan)
            push[0] = np.inf
            worlds.push(linear_velocity_w=push)
        else:
            broken[0] = False
        worlds.step(poisoned)
        untouched.step(target)
        for each in (worlds, untouched):
            each.step()
        state, expected = worlds.read(), untouched.read()
        expect(state.diverged[broken], f"diverged is {state.diverged} after an infinite push and a NaN target")
        expect(~state.diverged[~broken], f"diverged is {state.diverged}, but nothing happened to worlds 2 and 3")
        tolerance = worlds.precision(1e-9, 2e-3)
        expect_same_motion("beside diverged worlds", state, expected, tolerance, ~broken)
        for each in (worlds, untouched):
            stand(bench, each)
        expect(not worlds.read().diverged.any(), "diverged is not cleared by a reset")
        for each in (worlds, untouched):
            each.step(target)
            each.step()
        state, expected = worlds.read(), untouched.read()
        expect(not state.diverged.any(), "a healed world diverges again")
        expect_same_motion("of healed worlds", state, expected, tolerance)
    return "2 of 4 worlds"


@check("health/no_overflow", "contact_forces")
def no_overflow(bench: Bench) -> str:
    """A robot on its back has many contacts, and no engine overflows."""
    with bench.worlds() as worlds:
        lay_on_back(bench, worlds, clearance=0.06)
        worlds.run(0.4)
        state = worlds.read()
        expect(not state.overflowed.any(), "overflowed with the engine's own contact capacity")
        expect(not state.diverged.any(), "a robot dropped on its back diverges")
        most = int(state.contact_count.max())
        expect(most >= 3, f"contact_count of a robot on its back is {most}, must be 3 at least")
    return f"{most} contact points"
