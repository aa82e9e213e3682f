"""The film in a report: where the robot is shown, what becomes of machines that cannot draw, and one that is made."""

import os
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from gaitgauge.cli import clip
from gaitgauge.cli.errors import UserError
from gaitgauge.cli.picture import PLAIN, RICH, choose_renderer
from gaitgauge.gauge.report.page import CLIP
from gaitgauge.gauge.result import EnvironmentRow, read_result
from gaitgauge.gauge.store import StoreError

CARD = Path(__file__).parents[1] / "fuzz" / "seeds" / "results" / "results.json"
RESULT = read_result(CARD, StoreError)
make_clip, find = clip.make_clip, clip.FilmTime._find  # the suite's fixture puts others in their place


def rows(*places):
    names = ("terrain", "level", "friction", "payload")
    found = tuple(EnvironmentRow(**dict(zip(names, place, strict=True))) for place in places)
    return replace(RESULT, environments=found)


def test_robot_is_shown_where_it_was_judged():
    found = rows(
        ("flat", None, 0.6, 0.0), ("wave", 4, 0.6, 0.0), ("stairs_fd", 3, 0.2, 0.0), ("stairs_fd", 7, 0.6, 0.0),
        ("stairs_fd", 9, 1.0, 0.0), ("stairs_fd", 6, 0.6, 2.0),
    )  # fmt: skip
    assert clip.place(found) == ["--terrain", "stairs_fd", "--level", "7", "--friction", "0.6"]
    assert clip.place(rows(("wave", 0, 0.9, 0.0))) == ["--terrain", "wave", "--level", "1", "--friction", "0.9"]
    assert clip.place(rows(("flat", None, 0.6, 0.0))) == ["--terrain", "flat", "--friction", "0.6"]


def test_machine_that_cannot_draw_says_so_in_one_sentence(tmp_path, monkeypatch):
    def fail(command, **options):
        return subprocess.CompletedProcess(command, 2, stdout="", stderr="a notice\ngaitgauge: nothing draws here\n")

    monkeypatch.setattr(subprocess, "run", fail)
    assert make_clip(tmp_path, rows(("flat", None, 0.6, 0.0)), ["pretrained"]) == (
        "no clip of the robot: nothing draws here"
    )
    (tmp_path / CLIP).write_bytes(b"made before")
    assert make_clip(tmp_path, rows(("flat", None, 0.6, 0.0)), ["pretrained"]) is None


@pytest.mark.parametrize(
    ("found", "seconds"), [(("egl", RICH), 5.0), (("osmesa", PLAIN), 7.0), (UserError("nothing draws"), 3.5)]
)
def test_the_time_of_a_film_is_that_of_how_the_machine_draws(monkeypatch, found, seconds):
    """10 s were told on machines whose GPU draws it in 3 s, or that cannot draw; the start counts as it was seen."""

    def find_renderer():
        if isinstance(found, UserError):
            raise found
        return found

    monkeypatch.setattr(clip, "find_renderer", find_renderer)
    film = clip.FilmTime(3.0)
    find(film)
    assert film.seconds == seconds


def test_evaluate_films_unless_told_otherwise(run, tmp_path, policy, monkeypatch):
    suite = tmp_path / "tiny.toml"
    suite.write_text(
        """extends = "robogauge-1.1"
name = "tiny"
goals = [{ name = "max_velocity", phases = [0.1, 0.1] }]
matrix = { terrains = ["flat"], frictions = [0.6], seeds = [0], search_seeds = [0] }
settling = { longest = 0.1 }
"""
    )
    asked = []

    def film(folder: Path, result, options) -> str | None:
        asked.append((result.suite.name, options))
        (folder / CLIP).write_bytes(b"RIFF")
        return None if len(asked) == 1 else "no clip: nothing draws"

    monkeypatch.setattr(clip, "make_clip", film)
    command = ("evaluate", policy, "--suite", suite, "--threads", 1, "--out")
    assert run(*command, tmp_path / "a").exit_code == 0
    assert asked == [("tiny", [str(policy), "--suite", str(suite)])]
    assert "data:image/webp;base64,UklGRg==" in (tmp_path / "a" / "report.html").read_text()
    assert "no clip: nothing draws" in run(*command, tmp_path / "b", "--trust").stderr
    assert asked[1][1] == [str(policy), "--suite", str(suite), "--trust"]
    assert run(*command, tmp_path / "a", "--resume", "--no-clip").exit_code == 0
    assert len(asked) == 2


@pytest.mark.slow
def test_film_is_made(tmp_path, policy, monkeypatch):
    before = os.environ.get("MUJOCO_GL")
    try:
        choose_renderer()
    except UserError as error:
        pytest.skip(str(error))
    finally:
        os.environ.pop("MUJOCO_GL") if before is None else os.environ.update(MUJOCO_GL=before)
    monkeypatch.setattr(clip, "SECONDS", 0.4)
    assert make_clip(tmp_path, rows(("stairs_fd", 3, 0.6, 0.0)), [str(policy)]) is None
    assert (tmp_path / CLIP).read_bytes()[:4] == b"RIFF"
