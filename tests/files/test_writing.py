"""Files are whole or not there, folders have one writer, and JSON is written whatever is in it."""

import errno
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from gaitgauge.files.writing import csv_text, json_text, lock_folder, make_folder, replacing, write_atomically


class WriteError(RuntimeError):
    pass


def test_a_failure_keeps_what_was_there_and_leaves_nothing_behind(tmp_path):
    target = tmp_path / "file.txt"
    write_atomically(target, "old", WriteError)
    with (
        pytest.raises(WriteError, match=r"cannot write '.*file.txt': no space left on device; free some space"),
        replacing(target, WriteError) as partial,
    ):
        partial.write_text("half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_another_s_error_passes_through_and_leaves_nothing_behind(tmp_path):
    with pytest.raises(KeyError), replacing(tmp_path / "file", WriteError) as partial:
        partial.write_text("half")
        raise KeyError("x")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["missing/file", "x" * 300, "folder"])
def test_impossible_places_are_one_sentence(tmp_path, name):
    (tmp_path / "folder").mkdir()
    with pytest.raises(WriteError, match="cannot write '") as caught:
        write_atomically(tmp_path / name, "text", WriteError)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["a\0b", "\ud800", "x" * 300, "file/b"])
def test_a_folder_that_cannot_be_is_one_sentence(tmp_path, name):
    (tmp_path / "file").write_text("")
    with pytest.raises(WriteError, match="choose another --out") as caught:
        make_folder(tmp_path / name, WriteError)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("name", ["", ".", "..", "/", "a\0b", "pipe"])
def test_only_a_file_is_ever_replaced(tmp_path, monkeypatch, name):
    """As root, a new file would take the place of a device; ``--out .`` was a traceback."""
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    with pytest.raises(WriteError, match="cannot write '") as caught:
        write_atomically(Path(name), "text", WriteError)
    assert str(caught.value).isprintable()
    assert [p.name for p in tmp_path.iterdir()] == ["pipe"]
    assert Path("pipe").is_fifo()


@pytest.mark.parametrize("device", ["/dev/null", "/dev/stdout"])
def test_a_device_is_never_replaced(monkeypatch, device):
    monkeypatch.setattr(os, "replace", lambda *names: pytest.fail("replaced"))
    with pytest.raises(WriteError, match=f"cannot write '{device}': it is no file"):
        write_atomically(Path(device), "text", WriteError)


def test_no_text_of_a_table_is_a_formula():
    row = ["=cmd|' /C calc'!A0", "+1+1", "@SUM(1)", "-2+3", "\t=1", "-0.5", -0.5, "a=b", None]
    assert csv_text([row]) == "'=cmd|' /C calc'!A0,'+1+1,'@SUM(1),'-2+3,'\t=1,-0.5,-0.5,a=b,\n"


def test_half_written_files_of_another_s_folder_are_left_alone(tmp_path):
    """A training that outlived its sweep was writing its checkpoint there."""
    mine, theirs = (folder / ".0123456789abcdef.partial" for folder in (tmp_path, tmp_path / "runs" / "a"))
    theirs.parent.mkdir(parents=True)
    (theirs.parent / ".lock").touch()
    for path in (mine, theirs):
        path.write_text("half")
    lock_folder(tmp_path, WriteError).release()
    assert not mine.exists()
    assert theirs.exists()


def test_a_name_as_long_as_names_can_be(tmp_path):
    target = tmp_path / ("x" * 255)
    write_atomically(target, b"data", WriteError)
    assert target.read_bytes() == b"data"


def test_many_writers_of_one_file_do_not_meet(tmp_path):
    target = tmp_path / "file"
    texts = [str(i) * 100_000 for i in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda t: write_atomically(target, t, WriteError), texts * 5))
    assert target.read_text() in texts
    assert list(tmp_path.iterdir()) == [target]


def test_json_of_what_json_cannot_hold():
    data = {"nan": float("nan"), "list": [float("inf"), 1.5, None], "half \ud800": "\udcff", 3: (True,)}
    assert json.loads(json_text(data)) == {
        "nan": "nan",
        "list": ["inf", 1.5, None],
        "half \\ud800": "\\udcff",
        "3": [True],
    }


def test_a_folder_has_one_writer(tmp_path, monkeypatch):
    monkeypatch.setattr("gaitgauge.files.writing._PATIENCE", 0.1)
    hold = (
        "import sys; from pathlib import Path; from gaitgauge.files.writing import lock_folder\n"
        "lock = lock_folder(Path(sys.argv[1]), RuntimeError); print('held', flush=True); sys.stdin.read()"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", hold, tmp_path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert other.stdout.readline() == "held\n"
    with pytest.raises(WriteError, match="another process is writing to"):
        lock_folder(tmp_path, WriteError)
    other.kill()
    other.wait()
    stray = tmp_path / "below" / ".0123456789abcdef.partial"
    stray.parent.mkdir()
    stray.write_text("half")
    kept = [tmp_path / "kept.partial", tmp_path / ".somebody's.partial", tmp_path / ".bed.partial.toml"]
    for path in kept:
        path.write_text("somebody's")
    lock_folder(tmp_path, WriteError).release()
    assert not stray.exists()
    assert all(path.exists() for path in kept)


def test_files_are_written_by_the_rules_of_windows(tmp_path, monkeypatch):
    """Windows opens no folder and flushes no file that is open for reading alone: every write failed there."""
    import fcntl

    opened, flushed = os.open, os.fsync

    def open_file(path, flags, *more):
        if os.path.isdir(path):
            raise PermissionError(13, "Permission denied", str(path))
        return opened(path, flags, *more)

    def flush(descriptor):
        if fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(9, "Bad file descriptor")
        flushed(descriptor)

    monkeypatch.setattr("sys.platform", "win32")
    monkeypatch.setattr("os.open", open_file)
    monkeypatch.setattr("os.fsync", flush)
    write_atomically(tmp_path / "a.json", "{}", RuntimeError)
    assert (tmp_path / "a.json").read_text() == "{}"
