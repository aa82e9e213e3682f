"""Records on disk: they come back as they were, and what is not a run's folder is left alone."""

import json
import math
import re

import numpy as np
import pytest
from gaitgauge.files.writing import lock_folder
from gaitgauge.gauge import store
from gaitgauge.gauge.episodes import Record, RecordError
from gaitgauge.gauge.store import RunFolder, StoreError
from scripted_gauge import DIAGONAL, MAXIMUM, episode

REQUEST = {"suite": "s 1", "seeds": [0, 1], "level": None}


def opened(path, *, resume=False):
    with RunFolder(path, REQUEST, resume=resume):
        pass


def put(path, record):
    with RunFolder(path, REQUEST, resume=False) as folder:
        folder.put(record)


def records(path):
    with RunFolder(path, REQUEST, resume=True) as folder:
        return folder.records


def full_record(**changes):
    values = np.array([[0.5, math.nan], [-1e9, 0.1], [math.inf, 1.0]], dtype=np.float32)
    options = {
        "episode": episode(DIAGONAL, MAXIMUM, friction=0.1 + 0.2, terrain="wave", level=3),
        "falls": 2,
        "fallen": ((0, 7), (0, 7)),
        "diverged": True,
        "control_steps": 12,
        "physics_steps": 125,
        "columns": ("dof_power", "quality"),
        "samples": values,
        "goal_index": np.array([0, 0, 1], dtype=np.int16),
        "part_index": np.array([0, 7, 2], dtype=np.int16),
        "touching": np.array([False, True, False]),
    }
    return Record(**{**options, **changes})


def same(one, other):
    assert one.summary() == other.summary()
    assert one.episode == other.episode
    assert (one.columns, one.fallen) == (other.columns, other.fallen)
    for name in ("samples", "goal_index", "part_index"):
        assert getattr(one, name).dtype == getattr(other, name).dtype
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes()
    assert (one.touching is None) == (other.touching is None)
    assert one.touching is None or one.touching.tolist() == other.touching.tolist()


@pytest.mark.parametrize("success", [None, True, False])
def test_a_record_comes_back_bit_by_bit(tmp_path, success):
    record = full_record(success=success)
    put(tmp_path / "run", record)
    again = records(tmp_path / "run")[record.episode]
    same(again, record)
    assert again.success is success
    assert again.diverged is True


def test_a_record_without_samples_comes_back(tmp_path):
    record = Record(episode=episode("target_pos_velocity", stage="search"), success=True)
    put(tmp_path, record)
    same(records(tmp_path)[record.episode], record)


def test_what_a_killed_process_left_half_written_is_no_record_and_goes(tmp_path):
    record = full_record()
    put(tmp_path, record)
    half = tmp_path / "episodes" / ".0123456789abcdef.partial.npz"
    half.write_bytes(b"half")
    assert list(records(tmp_path)) == [record.episode]
    assert not half.exists()


@pytest.mark.parametrize(
    ("wanted", "sentence"), [("another", "belongs to another run"), ("same", "already holds this run")]
)
def test_a_run_that_came_first_keeps_its_folder_though_it_ends_while_another_waits(
    tmp_path, monkeypatch, wanted, sentence
):
    """The other saw a folder without an episode, and would have taken this run's records for its own."""
    request = {**REQUEST, "suite": "s 2"} if wanted == "another" else REQUEST
    first = RunFolder(tmp_path, {**REQUEST, "seeds": [7]}, resume=False)
    first.__exit__()

    def lock(folder, error):
        """What happens while the second one waits for the lock: a first run of REQUEST begins, keeps a record and ends."""
        monkeypatch.setattr(store, "lock_folder", lock_folder)
        put(tmp_path, full_record())
        return lock_folder(folder, error)

    monkeypatch.setattr(store, "lock_folder", lock)
    with pytest.raises(StoreError, match=sentence):
        RunFolder(tmp_path, request, resume=False)
    assert json.loads((tmp_path / "request.json").read_text()) == REQUEST
    assert list(records(tmp_path)) == [full_record().episode]  # the lock is free again


def test_records_that_results_do_not_count_are_discarded(tmp_path):
    kept, other = full_record(), full_record(episode=episode(DIAGONAL, seed=7))
    with RunFolder(tmp_path, REQUEST, resume=False) as folder:
        folder.put(kept)
        folder.put(other)
        folder.discard_all_but([kept.episode])
    assert list(records(tmp_path)) == [kept.episode]


