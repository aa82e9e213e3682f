"""Statistics and special cases of the command draws."""

from dataclasses import replace

import pytest
import torch
from gaitgauge.training.environment.commands import COMMAND_COLUMNS, CommandGenerator, largest_commands
from gaitgauge.training.environment.configuration import CommandConfiguration, CommandStage, Ramp
from gaitgauge.training.environment.terrain_configuration import TileConfiguration

COUNT = 40_000
torch.set_num_threads(1)  # small tensors: threads only get in each other's way
LIMITS = ((1.5, 1.0, 1.5), (0.6, 0.6, 9.0))
STAGES = (
    CommandStage(begin=0.0, forward=(-0.5, 0.5), lateral=(-0.5, 0.5), yaw=(-1.0, 1.0)),
    CommandStage(begin=0.5, forward=(-2.0, 3.0), lateral=(-1.0, 1.0), yaw=(-2.0, 2.0)),
)
PLAIN = CommandConfiguration(
    stages=STAGES,
    straight_probability=0.0,
    extreme_probability=0.0,
    flip_probability=0.0,
    stationary_probability=Ramp(start=0.0, end=0.0),
)


TILES = tuple(
    TileConfiguration(name=name, share=1.0, command_limits=limits, sigma=0.25, ends=ends)
    for name, limits, ends in zip(("stairs_up", "flat"), LIMITS, (True, False), strict=True)
)


def draw(configuration, *, progress=0.0, kind=0, count=COUNT, tiles=TILES, **changes):
    generator = CommandGenerator(
        configuration,
        tiles=tiles,
        control_period=0.02,
        max_episode_length=1250,
        device="cpu",
    )
    random = torch.Generator().manual_seed(1)
    state = {
        "kind": torch.full((count,), kind),
        "progress": torch.tensor(progress),
        "episode_length": torch.zeros(count, dtype=torch.int64),
        "issued": torch.zeros(count, 2),
        "command": torch.zeros(count, 3),
        "extreme": torch.zeros(count, dtype=torch.bool),
        "holds_heading": torch.zeros(count, dtype=torch.bool),
    }
    uniform = {name: torch.rand(count, width, generator=random) for name, width in COMMAND_COLUMNS.items()}
    return generator.draw(uniform, **{**state, **changes})


def share(mask):
    return float(mask.float().mean())


def test_ranges_are_those_of_the_stage_capped_by_the_terrain():
    for progress, kind, forward, lateral, yaw in (
        (0.0, 0, 0.5, 0.5, 1.0),
        (0.5, 0, 1.5, 1.0, 1.5),
        (0.9, 1, 0.6, 0.6, 2.0),
    ):
        highest = draw(PLAIN, progress=progress, kind=kind).command.abs().amax(dim=0)
        assert highest.tolist() == pytest.approx([forward, lateral, yaw], rel=1e-3)
        assert (highest <= torch.tensor([forward, lateral, yaw]) + 1e-6).all()


def test_without_the_curriculum_all_ranges_are_the_last_stage_s_from_the_start():
    whole = replace(PLAIN, curriculum=False)
    for progress in (0.0, 0.4, 0.9):
        highest = draw(whole, progress=progress).command.abs().amax(dim=0)
        assert highest.tolist() == pytest.approx([1.5, 1.0, 1.5], rel=1e-3), progress
    sideways = replace(whole, stages=(replace(STAGES[0], lateral=(-0.9, 0.9)), replace(STAGES[1], lateral=(-0.3, 0.3))))
    assert largest_commands(sideways, LIMITS) == (1.5, 0.3, 2.0)


def test_least_speed_lets_the_robot_leave_its_tile():
    command = draw(PLAIN).command
    # 5 m in 25 s.
    assert float(command[:, :2].abs().min()) == pytest.approx(0.2, abs=1e-3)
    assert share(command[:, 0] > 0) == pytest.approx(0.5, abs=0.01)
    assert float(command[:, 2].abs().min()) < 0.01, "the yaw rate has no least value"
    done = draw(PLAIN, issued=torch.full((COUNT, 2), 1.0)).command
    assert float(done[:, :2].abs().min()) < 0.01, "7 m were commanded already"


def test_least_speed_beyond_the_range_means_full_speed_either_way():
    late = draw(PLAIN, episode_length=torch.full((COUNT,), 1200))
    assert late.command[:, :2].abs().unique().tolist() == pytest.approx([0.5])
    assert share(late.command[:, 0] > 0) == pytest.approx(0.5, abs=0.01)


