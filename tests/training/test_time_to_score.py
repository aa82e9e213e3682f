"""``benchmarks/time_to_score.py``: minutes from the command, and the first checkpoint with a score."""

import json

import pytest
import time_to_score
from time_to_score import Times, TimesError, main, table, wall_times
from torch.utils.tensorboard import SummaryWriter

BEGAN = 1_790_000_000.0


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A run of 100 steps an iteration on two processes of 10 worlds, with an iteration every 30 s, a minute after its beginning."""
    folder = tmp_path / "2026-11-28_02-29-10"
    folder.mkdir()
    settings = {"environment": {"num_envs": 10}, "training": {"run": {"steps_per_iteration": 5}}}
    noted = {"task": "go2-x", "seed": 3, "device": "GPU", "settings": settings, "began": "2026-09-21T14:13:20+00:00"}
    (folder / "run.json").write_text(json.dumps(noted))
    writer = SummaryWriter(folder)
    for iteration in range(6):
        writer.add_scalar(
            "Perf/total_steps", 100.0 * (iteration + 1), iteration, walltime=BEGAN + 60.0 + 30.0 * iteration
        )
    writer.close()
    names = ["model_2.pt", "model_2.rank1.pt", "model_4.pt", "model_4.rank1.pt", "model_6.gauge.pt", "last.gauge.pt"]
    for name in names:
        (folder / name).touch()
    scores = {"model_2.pt": 0.4, "model_4.pt": 0.66, "model_6.gauge.pt": 0.64}
    card = lambda policy, place, options: type("Card", (), {"score": scores[policy.name]})()  # noqa: E731
    monkeypatch.setattr(time_to_score, "card_of", card)
    return folder


def test_times_count_from_the_command(run):
    assert wall_times(run)[2] == (pytest.approx(1.5), pytest.approx(200e-6))
    (run / "run.json").write_text(json.dumps(json.loads((run / "run.json").read_text()) | {"resumed": [{}]}))
    with pytest.raises(TimesError, match="was resumed"):
        wall_times(run)


def test_the_first_checkpoint_with_a_score_counts(run, tmp_path, capsys):
    main([str(run), "--out", str(tmp_path / "out"), "--scores", "0.6", "0.65", "0.7"])
    assert (
        capsys.readouterr().out.splitlines()[-1]
        == "| go2-x | 3 | 2 × GPU | 2.5 (0 M) | 2.5 (0 M) | – | 0.6400, 3.5 min |"
    )
    (times,) = json.loads((tmp_path / "out" / "times.json").read_text())
    assert [point["minutes"] for point in times["points"]] == pytest.approx([1.5, 2.5, 3.5])


def test_a_median_needs_the_score_in_all_seeds():
    points = [[(5.0, 0.6), (9.0, 0.7)], [(7.0, 0.65), (9.0, 0.68)]]
    runs = [
        Times(
            run="a",
            task="t",
            seed=seed,
            device="GPU",
            processes=1,
            points=[time_to_score.Point(iteration=1, minutes=m, steps=1.0, score=s) for m, s in own],
        )
        for seed, own in enumerate(points)
    ]
    assert table(runs, (0.6, 0.7)).splitlines()[-1] == "| t | median of 2 | 1 × GPU | 6.0 | 1 of 2 | |"
