"""The page at the end of a training: film, score and what fell, ends of episodes, curves."""

from __future__ import annotations

import json

import pytest
from gaitgauge.training.run import page
from gaitgauge.training.run.page import PAGE, write_page
from sample_results import sample

RUN = {
    "task": "<i>mine</i>",
    "backend": "mujoco",
    "seed": 3,
    "iteration": 20,
    "environment_steps": 2_500_000,
    "training_seconds": 90.0,
    "best_score": 0.75,
    "best_iteration": 10,
    "settings": {
        "environment": {
            "schedule": {"stretches": [{"name": "end", "begin": 0.8, "settings": "environment.a=1 environment.b=2"}]}
        }
    },
}


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A run directory with two films of the last checkpoint and one of an earlier one."""
    (tmp_path / "run.json").write_text(json.dumps(RUN))
    (tmp_path / "videos").mkdir()
    for name in ("model_5_flat", "model_20_flat", "model_20_stairs_fd", "film", "model_best_flat"):
        (tmp_path / "videos" / f"{name}.mp4").write_bytes(name.encode())
    points = {"mean reward": ([0.0, 1.0], [-2.0, 8.0]), "mean terrain level in training": ([0.0, 1.0], [0.0, 0.0])}
    monkeypatch.setattr(page, "logged_curves", lambda folder: points)
    return tmp_path


def test_without_a_score(run):
    written = write_page(run, scores=None, scalars={"Episode_Termination/trunk_contact": 0.25, "Loss/value": 1.0})
    text = written.read_text()
    assert written == run / PAGE
    assert "&lt;i&gt;mine&lt;/i&gt;" in text and "<i>mine" not in text
    assert "Stretch end, from 80 % of the run: a=1, b=2." in text
    assert "2.50 million steps" in text and "1.5 min of learning" in text
    assert text.count("<video") == 2  # those of the last checkpoint
    assert "trunk contact" in text and "0.250" in text
    assert text.count("<polyline") == 1, "level ground has no terrain level to draw"
    assert "Report" not in text


def test_with_the_last_score_and_what_fell(run):
    result = sample(suite="quick")
    for name in ("model_9", "model_20"):
        folder = run / "gauge" / "quick" / name
        folder.mkdir(parents=True)
        (folder / "results.json").write_text(json.dumps(result.to_data()) if name == "model_20" else "damaged")
    text = write_page(run, scores="quick", scalars={}).read_text()
    assert f"{result.score:.4f}" in text and "best 0.7500 at iteration 10" in text
    assert 'href="gauge/quick/model_20/report.html"' in text
    for row in result.environments:
        assert f'data-label="falls">{row.falls}<' in text
