"""Runs the notebook of the first training, with a training of two iterations."""

from __future__ import annotations

from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[2] / "docs" / "start" / "first_training.ipynb"


@pytest.mark.slow
def test_the_notebook_trains_judges_and_shows_the_film(tmp_path):
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    notebook = nbformat.read(NOTEBOOK, 4)
    nbformat.validate(notebook)
    (training,) = (cell for cell in notebook.cells if 'options = ""' in cell.source)
    small = 'task, options = "toy", "--num-envs 8 --iterations 2 --no-score"'
    training.source = training.source.replace('options = ""', small)
    nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    run = next((tmp_path / "logs" / "rsl_rl" / "toy").iterdir())
    assert (run / "model_2.pt").is_file()
    assert (tmp_path / "results" / "latest" / "report.html").is_file()
    printed = "".join(output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", ()))
    assert "finished, 2 iterations done" in printed and "pretrained" in printed
    if list((run / "videos").glob("*.mp4")):
        assert "video" in str(notebook.cells[-2].outputs)
    else:
        assert "No video of iteration 2" in printed
