"""``gaitgauge export``: a policy as the files that robots and other programs run."""

from __future__ import annotations

from collections.abc import Callable
from difflib import get_close_matches
from pathlib import Path

from ..files.writing import make_folder
from ..policy.base import Policy
from ..policy.export import (
    ExportError,
    export_deploy,
    export_onnx,
    export_policy,
    export_torchscript,
    export_unitree,
    first_steps,
)
from ..policy.its_robot import robot_for
from ..policy.loading import load_policy
from ..robots import Robot, load_robot
from .console import Terminal
from .errors import UserError
from .policies import policy_file


def _torchscript(policy: Policy, folder: Path, robot: Robot) -> dict[Path, float]:
    path = folder / "policy.pt"
    return {path: export_torchscript(policy, path)}


def _onnx(policy: Policy, folder: Path, robot: Robot) -> dict[Path, float]:
    path = folder / "policy.onnx"
    return {path: export_onnx(policy, path)}


def _deploy(policy: Policy, folder: Path, robot: Robot) -> dict[Path, float]:
    path = folder / "deploy.yaml"
    export_deploy(policy, path, robot)
    return {path: 0.0}


def _without_deploy(policy: Policy, folder: Path, robot: Robot) -> dict[Path, float]:
    return _torchscript(policy, folder, robot) | _onnx(policy, folder, robot)


FORMATS: dict[str, Callable[[Policy, Path, Robot], dict[Path, float]]] = {
    "all": export_policy,
    "torchscript": _torchscript,
    "onnx": _onnx,
    "deploy": _deploy,
}
_ABOUT = {
    ".pt": "TorchScript: one observation in, history inside, reset()",
    ".onnx": "ONNX: stacked observations in, the contract in its metadata",
    ".yaml": "settings of the robot's C++ runtime for policy.onnx",
}


LAYOUTS = ("plain", "unitree")


def run_export(*, policy: str, out: Path | None, form: str, layout: str, trust: bool, robot: str | None) -> None:
    """Export, and print each file with its check against the policy.

    Raises:
        UserError: no such format or layout, or a format that the layout does not have.
        PolicyError, ContractError: no such policy, or it cannot be exported.
    """
    if form not in FORMATS:
        close = get_close_matches(form, FORMATS, 1)
        hint = f"did you mean '{close[0]}'? " if close else ""
        raise UserError(f"there is no format '{form}'; {hint}choose one of: {', '.join(FORMATS)} (--format)")
    if layout not in LAYOUTS:
        raise UserError(f"there is no layout '{layout}'; choose one of: {', '.join(LAYOUTS)} (--layout)")
    if layout == "unitree" and form != "all":
        raise UserError(f"--layout unitree always writes ONNX and deploy.yaml; leave out --format {form}")
    path = policy_file(policy)
    loaded = load_policy(path, None if robot is None else load_robot(robot), trust=trust)
    body = robot_for(loaded.contract, robot)
    # Beside the checkpoint of a run, where users of Isaac Lab look for it.
    folder = out or (path.parent if (path.parent / "run.json").is_file() else Path()) / (
        "unitree" if layout == "unitree" else "exported"
    )
    make_folder(folder, ExportError)
    console = Terminal()
    console.say(f"policy {path}, contract {loaded.contract.hash[:12]}")
    export = export_unitree if layout == "unitree" else FORMATS[form]
    if export is export_policy and body.sdk_joint_names is None:
        export = _without_deploy
        console.say(
            f"no deploy.yaml: it numbers joints as the maker's SDK does, which robot '{body.name}' does not say "
            "(sdk_joint_names in its robot.toml)"
        )
    for written, largest in export(loaded, folder, body).items():
        actions = f"actions differ by at most {largest:.1e}" if largest else "actions are the same"
        check = "reads back the same" if written.suffix == ".yaml" else actions
        console.say(f"{written}  {written.stat().st_size / 1e6:.2f} MB  {_ABOUT[written.suffix]}; {check}")
    if layout == "unitree":
        console.say(f"point the controller's policy_dir at {folder.resolve()}")
        if sentence := first_steps(loaded):
            console.say(sentence)
