"""Episode files that somebody edited or damaged: each is one sentence, and a folder of them loses the damaged ones alone."""

import json
import os
import zipfile

import numpy as np
import pytest
from gaitgauge.gauge import episodes
from gaitgauge.gauge.episodes import Episode, Record, RecordError, read_records

EPISODE = Episode(
    terrain="wave",
    level=3,
    friction=0.6,
    payload=0.0,
    seed=0,
    stage="eval",
    goals=("max_velocity", "diagonal_velocity"),
)
SAMPLES = {
    "samples": np.zeros((3, 2), np.float32),
    "goal_index": np.array([0, 0, 1], np.int16),
    "part_index": np.array([0, 7, 2], np.int16),
}


def record(**changes):
    return Record(**{"episode": EPISODE, "columns": ("dof_power", "quality"), **SAMPLES, **changes})


@pytest.fixture
def edited(tmp_path):
    """Writes a record with entries of its head, or arrays, replaced; None takes one out."""

    def write(head=None, **arrays):
        record().save(tmp_path)
        path = tmp_path / f"{EPISODE.key}.npz"
        with np.load(path) as data:
            old = json.loads(data["head"].tobytes())
            found = {k: data[k] for k in data.files if k != "head"} | arrays
        new = {k: v for k, v in (old | (head or {})).items() if v != "gone"}
        raw = json.dumps(new).encode() if not isinstance(head, bytes) else head
        np.savez(path, head=np.frombuffer(raw, np.uint8), **{k: v for k, v in found.items() if v is not None})
        return path

    return write


@pytest.mark.parametrize(
    ("head", "arrays", "sentence"),
    [
        ({"falls": "many"}, {}, "its head: falls is 'many'; it must be a whole number"),
        ({"falls": -1}, {}, "falls is -1"),
        ({"fallen": [[0, 7]]}, {}, "fallen has 1 falls, not 0"),
        ({"falls": 1, "fallen": [[0]]}, {}, "fallen"),
        ({"falls": 1, "fallen": [[0, -7]]}, {}, "fallen"),
        ({"diverged": 1}, {}, "diverged is 1; it must be true or false"),
        ({"columns": 3}, {}, "columns is 3"),
        ({"columns": ["one"]}, {}, r"samples is float32 \[3, 2\], not float32 \[3, 1\]"),
        ({"falls": "gone"}, {}, "it lacks 'falls'"),
        ({"goals": "gone"}, {}, "it lacks 'goals'"),
        ({"friction": float("nan")}, {}, "friction is nan"),
        ({"seed": -3}, {}, "seed is -3"),
        ({"level": 4}, {}, "it holds episode eval-wave-L4"),
        ({"terrain": "../../x"}, {}, "it holds episode eval-../../x"),
        ({"control_steps": 10**30}, {}, "2.63"),
        ({"success": [[[[]]]]}, {}, "success is"),
        ({}, {"samples": np.zeros(3, np.float32)}, "samples is float32"),
        ({}, {"samples": np.zeros((3, 2))}, "samples is float64"),
        ({}, {"samples": np.array(["a"] * 3)}, "samples is"),
        ({}, {"samples": np.float32(3)}, "damaged"),
        ({}, {"goal_index": np.array([0, 0, 2], np.int16)}, "goal_index is out of range"),
        ({}, {"goal_index": np.array([0, 0], np.int16)}, "goal_index is int16"),
        ({}, {"part_index": np.array([0, -1, 0], np.int16)}, "part_index is out of range"),
        ({}, {"touching": np.zeros(2, np.bool_)}, r"touching is bool \[2\], not bool \[3\]"),
        ({}, {"touching": np.zeros(3)}, "touching is float64"),
        ({}, {"part_index": None}, "part_index"),
    ],
)
def test_an_edited_record_is_one_sentence(edited, head, arrays, sentence):
    path = edited(head, **arrays)
    with pytest.raises(RecordError, match=sentence) as caught:
        Record.load(path)
    assert str(caught.value).isprintable() and path.name in str(caught.value)


def test_a_record_of_before_does_not_say_where_it_fell(edited):
    assert Record.load(edited({"falls": 2, "fallen": "gone"})).fallen is None


@pytest.mark.parametrize("head", [b"", b"[]", b"3", b"{" * 5000, b"\xff", b'{"terrain": "\\ud800"}', b"9" * 5000])
def test_a_head_that_is_no_table_is_one_sentence(edited, tmp_path, head):
    path = edited()
    np.savez(path, head=np.frombuffer(head, np.uint8), **SAMPLES)
    with pytest.raises(RecordError, match="is damaged"):
        Record.load(path)


def test_an_archive_that_unpacks_to_more_than_a_record_is_refused(edited, monkeypatch):
    """A thousandth of what it unpacks to; the limit is a tenth of the real one."""
    monkeypatch.setattr(episodes, "_LARGEST", 10**8)
    path = edited()
    with (
        zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive,
        archive.open("more.npy", "w", force_zip64=True) as entry,
    ):
        for _ in range(11):
            entry.write(bytes(10**7))
    assert path.stat().st_size < 2e5
    with pytest.raises(RecordError, match="more than 100 MB"):
        Record.load(path)


def test_one_damaged_episode_is_set_aside_and_the_others_stay(tmp_path):
    record().save(tmp_path)
    bad = tmp_path / f"{'x' * 250}.npz"
    bad.write_bytes(b"half")
    found, damaged = read_records(tmp_path)
    assert list(found) == [EPISODE]
    assert [d.read_bytes() for d in damaged] == [b"half"]
    assert read_records(tmp_path)[1] == []


@pytest.mark.parametrize("kind", ["pipe", "link", "folder"])
def test_what_is_no_file_is_set_aside(tmp_path, kind):
    """A pipe was waited for without an end, and /dev/zero read until the memory was full."""
    path = tmp_path / f"{EPISODE.key}.npz"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "link":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    with pytest.raises(RecordError, match="is damaged"):
        Record.load(path)
    assert read_records(tmp_path) == ({}, [path.with_name(f"{path.name}.damaged")])
