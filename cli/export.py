"""Write a policy as the files that robots and other programs run (``gaitgauge export``)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ..files.parsing import did_you_mean
from ..files.writing import make_folder
from ..policy.export.files import PARTS, ExportError, export_policy, export_unitree, first_steps
from .console import Terminal
from .errors import UserError
from .policies import open_policy, policy_file
from .requests import LAYOUTS, ExportRequest

FORMATS: Mapping[str, tuple[str, ...]] = {"all": PARTS, **{part: (part,) for part in PARTS}}
_ABOUT = {
    ".pt": "TorchScript: one observation in, history inside, reset()",
    ".onnx": "ONNX: stacked observations in, the contract in its metadata",
    ".yaml": "settings of the robot's C++ runtime for policy.onnx",
}


def run_export(request: ExportRequest) -> None:
    """Export, and print each file with its check against the policy.

    Raises:
        UserError: no such format or layout, or a format that the layout does not have.
        PolicyError, ContractError: no such policy, or it cannot be exported.
    """
    form, layout = request.form, request.layout
    if form not in FORMATS:
        hint = did_you_mean(form, FORMATS) or ";"
        raise UserError(f"there is no format '{form}'{hint} choose one of: {', '.join(FORMATS)} (--format)")
    if layout not in LAYOUTS:
        raise UserError(f"there is no layout '{layout}'; choose one of: {', '.join(LAYOUTS)} (--layout)")
    unitree = layout == "unitree"
    if unitree and form != "all":
        raise UserError(f"--layout unitree always writes ONNX and deploy.yaml; leave out --format {form}")
    path = policy_file(request.policy)
    loaded, body = open_policy(str(path), request.robot, trust=request.trust, contract_file=request.contract)
    # Beside the checkpoint of a run, where users of Isaac Lab look for it.
    beside = path.parent if (path.parent / "run.json").is_file() else Path()
    folder = request.out or beside / ("unitree" if unitree else "exported")
    make_folder(folder, ExportError)
    console = Terminal()
    console.say(f"policy {path}, contract {loaded.contract.hash[:12]}")
    parts = FORMATS[form]
    if not unitree and form == "all" and body.sdk_joint_names is None:
        parts = tuple(part for part in PARTS if part != "deploy")
        console.say(
            f"no deploy.yaml: it numbers joints as the maker's SDK does, which robot '{body.name}' does not say "
            "(sdk_joint_names in its robot.toml)"
        )
    found = export_unitree(loaded, folder, body) if unitree else export_policy(loaded, folder, body, parts)
    for written, largest in found.items():
        actions = f"actions differ by at most {largest:.1e}" if largest else "actions are the same"
        check = "reads back the same" if written.suffix == ".yaml" else actions
        console.say(f"{written}  {max(written.stat().st_size / 1e3, 1):,.0f} kB  {_ABOUT[written.suffix]}; {check}")
    if unitree:
        console.say(f"point the controller's policy_dir at {folder.resolve()}")
        if sentence := first_steps(loaded):
            console.say(sentence)
