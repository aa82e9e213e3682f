"""The leave-one-engine-out study on figures with a known answer."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import kendalltau

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import leave_one_engine_out as study


def test_tau_of_whole_and_repeated_samples_is_scipys():
    rng = np.random.default_rng(1)
    one, other = rng.integers(0, 6, 12).astype(float), rng.normal(size=12)
    drawn = rng.integers(0, 12, 12)
    for sample in (np.arange(12), drawn):
        counts = np.bincount(sample, minlength=12)[None].astype(float)
        assert study.tau(one, other, counts)[0] == pytest.approx(kendalltau(one[sample], other[sample]).statistic)
    assert study.tau(np.ones(3), np.arange(3.0), np.ones((1, 3)))[0] == 0.0


def test_violation_is_the_largest_difference_that_the_order_gets_wrong():
    real = np.array([0.1, 0.5, 0.9])
    assert study.violation(real, real) == 0.0
    assert study.violation(np.array([1.0, 3.0, 2.0]), real) == pytest.approx((0.0 + 0.4 + 0.4) / 3)


def test_a_jury_that_sees_the_truth_beats_a_judge_that_guesses(monkeypatch):
    monkeypatch.setattr(study, "RESAMPLES", 200)
    rng = np.random.default_rng(2)
    truth, guess = rng.uniform(size=20), rng.uniform(size=20)
    figures = dict.fromkeys((*study.TARGETS, *(f"metrics: {g}" for g in study.GROUPS)))

    def engines(i):
        known = {e: dict.fromkeys(figures, truth[i]) for e in ("newton:steel", "drake", "physx", study.TRAINING)}
        return known | {"mujoco": dict.fromkeys(figures, guess[i]), "return": None}

    found = study.analyse({"policies": {f"policy-{i}": engines(i) for i in range(20)}})
    assert found["jury_minus_mujoco"]["score"]["interval"][0] > 0.0
    rows = {(r["hidden"], r["predictor"]): r["tau"] for r in found["table"] if r["target"] == "score"}
    assert rows["drake", "newton: score"] == 1.0
    assert rows["drake", "mujoco: score"] < 0.5
    assert not any(f"{h}: score" == p for h, p in rows)  # no predictor knows what is hidden


def test_returns_of_training_are_none_where_no_curve_holds_them():
    """A curve without a row ended ``collect``."""
    assert study._return("baselines-CTS-seed-1") is None
    assert study._return("baselines-CTS-seed-0") > 0.0
    assert study._return("published-cts") is None
