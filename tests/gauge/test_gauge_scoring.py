"""From samples to scores: tail means, level scores, the paper's own tables, and the bootstrap."""

from dataclasses import replace

import numpy as np
import pytest
from gaitgauge.gauge.episodes import Episode, Record
from gaitgauge.gauge.plan import EnvironmentResult
from gaitgauge.gauge.results import fold
from gaitgauge.gauge.scoring import (
    command_statistics,
    group_values,
    level_score,
    rounded,
    run_statistics,
    tail_means,
)
from gaitgauge.gauge.suite import load_suite

REFERENCE, OWN = load_suite("robogauge-1.1"), load_suite("gaitgauge-1")
METRICS = ("lin_vel_err", "ang_vel_err", "dof_limits", "dof_power", "orientation_stability", "torque_smoothness")


def record(
    samples, goals=None, parts=None, *, names=("diagonal_velocity", "max_velocity"), seed=0, terrain="flat", level=0
):
    samples = np.asarray(samples, dtype=np.float32)
    samples = samples.reshape(len(samples), -1) if samples.ndim == 1 else samples
    count = len(samples)
    return Record(
        episode=Episode(
            terrain=terrain, level=level, friction=0.6, payload=0.0, seed=seed, stage="eval", goals=tuple(names)
        ),
        columns=tuple(f"c{i}" for i in range(samples.shape[1])),
        samples=samples,
        goal_index=np.asarray(np.zeros(count) if goals is None else goals, dtype=np.int16),
        part_index=np.asarray(np.zeros(count) if parts is None else parts, dtype=np.int16),
    )


# ---- tail means -----------------------------------------------------------------------------------------------------


def test_tail_means_are_those_of_the_lowest_values():
    # ten values: the lowest quarter are two, the lowest half five
    assert tail_means(np.arange(10.0)[::-1] / 10) == pytest.approx([0.45, 0.05, 0.2])


def test_tail_means_clamp_each_sample_before_they_average():
    assert tail_means(np.array([-3.0, 2.0, 0.5, 0.5])) == pytest.approx([0.5, 0.0, 0.25])


@pytest.mark.parametrize(("values", "expected"), [([0.3], [0.3] * 3), ([0.2, 0.8], [0.5, 0.2, 0.2]), ([], [0.0] * 3)])
def test_tail_means_of_few_values_take_at_least_one(values, expected):
    assert tail_means(np.array(values)) == pytest.approx(expected)


def test_tail_means_leave_out_what_is_not_defined():
    assert tail_means(np.array([np.nan, 0.4, np.nan, 0.6])) == pytest.approx([0.5, 0.4, 0.4])
    assert tail_means(np.full(3, np.nan)) == pytest.approx([0.0] * 3)


def test_goals_weigh_the_same_however_many_samples_they_have():
    run = record([1.0] * 30 + [0.5] * 2, [0] * 30 + [1] * 2)
    assert run_statistics(run, 0) == pytest.approx([0.75] * 3)


def test_a_goal_without_samples_counts_zero():
    assert run_statistics(record([0.8] * 4), 0) == pytest.approx([0.4] * 3)
    assert run_statistics(record(np.zeros((0, 1))), 0) == pytest.approx([0.0] * 3)


def test_sub_commands_have_statistics_of_their_own_where_they_were_played():
    run = record([0.2, 0.4, 0.6, 0.9], [0, 0, 0, 1], [0, 0, 2, 5])
    found = command_statistics(run, 0)
    assert set(found) == {(0, 0), (0, 2), (1, 5)}
    assert found[0, 0] == pytest.approx([0.3, 0.2, 0.2])
    assert found[1, 5] == pytest.approx([0.9] * 3)


# ---- levels ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("quality", "level", "flat", "expected"),
    [
        (0.7, 0, True, 0.7),
        (1.0, 10, False, 1.0),
        (0.0, 1, False, 0.0),
        (0.5, 6, False, 0.545),
        (0.9, 0, False, 0.0),
        # expected levels: half way between two scores, and half way from nothing to level 1
        (0.5, 5.5, False, 0.5),
        (0.8, 0.5, False, 0.076),
    ],
)
def test_level_score(quality, level, flat, expected):
    assert level_score(quality, level, REFERENCE.scoring, flat=flat) == pytest.approx(expected)
    assert level_score(np.full(3, quality), level, REFERENCE.scoring, flat=flat) == pytest.approx([expected] * 3)


def test_level_scores_overlap_as_the_reference_measured_them():
    """Reference run of the CTS policy: slope_fd at level 6 and stairs_fd at level 9, Q and terrain quality in three tails."""
    slope = level_score(np.array([0.5906, 0.1478, 0.3709]), 6, REFERENCE.scoring, flat=False)
    assert slope == pytest.approx([0.5622, 0.4781, 0.5205], abs=1e-4)
    stairs = level_score(np.array([0.4014, 0.0027, 0.1143]), 9, REFERENCE.scoring, flat=False)
    assert stairs == pytest.approx([0.7963, 0.7205, 0.7417], abs=1e-4)


