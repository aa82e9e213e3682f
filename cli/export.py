"""``gaitgauge export``: a policy as the files that robots and other programs run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ..files.parsing import did_you_mean
from ..files.writing import make_folder
from ..policy.export.files import PARTS, ExportError, export_policy, export_unitree, first_steps
from ..policy.loading import load_policy
from ..policy.robot_of import robot_for
from ..robots import load_robot
from .console import Terminal
from .errors import UserError
from .policies import policy_file

FORMATS: Mapping[str, tuple[str, ...]] = {"all": PARTS, **{part: (part,) for part in PARTS}}
_ABOUT = {
    ".pt": "TorchScript: one observation in, history inside, reset()",
    ".onnx": "ONNX: stacked observations in, the contract in its metadata",
    ".yaml": "settings of the robot's C++ runtime for policy.onnx",
}


LAYOUTS = ("plain", "unitree")


def run_export(policy: str, *, out: Path | None, form: str, layout: str, trust: bool, robot: str | None) -> None:
    """Export, and print each file with its check against the policy.

    Raises:
        UserError: no such format or layout, or a format that the layout does not have.
        PolicyError, ContractError: no such policy, or it cannot be exported.
    """
    if form not in FORMATS:
        hint = did_you_mean(form, FORMATS) or ";"
        raise UserError(f"there is no format '{form}'{hint} choose one of: {', '.join(FORMATS)} (--format)")
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
    parts = FORMATS[form]
    if layout == "plain" and form == "all" and body.sdk_joint_names is None:
        parts = tuple(part for part in PARTS if part != "deploy")
        console.say(
            f"no deploy.yaml: it numbers joints as the maker's SDK does, which robot '{body.name}' does not say "
            "(sdk_joint_names in its robot.toml)"
        )
    unitree = layout == "unitree"
    found = export_unitree(loaded, folder, body) if unitree else export_policy(loaded, folder, body, parts)
    for written, largest in found.items():
        actions = f"actions differ by at most {largest:.1e}" if largest else "actions are the same"
        check = "reads back the same" if written.suffix == ".yaml" else actions
        console.say(f"{written}  {max(written.stat().st_size / 1e3, 1):,.0f} kB  {_ABOUT[written.suffix]}; {check}")
    if unitree:
        console.say(f"point the controller's policy_dir at {folder.resolve()}")
        if sentence := first_steps(loaded):
            console.say(sentence)
