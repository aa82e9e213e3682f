"""Policy files: the project's own format, TorchScript, ONNX, rsl_rl checkpoints, and what lies beside them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from fuzzing import SEEDS, register
from gaitgauge.policy.base import PolicyError
from gaitgauge.policy.foreign.deploy_yaml import deploy_contract
from gaitgauge.policy.foreign.fence.archive import packed, read_archive
from gaitgauge.policy.foreign.readers import Facts, find_description
from gaitgauge.policy.loading import load_policy
from gaitgauge.robots import load_robot

ROBOT = load_robot("go2")


def _load(content: bytes, folder: Path) -> None:
    path = folder / "policy"
    path.write_bytes(content)
    load_policy(path, ROBOT, trust=True)


def _inside(seed: Path, record: str) -> tuple[Callable[[bytes, Path], None], bytes]:
    """Feeds the content as one record of an archive, whose sums are right."""
    records = read_archive(seed.read_bytes(), source=seed.name)

    def feed(content: bytes, folder: Path) -> None:
        _load(packed({**records, record: content}), folder)

    return feed, records[record]


def _record(name: str, seed: str, record: str, *, words: tuple[bytes, ...] = (), text: bool = False) -> None:
    feed, content = _inside(SEEDS / seed, record)
    register(name, feed, seeds=[content], words=words, text=text)


_OPERATIONS = (
    b"torch.from_file(",
    b"ops.aten.save(",
    b"torch.relu(",
    b"while True:\n",
    b"import ",
    b"(x).set_(x)",
    b"# ",
)
_PICKLE = (b"cos\nsystem\n", b"R", b"Q", b"b", b"t", b"}", b"(", b"\x8a\xff", b"h\x05", b"cbuiltins\nbytearray\n")

register("policy-own", _load)
register("policy-torchscript", _load)
register("policy-onnx", _load, words=(b"If", b"Loop", b"ConstantOfShape", b"../../etc/passwd"))
register("policy-rsl-rl", _load)
_record("policy-own-pickle", "policy-own/mlp.gauge.pt", "data.pkl", words=_PICKLE)
_record("policy-rsl-rl-pickle", "policy-rsl-rl/model_1.pt", "data.pkl", words=_PICKLE)
_record("policy-torchscript-pickle", "policy-torchscript/history.pt", "data.pkl", words=_PICKLE)
_record("policy-torchscript-code", "policy-torchscript/history.pt", "code/__torch__.py", words=_OPERATIONS, text=True)


def _deploy(content: bytes, folder: Path) -> None:
    path = folder / "deploy.yaml"
    path.write_bytes(content)
    deploy_contract(path, ROBOT)


def _sidecar(content: bytes, folder: Path) -> None:
    path = folder / "contract.json"
    path.write_bytes(content)
    if find_description(folder / "policy.pt", ROBOT, Facts()) is None:
        raise PolicyError("there is no contract")


register("policy-deploy", _deploy, words=(b"&a [*a]", b"*a", b"!!python/object:os.system", b"<<: ", b"? "), text=True)
register("policy-contract", _sidecar, json=True)