def test_rounding_is_the_suites():
    assert rounded(np.array([0.123456]), REFERENCE.scoring).tolist() == [0.1235]
    assert rounded(np.array([0.123456]), OWN.scoring).tolist() == [0.123456]


# ---- the paper's tables -----------------------------------------------------------------------------------------------

# Level-weighted mean@50 of the eight metrics, in this order, then the published Tracking, Safety and Quality.
COLUMNS = (
    "ang_vel_err",
    "lin_vel_err",
    "dof_limits",
    "dof_power",
    "orientation_stability",
    "torque_smoothness",
    "zmp_margin",
    "friction_margin",
)
BASELINES = {
    "Ours": ((0.6431, 0.6908, 0.8073, 0.7642, 0.8040, 0.7535, 0.7653, 0.6340), (0.6669, 0.7857, 0.7392)),
    "CTS": ((0.5632, 0.5878, 0.7275, 0.6856, 0.7232, 0.6744, 0.6900, 0.5622), (0.5755, 0.7066, 0.6624)),
    "HIM": ((0.5025, 0.5881, 0.6699, 0.6253, 0.6643, 0.6201, 0.6344, 0.5014), (0.5453, 0.6476, 0.6050)),
    "DreamWaQ": ((0.4698, 0.5512, 0.6360, 0.5939, 0.6312, 0.5853, 0.6049, 0.4706), (0.5105, 0.6149, 0.5730)),
}


@pytest.mark.parametrize("model", BASELINES)
def test_groups_are_the_papers(model):
    weighted, published = BASELINES[model]
    groups = group_values(dict(zip(COLUMNS, weighted, strict=True)), OWN.scoring.groups)
    assert list(groups) == ["tracking", "safety", "quality"]
    assert list(groups.values()) == pytest.approx(published, abs=0.51e-4 + 1e-9)


# Terrain scores mean@50: flat, wave, slope_fd, slope_bd, stairs_fd, stairs_bd, obstacle; the score and the mean level as the
# sum of the levels of 54 environments.
TERRAINS = ("flat", "wave", "slope_fd", "slope_bd", "stairs_fd", "stairs_bd", "obstacle")
TERRAIN_SCORES = {
    "Ours": ((0.663, 0.579, 0.551, 0.553, 0.775, 0.744, 0.835), 0.6713, 424, 7.85),
    "CTS": ((0.592, 0.561, 0.521, 0.491, 0.746, 0.617, 0.521), 0.5786, 369, 6.83),
    "HIM": ((0.621, 0.525, 0.457, 0.537, 0.514, 0.693, 0.418), 0.5379, 334, 6.19),
    "DreamWaQ": ((0.620, 0.491, 0.373, 0.564, 0.542, 0.633, 0.315), 0.5054, 310, 5.74),
}


@pytest.mark.parametrize("model", TERRAIN_SCORES)
def test_benchmark_and_level_fold_as_in_the_papers_tables(model):
    """Levels and qualities of 63 environments that fit the published terrain scores and level sum give the published score."""
    scores, published, level_sum, level_mean = TERRAIN_SCORES[model]
    common = (np.mean(scores[1:]) - 0.09 * (level_sum / 54 - 1)) / 0.19
    assert common == pytest.approx({"Ours": 0.296, "CTS": 0.271, "HIM": 0.299, "DreamWaQ": 0.314}[model], abs=3e-3)
    # whole level sums of each terrain that add up to the published one; quality takes up the rest
    wanted = np.array([9 * ((score - 0.19 * common) / 0.09 + 1) for score in scores[1:]])
    sums = np.floor(wanted).astype(int)
    sums[np.argsort(sums - wanted)[: level_sum - sums.sum()]] += 1
    suite = replace(REFERENCE, scoring=replace(REFERENCE.scoring, decimals=None, bootstrap=4))
    environments = [flat_environment([scores[0]], 0.1 * n) for n in range(2, 11)]
    for terrain, score, levels in zip(TERRAINS[1:], scores[1:], sums.tolist(), strict=True):
        quality = (score - 0.09 * (levels / 9 - 1)) / 0.19
        assert 0.0 < quality < 1.0
        for n in range(9):
            level = levels // 9 + (n < levels % 9)
            environments.append(flat_environment([quality], 0.1 * (n + 2), terrain, level, True))
    result = fold(suite, environments, (*METRICS, "quality"))
    assert [result.terrains[t].mean50 for t in TERRAINS] == pytest.approx(scores, abs=1e-6)
    assert result.level == pytest.approx(level_sum / 54)
    assert round(result.level, 2) == level_mean
    assert result.score == pytest.approx(published, abs=3e-4)


