"""Score cards are replayed: one that holds, one that does not, and what is refused."""

import json
import shutil

import pytest
from gaitgauge.cli.console import Terminal
from gaitgauge.cli.main import app
from gaitgauge.cli.requests import VerifyRequest
from gaitgauge.cli.verify import _print_verification
from gaitgauge.policy.native import save_policy
from tiny_suite import SUITE
from typer.testing import CliRunner


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory, contract, stored):
    """The folder of an evaluation, its suite and its policy."""
    folder = tmp_path_factory.mktemp("evaluated")
    (folder / "tiny.toml").write_text(SUITE)
    save_policy(folder / "standing.gauge.pt", contract, stored)
    files = [str(folder / name) for name in ("standing.gauge.pt", "tiny.toml", "run")]
    command = ["evaluate", files[0], "--suite", files[1], "--out", files[2], "--threads", "1", "--no-clip"]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    return folder


@pytest.fixture
def card(evaluated, tmp_path):
    """A card, its content and the options that replay it."""
    suite = evaluated / "tiny.toml"
    shutil.copytree(evaluated / "run", tmp_path / "run")
    path = tmp_path / "card.json"
    path.write_text((tmp_path / "run" / "results.json").read_text())
    return path, json.loads(path.read_text()), ("--suite", suite, "--threads", 1)


def test_a_card_holds_where_it_was_made_and_an_edited_one_does_not(run, refused, tmp_path, capsys, card):
    path, content, options = card
    done = run("verify", path, *options, "--quick", "--out", tmp_path / "again")
    assert done.exit_code == 0, done.output
    words = " ".join(done.stdout.split())
    assert "2 of 4 rows were played, none of the others was checked" in words
    assert "the card holds in these rows: every outcome is the same to the last digit" in words

    forged = json.loads(path.read_text())
    forged["score"] += 0.3
    path.write_text(json.dumps(forged))
    assert "but what it is made of gives" in refused("verify", path, *options)
    forged = json.loads(json.dumps(content)) | {"score_interval": [0.0, 1.0]}
    path.write_text(json.dumps(forged))
    assert "score_interval is [0.0, 1.0], but what it is made of gives" in refused("verify", path, *options)

    forged = json.loads(json.dumps(content))
    forged["solver"]["iterations"] += 1
    path.write_text(json.dumps(forged))
    assert "solver is" in refused("verify", path, *options, "--quick")
    forged = json.loads(json.dumps(content))
    forged["motors"]["damping"][0] += 1.0
    path.write_text(json.dumps(forged))
    assert "motors.damping is [" in refused("verify", path, *options, "--quick")

    forged = json.loads(json.dumps(content))
    forged["provenance"]["versions"]["mujoco"] = "3.0.0"
    path.write_text(json.dumps(forged))
    done = run("verify", path, *options, "--quick", "--out", tmp_path / "again")
    words = " ".join(done.stdout.split())
    assert done.exit_code == 0 and "card and replay were made with other versions: mujoco 3.0.0 and" in words

    forged = json.loads(json.dumps(content))
    forged["environments"][0]["falls"] += 1
    forged["health"]["falls"] += 1
    path.write_text(json.dumps(forged))
    assert "environments[0].falls is" in refused("verify", path, *options)

    path.write_text((tmp_path / "run" / "results.json").read_text())
    done = run("verify", path, *options, "--quick", "--fresh", 5, "--out", tmp_path / "fresh", "--json")
    replayed = json.loads((tmp_path / "fresh" / "results.json").read_text())
    assert replayed["chance"]["seeds"] == [5_000_000, 5_000_001]
    assert replayed["chance"]["search_seeds"] == [5_000_100, 5_000_101]
    found = json.loads(done.stdout)
    assert found["fresh"] == 5 and not found["equal"]
    assert done.exit_code == (0 if found["holds"] else 1)
    _print_verification(Terminal(), found, VerifyRequest(card=path, fresh=5))
    assert "2 of 4 rows were played with other seeds" in " ".join(capsys.readouterr().out.split())

    path.write_text(json.dumps(content))
    assert "digest" in refused("verify", path, "--suite", "demo")
    told = content["policy"]["observations"]
    content["policy"]["observations"] = told[1:]
    path.write_text(json.dumps(content))
    assert "policy.observations is [" in refused("verify", path, *options)
    content["policy"] |= {"observations": told, "file_sha256": "ab" * 32}
    path.write_text(json.dumps(content))
    assert "another policy than the card's" in refused("verify", path, *options)
    content["policy"]["path"] = "elsewhere/policy.pt"
    path.write_text(json.dumps(content))
    assert "--policy" in refused("verify", path, *options)


def test_a_card_s_folder_by_default_has_its_whole_name_whatever_names_the_card(run, tmp_path, monkeypatch, card):
    options = card[2]
    folder = tmp_path / "tiny-1.1-stress"
    (tmp_path / "run").rename(folder)
    monkeypatch.chdir(folder)
    for named in (folder / "results.json", "."):
        assert run("verify", named, *options, "--quick").exit_code == 0
    assert [f.name for f in (folder / "results").iterdir()] == ["verify-tiny-1.1-stress-quick"]


def test_the_policy_is_found_beside_its_card_and_the_replay_named_after_both(
    run, refused, tmp_path, monkeypatch, policy, card
):
    """As sweeps keep them: ``kept/results.json`` names ``policy.gauge.pt``, and so does every other one."""
    _, content, options = card
    content["policy"]["path"] = "policy.gauge.pt"
    monkeypatch.chdir(tmp_path)
    kept = tmp_path / "runs" / "HIM" / "seed-1" / "kept"
    kept.mkdir(parents=True)
    (kept / "results.json").write_text(json.dumps(content))
    assert "the card's policy is not at 'policy.gauge.pt'" in refused("verify", kept, *options)
    (kept / "policy.gauge.pt").write_bytes(policy.read_bytes())
    assert run("verify", kept, *options, "--quick").exit_code == 0
    assert [f.name for f in (tmp_path / "results").iterdir()] == ["verify-HIM-seed-1-quick"]
    run("board", tmp_path / "runs" / "HIM" / "seed-1", "--out", "board.html")
    page = (tmp_path / "board.html").read_text()
    assert "HIM seed-1" in page and "--policy FILE" not in page
