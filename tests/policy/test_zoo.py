"""The zoo of public policies, and presets where a description is named: what goes before what, and what is refused."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from gaitgauge.cli.inspect import show_contract
from gaitgauge.cli.requests import ShowRequest
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy import loading
from gaitgauge.policy.base import PolicyError
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.foreign.adapters import described
from gaitgauge.policy.foreign.described import described_contract
from gaitgauge.policy.foreign.presets import find_preset, preset_contract
from gaitgauge.policy.foreign.zoo import KnownPolicy, known_contract, zoo
from gaitgauge.policy.loading import load_policy
from gaitgauge.robots import load_robot
from torch import nn

GO2 = load_robot("go2")
HIMLOCO = preset_contract(find_preset("himloco"), GO2, frames=6)


def script(path, width):
    """A TorchScript file that takes so many values."""
    torch.jit.save(torch.jit.script(nn.Sequential(nn.Linear(width, 12)).eval()), path)
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Files of three widths, each in a folder of its own."""
    return {width: script(tmp_path_factory.mktemp(str(width)) / "policy.pt", width) for width in (45, 47, 270)}


def refused(path, **options) -> str:
    with pytest.raises(PolicyError) as caught:
        load_policy(path, **options)
    assert "\n" not in str(caught.value) and str(caught.value).count(". ") == 0
    return str(caught.value)


# ---- the zoo --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("known", zoo().values(), ids=lambda known: known.name)
def test_every_known_policy_has_a_whole_contract_without_its_robot(known):
    contract = known_contract(known, None)
    assert contract.robot == known.robot and contract.provenance["adapter"] == "zoo"
    assert len(contract.joint_names) in (10, 12, 16, 29)
    assert max(contract.command_limits) <= 1.5


def test_the_zoo_holds_each_file_once():
    names = [known.name for known in zoo().values()]
    assert len(set(names)) == len(names) == 17
    assert known_contract(next(k for k in zoo().values() if k.file == "himloco.pt"), None).observation_width == 270


def test_the_page_lists_what_the_zoo_knows():
    page = (Path(__file__).parents[2] / "docs/reference/zoo.md").read_text(encoding="utf-8")
    for known in zoo().values():
        row = f"| {known.title} | `{known.robot}` | `{known.file}` | `{known.sha256[:16]}…` | {known.source} | {known.licence} |"
        assert f"{row} {known.note or known.remark or ''} |" in page


@pytest.fixture
def known(monkeypatch, files):
    """Makes the zoo know the file of 270 values as HIMLoco's."""
    entry = KnownPolicy(
        name="mine",
        file="policy.pt",
        sha256=hashlib.sha256(files[270].read_bytes()).hexdigest(),
        title="mine",
        source="a project",
        licence="MIT",
        note="the rest",
        remark="it limps",
        contract={"robot": "go2", "preset": "himloco", "history": {"length": 6}, "command_limits": [0.5, 0.4, 0.3]},
    )
    monkeypatch.setattr(loading, "zoo", lambda: {entry.sha256: entry})
    return files[270]


def test_a_known_file_needs_no_description(known):
    contract = load_policy(known).contract
    assert contract.hash == replace(HIMLOCO, command_limits=(0.5, 0.4, 0.3)).hash
    assert contract.provenance["licence"] == "MIT" and contract.provenance["assumed"] == "the rest"
    assert described(contract) == "is run as the zoo's mine says; assumed: the rest; it limps"


def test_contract_show_needs_no_robot(files, monkeypatch, capsys):
    b2 = next(each for each in zoo().values() if each.robot == "b2")
    monkeypatch.setattr(loading, "zoo", lambda: {hashlib.sha256(files[45].read_bytes()).hexdigest(): b2})
    show_contract(ShowRequest(policy=str(files[45]), json_output=True))
    assert json.loads(capsys.readouterr().out)["robot"] == "b2"


def test_a_contract_that_is_given_or_lies_beside_it_goes_before_the_zoo(known, tmp_path):
    file = tmp_path / "contract.toml"
    file.write_text("history = { length = 6 }\nstiffness = 33")
    assert set(load_policy(known, contract_file=file).contract.stiffness) == {33.0}
    copy = tmp_path / "policy.pt"
    copy.write_bytes(known.read_bytes())
    assert set(load_policy(copy).contract.stiffness) == {33.0}


def test_a_known_file_for_another_robot_is_one_sentence(known):
    message = refused(known, robot=load_robot("go1"))
    assert "describes a policy for robot 'go2', not for 'go1'" in message
    own = replace(GO2, name="go2_mine")
    assert load_policy(known, own).contract.robot == "go2_mine"


# ---- presets --------------------------------------------------------------------------------------------------------


def test_a_preset_is_named_in_place_of_a_file(files):
    contract = load_policy(files[270], contract_file="himloco").contract
    assert contract.hash == HIMLOCO.hash
    assert contract.provenance["adapter"] == "preset himloco"
    assert load_policy(files[45], contract_file="isaac_lab_blind").contract.history.length == 1


def test_a_preset_that_does_not_fit_is_one_sentence_with_those_that_do(files):
    message = refused(files[45], contract_file="isaac_lab")
    assert message.startswith(
        "preset 'isaac_lab' gives 48 values a frame, but the policy takes 45; presets that fit: go2_rl"
    )
    assert refused(files[47], contract_file="himloco").endswith("the policy takes 47; presets that fit: none")


def test_an_unknown_preset_is_one_sentence_with_the_nearest_name(files):
    message = refused(files[45], contract_file="himlco")
    assert message.startswith(
        "--contract 'himlco' is no file, and there is no preset 'himlco'; did you mean 'himloco'?"
    )


def test_a_description_may_change_what_a_preset_says(tmp_path):
    file = tmp_path / "contract.toml"
    file.write_text('preset = "himloco"\nstiffness = 30\nhistory = { length = 6, start = "repeat" }')
    contract = described_contract(file, GO2)
    wanted = replace(HIMLOCO, stiffness=(30.0,) * 12, history=replace(HIMLOCO.history, start="repeat"))
    assert contract.hash == wanted.hash
    file.write_text("stiffness = 30")
    assert described_contract(file, GO2).hash == replace(standard_contract(GO2), stiffness=(30.0,) * 12).hash


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('preset = "isaaclab"', r"there is no preset 'isaaclab'; did you mean 'isaac_lab' or"),
        ("preset = 3", "preset is 3; it must be one of go2_rl_gym"),
        ('preset = "himloco"\nstifness = 30', "stifness"),
    ],
)
def test_wrong_presets_in_a_description_are_one_sentence(tmp_path, text, message):
    file = tmp_path / "contract.toml"
    file.write_text(text)
    with pytest.raises(PolicyError, match=message) as caught:
        described_contract(file, GO2)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["suite", "gentle", "biped", "biped-gentle"])
def test_the_board_of_public_policies_judges_each_robot_in_its_own_measure(name):
    """An 83 kg robot that walks without a fall scored 0.01 on a Go2's watts and newton metres."""
    suite = load_suite(str(Path(__file__).parents[2] / "benchmarks" / "public_contracts" / f"{name}.toml"))
    assert suite.metrics.measure == "robot" and "motion_done" in suite.metrics.weights
    assert suite.matrix.terrains == ("flat",) and suite.commands.beyond == ("clip" if name == "suite" else "scale")
