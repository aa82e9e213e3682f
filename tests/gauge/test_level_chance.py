"""Success by level, the search done again, and a seed's luck."""

from functools import partial

import numpy as np
import pytest
from gaitgauge.gauge.chance.level_chance import bisect, bisected_levels, redraw_levels, shared_luck, success_curves


def outcomes(reached, played, first=0):
    return {first + seed: seed < reached for seed in range(played)}


# ---- the fit --------------------------------------------------------------------------------------------------------


def test_a_curve_falls_with_the_level_and_goes_through_what_was_played():
    (curve,) = success_curves([{5: outcomes(4, 4), 8: outcomes(2, 4), 9: outcomes(0, 2)}], ["wave"], 10)
    assert (np.diff(curve) <= 0.0).all()
    assert curve[4] > 0.95 and 0.3 < curve[7] < 0.7 and curve[9] < 0.1


def test_five_of_five_is_not_certainty_and_none_of_two_not_impossibility():
    passed, failed = success_curves([{5: outcomes(5, 5)}, {5: outcomes(0, 2)}], ["a", "b"], 10)
    assert 0.8 < passed[4] < 0.9999
    assert 0.0001 < failed[4] < 0.2


def test_more_trials_leave_less_open():
    few, many = ({5: outcomes(n, n), 6: outcomes(0, n)} for n in (2, 40))
    (curve,), (sure,) = success_curves([few], ["a"], 10), success_curves([many], ["a"], 10)
    assert sure[4] > curve[4] > 0.5 and sure[5] < curve[5] < 0.5


def test_environments_of_a_terrain_share_their_width():
    """A terrain on which levels 5 to 8 are passed by some seeds says that its curves are wide, also where four trials do not."""
    wide = [{4: outcomes(16, 20), 5: outcomes(12, 20), 6: outcomes(10, 20), 7: outcomes(8, 20)}]
    lone = {5: outcomes(4, 4), 8: outcomes(0, 2)}
    together, alone = success_curves([*wide, lone], ["a", "a"], 10)[1], success_curves([lone], ["a"], 10)[0]
    apart = success_curves([*wide, lone], ["b", "a"], 10)[1]
    slope = [c[4] - c[8] for c in (together, apart, alone)]
    assert slope == sorted(slope)


# ---- the search -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("passed", "level"),
    [("1111111111", 10), ("0000000000", 0), ("1000000000", 1), ("1111100000", 5), ("0000111000", 7), ("1111011111", 4)],
)
def test_bisection_goes_5_then_8_or_2(passed, level):
    """Of the last: 5 is not passed, then it asks 2, 3 and 4."""
    table = np.array([c == "1" for c in passed])
    assert bisect(table) == level
    assert bisect(np.stack([table, ~table]))[0] == level


def test_redrawn_levels_have_the_distribution_of_the_search():
    """Three levels, five seeds, four needed; chances .99, .8, .2: P(pass) = .99902, .73728, .00672."""
    curves = np.array([[0.99, 0.8, 0.2]])
    levels = redraw_levels(
        curves,
        seeds=5,
        find=partial(bisected_levels, pass_rate=0.8),
        luck=0.0,
        resamples=20_000,
        generator=np.random.default_rng(0),
    )[0]
    shares = np.bincount(levels.astype(int), minlength=4) / levels.size
    # asked first is 2; then 3, or 1
    assert shares == pytest.approx([0.0003, 0.2625, 0.7323, 0.005], abs=0.01)


def test_luck_moves_environments_together():
    curves = np.full((2, 10), 1e-6)
    curves[:, 0] = 0.8

    def correlation(luck):
        drawn = redraw_levels(
            curves,
            seeds=5,
            find=partial(bisected_levels, pass_rate=0.8),
            luck=luck,
            resamples=4000,
            generator=np.random.default_rng(1),
        )
        return np.corrcoef(drawn)[0, 1]

    assert abs(correlation(0.0)) < 0.05
    assert correlation(0.9) > 0.5


def test_shared_luck_is_found_where_it_is_and_not_where_it_is_not():
    generator = np.random.default_rng(2)
    curves = np.full((40, 10), 0.5)

    def estimate(luck):
        common = np.sqrt(luck) * generator.standard_normal(5)
        own = np.sqrt(1 - luck) * generator.standard_normal((40, 5))
        return shared_luck([{5: dict(enumerate((row < 0).tolist()))} for row in common + own], curves)

    assert np.mean([estimate(0.0) for _ in range(40)]) < 0.05
    assert np.mean([estimate(0.6) for _ in range(40)]) == pytest.approx(0.55, abs=0.12)


def test_one_environment_says_nothing_about_luck():
    assert shared_luck([{5: outcomes(3, 5)}], np.full((1, 10), 0.6)) == 0.0
