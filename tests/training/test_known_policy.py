"""The two benchmarks that play a known policy: on training tiles at fixed levels, and up the gauge's stairs."""

import math

import pytest
import torch
from fixed_levels import FixedLevels
from gaitgauge.terrains import gauge_terrains
from headings import Changes, Walk, ground


@pytest.mark.slow
def test_levels_stay_and_commands_lead_straight_ahead():
    played = FixedLevels("pretrained", kind="stairs_up", levels=(3, 7), worlds=4, speeds=(0.8, 0.0), settings=())
    environment, memory = played.environment, played.environment.parts.memory
    memory.farthest.fill_(9.0)  # the rule would move them up
    memory.moves_level.fill_(True)
    environment.episode_length_buf = torch.full((4,), environment.max_episode_length - 3)
    played.play(0.1)
    assert memory.level.tolist() == [3, 7, 3, 7]
    names = [environment.palette.terrains[i].level for i in memory.terrain_index.tolist()]
    assert names == [3, 7, 3, 7], "the tiles are those of the levels"
    assert played.moves[3]["up"] == played.moves[7]["up"] == 2
    assert memory.command[:, 0].tolist() == pytest.approx([0.8] * 4)
    rows = played.lines(terms=True)
    assert rows[0].startswith("level  3  up 2 down 0 same 0") and any("linear_tracking" in row for row in rows)
    assert rows[1] == "    ends: time_out 2"


@pytest.mark.slow
def test_levels_have_the_last_stretch_and_the_commands_of_their_kind():
    played = FixedLevels("pretrained", kind="stairs_up", levels=(3,), worlds=1, speeds=None, settings=())
    tiles = played.environment.configuration.terrain.tiles
    assert [tile.name for tile in tiles if tile.share] == ["stairs_up"], "the stretch has shares of its own"
    assert played.environment.configuration.rewards.turn_error == -6.0


def test_steps_of_another_depth_and_height():
    stairs = ground("stairs", 8, Changes(riser=0.2, tread=0.25))
    assert stairs.height(0.3, 0.0) == pytest.approx(0.4) and stairs.height(0.2, 0.0) == pytest.approx(0.2)
    assert ground("stairs", 8, Changes()).boxes == gauge_terrains.stairs(8).boxes
    assert sum(box.wall for box in stairs.boxes) == 4


@pytest.mark.parametrize("training", [False, True])
def test_a_walk_is_counted_from_where_it_sets_out(training):
    changes = Changes(training=training, gravity_noise=0.05, strength=0.2, push=0.4)
    walk = Walk("pretrained", ground("stairs", 1, changes), robots=2, friction=0.7, seed=0, changes=changes)
    with torch.no_grad():
        for number in range(60):
            walk.step(number)
    assert len(walk.off) == 35 and max(float(yaw.max()) for yaw in walk.off) < math.pi / 2
    assert walk.line().startswith("arrived 0 of 2, way 0.")