def flat_environment(qualities, friction=0.6, terrain="flat", level=0, searched=False):
    halves = {"goals": [0, 0, 1, 1], "parts": [0, 1, 0, 1], "terrain": terrain, "level": level}
    return EnvironmentResult(
        terrain=terrain,
        friction=friction,
        payload=0.0,
        level=level,
        search={} if searched else None,
        trials=[],
        records=[record(np.full((4, 7), quality), **halves, seed=seed) for seed, quality in enumerate(qualities)],
    )


def test_fold_weighs_terrains_the_same_and_counts_unpassed_environments_zero():
    suite = replace(REFERENCE, scoring=replace(REFERENCE.scoring, bootstrap=10))
    environments = [
        flat_environment([0.6, 0.7, 0.8]),
        flat_environment([0.5, 0.5, 0.5], 0.2, "wave", 3, True),
        flat_environment([], 0.3, "wave", 0, True),
    ]
    result = fold(suite, environments, (*METRICS, "quality"))
    wave = (0.09 * 2 + 0.19 * 0.5) / 2
    assert result.terrains["flat"].score == pytest.approx(0.7)
    assert result.terrains["wave"].score == pytest.approx(wave)
    assert result.score == pytest.approx((0.7 + wave) / 2)
    assert result.level == 1.5
    # metrics are weighted by level like quality, over environments and not over terrains
    assert result.metrics["dof_limits"].mean50 == pytest.approx((0.7 + 2 * wave) / 3, abs=1e-4)
    assert [row.score for row in result.environments] == pytest.approx([0.7, 2 * wave, 0.0])


def test_the_score_of_an_expected_level_lies_between_those_of_the_levels_beside_it():
    """Level 5.25, qualities 0.6 and 0.4 there: 3/4 of 0.36 + 0.114 and 1/4 of 0.45 + 0.076."""
    suite = replace(OWN, scoring=replace(OWN.scoring, bootstrap=5))
    names = [*suite.metrics.weights, "quality"]
    halves = {"goals": [0, 0, 1, 1], "parts": [0, 1, 0, 1], "terrain": "wave"}
    low, high = (
        [record(np.full((4, len(names)), q + 0.02 * (seed - 1)), **halves, seed=seed, level=at) for seed in range(3)]
        for at, q in ((5, 0.6), (6, 0.4))
    )
    environment = replace(flat_environment([], 0.6, "wave", 5.25, True), records=[*low, *high])
    result = fold(suite, [environment], names)
    (row,) = result.environments
    assert row.score == pytest.approx(0.75 * 0.474 + 0.25 * 0.526)
    assert row.level == result.level == 5.25
    assert row.quality.mean50 == pytest.approx(0.55)
    assert [run.columns["quality"] for run in row.runs.values()] == pytest.approx([0.53, 0.55, 0.57])
    powers = {at: runs[1].columns["dof_power"] for at, runs in row.runs_by_level.items()}
    assert powers == pytest.approx({5: 0.6, 6: 0.4})
    assert row.runs[2].commands["max_velocity +x"] == pytest.approx(0.57)
    assert result.score == pytest.approx(row.score)


def test_fold_rounds_a_run_before_it_averages_as_the_reference_does():
    suite = replace(REFERENCE, scoring=replace(REFERENCE.scoring, bootstrap=2))
    result = fold(suite, [flat_environment([0.12344, 0.12344, 0.12346])], (*METRICS, "quality"))
    assert result.score == pytest.approx(0.1234)  # (0.1234 + 0.1234 + 0.1235) / 3 = 0.12343
    own = replace(OWN, scoring=replace(OWN.scoring, bootstrap=2))
    names = [*own.metrics.weights, "quality"]
    environment = flat_environment([0.12344, 0.12344, 0.12346])
    for item in environment.records:
        item.samples = np.repeat(item.samples[:, :1], len(names), axis=1)
    assert fold(own, [environment], names).score == pytest.approx(0.123447, abs=1e-6)


def test_a_policy_that_passes_no_level_anywhere_scores_zero():
    suite = replace(REFERENCE, scoring=replace(REFERENCE.scoring, bootstrap=5))
    environments = [flat_environment([], 0.6, name, 0, True) for name in ("wave", "obstacle")]
    result = fold(suite, environments, (*METRICS, "quality"), evaluated=True)
    assert result.score == 0.0
    assert result.groups == {"tracking": 0.0, "safety": 0.0, "quality": 0.0}
    assert result.level == 0.0
    assert fold(suite, environments, (*METRICS, "quality"), evaluated=False).score is None
