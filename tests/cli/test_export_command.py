"""``gaitgauge export``: files, their check, and one sentence for what cannot be exported."""

import re
from pathlib import Path

import pytest
from gaitgauge.policy.loading import load_policy

pytestmark = pytest.mark.usefixtures("programs_run_here")


def test_all_formats(run, policy, tmp_path):
    result = run("export", policy, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert sorted(f.name for f in (tmp_path / "out").iterdir()) == ["deploy.yaml", "policy.onnx", "policy.pt"]
    assert result.output.count("; actions ") == 2
    assert "reads back the same" in result.output
    assert re.search(r"deploy.yaml  [1-9]\d* kB", result.output)
    ours = load_policy(policy).contract
    assert load_policy(tmp_path / "out" / "policy.pt").contract.joint_names == ours.joint_names


def test_run_directory_gives_its_best_and_holds_the_files(run, policy, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "run.json").write_text("{}")
    (folder / "model_9.pt").write_bytes(b"not this one")
    (folder / "best.pt").write_bytes(policy.read_bytes())
    result = run("export", folder, "--format", "torchscript")
    assert result.exit_code == 0, result.output
    assert [f.name for f in (folder / "exported").iterdir()] == ["policy.pt"]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("nowhere.pt",), ("'nowhere.pt'", "pretrained")),
        (("standing.gauge.pt", "--format", "onxx"), ("'onxx'", "'onnx'", "--format")),
        (("standing.gauge.pt", "--out", "standing.gauge.pt"), ("standing.gauge.pt", "--out")),
        (("empty",), ("'empty'", "best.pt")),
    ],
)
def test_bad_request(refused, policy, tmp_path, arguments, named):
    (tmp_path / "empty").mkdir()
    message = refused("export", *arguments)
    for text in named:
        assert text in message


def test_exported_file_is_not_exported_again(run, refused, policy, tmp_path):
    assert run("export", policy, "--format", "torchscript", "--out", tmp_path).exit_code == 0
    assert "exported file already" in refused("export", Path(tmp_path) / "policy.pt", "--out", tmp_path / "again")


def test_a_contract_file_that_takes_the_place_of_the_export_s_own_is_said(run, policy, tmp_path):
    """What it leaves out is the robot's standard, not what the export holds."""
    assert run("export", policy, "--format", "torchscript", "--out", tmp_path).exit_code == 0
    (tmp_path / "contract.toml").write_text("control_period = 0.01")
    words = "the robot's standard where it says nothing; what policy.pt itself says is not used"
    for options, said in (((), False), (("--contract", "contract.toml"), True)):
        done = run("import", "policy.pt", "mine.gauge.pt", "--force", *options)
        assert done.exit_code == 0, done.output
        assert (words in done.stdout.replace("\n", " ")) == said


def test_the_policy_is_not_written_over(refused, policy, tmp_path):
    policy = policy.rename(tmp_path / "policy.pt")
    before = policy.read_bytes()
    assert "'policy.pt' is the policy that is to be exported" in refused("export", policy, "--out", ".")
    assert policy.read_bytes() == before
