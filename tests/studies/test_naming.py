"""Names of policies: what a reader takes for the policy's, and two that are never alike."""

from pathlib import Path

import pytest
from gaitgauge.gauge.store import RunFolder
from gaitgauge.studies.naming import distinct_names, free_run_folder, joined_names, run_folders

KEPT = "sweeps/baselines/runs/{}/seed-{}/kept/policy.gauge.pt"


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("pretrained", "pretrained"),
        ("mine/walk.gauge.pt", "walk"),
        (KEPT.format("HIM", 1), "HIM seed-1"),
        ("HIM/kept/policy.gauge.pt", "HIM"),
        ("logs/walking/2026-11-24_tall/exported/policy.onnx", "2026-11-24_tall"),
        ("logs/walking/2026-11-24_tall/best.pt", "2026-11-24_tall best"),
        ("logs\\walking\\tall\\model_50.pt", "tall model_50"),
        ("policy.gauge.pt", "policy"),  # nothing better is known
        ("kept/policy.gauge.pt", "policy"),
        ("latest", "latest"),
        ("../model_50.pt", "model_50"),
        ("robogauge-1.1/a.pt", "a"),
    ],
)
def test_one_policy_is_called_by_what_tells_something(path, name):
    assert distinct_names([path]) == [name]


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        ([KEPT.format("CTS", 1), KEPT.format("HIM", 1)], ["CTS seed-1", "HIM seed-1"]),
        ([KEPT.format("HIM", 0), KEPT.format("HIM", 1)], ["HIM seed-0", "HIM seed-1"]),
        (["one/a/x.pt", "two/b/x.pt", "y.pt"], ["a x", "b x", "y"]),
        (["one/a/x.pt", "two/a/x.pt"], ["one a x", "two a x"]),
        (["x.pt", "a/x.pt"], ["x.pt", "a x"]),
        (["a/x.pt", "a/x.onnx"], ["x.pt", "x.onnx"]),
        (["a/kept/policy.pt", "a/exported/policy.pt"], ["a kept policy.pt", "a exported policy.pt"]),
        (["latest", "latest"], ["latest (1)", "latest (2)"]),
        (["a/b/x.pt", "a-b/x.pt", "b/c.pt"], None),
        (["x" * 200 + "a.pt", "x" * 200 + "b.pt"], None),
        (["a\nb.pt", "a b.pt"], None),
        (["A/policy.pt", "a/policy.pt"], None),  # one folder on some disks
        (["", "/", "."], None),
    ],
)
def test_two_policies_are_never_called_alike(paths, names):
    found = distinct_names(paths)
    assert names is None or found == names
    assert all(name and "\n" not in name and len(name) <= 90 for name in found)
    folders = run_folders(paths, Path("results"), suite="suites/icy.toml", pipeline="stress")
    assert len({str(folder).casefold() for folder in folders}) == len(paths)
    assert {folder.parent for folder in folders} == {Path("results")}
    assert all(folder.name.endswith("-icy-stress") for folder in folders)


def test_studies_of_other_policies_have_other_folders():
    assert joined_names([KEPT.format("CTS", 1)]) == "CTS-seed-1"
    assert joined_names(["a.pt", "b/best.pt", "a.pt"]) == "a-b-best"
    four = ["a.pt", "b.pt", "c.pt", "d.pt"]
    assert joined_names(four) != joined_names([*four[:3], "e.pt"])
    assert len(joined_names([f"{i}/{'x' * 70}.pt" for i in range(50)])) < 200


def test_latest_is_called_by_the_checkpoint_that_it_stands_for(tmp_path, monkeypatch):
    """The next training changes it: two evaluations of ``latest`` had one folder, and the second was refused."""
    monkeypatch.chdir(tmp_path)
    usual = {"suite": "demo", "pipeline": "stress"}
    assert run_folders(["latest"], Path("results"), **usual) == [Path("results/latest-demo-stress")]  # there is none
    run = tmp_path / "logs/rsl_rl/walking/2026-11-24_tall"
    run.mkdir(parents=True)
    for iteration in (50, 100):
        (run / f"model_{iteration}.pt").touch()
        named = f"2026-11-24_tall-model_{iteration}"
        assert run_folders(["latest"], Path("results"), **usual) == [Path(f"results/{named}-demo-stress")]
        assert joined_names(["latest", "a.pt"]) == f"{named}-a"


def test_a_run_never_gets_the_folder_of_another_one(tmp_path):
    usual, runs = tmp_path / "walk-demo-stress", [("engine", {"seeds": [seed]}) for seed in range(3)]
    for run, name in zip(runs, ("", "-2", "-3"), strict=True):
        folder = free_run_folder(usual, run)
        assert folder == tmp_path / f"walk-demo-stress{name}"
        with RunFolder(folder / "engine", run[1], resume=False):
            (folder / "engine" / "episodes" / "x.npz").touch()
    assert free_run_folder(usual, runs[1]) == tmp_path / "walk-demo-stress-2"  # its own, to go on with
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "mine.txt").touch()
    assert free_run_folder(tmp_path / "notes", ("", runs[0][1])) == tmp_path / "notes-2"
