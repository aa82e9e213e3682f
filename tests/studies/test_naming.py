"""Names of policies: what a reader takes for the policy's, and two that are never alike."""

from pathlib import Path

import pytest
from gaitgauge.studies.naming import distinct_names, joined_names, run_folders

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
