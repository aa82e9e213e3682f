"""Assignment of tiles, moves between levels, and where worlds end up."""

from dataclasses import replace

import pytest
import torch
from gaitgauge.terrains import TerrainError
from gaitgauge.training.environment.configuration import (
    CommandConfiguration,
    CommandStage,
    Ramp,
    ScheduleConfiguration,
    TerminationConfiguration,
)
from gaitgauge.training.environment.curriculum import assign_kinds, build_palette, next_level
from gaitgauge.training.environment.terrain_configuration import (
    ALL_TILES,
    FLAT_TILE,
    TerrainConfiguration,
    TileConfiguration,
)
from gaitgauge_fake_engine import FakeScript
from small_environment import STAIRS, gliding, idle, make


def moved(configuration, **changes):
    arguments = {
        "level": 3,
        "farthest": 0.0,
        "commanded": 0.0,
        "fallen": False,
        "uniform": 0.25,
        **changes,
    }
    tensors = {name: torch.tensor([value]) for name, value in arguments.items()}
    return int(next_level(configuration, num_levels=10, **tensors)[0])


@pytest.mark.parametrize(
    ("situation", "expected"),
    [
        ({"farthest": 4.1}, 4),
        ({"farthest": 3.9}, 3),
        ({"farthest": 4.1, "fallen": True}, 4),
        ({"farthest": 3.9, "fallen": True}, 2),
        ({"farthest": 2.0, "commanded": 4.1}, 2),
        ({"farthest": 2.0, "commanded": 3.9}, 3),
        ({"farthest": 4.1, "commanded": 20.0}, 4),
        ({"level": 0, "fallen": True}, 0),
        ({"level": 9, "farthest": 4.1, "uniform": 0.25}, 2),
        ({"level": 9, "farthest": 4.1, "uniform": 0.999}, 9),
        ({"level": 9, "farthest": 3.0}, 9),
    ],
)
def test_level_moves(situation, expected):
    assert moved(TerrainConfiguration(), **situation) == expected


def test_falls_may_be_forgiven():
    assert moved(TerrainConfiguration(demote_falls=False), farthest=3.0, commanded=3.0, fallen=True) == 3


def test_levels_are_drawn_without_curriculum():
    assert moved(TerrainConfiguration(curriculum=False), farthest=4.1, uniform=0.75) == 7


def test_kinds_are_blocks_in_proportion():
    kind = assign_kinds([1.0, 2.0, 1.0], 16)
    assert kind.tolist() == [0] * 4 + [1] * 8 + [2] * 4
    shares = [tile.share for tile in ALL_TILES]
    counts = torch.bincount(assign_kinds(shares, 8192), minlength=len(shares))
    assert (counts / 8192).tolist() == pytest.approx([s / sum(shares) for s in shares], abs=2e-4)
    for shares in ([0.0, 0.0], [], [2.0, -1.0]):
        with pytest.raises(
            ValueError,
            match=r"^environment\.terrain\.tiles\.<kind>\.share is 0 for every kind, or negative for one; give",
        ):
            assign_kinds(shares, 4)


def test_students_and_teachers_share_every_kind_and_level():
    environment = make(800, terrain=replace(STAIRS, levels=3))
    student = torch.arange(800) % 4 == 0
    level, kind = environment.parts.memory.level, environment.kind
    for k in range(2):
        for lv in range(3):
            here = (kind == k) & (level == lv)
            assert 0.15 < float((here & student).sum() / here.sum()) < 0.36


def test_palette_holds_each_tile_once():
    configuration = TerrainConfiguration(levels=2, variants=3)
    palette = build_palette(configuration)
    assert palette.index.shape == (9, 2, 3)
    names = [tile.name for tile in palette.tiles]
    slope, flat, wave = names.index("slope_up"), names.index("flat"), names.index("wave")
    assert palette.index[slope].unique().numel() == 2, "no chance in slopes"
    assert palette.index[flat].unique().numel() == 1
    assert palette.index[wave].unique().numel() == 6
    for k, tile in enumerate(palette.tiles):
        for index in palette.index[k].flatten().tolist():
            assert palette.terrains[index].name == f"tile_{tile.name}"
    assert len({id(t) for t in palette.terrains}) == palette.index.unique().numel() == len(palette.terrains)


def test_kinds_without_share_are_left_out():
    tiles = (FLAT_TILE, replace(ALL_TILES[0], share=0.0))
    palette = build_palette(TerrainConfiguration(tiles=tiles, levels=1))
    assert [t.name for t in palette.tiles] == ["flat"]


def test_unknown_kind():
    tile = TileConfiguration(name="lava", share=1.0, command_limits=(1.0, 1.0, 1.0), sigma=0.25)
    with pytest.raises(TerrainError, match="lava"):
        build_palette(TerrainConfiguration(tiles=(tile,)))


def test_worlds_climb_levels_and_get_the_tile_of_their_level():
    environment = make(12, script=gliding(8.0), terrain=replace(STAIRS, highest_start_level=0))
    memory = environment.parts.memory
    assert (memory.level == 0).all()
    for _ in range(54):
        idle(environment)
    stairs = environment.kind == 0
    assert (memory.level[stairs] >= 1).all()
    expected = environment.palette.index[environment.kind, memory.level, 0]
    assert torch.equal(memory.terrain_index, expected)
    assert torch.equal(environment.backend.terrain_index, expected)


