"""Episodes in MuJoCo: what happens in one depends on nothing but itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from gaitgauge.backends import Scene, make_backend
from gaitgauge.gauge.episodes import Episode
from gaitgauge.gauge.runner import EpisodeRunner
from gaitgauge.gauge.suite import Goal, load_suite
from gaitgauge.terrains.registry import make_terrain
from scripted_gauge import GO2, MAXIMUM, TARGET, Agenda, ScriptedPolicy

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
def test_an_episode_is_the_same_to_the_last_bit_in_any_slot_order_and_number_of_threads(name):
    suite = load_suite(name)
    goals = (
        suite.goals[0],
        Goal(name=MAXIMUM, phases=(0.2, 0.1)),
        Goal(name=TARGET, phases=()),
    )
    commands = replace(suite.commands, target_time=dict.fromkeys(suite.commands.target_time, 0.6))
    settling = replace(suite.settling, longest=0.3)
    suite = replace(suite, goals=goals, commands=commands, settling=settling)

    def play(order, slots, threads):
        scene = Scene(
            robot=GO2,
            parameters=GO2.parameters[suite.parameters],
            terrains=tuple(make_terrain(*ground) for ground in GROUNDS),
            terrain_index=(0,) * slots,
            physics=suite.physics,
        )
        backend = make_backend("mujoco", scene, threads=threads)
        agenda = Agenda([episodes()[i] for i in order])
        runner = EpisodeRunner(suite, ScriptedPolicy(twitching), backend, lambda e: GROUNDS.index((e.terrain, e.level)))
        runner.run(agenda)
        backend.close()
        return {r.episode: r for r in agenda.records}

    count = len(episodes())
    alone = play(range(count), 1, 1)
    assert len(alone) == count
    assert all(len(r.samples) > 10 for e, r in alone.items() if e.stage == "eval")
    for order, slots, threads in ((range(count), 3, 1), (range(count)[::-1], 4, 2), (range(count), 16, 2)):
        other = play(order, slots, threads)
        for e, record in alone.items():
            assert record.summary() == other[e].summary(), e
            assert record.samples.tobytes() == other[e].samples.tobytes(), e
            assert record.part_index.tobytes() == other[e].part_index.tobytes(), e


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", "mujoco-warp"])
def test_what_happens_in_physics_does_not_depend_on_how_often_somebody_looks(engine):
    """As on a GPU: who ends, or goes back to its spawn, stands still until the next look."""
    suite = load_suite("robogauge-1.1")
    goals = (Goal(name=MAXIMUM, phases=(0.2, 0.1)), Goal(name=TARGET, phases=()))
    commands = replace(suite.commands, target_time=dict.fromkeys(suite.commands.target_time, 0.4))
    suite = replace(suite, goals=goals, commands=commands, settling=replace(suite.settling, longest=0.3))
    grounds = GROUNDS[:3]
    chosen = [e for e in episodes() if (e.terrain, e.level) in grounds]

    def play(look_interval):
        scene = Scene(
            robot=GO2,
            parameters=GO2.parameters[suite.parameters],
            terrains=tuple(make_terrain(*ground) for ground in grounds),
            terrain_index=(0,) * 9,
            physics=suite.physics,
        )
        backend, agenda = make_backend(engine, scene), Agenda(chosen)
        policy, index = ScriptedPolicy(twitching), lambda e: grounds.index((e.terrain, e.level))
        runner = EpisodeRunner(suite, policy, backend, index, look_interval=look_interval)
        runner._slots._table._together = look_interval is not None
        runner.run(agenda)
        backend.close()
        return {r.episode: r for r in agenda.records}

    often = play(1)
    assert len(often) == len(chosen) == 5
    for interval in (None, 7):
        other = play(interval)
        for e, record in often.items():
            assert record.summary() == other[e].summary(), (e, interval)
            # the same samples; what they are worth may differ in the last bit, which depends on how many are evaluated at once
            np.testing.assert_allclose(record.samples, other[e].samples, rtol=1e-5, atol=1e-6)