def damaged(kind, data):
    return {
        "truncated": data[: len(data) // 2],
        "empty": b"",
        "text": b"not an archive",
        "flipped": data[:300] + bytes(b ^ 0xFF for b in data[300:340]) + data[340:],
        "array": b"\x93NUMPY" + data[6:],
    }[kind]


@pytest.mark.parametrize("kind", ["truncated", "empty", "text", "flipped", "array"])
def test_a_damaged_record_is_one_sentence(tmp_path, kind):
    record = full_record()
    put(tmp_path, record)
    file = tmp_path / "episodes" / f"{record.episode.key}.npz"
    file.write_bytes(damaged(kind, file.read_bytes()))
    with pytest.raises(RecordError, match=r"is damaged .*; delete it and run again with --resume") as caught:
        Record.load(file)
    assert "\n" not in str(caught.value)
    assert str(file) in str(caught.value)
    broken = file.read_bytes()
    assert records(tmp_path) == {}
    assert file.with_name(file.name + ".damaged").read_bytes() == broken


def test_a_record_under_another_episodes_name_is_damaged(tmp_path):
    record = full_record()
    put(tmp_path, record)
    other = episode(DIAGONAL)
    (tmp_path / "episodes" / f"{record.episode.key}.npz").rename(tmp_path / "episodes" / f"{other.key}.npz")
    with pytest.raises(RecordError, match=re.escape(f"it holds episode {record.episode.key}")):
        Record.load(tmp_path / "episodes" / f"{other.key}.npz")
    assert records(tmp_path) == {}


def test_a_record_runs_no_code_when_it_is_read(tmp_path):
    record = full_record()
    put(tmp_path, record)
    file = tmp_path / "episodes" / f"{record.episode.key}.npz"
    np.savez(file, head=np.array([{"a": 1}], dtype=object), samples=[], goal_index=[], part_index=[])
    with pytest.raises(RecordError, match="damaged"):
        Record.load(file)


# ---- folders ------------------------------------------------------------------------------------------------------------


def test_a_folder_is_taken_up_again_only_when_asked(tmp_path):
    opened(tmp_path / "run")
    with pytest.raises(StoreError, match="already holds this run; go on with --resume"):
        opened(tmp_path / "run")
    opened(tmp_path / "run", resume=True)


def test_every_difference_is_named(tmp_path):
    old = {**REQUEST, "versions": {"mujoco": "3.16", "torch": "2.13"}, "robot_digest": "a" * 64}
    new = {**REQUEST, "versions": {"mujoco": "3.17", "torch": "2.13"}, "robot_digest": "b" * 64}
    with RunFolder(tmp_path, old, resume=False) as folder:
        folder.put(full_record())
    with pytest.raises(StoreError, match=r"\(robot_digest differs; versions.mujoco was '3.16', now '3.17'\)"):
        RunFolder(tmp_path, new, resume=True)


@pytest.mark.parametrize("resume", [False, True])
def test_a_folder_of_another_run_is_refused_and_left_as_it_is(tmp_path, resume):
    put(tmp_path, full_record())
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    with pytest.raises(StoreError, match=r"belongs to another run \(seeds was \[0, 1\], now \[2\]\)"):
        RunFolder(tmp_path, {**REQUEST, "seeds": [2]}, resume=resume)
    with pytest.raises(StoreError, match=r"belongs to another run \(policy was None, now 'x'\)"):
        RunFolder(tmp_path, {**REQUEST, "policy": "x"}, resume=resume)
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before


def test_a_folder_with_something_else_in_it_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(StoreError, match="is not empty and holds no run"):
        RunFolder(tmp_path, REQUEST, resume=True)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]
    (tmp_path / "notes.txt").rename(tmp_path / "notes.partial")  # nor is that one of a run's own
    with pytest.raises(StoreError, match="is not empty and holds no run"):
        RunFolder(tmp_path, REQUEST, resume=True)
    (tmp_path / "notes.partial").rename(tmp_path / "notes.txt")
    with pytest.raises(StoreError, match="is a file"):
        RunFolder(tmp_path / "notes.txt", REQUEST, resume=False)


@pytest.mark.parametrize("content", ["{", "[1, 2]", ""])
def test_a_damaged_request_is_refused(tmp_path, content):
    opened(tmp_path)
    (tmp_path / "request.json").write_text(content)
    with pytest.raises(StoreError, match=r"request\.json is damaged"):
        RunFolder(tmp_path, REQUEST, resume=True)


def test_a_folder_of_a_run_that_was_killed_while_it_began_will_do(tmp_path):
    (tmp_path / "episodes").mkdir()
    (tmp_path / ".0123456789abcdef.partial").write_text('{"sui')
    (tmp_path / ".lock").touch()
    opened(tmp_path, resume=True)
    (tmp_path / "other" / "episodes").mkdir(parents=True)
    (tmp_path / "other" / "episodes" / "x.npz").write_bytes(b"")
    with pytest.raises(StoreError, match="holds no run"):
        RunFolder(tmp_path / "other", REQUEST, resume=True)


def test_an_empty_folder_and_one_that_is_not_there_will_do(tmp_path):
    (tmp_path / "empty").mkdir()
    opened(tmp_path / "empty", resume=True)
    opened(tmp_path / "a" / "b")
    assert json.loads((tmp_path / "a" / "b" / "request.json").read_text()) == REQUEST


def test_episodes_in_another_place_are_left_alone(tmp_path):
    """Records that cannot be read are set aside: a stranger's run folder led to a folder of one's own."""
    precious = tmp_path / "own" / "data.npz"
    precious.parent.mkdir()
    precious.write_text("years of work")
    opened(tmp_path / "run")
    (tmp_path / "run" / "episodes").rmdir()
    (tmp_path / "run" / "episodes").symlink_to(precious.parent)
    with pytest.raises(StoreError, match=r"episodes' is a link"):
        opened(tmp_path / "run", resume=True)
    assert [p.name for p in precious.parent.iterdir()] == ["data.npz"]