def test_uniform_draws_fill_both_sides_evenly():
    free = replace(PLAIN, dynamic=False)
    command = draw(free).command
    assert command.mean(dim=0).tolist() == pytest.approx([0.0] * 3, abs=0.01)
    assert command.std(dim=0).tolist() == pytest.approx([0.5 / 3**0.5, 0.5 / 3**0.5, 1.0 / 3**0.5], rel=0.02)
    lopsided = draw(PLAIN, progress=1.0, kind=1, issued=torch.full((COUNT, 2), 9.0)).command
    assert share(lopsided[:, 0] > 0) == pytest.approx(0.5, abs=0.01)


def test_extreme_commands_have_every_axis_at_a_limit_or_zero():
    only = replace(PLAIN, extreme_probability=1.0)
    drawn = draw(only)
    assert drawn.extreme.all()
    combinations, counts = drawn.command.unique(dim=0, return_counts=True)
    assert set(combinations.flatten().tolist()) == {-1.0, -0.5, 0.0, 0.5, 1.0}
    assert len(combinations) == 26, "all of 3 x 3 x 3 but the zero command"
    assert share((drawn.command == 0).sum(dim=1) == 2) == pytest.approx(6 / 27 + 1 / 27, abs=0.01)
    assert counts.min() > COUNT / 27 * 0.85


def test_extreme_commands_of_a_sprint_go_straight_ahead_or_back():
    only = replace(PLAIN, extreme_probability=1.0, extreme_zero_probability=(0.0, 1.0, 1.0 / 3.0))
    forward, lateral, yaw = draw(only, progress=0.5).command.unbind(1)
    assert set(forward.tolist()) == {-1.5, 1.5} and set(lateral.tolist()) == {0.0}
    assert share(yaw == 0.0) == pytest.approx(1.0 / 3.0, abs=0.01)


def test_opposite_follows_an_extreme_command():
    flips = replace(PLAIN, flip_probability=0.3)
    before = torch.tensor([0.5, -0.5, 1.0]).expand(COUNT, 3)
    drawn = draw(flips, command=before, extreme=torch.ones(COUNT, dtype=torch.bool))
    opposite = (drawn.command == -before).all(dim=1)
    assert share(opposite) == pytest.approx(0.3, abs=0.01)
    assert torch.equal(opposite, drawn.extreme), "an opposite is extreme, so it can be followed by its own opposite"
    without = draw(flips, command=before)
    assert not (without.command == -before).all(dim=1).any()


def test_opposite_stays_in_an_asymmetric_range():
    flips = replace(PLAIN, stages=(replace(STAGES[1], begin=0.0, forward=(-0.5, 1.2)),), flip_probability=1.0)
    before = torch.tensor([1.2, 0.0, 0.0]).expand(COUNT, 3)
    drawn = draw(flips, command=before, extreme=torch.ones(COUNT, dtype=torch.bool))
    assert drawn.command[:, 0].unique().tolist() == [-0.5]


def test_stationary_commands_are_mostly_all_zero_and_short():
    still = replace(PLAIN, stationary_probability=Ramp(start=0.4, end=0.4), extreme_probability=0.2)
    drawn = draw(still)
    halted = (drawn.command[:, :2] == 0).all(dim=1) & ~drawn.extreme
    assert share(halted) == pytest.approx(0.4, abs=0.01)
    assert share((drawn.command[halted] == 0).all(dim=1)) == pytest.approx(0.75, abs=0.02)
    assert drawn.steps[halted].unique().tolist() == [150]
    assert drawn.steps[~halted].unique().tolist() == [250]


def test_stationary_commands_wait_until_the_way_is_commanded():
    still = replace(PLAIN, stationary_probability=Ramp(start=1.0, end=1.0))
    # 0.4 m/s take 12.5 s, 625 steps, for 5 m: 100 steps before that there is no time to stand.
    assert not (draw(still, episode_length=torch.full((COUNT,), 725)).command == 0).all(dim=1).any()
    short = draw(still, episode_length=torch.full((COUNT,), 600))
    assert short.steps.unique().tolist() == [25]


def test_share_of_stationary_commands_follows_progress():
    still = replace(PLAIN, stationary_probability=Ramp(start=0.0, end=0.2, until=0.1))
    for progress, expected in ((0.0, 0.0), (0.05, 0.1), (0.4, 0.2)):
        halted = (draw(still, progress=progress).command[:, :2] == 0).all(dim=1)
        assert share(halted) == pytest.approx(expected, abs=0.01)


def test_straight_share():
    command = draw(replace(PLAIN, straight_probability=0.3)).command
    assert share(command[:, 2] == 0) == pytest.approx(0.3, abs=0.01)


def test_stages_must_be_in_order():
    with pytest.raises(ValueError, match="first must begin at 0"):
        draw(replace(PLAIN, stages=STAGES[1:]), count=2)


