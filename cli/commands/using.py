"""Commands that use a policy, describe a robot, and look at what there is: export, play, import, robot, list, doctor, warmup."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ...files.choices import Choice, RobotName, ThreadCount
from ..requests import DoctorRequest, ExportRequest, ImportRequest, PlayRequest, ShowRequest
from ..running import command

app = typer.Typer()
robot = typer.Typer(no_args_is_help=True, help="Describe a robot of your own, and check it.")
contract = typer.Typer(no_args_is_help=True, help="Describe how a policy is to be run, and see how it is.")

LISTS = ("robots", "terrains", "backends", "suites", "scenarios", "policies", "presets", "zoo", "tasks")
"""Kinds of names that can be listed."""
_ARCHITECTURES = "GPU architecture, such as sm_90 (H100, H200); repeatable. Default: this machine's GPU."
_ENGINES = Choice("mujoco-warp or newton; repeatable. Default: mujoco-warp.", values=("mujoco-warp", "newton"))
_ERROR = "Which difference its first input is. Default: known for the two public networks."
ACTIVATIONS = ("softsign", "tanh", "relu", "elu", "identity")
_LEGS = "A body, joint or shape of each leg, where it cannot be told which limbs are legs."
_FEET = "Shapes or bodies that are the feet, for each leg one or more."
_POSE = "Angles of the standing pose, by names of joints or words of them; others stay as guessed."
_CHECKED = Choice("A robot.toml, its folder, or a robot's name.", values="robots", metavar="PATH")


@command(app)
def export(request: ExportRequest) -> None:
    """Write a policy as TorchScript, ONNX and deploy.yaml, each checked against it.

    Examples:
      gaitgauge export latest --out exported
      gaitgauge export pretrained --layout unitree --out unitree
    """
    from ..export import run_export

    run_export(request)


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
def import_command(request: ImportRequest) -> None:
    """Turn a foreign policy into the project's own file, with its contract.

    Examples:
      gaitgauge import policy.onnx walk.gauge.pt
      gaitgauge import policy.pt walk.gauge.pt --contract contract.toml
    """
    from ..inspect import import_file

    import_file(request)


app.add_typer(robot, name="robot")


@command(robot)
def new(
    model: Annotated[Path, Choice("MuJoCo model of the robot alone.", metavar="MODEL.xml")],
    out: Annotated[Path | None, Choice("Folder of the robot.toml. Default: the model's.")] = None,
    name: Annotated[str | None, Choice("Name of the robot. Default: the model's.")] = None,
    force: Annotated[bool, Choice("Replace a robot.toml that is there.")] = False,
    legs: Annotated[str | None, Choice(_LEGS, metavar="A,B")] = None,
    feet: Annotated[str | None, Choice(_FEET, metavar="A,B")] = None,
    keyframe: Annotated[str | None, Choice("The model's keyframe that is the standing pose.")] = None,
    pose: Annotated[str | None, Choice(_POSE, metavar="JOINT=RAD,…")] = None,
) -> None:
    """Write a first robot.toml from a MuJoCo model; say its body plan, what was mended in a copy, and what was guessed.

    Examples:
      gaitgauge robot new mine/mine.xml
      gaitgauge robot new mine/biped.xml --pose hip_pitch=-0.3,knee=0.6,ankle_pitch=-0.3
    """
    from ..robot import asked, new_robot

    answers = asked(legs=legs, feet=feet, keyframe=keyframe, pose=pose)
    new_robot(model, out=out, name=name, force=force, answers=answers)


@command(robot)
def guess(
    robot: Annotated[Path, Choice("A robot.toml that `robot new` wrote, or its folder.", metavar="PATH")],
) -> None:
    """Make the guesses of a robot.toml again after an edit; what you changed stays.

    Examples:
      gaitgauge robot guess robots/mine
    """
    from ..robot import guess_again

    guess_again(robot)


@command(robot)
def check(
    robot: Annotated[str, _CHECKED],
    picture: Annotated[Path | None, Choice("Write a picture of the standing pose (.png).")] = None,
    json_output: Annotated[bool, Choice("Print JSON instead of sentences.", flags=("--json",))] = False,
) -> None:
    """Check a robot's description and model, and let it stand; exit code 1 where something is wrong.

    Examples:
      gaitgauge robot check mine/robot.toml
      gaitgauge robot check go2 --picture standing.png
    """
    from ..robot import check_robot_files

    if not check_robot_files(robot, picture=picture, json_output=json_output):
        raise typer.Exit(1)


@command(robot)
def motor(
    file: Annotated[Path, Choice("Actuator network, a TorchScript file.", metavar="FILE.pt")],
    robot: Annotated[str, Choice("Robot that has these motors.", values="robots", metavar="ROBOT")],
    out: Annotated[Path, Choice("Folder of the two files.")] = Path(),
    name: Annotated[str, Choice("Name of the parameter set and of its files.")] = "network",
    error: Annotated[str | None, Choice(_ERROR, values=("target-position", "position-target"))] = None,
    activation: Annotated[
        str | None, Choice("Between its linear layers. Default: softsign.", values=ACTIVATIONS)
    ] = None,
    passive: Annotated[bool, Choice("Keep the robot's rotor inertia and friction beside the network.")] = False,
    force: Annotated[bool, Choice("Replace files that are there.")] = False,
) -> None:
    """Make a parameter set of an actuator network: motors that were learned on a real robot.

    Examples:
      gaitgauge robot motor anydrive_v3_lstm.pt anymal_c --out motors
      gaitgauge robot motor mine.pt go2 --error target-position --activation elu
    """
    from ..robot import convert_motor

    convert_motor(
        file, robot=robot, out=out, error=error, activation=activation, name=name, passive=passive, force=force
    )


app.add_typer(contract, name="contract")


@command(contract, "new")
def new_contract(
    out: Annotated[Path, Choice("File to write.", metavar="FILE", argument=True)] = Path("contract.toml"),
    robot: RobotName = "go2",
    force: Annotated[bool, Choice("Replace a file that is there.")] = False,
) -> None:
    """Write a commented contract.toml: all that a policy can be described with, with the robot's usual values.

    Examples:
      gaitgauge contract new
      gaitgauge contract new b2.toml --robot mine/b2/robot.toml
    """
    from ..inspect import write_contract

    write_contract(out, robot or "go2", force=force)


@command(contract)
def show(request: ShowRequest) -> None:
    """Print how a policy is run, where that was read and what was assumed.

    Examples:
      gaitgauge contract show policy.onnx
      gaitgauge contract show model_1500.pt --contract params/deploy.yaml
    """
    from ..inspect import show_contract

    show_contract(request)


@command(app, "list")
def list_command(
    what: Annotated[
        str, Choice("robots, terrains, backends, suites, scenarios, policies, presets, zoo or tasks.", None, LISTS)
    ],
) -> None:
    """List what can be named on the command line.

    Examples:
      gaitgauge list suites
      gaitgauge list policies
    """
    from ..inspect import list_things

    list_things(what)


@command(app)
def doctor(request: DoctorRequest) -> None:
    """Say what is wrong: with this machine, or with how a policy is run; exit code 1 where something is.

    Of a policy it plays the description and every likely other one: joint order, scales, signs, history, gains, pose.

    Examples:
      gaitgauge doctor
      gaitgauge doctor policy.onnx
      gaitgauge doctor policy.onnx --contract contract.toml --out mended.toml
    """
    from ..doctor import run_doctor

    if not run_doctor(request):
        raise typer.Exit(1)


@command(app)
def warmup(
    architectures: Annotated[tuple[str, ...], Choice(_ARCHITECTURES, flags=("--arch",))] = (),
    backends: Annotated[tuple[str, ...], _ENGINES] = (),
    robot: Annotated[str, Choice("Robot name, or a robot.toml.", None, "robots")] = "go2",
    cache: Annotated[Path | None, Choice("Folder of the kernels. Default: Warp's own, or WARP_CACHE_PATH.")] = None,
    threads: ThreadCount = None,
) -> None:
    """Compile the GPU kernels of training and evaluating before they are needed, also for a GPU that is not here.

    Examples:
      gaitgauge warmup
      gaitgauge warmup --arch sm_90 --cache kernels
    """
    from ..warmup import run_warmup

    run_warmup(architectures, backends, robot=robot, cache=cache, threads=threads)
