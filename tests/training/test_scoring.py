"""Commands beside a training: their order, failures, and how the slow ones are given up."""

import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from gaitgauge.policy.finding import PRETRAINED
from gaitgauge.training.run import side_process
from gaitgauge.training.run.beside import Videos
from gaitgauge.training.run.filming import Filmer
from gaitgauge.training.run.scoring import Scorer
from gaitgauge.training.run.side_process import Job, SideProcess


def job(folder: Path, number: int, *command: str) -> Job:
    return Job(
        command=command,
        checkpoint=Path(f"model_{number}.pt"),
        iteration=number,
        output=folder / "side" / f"{number}.txt",
    )


def python(folder: Path, number: int, code: str) -> Job:
    return job(folder, number, sys.executable, "-c", code)


def test_jobs_run_in_order_and_not_on_the_gpu(tmp_path):
    side = SideProcess()
    code = "import os; print(repr(os.environ['CUDA_VISIBLE_DEVICES']))"
    for number in (1, 2):
        side.submit(python(tmp_path, number, code))
    assert side.pending == 2
    finished = side.drain(30.0)
    assert [(f.job.iteration, f.failure) for f in finished] == [(1, ""), (2, "")]
    assert (tmp_path / "side" / "2.txt").read_text() == "''\n"
    assert side.pending == 0


def test_failures_are_reported(tmp_path):
    side = SideProcess()
    side.submit(python(tmp_path, 7, "import sys; print('oops', file=sys.stderr); sys.exit(3)"))
    (finished,) = side.drain(30.0)
    assert finished.failure == f"exit code 3; see {tmp_path / 'side' / '7.log'}"
    assert (tmp_path / "side" / "7.log").read_text() == "oops\n"
    side.submit(job(tmp_path, 8, "/no/such/program"))
    assert side.poll()[0].failure == "cannot start /no/such/program: No such file or directory"


def test_a_folder_that_cannot_be_is_the_failure_of_its_job(tmp_path):
    """A full disk, or a file where the folder of scores would be: the training goes on."""
    (tmp_path / "gauge").touch()
    side = SideProcess()
    side.submit(
        Job(command=["true"], checkpoint=tmp_path / "model_1.pt", iteration=1, output=tmp_path / "gauge" / "1.json")
    )
    (finished,) = side.drain(10.0)
    assert finished.failure.startswith("cannot start true: ") and "gauge" in finished.failure


def test_the_oldest_waiting_job_is_given_up_and_a_running_one_can_be_stopped(tmp_path):
    side = SideProcess()
    for number in range(3):
        side.submit(python(tmp_path, number, "import time; time.sleep(60)"))
    assert [(f.job.iteration, f.failure) for f in side.poll()] == [(1, "skipped")]
    start = time.monotonic()
    side.close()
    assert time.monotonic() - start < 5.0 and side.pending == 0


def test_jobs_of_one_checkpoint_wait_together(tmp_path):
    side = SideProcess()
    for number in (0, 0, 1, 1, 2, 2):
        side.submit(python(tmp_path, number, "import time; time.sleep(60)"))
    assert [(f.job.iteration, f.failure) for f in side.poll()] == [(n, "skipped") for n in (0, 1, 1)]
    assert side.pending == 3
    side.close()


@pytest.mark.slow
def test_a_gauge_that_cannot_play_says_why(tmp_path):
    """The gauge itself runs; the checkpoint is none."""
    (tmp_path / "model_3.pt").write_bytes(b"nothing of the kind")
    scorer = Scorer(tmp_path, suite="quick", threads=1)
    scorer.submit(tmp_path / "model_3.pt", 3)
    (report,) = scorer.drain(60.0)
    assert (report.iteration, dict(report.scores)) == (3, {})
    log = tmp_path / "gauge" / "quick" / "model_3.log"
    assert report.failure == f"exit code 2; see {log}" and "model_3.pt" in log.read_text()


def test_a_film_of_each_terrain_once(tmp_path, monkeypatch):
    started = []

    class Ended:
        def __init__(self, command, **options):
            started.append(command[command.index("play") :])

        def poll(self):
            return 0

    monkeypatch.setattr(side_process.subprocess, "Popen", Ended)
    filmer = Filmer(tmp_path, terrains=("flat", "stairs_fd"), command=(0.75, 0.0, 0.0))
    for _ in range(2):
        filmer.submit(tmp_path / "model_5.pt", 5)
    films = [tmp_path / "videos" / f"model_5_{terrain}.mp4" for terrain in ("flat", "stairs_fd")]
    assert filmer.take(5.0) == ([(film, 5) for film in films], "")
    assert [command[3] for command in started] == ["flat", "stairs_fd"]
    for command, film in zip(started, films, strict=True):
        assert command[command.index("--out") + 1] == str(film)
        assert command[command.index("--command") + 1 :] == ["0.75", "0.0", "0.0"]


@pytest.mark.parametrize(
    ("every", "last", "seconds", "filmed"),
    [(True, False, 9.0, [7]), (False, True, 9.0, [8]), (True, True, 9.0, [7, 8]), (False, True, 0.0, [])],
)
def test_films_every_so_often_and_at_the_end(tmp_path, monkeypatch, every, last, seconds, filmed):
    filmer, asked, said = Filmer(tmp_path, terrains=("flat",), every=every, last=last), [], []
    monkeypatch.setattr(filmer, "submit", lambda path, iteration: asked.append(iteration))
    run = SimpleNamespace(iteration=7, message=said.append)
    videos = Videos(run, filmer)
    videos.submit(tmp_path / "model_7.pt")
    run.iteration = 8
    videos.finish(tmp_path / "model_8.pt", seconds)
    assert asked == filmed
    assert [sentence[:23] for sentence in said] == ["No film: the time limit"] * (seconds == 0.0)


def test_a_machine_that_cannot_draw_is_told_once(tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    filmer = Filmer(tmp_path, terrains=("flat",))
    filmer.submit(PRETRAINED, 20)
    videos, sentence = filmer.take(120.0)
    assert videos == []
    assert sentence.startswith("No video of iteration 20, and none from here on; training goes on: ")
    assert "MUJOCO_GL=nonsense does not draw" in sentence and "\n" not in sentence
    filmer.submit(PRETRAINED, 40)
    assert filmer.take(5.0) == ([], "")


@pytest.mark.slow
def test_a_video_of_a_checkpoint(tmp_path):
    filmer = Filmer(tmp_path, terrains=("flat",))
    filmer.submit(PRETRAINED, 20)
    videos, sentence = filmer.take(600.0)
    if "does not draw" in sentence or "neither EGL nor OSMesa" in sentence:
        pytest.skip(sentence)
    assert (videos, sentence) == ([(tmp_path / "videos" / f"{PRETRAINED.stem}_flat.mp4", 20)], "")
    assert videos[0][0].stat().st_size > 10_000
    assert [f.name for f in (tmp_path / "videos").iterdir()] == [videos[0][0].name]
