"""``gaitgauge compare`` as a user runs it."""

import json
import shutil
from dataclasses import replace

import pytest
from gaitgauge.cli.main import app
from gaitgauge.policy.native import save_policy
from tiny_suite import SUITE
from typer.testing import CliRunner


@pytest.fixture
def tiny(tmp_path):
    path = tmp_path / "tiny.toml"
    path.write_text(SUITE.replace("[0.6, 0.9]", "[0.6]"))
    return path


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory, contract, stored):
    """The folder of an evaluation on the suite of ``tiny``."""
    folder = tmp_path_factory.mktemp("evaluated")
    (folder / "tiny.toml").write_text(SUITE.replace("[0.6, 0.9]", "[0.6]"))
    save_policy(folder / "standing.gauge.pt", contract, stored)
    names = [str(folder / name) for name in ("standing.gauge.pt", "tiny.toml", "first")]
    done = CliRunner().invoke(
        app, ["evaluate", names[0], "--suite", names[1], "--out", names[2], "--threads", "1", "--no-clip"]
    )
    assert done.exit_code == 0, done.output
    return folder / "first"


def test_policies_and_results_side_by_side(run, tmp_path, policy, tiny):
    other = tmp_path / "copies" / "another.gauge.pt"
    other.parent.mkdir()
    shutil.copy(policy, other)
    out = tmp_path / "out"
    command = ("compare", policy, other, "--suite", tiny, "--threads", 1, "--out", out)
    done = run(*command)
    assert done.exit_code == 0, done.output
    assert "do not tell 'another' and 'standing' apart" in done.stdout.replace(
        "'standing' and 'another'", "'another' and 'standing'"
    )
    assert {p.name for p in out.iterdir() if p.is_file()} == {f"comparison.{k}" for k in ("json", "csv", "tex", "html")}
    # what has been played is not played again, and results stand in for policies
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*.npz")}
    again = run("compare", out / "standing-tiny-stress", other, *command[3:], "--json")
    assert again.exit_code == 0, again.output
    assert json.loads(again.stdout) == json.loads((out / "comparison.json").read_text())
    assert {p: p.stat().st_mtime_ns for p in out.rglob("*.npz")} == before


def test_what_cannot_be_compared_is_said_before_anything_is_played(refused, tmp_path, policy, tiny, evaluated):
    assert "at least two" in refused("compare", policy)
    assert "there are no results at 'none.json'" in refused("compare", policy, "none.json")
    (tmp_path / "link.gauge.pt").symlink_to(policy)
    same = "are one and the same; a comparison needs different policies or results"
    assert refused("compare", policy, "link.gauge.pt", "--suite", tiny) == f"'{policy}' and 'link.gauge.pt' {same}"
    first = shutil.copytree(evaluated, tmp_path / "first")
    shutil.copy(first / "results.json", "card.json")
    for other in ("first", "first/results.json", "card.json"):
        assert refused("compare", "first", policy, other, "--suite", tiny) == f"'first' and '{other}' {same}"
    sentence = refused("compare", first, policy, "--suite", "demo")
    assert "results of different suites do not compare: 'first' has tiny " in sentence.replace(str(first), "first")
    assert sentence.endswith("evaluate both on one suite (--suite)")
    sentence = refused("compare", first, policy, "--suite", tiny, "--friction", 0.9)
    assert "were not given the same environments: only 'first' has" in sentence.replace(str(first), "first")
    assert not (tmp_path / "results").exists()


def test_what_was_not_made_alike_is_refused_before_anything_is_played(refused, tmp_path, policy, tiny, evaluated):
    shutil.copytree(evaluated, "first")
    alike = ("compare", "first", policy, "--suite", tiny)
    for choices, words in (
        (
            ("--pipeline", "multi", "--terrain", "wave", "--level", 1),
            "different pipelines do not compare: 'first' has stress",
        ),
        (("--level", 1), f"'{policy}' was given its level and that of 'first' was searched for; "),
        (("--pipeline", "level"), f"the results of '{policy}' have levels and no scores; "),
    ):
        assert words in refused(*alike, *choices)
    for change, words in (
        ({"backend": "newton"}, "different engines do not compare: 'first' has newton"),
        ({"robot": "a1"}, "different robots do not compare: 'first' has a1"),
        (
            {"digests": {"robot": "ab" * 32}},
            "name the robot go2, but its files differ (abababababab and ",
        ),
    ):
        card = json.loads((tmp_path / "first" / "results.json").read_text())
        card["provenance"]["digests"] |= change.pop("digests", {})
        (tmp_path / "card.json").write_text(json.dumps(card | change))
        assert words in refused("compare", "card.json", *alike[2:]).replace("card.json", "first")
    # two policies, and nothing that was played before
    flat = ("--terrain", "flat", "--friction", 0.6, "--payload", 0, "--pipeline", "multi")
    assert "different robots do not compare" in refused("compare", "pretrained", "pretrained-go1", *flat)
    assert not (tmp_path / "results").exists()


@pytest.mark.slow
def test_policies_whose_files_are_called_alike_are_told_apart_before_anything_is_played(run, tmp_path, policy, tiny):
    for method in ("HIM", "CTS"):
        (tmp_path / method / "seed-1" / "kept").mkdir(parents=True)
        shutil.copy(policy, tmp_path / method / "seed-1" / "kept" / "policy.gauge.pt")
    paths = [f"{method}/seed-1/kept/policy.gauge.pt" for method in ("HIM", "CTS")]
    done = run("compare", *paths, "--suite", tiny, "--threads", 1, "--json")
    assert done.exit_code == 0, done.output
    assert [p["label"] for p in json.loads(done.stdout)["policies"]] == ["HIM seed-1", "CTS seed-1"]
    names = {f"{m}-seed-1-tiny-stress" for m in ("HIM", "CTS")}
    assert {p.name for p in (tmp_path / "results").iterdir()} == {"compare-HIM-seed-1-CTS-seed-1", *names}


def test_the_folder_of_another_run_is_left_alone(run, tmp_path, policy, contract, stored, tiny):
    (tmp_path / "other").mkdir()
    leans = {name: value + 0.1 for name, value in stored.state_dict.items()}
    save_policy(tmp_path / "other" / "walk.gauge.pt", contract, replace(stored, state_dict=leans))
    flat = ("--suite", tiny, "--terrain", "flat", "--threads", 1)
    assert run("evaluate", "other/walk.gauge.pt", *flat).exit_code == 0
    before = (tmp_path / "results/walk-tiny-stress/results.json").read_bytes()
    shutil.copy(policy, tmp_path / "walk.gauge.pt")
    done = run("evaluate", "walk.gauge.pt", *flat)
    assert done.exit_code == 0 and "results/walk-tiny-stress-2/results.json" in done.stdout.replace("\n", "")
    assert (tmp_path / "results/walk-tiny-stress/results.json").read_bytes() == before


def test_one_seed_is_said_before_anything_is_played(run, refused, tmp_path, policy, tiny):
    """``compare --suite demo`` played for three minutes, and then could not tell."""
    (tmp_path / "copy.gauge.pt").write_bytes(policy.read_bytes())
    sentence = refused("compare", policy, "copy.gauge.pt", "--suite", tiny, "--seed", 1)
    assert sentence.startswith(
        "seed 1 is the only one, which tells no difference from chance; compare with three seeds"
    )
    assert not (tmp_path / "results").exists()
