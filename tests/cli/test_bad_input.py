"""Whatever is wrong with a request ends with one clear sentence, and harms no earlier result."""

import math
import os
import pickle
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import typer
from gaitgauge.cli.errors import report_errors
from gaitgauge.cli.main import main
from gaitgauge.gauge.store import RunFolder
from gaitgauge.policy.native import save_policy
from torch import nn


class Hostile:
    """Creates a folder when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.marker),)


class Constant(nn.Module):
    """Answers every observation with one value in every entry, after some good answers."""

    def __init__(self, width: int, value: float, good: int = 0) -> None:
        super().__init__()
        self.width, self.value, self.good = width, value, good
        self.register_buffer("calls", torch.zeros(1, dtype=torch.int64))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        value = self.value if int(self.calls) > self.good else 0.0
        return torch.full((observation.shape[0], self.width), value)


def scripted(path: Path, **options: float) -> Path:
    torch.jit.script(Constant(**{"width": 12, "value": 0.0} | options)).save(str(path))
    return path


def content(folder: Path) -> dict[str, bytes]:
    """All files below a folder."""
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


def earlier_run(folder: Path, **identity: object) -> dict[str, bytes]:
    """A folder that holds the results of another run; returns what is in it."""
    with RunFolder(folder, {"suite": "gaitgauge-1 1.0.0", "policy": "other", **identity}, resume=False):
        pass
    (folder / "episodes" / "flat-0.npz").write_bytes(b"an earlier episode")
    (folder / "results.json").write_text('{"score": 0.5}\n')
    return content(folder)


ONE = ("--pipeline", "base", "--threads", 1)
COARSE = """
extends = "gaitgauge-1"
name = "coarse"
[physics]
timestep = 0.005
substeps = 4
[noise]
latency = 2
[settling]
longest = 0.1
"""


# ---- policies -------------------------------------------------------------------------------------------------------


def test_missing_policy(refused):
    assert "'nowhere.pt'" in refused("evaluate", "nowhere.pt")
    assert "pretrained" in refused("evaluate", "nowhere.pt")


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.999])
def test_truncated_policy(refused, policy, share):
    whole = policy.read_bytes()
    policy.write_bytes(whole[: int(len(whole) * share)])
    assert policy.name in refused("evaluate", policy)


@pytest.mark.parametrize("kind", ["text", "zeros", "picture", "folder", "zip", "tensors"])
def test_file_that_is_no_policy(refused, tmp_path, kind):
    path = tmp_path / "thing.pt"
    if kind == "folder":
        path.mkdir()
    elif kind == "zip":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("letter.txt", "hello")
    elif kind == "tensors":
        torch.save({"weights": torch.ones(3)}, path)
    else:
        path.write_bytes(
            {"text": b"a text of some length\n" * 9, "zeros": bytes(999), "picture": b"\x89PNG\r\n\x1a\n" * 9}[kind]
        )
    assert "thing.pt" in refused("evaluate", path)
    assert "thing.pt" in refused("import", path, tmp_path / "out.gauge.pt")
    assert not (tmp_path / "out.gauge.pt").exists()


@pytest.mark.parametrize("kind", ["plain pickle", "torch.save", "torch.save, old format"])
def test_pickle_that_executes_code_is_not_executed(refused, tmp_path, kind):
    marker, path = tmp_path / "executed", tmp_path / "policy.pt"
    if kind == "plain pickle":
        path.write_bytes(pickle.dumps(Hostile(marker)))
    else:
        torch.save({"model": Hostile(marker)}, path, _use_new_zipfile_serialization=kind == "torch.save")
    refused("evaluate", path)
    refused("import", path, tmp_path / "out.gauge.pt")
    assert not marker.exists()
    torch.load(path, weights_only=False) if kind != "plain pickle" else pickle.loads(path.read_bytes())
    assert marker.exists(), "the file would not have done anything anyway"


@pytest.mark.parametrize("width", [1, 10, 13, 24])
def test_policy_of_wrong_width(refused, tmp_path, width):
    message = refused("evaluate", scripted(tmp_path / "wide.pt", width=width), *ONE)
    assert "12" in message
    assert str(width) in message
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize(("value", "good"), [(math.nan, 0), (math.inf, 0), (-math.inf, 0), (math.nan, 60)])
def test_policy_that_returns_no_numbers(refused, tmp_path, value, good):
    path, suite = scripted(tmp_path / "broken.pt", value=value, good=good), tmp_path / "coarse.toml"
    suite.write_text(COARSE)
    assert f"{value}" in refused("evaluate", path, "--suite", suite, *ONE)
    assert not list((tmp_path / "results").rglob("results.json"))


def test_wrong_joint_names(refused, tmp_path, contract, stored):
    other = replace(contract, joint_names=("tail_joint", *contract.joint_names[1:]))
    save_policy(tmp_path / "tail.gauge.pt", other, stored)
    message = refused("evaluate", tmp_path / "tail.gauge.pt")
    assert "tail_joint" in message
    assert "FL_hip_joint" in message


def test_other_robot_and_other_period(refused, tmp_path, contract, stored):
    save_policy(tmp_path / "other.gauge.pt", replace(contract, robot="spot"), stored)
    assert "'spot'" in refused("evaluate", tmp_path / "other.gauge.pt")
    save_policy(tmp_path / "slow.gauge.pt", replace(contract, control_period=0.015), stored)
    assert "0.015" in refused("evaluate", tmp_path / "slow.gauge.pt")


# ---- requests -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--terrain", "stairs_fw"), ("'stairs_fw'", "'stairs_fd'")),
        (("--terrain", "moon"), ("'moon'", "wave")),
        (("--terrain", "wave", "--level", 0), ("0", "1 to 10")),
        (("--terrain", "wave", "--level", 11), ("11", "1 to 10")),
        (("--terrain", "wave", "--level", -3), ("-3", "1 to 10")),
        (("--friction", -0.5), ("-0.5", "--friction")),
        (("--friction", 0), ("0", "--friction")),
        (("--friction", "nan"), ("nan", "--friction")),
        (("--payload", -100), ("-100", "--payload")),
        (("--payload", "nan"), ("nan", "--payload")),
        (("--seed", -1), ("-1", "--seed")),
        (("--seed", 10**300), ("1000", "--seed")),
        (("--suite", "gaitgauge-2"), ("'gaitgauge-2'", "'gaitgauge-1'")),
        (("--suite", "nowhere.toml"), ("'nowhere.toml'",)),
        (("--pipeline", "strss"), ("'strss'", "stress")),
        (("--backend", "mujoko"), ("'mujoko'", "mujoco")),
        (("--backend", "mujoco:kamino"), ("mujoco",)),
        (("--robot", "go3"), ("'go3'", "go2")),
        (("--device", "abacus"), ("'abacus'", "cuda")),
        (("--device", "cuda:9"), ("'cuda:9'", "mujoco-warp")),
        (("--backend", "fake", "--device", "cuda:99"), ("'cuda:99'", "cpu")),
        (("--backend", "fake", "--device", "meta"), ("'meta'", "cpu")),
        (("--pipeline", "multi", "--terrain", "wave"), ("--level",)),
        (("--pipeline", "base", "--friction", 0.5, "--friction", 0.6), ("base",)),
        (("--pipeline", "level", "--terrain", "flat"), ("flat",)),
    ],
    ids=lambda value: " ".join(map(str, value)) if isinstance(value, tuple) and str(value[0]).startswith("--") else "",
)
def test_impossible_request(refused, tmp_path, policy, arguments, named):
    message = refused("evaluate", policy, *arguments)
    for text in named:
        assert text in message
    assert not (tmp_path / "results").exists()


def test_malformed_suites(refused, tmp_path, policy):
    for text in ("not TOML at all", "extends = 'gaitgauge-1'\nunknown = 1\n", "name = 'half'\n"):
        (tmp_path / "mine.toml").write_text(text)
        assert "mine.toml" in refused("evaluate", policy, "--suite", tmp_path / "mine.toml")


# ---- output folders -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("resume", [(), ("--resume",)])
def test_folder_of_another_run(refused, tmp_path, policy, resume):
    before = earlier_run(tmp_path / "out")
    message = refused("evaluate", policy, *ONE, "--out", tmp_path / "out", *resume)
    assert "another run" in message
    assert "--out" in message
    assert content(tmp_path / "out") == before


def test_foreign_folder_and_file(refused, tmp_path, policy):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("years of work")
    assert "not empty" in refused("evaluate", policy, *ONE, "--out", tmp_path / "thesis")
    assert content(tmp_path / "thesis") == {"chapter.tex": b"years of work"}
    chapter = tmp_path / "thesis" / "chapter.tex"
    assert "is a file" in refused("evaluate", policy, *ONE, "--out", chapter)
    assert "thesis" in refused("evaluate", policy, *ONE, "--out", chapter / "below")
    assert content(tmp_path / "thesis") == {"chapter.tex": b"years of work"}


def test_damaged_marker_of_a_run(refused, tmp_path, policy):
    earlier_run(tmp_path / "out")
    (tmp_path / "out" / "request.json").write_text("{")
    before = content(tmp_path / "out")
    assert "request.json" in refused("evaluate", policy, *ONE, "--out", tmp_path / "out", "--resume")
    assert content(tmp_path / "out") == before


@pytest.mark.parametrize("arguments", [("--friction", -1), ("--terrain", "moon"), ("--level", 11, "--terrain", "wave")])
def test_bad_request_leaves_an_earlier_run_alone(refused, tmp_path, policy, arguments):
    before = earlier_run(tmp_path / "out")
    refused("evaluate", policy, *arguments, "--out", tmp_path / "out")
    assert content(tmp_path / "out") == before


# ---- import and list ------------------------------------------------------------------------------------------------


def test_import_replaces_nothing_unasked(refused, run, tmp_path, policy):
    target = tmp_path / "target.gauge.pt"
    target.write_bytes(b"precious")
    assert "--force" in refused("import", policy, target)
    assert "folder" in refused("import", policy, tmp_path, "--force")
    assert "nowhere.pt" in refused("import", "nowhere.pt", target, "--force")
    assert target.read_bytes() == b"precious"
    assert run("import", policy, target, "--force").exit_code == 0
    assert target.read_bytes() != b"precious"
    assert [f.name for f in tmp_path.glob(".*")] == []


@pytest.mark.parametrize("options", [("--force",), ("--force", "--trainable"), ()])
def test_an_import_does_not_replace_what_it_reads(refused, tmp_path, policy, options):
    before = policy.read_bytes()
    (tmp_path / "link.pt").symlink_to(policy)
    (tmp_path / "contract.toml").write_text("mine")
    for source, destination in ((policy, policy), ("link.pt", policy), (policy, "link.pt")):
        assert "is itself read for the import; give another file" in refused("import", source, destination, *options)
    for option in ("--robot", "--contract")[: 1 if "--trainable" in options else 2]:
        words = (policy, "contract.toml", option, "contract.toml", *options)
        assert "is itself read for the import" in refused("import", *words)
    assert policy.read_bytes() == before and (tmp_path / "contract.toml").read_text() == "mine"


def test_unwritable_destination_of_an_import(refused, tmp_path, policy):
    (tmp_path / "file").write_text("not a folder")
    assert "cannot write" in refused("import", policy, tmp_path / "file" / "out.gauge.pt")


def test_unknown_list(refused):
    message = refused("list", "robot")
    assert "'robots'" in message
    assert "policies" in message


# ---- the real process -----------------------------------------------------------------------------------------------


def test_whole_process_ends_with_one_line(tmp_path, monkeypatch, capfd):
    """Nothing is written to standard error behind Python's back either."""
    path = scripted(tmp_path / "broken.pt", value=float("nan"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["gaitgauge", "evaluate", str(path), *map(str, ONE)])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    printed = capfd.readouterr()
    assert printed.out == ""
    assert len(printed.err.splitlines()) == 1, printed.err
    assert printed.err.startswith("gaitgauge: ")


@pytest.mark.parametrize("command", ["evaluate", "trial", "latent", "doctor"])
@pytest.mark.parametrize(("threads", "limit"), [("1000000", "1024"), ("9" * 400, "1024"), ("0", "1"), ("-1", "1")])
def test_no_machine_has_so_many_threads(run, command, threads, limit):
    result = run(command, "pretrained", "--threads", threads)
    assert result.exit_code == 2
    assert f"than or equal to {limit} " in result.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="limits of address space")
@pytest.mark.parametrize("words", [("evaluate", "pretrained"), ("list", "suites")])
def test_too_little_memory_is_one_sentence(words):
    """Libraries crashed, or waited for ever."""
    limit = "import resource, sys; resource.setrlimit(resource.RLIMIT_AS, (700_000_000,) * 2); "
    program = limit + f"from gaitgauge.cli.main import app; sys.argv[1:] = {list(words)}; app()"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("gaitgauge: a process may take 0.70 GB of address space here, and at least 1.2 GB")


def test_memory_that_runs_out_is_one_sentence(capsys):
    def command():
        raise MemoryError

    with pytest.raises(typer.Exit) as ended:
        report_errors(command)()
    assert ended.value.exit_code == 2 and "gaitgauge: memory is exhausted; raise the limit" in capsys.readouterr().err
