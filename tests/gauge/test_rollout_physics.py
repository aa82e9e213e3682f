"""Episodes in MuJoCo: what happens in one depends on nothing but itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from gaitgauge.backends import Scene, make_backend
from gaitgauge.gauge.episodes import Episode
from gaitgauge.gauge.play.rollout import Rollout
from gaitgauge.gauge.suite import Goal, load_suite
from gaitgauge.terrains.registry import make_terrain
from scripted_gauge import GO2, MAXIMUM, TARGET, ScriptedPolicy, to_the_end

GROUNDS = [("flat", 0), ("stairs_fd", 4), ("obstacle", 7), ("slope_bd", 9), ("wave", 6)]


def twitching(observation):
    """A stumbling gait from the observations, entry by entry: no row and no batch size shows in it."""
    return torch.tanh(1.5 * observation[:, 9:21] + observation[:, 21:33] + 0.3 * observation[:, 33:45])


def episodes():
    made = []
    for number, (terrain, level) in enumerate(GROUNDS):
        for stage, goal in (("eval", MAXIMUM), ("search", TARGET)):
            if stage == "search" and terrain == "flat":
                continue
            made.append(
                Episode(
                    terrain=terrain,
                    level=level,
                    friction=0.2 + 0.2 * number,
                    payload=float(number - 1),
                    seed=number,
                    stage=stage,
                    goals=(goal,),
                )
            )
    return made


@pytest.mark.slow
@pytest.mark.parametrize("name", ["robogauge-1.1", "gaitgauge-1"])
def test_an_episode_is_the_same_to_the_last_bit_in_any_world_order_and_number_of_threads(name):
    suite = load_suite(name)
    goals = (
        suite.goals[0],
        Goal(name=MAXIMUM, phases=(0.2, 0.1)),
        Goal(name=TARGET, phases=()),
    )
    commands = replace(suite.commands, target_time=dict.fromkeys(suite.commands.target_time, 0.6))
    settling = replace(suite.settling, longest=0.3)
    suite = replace(suite, goals=goals, commands=commands, settling=settling)

    def play(order, worlds, threads):
        scene = Scene(
            robot=GO2,
            parameters=GO2.parameters[suite.parameters],
            terrains=tuple(make_terrain(*ground) for ground in GROUNDS),
            terrain_index=(0,) * worlds,
            physics=suite.physics,
        )
        backend = make_backend("mujoco", scene, threads=threads)
        rollout = Rollout(suite, ScriptedPolicy(twitching), backend, lambda e: GROUNDS.index((e.terrain, e.level)))
        rollout.play([episodes()[i] for i in order])
        records = to_the_end(rollout)
        backend.close()
        return {r.episode: r for r in records}

    count = len(episodes())
    alone = play(range(count), 1, 1)
    assert len(alone) == count
    assert all(len(r.samples) > 10 for e, r in alone.items() if e.stage == "eval")
    for order, worlds, threads in ((range(count), 3, 1), (range(count)[::-1], 4, 2), (range(count), 16, 2)):
        other = play(order, worlds, threads)
        for e, record in alone.items():
            assert record.summary() == other[e].summary(), e
            assert record.samples.tobytes() == other[e].samples.tobytes(), e
            assert record.part_index.tobytes() == other[e].part_index.tobytes(), e


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", "mujoco-warp"])
def test_what_happens_in_physics_does_not_depend_on_the_poll_interval(engine):
    """As on a GPU: a robot whose segment ends, or that goes back to its spawn, stands still until the next poll."""
    suite = load_suite("robogauge-1.1")
    goals = (Goal(name=MAXIMUM, phases=(0.2, 0.1)), Goal(name=TARGET, phases=()))
    commands = replace(suite.commands, target_time=dict.fromkeys(suite.commands.target_time, 0.4))
    suite = replace(suite, goals=goals, commands=commands, settling=replace(suite.settling, longest=0.3))
    grounds = GROUNDS[:3]
    chosen = [e for e in episodes() if (e.terrain, e.level) in grounds]

    def play(poll_interval):
        scene = Scene(
            robot=GO2,
            parameters=GO2.parameters[suite.parameters],
            terrains=tuple(make_terrain(*ground) for ground in grounds),
            terrain_index=(0,) * 9,
            physics=suite.physics,
        )
        backend = make_backend(engine, scene)
        policy, index = ScriptedPolicy(twitching), lambda e: grounds.index((e.terrain, e.level))
        rollout = Rollout(suite, policy, backend, index, poll_interval=poll_interval)
        rollout.play(chosen)
        records = to_the_end(rollout)
        backend.close()
        return {r.episode: r for r in records}

    often = play(1)
    assert len(often) == len(chosen) == 5
    for interval in (3, 7):
        other = play(interval)
        for e, record in often.items():
            assert record.summary() == other[e].summary(), (e, interval)
            # the same samples; what they are worth may differ in the last bit, which depends on how many are evaluated at once
            np.testing.assert_allclose(record.samples, other[e].samples, rtol=1e-5, atol=1e-6)