def test_crossings_go_straight_on_or_back_for_the_whole_episode():
    crossing = replace(PLAIN, crossing_probability=0.4, extreme_probability=0.3)
    drawn = draw(crossing, progress=0.5)
    crosses = drawn.steps == 1250
    assert share(crosses) == pytest.approx(0.4, abs=0.01)
    forward, lateral, yaw = drawn.command[crosses].unbind(1)
    assert not lateral.any() and not yaw.any()
    assert drawn.holds_heading[crosses].all() and not drawn.extreme[crosses].any()
    assert share(forward > 0) == pytest.approx(0.5, abs=0.02)
    assert forward.abs().aminmax() == pytest.approx((0.75, 1.5), rel=1e-3)
    assert share(drawn.extreme[~crosses]) == pytest.approx(0.3, abs=0.01), "other episodes as without"
    later = draw(crossing, progress=0.5, episode_length=torch.ones(COUNT, dtype=torch.int64))
    assert later.steps.unique().tolist() == [250], "an episode that has begun is none"
    endless = draw(crossing, progress=0.5, kind=1)
    assert endless.steps.unique().tolist() == [250], "ground without an edge is not crossed"


def test_crossings_keep_to_a_range_that_goes_one_way():
    for bounds, expected in (((0.0, 1.2), (0.6, 1.2)), ((0.8, 1.2), (0.8, 1.2)), ((-1.2, 0.0), (-1.2, -0.6))):
        stage = replace(STAGES[1], begin=0.0, forward=bounds)
        forward = draw(replace(PLAIN, stages=(stage,), crossing_probability=1.0)).command[:, 0]
        assert forward.aminmax() == pytest.approx(expected, abs=1e-3)


def test_commands_of_a_tile_are_reversed_and_short_where_it_says_so():
    kinds = (replace(TILES[0], reversal_probability=0.4, interval=3.0), TILES[1])
    begun, before = torch.ones(COUNT, dtype=torch.int64), torch.tensor([0.5, -0.2, 0.6]).expand(COUNT, 3)
    drawn = draw(PLAIN, tiles=kinds, episode_length=begun, command=before)
    back = (drawn.command[:, :2] == -before[:, :2]).all(dim=1)
    assert share(back) == pytest.approx(0.4, abs=0.01) and drawn.steps.unique().tolist() == [150]
    assert share(drawn.holds_heading[back]) == pytest.approx(0.5, abs=0.02)
    assert drawn.command[back & drawn.holds_heading][:, 2].unique().tolist() == [0.0]
    assert drawn.command[back & ~drawn.holds_heading][:, 2].unique().tolist() == pytest.approx([-0.6])
    turning = draw(PLAIN, tiles=kinds, episode_length=begun, command=before * torch.tensor([0.0, 0.0, 1.0]))
    turned = (turning.command == torch.tensor([0.0, 0.0, -0.6])).all(dim=1)
    assert share(turned) == pytest.approx(0.4, abs=0.01), "a turn on the spot is always reversed, never halted"
    for same in (
        draw(PLAIN, tiles=kinds, command=before),
        draw(PLAIN, tiles=kinds, kind=1, episode_length=begun, command=before),
    ):
        assert not (same.command[:, :2] == -before[:, :2]).all(dim=1).any(), "a first command, or another tile"


@pytest.mark.parametrize("extreme", [False, True])
@pytest.mark.parametrize("forward", [0.05, -0.5])
def test_the_way_back_to_a_heading_is_no_part_of_what_is_reversed(extreme, forward):
    """A reversed extreme command may hold a heading, too; its opposite is drawn by ``flip_probability``."""
    kinds = (replace(TILES[0], reversal_probability=0.5), TILES[1])
    flips = replace(PLAIN, flip_probability=0.2)
    before, held = torch.tensor([forward, 0.0, 0.6]).expand(COUNT, 3), torch.ones(COUNT, dtype=torch.bool)
    begun = torch.ones(COUNT, dtype=torch.int64)
    state = {"episode_length": begun, "command": before, "holds_heading": held, "extreme": held & extreme}
    command = draw(flips, tiles=kinds, **state).command
    opposite = (command[:, 0] == -forward) & (command[:, 1] == 0.0)
    assert opposite.any() == (extreme or forward == -0.5), "hardly a walk is not reversed"
    assert (command[opposite, 2] == 0.0).all()


def test_a_tile_has_its_own_share_of_halts_and_of_turns_on_the_spot():
    kinds = (replace(TILES[0], stationary_probability=2.0, stationary_yaw_probability=3.0), TILES[1])
    still = replace(PLAIN, stationary_probability=Ramp(start=0.2, end=0.2))
    for kind, halts, turns in ((0, 0.4, 0.75), (1, 0.2, 0.25)):
        command = draw(still, tiles=kinds, kind=kind).command
        halted = (command[:, :2] == 0).all(dim=1)
        assert share(halted) == pytest.approx(halts, abs=0.01)
        assert share(command[halted][:, 2] != 0) == pytest.approx(turns, abs=0.02)
