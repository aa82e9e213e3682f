"""The search for cheats: what a filtered policy is told, and when a gain counts."""

import itertools
import math

import cheats
import numpy as np
import pytest
import torch
from cheats import Filter, FilteredBuilder, Play, Scores, lower_bounds, random_filter
from scipy.stats import t


class Builder:
    num_episodes = 2
    forgotten = None

    def reset(self, episodes=None):
        self.forgotten = episodes


def told(change, commands, period=0.1):
    """What both worlds are told over time, of which the first is returned."""
    builder = FilteredBuilder(Builder(), change, period)
    return [builder.filtered(torch.tensor([command] * 2))[0].tolist() for command in commands]


ASKED = [(1.0, -1.0, 1.5)] * 6


def test_a_filter_scales_and_caps_each_axis():
    change = Filter(name="", scale=(0.5, 1.0, 1.0), cap=(math.inf, 0.7, 1.0))
    assert told(change, ASKED[:1])[0] == pytest.approx((0.5, -0.7, 1.0))
    assert told(cheats.NONE, ASKED[:1])[0] == list(ASKED[0])


def test_a_filter_delays_lags_and_stands_between():
    late = [c[0] for c in told(Filter(name="", delay=0.2), ASKED)]
    assert late == [0.0, 0.0, 1.0, 1.0, 1.0, 1.0]
    lagged = [c[0] for c in told(Filter(name="", lag=0.1), ASKED)]
    assert lagged == pytest.approx([1 - 0.5**k for k in range(1, 7)])
    between = [c[0] for c in told(Filter(name="", walk=0.2, stand=0.1), ASKED)]
    assert between == [1.0, 1.0, 0.0, 1.0, 1.0, 0.0]


def test_a_reset_forgets_the_past_of_its_world_alone():
    builder = FilteredBuilder(Builder(), Filter(name="", delay=0.1), 0.1)
    builder.filtered(torch.ones(2, 3))
    builder.reset(torch.tensor([True, False]))
    assert builder.filtered(torch.ones(2, 3))[:, 0].tolist() == [0.0, 1.0]


def test_random_filters_are_reproducible_and_differ():
    filters = [random_filter(index) for index in range(50)]
    assert filters == [random_filter(index) for index in range(50)]
    assert len({str(f) for f in filters}) == 50
    assert all(min(f.scale) >= 0.5 and max(f.scale) <= 1.0 and min(f.cap) >= 0.4 for f in filters)


def test_lower_bounds_are_students_with_holms_correction():
    generator = np.random.default_rng(0)
    gains = {"good": 0.01 + 0.01 * generator.standard_normal(20), "none": 0.01 * generator.standard_normal(20)}
    found = lower_bounds(gains)
    for name, level in (("good", 0.05 / 2), ("none", 0.05)):
        g = gains[name]
        expected = g.mean() - t.ppf(1 - level, 19) * g.std(ddof=1) / math.sqrt(20)
        assert found[name] == pytest.approx(expected)
    assert found["good"] > 0 > found["none"]


def test_a_listed_cheat_that_gains_somewhere_is_found(capsys):
    seeds, scores = range(5), Scores()
    for change in (cheats.NONE, *cheats.LISTED):
        for friction in cheats.FRICTIONS:
            for seed in seeds:
                worse = 0.0 if change is cheats.NONE else -0.01
                scores.found[change.name, "flat", friction, seed] = 0.7 + worse + 0.001 * seed, 0
    assert cheats.judge_listed(scores, ["flat"], seeds)
    for seed in seeds:
        scores.found["0.3 s later", "flat", 0.9, seed] = 0.703 + 0.001 * seed, 0
    assert not cheats.judge_listed(scores, ["flat"], seeds)
    assert "0.3 s later" in capsys.readouterr().out


