"""``benchmarks/gap_over_training.py``: where checkpoints stand, which tables belong together, what a ranking says."""

from dataclasses import replace
from types import SimpleNamespace

import gap_over_training as gap
import pytest
from gaitgauge.gauge.suite import load_suite
from gaitgauge.training.tasks import find_task


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """Two folders of files that say when they were saved: iteration in the name, 2 million steps an iteration."""

    def load_policy(path):
        iteration = int(path.stem.removeprefix("model_"))
        provenance = {"iteration": iteration, "environment_steps": 2e6 * iteration}
        return SimpleNamespace(contract=SimpleNamespace(provenance=provenance))

    monkeypatch.setattr(gap, "load_policy", load_policy)

    def make(*stretches):
        made = []
        for number, iterations in enumerate(stretches):
            folder = tmp_path / str(number)
            folder.mkdir()
            for iteration in iterations:
                (folder / f"model_{iteration}.pt").touch()
            (folder / "best.pt").touch()
            made.append(folder)
        return made

    return make


def test_a_count_that_starts_over_is_added_and_one_that_goes_on_is_not(folders):
    found = gap.find_checkpoints(folders((10, 20), (5, 15), (20, 30)), None)
    assert [(c.stretch, c.iteration, c.steps) for c in found] == [
        (1, 10, 20.0),
        (1, 20, 40.0),
        (2, 5, 50.0),
        (2, 15, 70.0),
        (3, 20, 80.0),
        (3, 30, 100.0),
    ]


def test_steps_before_are_taken_as_given(folders):
    made = folders((10,), (5, 10))
    assert [c.steps for c in gap.find_checkpoints(made, [0.0, 100.0], every=10)] == [20.0, 120.0]
    with pytest.raises(gap.GapError, match="1 numbers for 2 folders"):
        gap.find_checkpoints(made, [0.0])


def test_training_suite_keeps_times_and_takes_the_physics(tmp_path):
    plain, environment = load_suite("robogauge-1.1"), find_task("go2-moe-cts").environment
    suite = load_suite(str(gap.training_suite(plain, environment.physics, environment.joints.parameters, tmp_path)))
    assert suite.physics.control_period == pytest.approx(0.02)
    assert (suite.physics.timestep, suite.physics.cone) == (0.005, "pyramidal")
    watches = {"watch_tilt": 2.5, "watch_penetration": 0.035}  # the gauge's own
    assert environment.physics.torque_speed_limit  # it was left out
    assert suite.physics == replace(environment.physics, **watches)
    assert suite.metrics.interval * suite.physics.timestep == pytest.approx(0.1)
    assert suite.noise.latency * suite.physics.timestep == pytest.approx(0.018, abs=0.0025)
    assert (suite.scoring, suite.goals, suite.matrix) == (plain.scoring, plain.goals, plain.matrix)


def test_tables_of_two_engines_become_one(tmp_path):
    who = {"stretch": "1", "iteration": "20", "environment_steps_millions": "40", "policy_sha256": "a", "protocol": "p"}
    cpu = who | {"mujoco_score": "0.5", "mujoco_warp_score": ""}
    gpu = who | {"mujoco_score": "", "mujoco_warp_score": "0.7", "training_physics": "d"}
    merged = gap.merge(gap.merge({}, cpu), gpu)
    assert (merged["mujoco_score"], merged["mujoco_warp_score"]) == ("0.5", "0.7")
    gap.write_table(tmp_path / "t.csv", {("1", "20"): merged})
    assert gap.read_table(tmp_path / "t.csv")["1", "20"]["training_physics"] == "d"
    with pytest.raises(gap.GapError, match="policy_sha256 is 'a' in the earlier table and 'b' here"):
        gap.merge(cpu, gpu | {"policy_sha256": "b"})


def test_ranking():
    scores = {"mujoco_score": (0.1, 0.4, 0.3), "mujoco_warp_score": (0.2, 0.5, 0.6), "mean_reward": (3.0, 2.0, 1.0)}
    rows = [{name: str(values[i]) for name, values in scores.items()} for i in range(3)]
    warp, reward, level = gap.correlations(rows)
    assert "+0.500 (3 checkpoints)" in warp and "scores 0.3000, the best 0.4000" in warp
    assert "-0.500 (3 checkpoints)" in reward and "scores 0.1000" in reward
    assert "too few" in level


def test_training_figures_are_those_before_the_checkpoint():
    series = [(1.0, 10.0), (2.0, 20.0), (3.0, 30.0), (4.0, 99.0)]
    assert gap.mean_before(series, 3.0, 1.5) == 25.0
    assert gap.mean_before(series, 9.0, 1.0) is None
