"""Runs that were killed: what they leave, that they end with the very same results, and what does not go on."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from gaitgauge.files.provenance import versions
from gaitgauge.gauge import evaluate as evaluation
from gaitgauge.gauge.episodes import Record
from gaitgauge.gauge.evaluate import identity, prepare
from gaitgauge.gauge.store import RunFolder, StoreError
from scripted_gauge import GO2, Puppet
from tiny_runs import evaluate, without_provenance


class Killed(BaseException):
    pass


@pytest.mark.parametrize("counts", [(3,), pytest.param(range(9), marks=pytest.mark.slow)])
def test_a_run_killed_after_any_episode_ends_with_the_very_same_results(request_for, tmp_path, monkeypatch, counts):
    request, puts = request_for("robogauge-1.1"), []
    put = RunFolder.put
    monkeypatch.setattr(RunFolder, "put", lambda self, record: (puts.append(record.episode.key), put(self, record)))
    evaluate(request, tmp_path / "whole")
    episodes = sorted(puts)
    assert len(set(episodes)) == len(episodes) == 8
    for count in counts:
        folder = tmp_path / f"killed-{count}"
        puts.clear()

        def watch(status, count=count):
            if status.done >= count:
                raise Killed

        with pytest.raises(Killed):
            evaluate(request, folder, watch=watch)
        assert not (folder / "results.json").exists()
        assert len(puts) >= count
        evaluate(request, folder, resume=True)
        assert sorted(puts) == episodes, "an episode was played twice or never"
        assert without_provenance(folder) == without_provenance(tmp_path / "whole")
        assert (folder / "episodes.csv").read_bytes() == (tmp_path / "whole" / "episodes.csv").read_bytes()


def test_speculative_episodes_that_nothing_asked_for_are_gone_at_the_end(whole_run, finished):
    """A killed run may leave some: they are no part of results, whatever they say."""
    (request, run), (_, whole) = finished, whole_run
    (run / "results.json").unlink()
    with RunFolder(run, identity(prepare(request)), resume=True) as folder:
        counted = next(e for e in folder.records if e.stage == "search")
        extra = Record(episode=replace(counted, level=1, seed=102), success=False)
        assert extra.episode not in folder.records
        folder.put(extra)
    evaluate(request, run, resume=True)
    assert without_provenance(run) == without_provenance(whole)
    files = [{p.name: p.read_bytes() for p in (f / "episodes").iterdir()} for f in (run, whole)]
    assert files[0] == files[1]


def test_two_processes_cannot_use_one_folder(request_for, tmp_path, monkeypatch):
    monkeypatch.setattr("gaitgauge.files.writing._PATIENCE", 0.1)
    with (
        RunFolder(tmp_path / "run", identity(prepare(request_for())), resume=False),
        pytest.raises(StoreError, match="another process is writing to"),
    ):
        evaluate(request_for(), tmp_path / "run", resume=True)


def test_a_finished_run_resumes_to_itself_without_playing(finished, monkeypatch):
    request, run = finished
    before = without_provenance(run)
    monkeypatch.setattr(Puppet, "step", lambda *_, **__: pytest.fail("an episode was played again"))
    evaluate(request, run, resume=True)
    assert without_provenance(run) == before


def test_a_damaged_episode_is_set_aside_and_played_again(finished):
    request, run = finished
    before = without_provenance(run)
    file = next((run / "episodes").glob("eval-flat*s1*"))
    whole = file.read_bytes()
    file.write_bytes(whole[:100])
    result = evaluate(request, run, resume=True)
    assert without_provenance(run) == before
    assert file.read_bytes() == whole
    assert result.provenance.set_aside == (file.name + ".damaged",)
    assert file.with_name(file.name + ".damaged").read_bytes() == whole[:100]


def test_a_run_does_not_go_on_with_another_robot(request_for, tmp_path):
    folder = tmp_path / "robot"
    shutil.copytree(GO2.mjcf.parent, folder)
    request = request_for(robot=str(folder))
    evaluate(request, tmp_path / "run")
    evaluate(request, tmp_path / "run", resume=True)
    file = folder / "robot.toml"
    file.write_text(file.read_text().replace("stiffness = 20.0", "stiffness = 20.5", 1))
    with pytest.raises(StoreError, match=r"belongs to another run \(robot_digest differs\)"):
        evaluate(request, tmp_path / "run", resume=True)


def test_a_run_does_not_go_on_with_another_engine_version(finished, monkeypatch):
    request, run = finished
    monkeypatch.setattr(evaluation, "versions", lambda: {**versions(), "mujoco": "0.0"})
    with pytest.raises(StoreError, match=r"versions.mujoco was '[0-9.]+', now '0.0'"):
        evaluate(request, run, resume=True)


@pytest.mark.parametrize("changes", [{"seeds": (0,)}, {"frictions": (0.5,)}, {"pipeline": "level"}])
def test_the_folder_of_another_request_is_refused(finished, changes):
    request, run = finished
    before = (run / "results.json").read_bytes()
    with pytest.raises(StoreError, match="belongs to another run"):
        evaluate(replace(request, **changes), run, resume=True)
    assert (run / "results.json").read_bytes() == before


@pytest.mark.parametrize(
    ("old", "new"), [('"gaitgauge-1"', '"robogauge-1.1"'), ("interval = 2", "interval = 4")], ids=["base", "metrics"]
)
def test_a_suite_that_changed_under_its_name_is_another_run(finished, tmp_path, old, new):
    request, run = finished
    text, suite = Path(request.suite).read_text(), tmp_path / "changed.toml"
    assert old in text
    suite.write_text(text.replace(old, new))
    with pytest.raises(StoreError, match="belongs to another run"):
        evaluate(replace(request, suite=str(suite)), run, resume=True)
