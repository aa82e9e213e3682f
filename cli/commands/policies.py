"""Commands for one policy: export, play, import."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ...files.choices import Choice, RobotName, Trust
from ..play_request import PlayRequest
from ..running import command

app = typer.Typer()


@command(app)
def export(
    policy: Annotated[
        str,
        Choice(
            "A checkpoint of the project's own, a run directory, or latest, best, pretrained.",
            argument=True,
            metavar="POLICY",
            values="policies",
        ),
    ],
    out: Annotated[Path | None, Choice("Output folder. Default: 'exported' in the run directory, or here.")] = None,
    form: Annotated[
        str,
        Choice(
            "torchscript, onnx, deploy or all.", flags=("--format",), values=("torchscript", "onnx", "deploy", "all")
        ),
    ] = "all",
    layout: Annotated[
        str,
        Choice(
            "plain: the files side by side; unitree: the folder of the published C++ controller, 'unitree'.",
            values=("plain", "unitree"),
        ),
    ] = "plain",
    trust: Trust = False,
    robot: RobotName = None,
) -> None:
    """Write a policy as TorchScript, ONNX and deploy.yaml, each checked against it.

    Examples:
      gaitgauge export latest --out exported
      gaitgauge export pretrained --layout unitree --out unitree
    """
    from ..export import run_export

    run_export(policy, out=out, form=form, layout=layout, trust=trust, robot=robot)


@command(app)
def play(request: PlayRequest) -> None:
    """Watch policies walk: in MuJoCo's viewer, in a browser, or in a video file without a display.

    Examples:
      gaitgauge play pretrained --terrain stairs_fd --level 6
      gaitgauge play latest --viewer viser --command 1 0 0
      gaitgauge play old.gauge.pt new.gauge.pt --out walk.mp4
    """
    from ..play import run_play

    run_play(request)


@command(app, "import")
def import_command(
    source: Annotated[
        str,
        Choice(
            "TorchScript, ONNX (with a deploy.yaml beside it) or rsl_rl checkpoint.", argument=True, values="policies"
        ),
    ],
    destination: Annotated[Path, Choice("File to write, by custom NAME.gauge.pt.", argument=True)],
    force: Annotated[bool, Choice("Replace the destination if it exists.", flags=("--force",))] = False,
    trainable: Annotated[
        bool,
        Choice("Keep teacher and critic of a training checkpoint, for train --init-from.", flags=("--trainable",)),
    ] = False,
    raw: Annotated[
        bool, Choice("The same with the weights after the last update, not their average.", flags=("--raw",))
    ] = False,
    trust: Trust = False,
    contract: Annotated[
        Path | None,
        Choice(
            "A contract.toml that says how a TorchScript or ONNX file is to be run, in place of what the file says."
        ),
    ] = None,
    robot: Annotated[str | None, Choice("Robot name, or a robot.toml. Default: go2.", values="robots")] = None,
) -> None:
    """Turn a foreign policy into the project's own file, with its contract.

    Examples:
      gaitgauge import policy.onnx walk.gauge.pt
      gaitgauge import policy.pt walk.gauge.pt --contract contract.toml
    """
    from ..inspect import import_file

    import_file(
        source,
        destination,
        force=force,
        trainable=trainable,
        raw=raw,
        trust=trust,
        contract=contract,
        robot=robot,
    )