def test_falls_lower_the_level_of_the_fallen():
    never = float("inf")
    fall = torch.tensor([0.1, never, 0.1, never], dtype=torch.float64)
    environment = make(4, script=FakeScript(fall_time=fall), terrain=replace(STAIRS, tiles=STAIRS.tiles[:1]))
    memory = environment.parts.memory
    memory.level.fill_(2)
    while not idle(environment)[2].any():
        pass
    assert memory.level.tolist() == [1, 2, 1, 2]


def test_divergence_moves_no_level():
    diverge = torch.tensor([0.1, float("inf")], dtype=torch.float64)
    environment = make(2, script=FakeScript(diverge_time=diverge), terrain=replace(STAIRS, tiles=STAIRS.tiles[:1]))
    environment.parts.memory.level.fill_(2)
    while not idle(environment)[2].any():
        pass
    assert environment.parts.memory.level.tolist() == [2, 2]


@pytest.mark.parametrize(("farthest", "commanded"), [(4.5, 0.0), (0.1, 6.0)])
def test_divergence_moves_no_level_wherever_the_robot_was_flung(farthest, commanded):
    """Its state may be numbers: here the joints are too fast."""
    limits = TerminationConfiguration(joint_velocity=1e-6)
    environment = make(2, terrain=replace(STAIRS, tiles=STAIRS.tiles[:1]), termination=limits)
    memory = environment.parts.memory
    memory.level.fill_(2)
    memory.farthest.fill_(farthest)
    memory.commanded_farthest.fill_(commanded)
    while not idle(environment)[2].any():
        pass
    assert memory.level.tolist() == [2, 2]


def test_episodes_spread_over_the_tile_do_not_move_levels():
    spread = replace(STAIRS, spread_probability=1.0, tiles=STAIRS.tiles[:1])
    environment = make(8, script=gliding(8.0), terrain=spread)
    level = environment.parts.memory.level.clone()
    finished = sum(idle(environment)[2] for _ in range(60))
    assert (finished > 0).all()
    assert torch.equal(environment.parts.memory.level, level)


def test_without_a_curriculum_every_episode_draws_its_level():
    drawn = replace(STAIRS, spread_probability=1.0, tiles=STAIRS.tiles[:1], curriculum=False)
    environment = make(64, script=gliding(8.0), terrain=drawn)
    level = environment.parts.memory.level
    level.fill_(1)
    finished = sum(idle(environment)[2] for _ in range(60))
    assert level[finished > 0].unique().tolist() == [0, 1, 2]


def walking(speed_share, command):
    """A script in which each base has that share of the commanded speed, (N,), along the command."""

    def motion(backend):
        linear = torch.zeros(backend.num_worlds, 3, dtype=backend.dtype)
        linear[:, 0] = command * torch.tensor(speed_share)
        return linear, torch.zeros_like(linear)

    return FakeScript(motion=motion)


def forward_at(speed):
    """Commands that are all the same forward speed."""
    return CommandConfiguration(
        stages=(CommandStage(begin=0.0, forward=(speed, speed), lateral=(0.0, 0.0), yaw=(0.0, 0.0)),),
        dynamic=False,
        extreme_probability=0.0,
        stationary_probability=Ramp(start=0.0, end=0.0),
    )


STUCK = TerminationConfiguration(stuck=1.0, stuck_from=0.0)


def test_a_robot_without_progress_is_stuck_after_the_time_set():
    shares = (0.0, 0.05, 0.3, 1.0)
    environment = make(4, script=walking(shares, 0.5), commands=forward_at(0.5), termination=STUCK)
    first = torch.zeros(4)
    for step in range(1, 76):
        _, _, done, extras = idle(environment)
        assert extras["time_outs"].sum() == 0
        first = torch.where((first == 0) & (done == 1), float(step), first)
    assert first[0] == pytest.approx(50, abs=1), "1 s of control steps of 20 ms"
    assert 50 < first[1] < 75, "a little progress takes longer"
    assert first[2:].tolist() == [0, 0], "slow or fast, they come on"


def test_being_stuck_lowers_the_level():
    environment = make(4, terrain=STAIRS, commands=forward_at(0.5), termination=STUCK)
    environment.parts.memory.level.fill_(2)
    while not idle(environment)[2].any():
        assert environment.parts.memory.level.tolist() == [2] * 4
    assert environment.parts.memory.level.tolist() == [1] * 4


def test_who_was_told_to_stand_is_not_stuck():
    environment = make(4, terrain=STAIRS, commands=forward_at(0.0), termination=STUCK)
    assert not any(bool(idle(environment)[2].any()) for _ in range(60))


def test_no_robot_is_stuck_on_a_tile_that_does_not_say_so():
    free = replace(STAIRS, tiles=(STAIRS.tiles[0], replace(STAIRS.tiles[1], stuck=False)))
    environment = make(8, terrain=free, commands=forward_at(0.5), termination=STUCK)
    ended = torch.zeros(8, dtype=torch.bool)
    for _ in range(55):
        ended |= idle(environment)[2].bool()
    assert ended.tolist() == [environment.palette.tiles[kind].stuck for kind in environment.kind.tolist()]
    assert 0 < ended.sum() < 8


def test_being_stuck_ends_nothing_before_its_time_in_the_run():
    later = replace(STUCK, stuck_from=0.5)
    environment = make(
        4,
        terrain=STAIRS,
        commands=forward_at(0.5),
        termination=later,
        schedule=ScheduleConfiguration(horizon_steps=120),
    )
    ends = [bool(idle(environment)[2].any()) for _ in range(65)]
    assert ends.index(True) == 59, "half of the run"
