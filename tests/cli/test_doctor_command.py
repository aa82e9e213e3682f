"""``gaitgauge doctor``, with and without a policy."""

import json
import tomllib
from dataclasses import replace

import pytest
from gaitgauge.cli import doctor
from gaitgauge.policy.contract import PolicyContract
from gaitgauge.policy.foreign.presets import find_preset
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import save_policy
from gaitgauge.studies.doctor import diagnosis
from gaitgauge.studies.doctor.alternatives import alternatives


@pytest.fixture
def few(monkeypatch):
    """Only the sign of actions is tried."""
    monkeypatch.setattr(diagnosis, "fitting_presets", lambda robot, width: {})
    monkeypatch.setattr(
        diagnosis, "alternatives", lambda c, robot: [a for a in alternatives(c, robot) if a.kind == "sign of actions"]
    )


@pytest.fixture
def backwards(tmp_path):
    """A policy that walks, with the sign of its actions turned round."""
    good = load_policy("pretrained")
    path = tmp_path / "backwards.gauge.pt"
    wrong = replace(good.contract, action_scale=tuple(-v for v in good.contract.action_scale))
    save_policy(path, wrong, good.stored)
    return path


@pytest.mark.usefixtures("few")
def test_it_names_the_mistake_and_the_lines_to_change(run, backwards, tmp_path):
    result = run("doctor", backwards, "--seconds", 0.6, "--threads", 1, "--out", tmp_path / "contract.toml")
    assert result.exit_code == 1, result.output
    assert "the sign of actions looks wrong" in result.output
    assert "action_scale = [0.25, 0.25" in result.output
    data = tomllib.loads((tmp_path / "contract.toml").read_text())
    assert PolicyContract.from_dict(data).hash == load_policy("pretrained").contract.hash


def test_the_policy_is_not_written_over(refused, backwards):
    """The description of how a policy is run took the policy's place."""
    before = backwards.read_bytes()
    assert "ends in .toml" in refused("doctor", backwards, "--out", backwards)
    assert backwards.read_bytes() == before


@pytest.mark.parametrize("option", ["--contract", "--robot"])
def test_what_is_read_is_not_written_over(refused, backwards, tmp_path, option):
    mine = tmp_path / "mine.toml"
    mine.write_text("# mine")
    words = ("doctor", backwards, option, mine, "--out", "mine.toml")
    assert "which is read as --contract or --robot; give another file" in refused(*words)
    assert mine.read_text() == "# mine"


def test_the_contract_beside_the_policy_is_not_written_over(refused, backwards):
    mine = backwards.with_name("contract.toml")
    mine.write_text("# mine")
    assert "lies beside the policy and is read; give another file" in refused("doctor", backwards, "--out", mine)
    assert mine.read_text() == "# mine"


def test_json_holds_it_all(run, monkeypatch):
    fitting = diagnosis.fitting_presets

    def one(robot, width):
        return {k: v for k, v in fitting(robot, width).items() if find_preset(k).title == "HIMLoco"}

    monkeypatch.setattr(diagnosis, "fitting_presets", one)
    result = run("doctor", "pretrained", "--seconds", 1, "--threads", 1, "--json")
    assert result.exit_code == 0, result.output
    data = json.loads(result.stdout)
    assert data["sound"]
    assert data["contract_lines"] == []
    assert {o["kind"] for o in data["others"]} == {"preset"}
    assert "HIMLoco" in [o["text"] for o in data["others"]]


def test_a_file_that_is_no_policy_is_refused(refused, tmp_path):
    assert "there is no policy file" in refused("doctor", tmp_path / "nothing.pt")


@pytest.mark.parametrize(
    "option",
    [("--contract", "it"), ("--robot", "it"), ("--out", "it"), ("--seconds", 1), ("--trust",), ("--threads", 1)],
)
def test_what_is_for_a_policy_is_refused_without_one(refused, option):
    assert f"{option[0]} is for the examination of a policy" in refused("doctor", *option)


def test_a_folder_that_is_not_there_is_told_before_anything_is_played(refused, monkeypatch):
    monkeypatch.setattr("gaitgauge.cli.diagnosis.diagnose", None)
    assert "of --out does not exist" in refused("doctor", "pretrained", "--out", "nowhere/mended.toml")


def test_the_machine_is_told_as_json(run, monkeypatch):
    monkeypatch.setattr(doctor, "CHECKS", (doctor.check_python,))
    (found,) = json.loads(run("doctor", "--json").stdout)
    assert found["what"] == "Python"
    assert found["status"] == "ok"