def test_a_filter_changes_the_sub_commands_that_it_touches():
    turn, walk = torch.tensor([[0.0, 0.0, 1.5]] * 3), torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    slow_turn = Filter(name="", cap=(1.0, 1.0, 1.0))
    assert cheats.changes(slow_turn, turn, 0.02) and not cheats.changes(slow_turn, walk, 0.02)
    for change in (Filter(name="", delay=0.009), Filter(name="", walk=1.5, stand=0.009)):  # less than half a step
        assert not cheats.changes(change, walk, 0.02)
    for change in (Filter(name="", delay=0.02), Filter(name="", lag=0.001), Filter(name="", walk=1.0, stand=0.1)):
        assert cheats.changes(change, walk, 0.02)


@pytest.mark.slow
def test_sub_commands_that_a_filter_does_not_change_score_as_if_they_were_played(tmp_path):
    prepared = cheats.prepare(
        cheats.Request(policy="pretrained", suite="gaitgauge-1", frictions=(0.6,), payloads=(0.0,))
    )

    def play(change, folder):
        return cheats.play(prepared, 5, Play(change=change, terrain="flat", seeds=(1,), frictions=(0.3,)), folder)

    unfiltered = play(cheats.NONE, tmp_path)
    sideways = Filter(name="", cap=(math.inf, 0.7, math.inf))
    assert play(sideways, tmp_path) == play(sideways, None) != unfiltered
    assert play(Filter(name="", cap=(2.0, 1.0, 2.0)), tmp_path) == unfiltered


def test_jobs_that_have_ended_are_not_played_again(tmp_path, monkeypatch):
    played = []

    def play(prepared, level, wanted, folder):
        played.append(wanted.key)
        return [[f, s, 0.5, 0] for f in cheats.FRICTIONS for s in wanted.seeds]

    class Pool:
        def __init__(self, threads): ...
        def __enter__(self):
            return self

        def __exit__(self, *error): ...
        def imap_unordered(self, function, items):
            return map(function, items)

    monkeypatch.setattr(cheats, "play", play)
    monkeypatch.setattr(cheats.multiprocessing, "get_context", lambda _: type("Context", (), {"Pool": Pool}))
    monkeypatch.setattr(cheats, "_shared", {"prepared": None, "level": 5, "folder": tmp_path})
    jobs = [Play(change=cheats.NONE, terrain="flat", seeds=some) for some in cheats.chunks(range(8))]
    cheats.play_all(jobs[:1], tmp_path, 1, Scores())
    with (tmp_path / "played.jsonl").open("a") as file:
        file.write('{"key": "none | fl')  # killed while it wrote
    scores = Scores()
    cheats.play_all(jobs, tmp_path, 1, scores)
    assert played == [f"none | flat 0.3,0.6,0.9 | {first}-{first + 1}" for first in range(0, 8, 2)]
    assert len(scores.found) == 3 * 8
    cheats.play_all(jobs, tmp_path, 1, scores)
    assert len(played) == 4


def test_the_thirds_of_a_screen_are_all_places_once():
    terrains, frictions = ("flat", "wave", "stairs_fd", "obstacle"), (0.3, 0.6, 0.9)
    turns = [cheats.thirds(terrains, frictions, turn) for turn in range(3)]
    assert all([terrain for terrain, _ in turn] == list(terrains) for turn in turns)
    assert sorted(place for turn in turns for place in turn) == sorted(itertools.product(terrains, frictions))
    assert {friction for _, friction in turns[0]} == set(frictions)


def test_a_screen_tells_which_of_the_best_it_would_lose(capsys):
    """Four filters: one gains everywhere, one loses only where the first third looks."""
    scores, terrains = Scores(), ("flat", "wave", "stairs_fd")
    first = cheats.thirds(terrains, scores.frictions, 0)
    for place in itertools.product(terrains, scores.frictions):
        for name, gain in {"none": 0.0, "a": 0.1, "b": 0.2 * (place not in first) - 0.2, "c": -0.1, "d": -0.3}.items():
            scores.found[name, *place, 1] = gain, 0
    cheats.judge_screen(scores, terrains, [(name, 1) for name in "abcd"])
    assert [line.split()[2:] for line in capsys.readouterr().out.splitlines()[2:]] == [["0", "of", "1"]] * 3
    assert scores.third("b", terrains, 0, 1) == pytest.approx(-0.2) and scores.third("b", terrains, 1, 1) == 0.0
