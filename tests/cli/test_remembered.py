"""The time of a command line is remembered, and corrects what its next run estimates."""

import io
import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from gaitgauge.cli.console import Terminal
from gaitgauge.cli.errors import UserError
from gaitgauge.cli.progress import ProgressDisplay
from gaitgauge.cli.remembered import Remembered, folder_of_times

LINE = ("evaluate", "p.pt", "--out", "a")


@pytest.fixture
def after(tmp_path):
    """A run of 100 s has ended: it estimated half of the rest up to the middle, and the rest itself afterwards."""

    def run(*line):
        memory = Remembered(line, tmp_path)
        for spent in range(10, 100):
            memory.left(spent, spent / 100, (100 - spent) / (2 if spent < 50 else 1))
        memory.keep(100.0)
        return lambda *line: Remembered(line, tmp_path)

    return run


def test_the_next_run_of_a_line_corrects_its_estimates(after):
    again = after(*LINE)("evaluate", "p.pt", "--out=b")
    assert again.left(4.0, 0.0, None) == 96.0  # before anything is estimated
    assert again.left(20.0, 0.2, 40.0) == pytest.approx(80.0)
    # a slower machine: the estimate is longer, and its correction the same
    assert again.left(40.0, 0.2, 80.0) == pytest.approx(160.0)
    assert again.left(140.0, 0.7, 60.0) == pytest.approx(60.0)
    assert again.left(141.0, 0.2, 60.0) == pytest.approx(60.0)  # less done than before: the furthest counts


def test_what_follows_the_work_is_remembered_too(tmp_path):
    """Tables and a page of 4 s, of which the estimate said 2 s; and no more than three times what is estimated."""
    memory = Remembered(LINE, tmp_path)
    memory.left(20.0, 0.5, 2.0)
    memory.left(96.0, 1.0, 2.0)
    memory.keep(100.0)
    again = Remembered(LINE, tmp_path)
    assert again.left(20.0, 0.5, 2.0) == pytest.approx(6.0)
    assert again.left(70.0, 1.0, 2.5) == pytest.approx(5.0)


@pytest.mark.parametrize("line", [("evaluate", "q.pt"), ("evaluate", "p.pt", "--suite", "demo"), (*LINE, "--resume")])
def test_other_lines_and_runs_that_go_on_are_not_corrected(after, line):
    again = after(*LINE)(*line)
    assert (again.left(4.0, 0.0, None), again.left(20.0, 0.2, 40.0)) == (None, 40.0)


@pytest.mark.parametrize("text", ["", "[]", '{"seconds": 1, "factors": [1]}', '{"seconds": "x", "factors": []}'])
def test_a_spoilt_memory_is_none(after, tmp_path, text):
    again = after(*LINE)
    (file,) = tmp_path.iterdir()
    file.write_text(text)
    assert again(*LINE).left(20.0, 0.2, 40.0) == 40.0


def test_the_last_lines_are_kept(after, tmp_path, monkeypatch):
    monkeypatch.setattr("gaitgauge.cli.remembered._KEPT", 2)
    for i, name in enumerate("abc"):
        again = after("trial", name)
        os.utime(max(tmp_path.iterdir(), key=lambda f: f.stat().st_mtime_ns), (i, i))
    assert [again("trial", name).left(20.0, 0.2, 40.0) for name in "abc"] == pytest.approx([40.0, 80.0, 80.0])


def test_nothing_is_kept_of_short_commands_of_compilations_and_where_nothing_can_be_written(tmp_path, monkeypatch):
    def run(seconds, folder):
        memory = Remembered(LINE, folder)
        memory.left(1.0, 0.5, 4.0)
        memory.keep(seconds)
        return folder.is_dir() and len(list(folder.iterdir()))

    (tmp_path / "file").touch()
    assert not run(9.0, tmp_path / "a") and not run(20.0, tmp_path / "file" / "b")
    kernels = tmp_path / "kernels"
    (kernels / "step").mkdir(parents=True)
    os.utime(kernels / "step", (4e9, 4e9))
    monkeypatch.setitem(sys.modules, "warp", SimpleNamespace(config=SimpleNamespace(kernel_cache_dir=str(kernels))))
    assert not run(20.0, tmp_path / "c")
    os.utime(kernels / "step", (1e9, 1e9))
    assert run(20.0, tmp_path / "c") == 1


def test_a_user_without_a_home_has_no_memory(monkeypatch):
    """Such as ``docker run --user`` makes, with an image that sets no HOME."""
    monkeypatch.setenv("XDG_CACHE_HOME", "/cache")
    assert folder_of_times() == Path("/cache/gaitgauge/times")
    for name in ("XDG_CACHE_HOME", "HOME", "USERPROFILE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("os.path.expanduser", lambda path: path)
    assert folder_of_times() is None


def test_a_command_shows_its_last_time_from_the_start(tmp_path, monkeypatch):
    monkeypatch.setattr("gaitgauge.cli.progress.folder_of_times", lambda: tmp_path)
    monkeypatch.setattr("sys.argv", ["gaitgauge", *LINE])
    monkeypatch.setattr("time.process_time", lambda: 2.0)
    now, texts = 0.0, []

    def run(end=None):
        nonlocal now
        now, terminal = 0.0, Terminal()
        terminal.file = io.StringIO()
        with ProgressDisplay.of_start(terminal, "evaluate", clock=lambda: now):
            now = 2.0
            with ProgressDisplay(terminal, "gauging", clock=lambda: now) as display:
                now = 12.0
                display._tell(last=True)
                display.update(0.5, "1 of 2", left=7.4, last=True)
            now = 20.0
            if end:
                raise end
        texts.append(terminal.file.getvalue().splitlines())

    with pytest.raises(UserError):
        run(UserError("no such suite"))
    run()
    run()
    # the page and the tables take 0.3 times the start of 2 s; what was 8 s in all is 8 s again
    assert texts[0][-2:] == ["12 s: gauging, starting", "12 s: gauging, 1 of 2, about 8 s left"]
    assert texts[1][-2:] == ["12 s: gauging, starting, about 8 s left", "12 s: gauging, 1 of 2, about 8 s left"]
