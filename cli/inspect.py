"""Import policies and list what can be named on the command line (``gaitgauge import``, ``gaitgauge list``)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

from ..files.parsing import did_you_mean
from ..files.writing import same_file
from .console import Terminal, make_table, print_json
from .errors import UserError

if TYPE_CHECKING:
    from ..policy.contract import ObservationTerm, Part, PolicyContract
    from .requests import ImportRequest, ShowRequest

_HASH = 12
"""Digits of a contract's hash that are shown in lists; enough to tell policies apart by eye."""


def import_file(request: ImportRequest) -> None:
    """Write a foreign policy as the project's own file, and print its contract.

    Raises:
        CheckpointError: ``trainable``, and the source is no training checkpoint.
        UserError: the destination exists and is not to be replaced, is the source, or is a folder.
        PolicyError, ContractError: the source is no policy, or the destination cannot be written.
    """
    source, destination, contract, robot = request.source, request.destination, request.contract, request.robot
    if destination.is_dir():
        example = f"{destination}/policy.gauge.pt"
        raise UserError(f"'{destination}' is a folder; give the file to write, for example '{example}'")
    from ..policy.finding import find_policy

    if any(same_file(destination, given) for given in (find_policy(source), contract, robot) if given):
        raise UserError(f"'{destination}' is itself read for the import; give another file to write")
    if destination.exists() and not request.force:
        raise UserError(f"'{destination}' already exists; give another name, or replace it with --force")
    from ..policy.native import ForeignFile

    if request.trainable or request.raw:
        for option in ("contract", "robot"):
            if getattr(request, option) is not None:
                raise UserError(f"a training checkpoint has its {option} inside; leave out --{option}")
        from ..policy.loading import load_policy
        from ..training.run.checkpoint import trim_checkpoint

        trim_checkpoint(find_policy(source), destination, raw=request.raw)
        policy = load_policy(str(destination))
    else:
        from ..policy.importing import import_policy

        policy = import_policy(source, destination, robot, trust=request.trust, contract_file=contract)
    console = Terminal()
    console.say(f"wrote {destination}")
    if contract is not None:
        rest = f"the robot's standard where it says nothing; what {source} itself says is not used"
        console.say(f"it is run as {contract} says and {rest}")
    if isinstance(policy.stored, ForeignFile):
        console.say("it carries the program of its source, not weights alone: commands that run it need --trust")
    console.print(contract_table(policy.contract))


def write_contract(out: Path, robot: str, *, force: bool) -> None:
    """Write a commented ``contract.toml``. Raises UserError: the file exists, or cannot be written."""
    from ..files.writing import write_atomically
    from ..policy.foreign.described import template
    from ..robots import load_robot

    if out.exists() and not force:
        raise UserError(f"'{out}' already exists; give another name, or replace it with --force")
    write_atomically(out, template(load_robot(robot)), UserError)
    Terminal().say(f"wrote {out}; give it as --contract {out}, or lay it beside the policy as contract.toml")


def show_contract(request: ShowRequest) -> None:
    """Print the contract that a policy is run with; its robot need not be installed."""
    from ..policy.loading import load_policy
    from ..robots import load_robot
    from .policies import policy_file

    asked = None if request.robot is None else load_robot(request.robot)
    file = policy_file(request.policy)
    policy = load_policy(file, asked, trust=request.trust, contract_file=request.contract)
    if request.json_output:
        print_json(policy.contract.to_dict())
    else:
        Terminal().print(contract_table(policy.contract))


def contract_table(contract: PolicyContract) -> Table:
    """Return a policy contract as a table for people."""
    from ..gauge.described import training_physics
    from ..policy.contract import PHYSICS
    from ..policy.observation_table import HEIGHT_SCAN
    from ..policy.robot_of import REMEMBERED

    table = Table(show_header=False)
    table.add_column("field")
    table.add_column("value", overflow="fold")
    history, physics = contract.history, training_physics(contract)
    frames = f"{history.length} frames, {history.order}, starts with {history.start}"
    rows = {
        "robot": contract.robot,
        "joints": f"{contract.num_joints}: {', '.join(contract.joint_names)}",
        "standing pose [rad]": _numbers(contract.default_joint_position),
        "action scale [rad]": _numbers(contract.action_scale),
        "action clip": "none" if contract.action_clip is None else f"{contract.action_clip:g}",
        "stiffness [N·m/rad]": _numbers(contract.stiffness),
        "damping [N·m·s/rad]": _numbers(contract.damping),
        "held [rad; N·m/rad; N·m·s/rad]": ", ".join(
            f"{h.name} {h.position:g}; {h.stiffness:g}; {h.damping:g}" for h in contract.held
        )
        or None,
        "control period [s]": f"{contract.control_period:g}",
        "observation": ", ".join(f"{t.name} × {_numbers(t.scale)}" for t in contract.observation),
        "height scan": next((_scan(t) for t in contract.observation if t.name == HEIGHT_SCAN), None),
        "targets of velocity [rad/s]": ", ".join(contract.velocity_joints) or None,
        "history": "current frame" if history.length == 1 else frames,
        "layout": "; ".join(map(_part, contract.layout)) or None,
        "encoder": None if (e := contract.encoder) is None else f"{e.file}, its output {e.latent}",
        "action offset [rad]": None if contract.action_offset is None else _numbers(contract.action_offset),
        "observation width": str(contract.observation_width),
        "command limits": "forward {:g} m/s, sideways {:g} m/s, turning {:g} rad/s".format(*contract.command_limits),
        "made from": ", ".join(
            f"{key} {value}" for key, value in contract.provenance.items() if key not in (REMEMBERED, PHYSICS)
        )
        or "unknown",
        "trained in": ", ".join(dict.fromkeys(f"{each.engine} {each.version}" for each in physics.trained))
        or physics.note,
        "contract hash": contract.hash,
    }
    for name, value in rows.items():
        if value is not None:
            table.add_row(name, value)
    return table


def _scan(term: ObservationTerm) -> str:
    """Return the grid of a height scan in words."""
    (length, width), (along, across) = term.size, term.grid
    return f"{along} by {across} points on {length:g} by {width:g} m, neighbours along {term.fastest}"


def _part(part: Part) -> str:
    """Return a part of a layout in words."""
    frames = "as in history" if part.length is None else f"{part.length} frame{'s' * (part.length > 1)}"
    return f"{part.input or 'input'}: {', '.join(part.terms) or 'all terms'}, {frames} {part.order or ''}".rstrip()


def _numbers(values: Sequence[float]) -> str:
    """Return numbers in short: one where all are equal."""
    shown = [f"{v:g}" for v in values]
    return shown[0] if len(set(shown)) == 1 else "(" + ", ".join(shown) + ")"


def list_things(what: str) -> None:
    """Print a table of the names of a kind, a key of ``LISTS``. Raises UserError: nothing of that name can be listed."""
    make = LISTS.get(what)
    if make is None:
        raise UserError(f"cannot list '{what}'{did_you_mean(what, LISTS) or ';'} choose one of: {', '.join(LISTS)}")
    Terminal().print(make())


def _robots() -> Table:
    from ..robots import RobotError, load_robot, robot_names

    columns = ("name", "title", "joints", "parameter sets", "speed limits")
    table = make_table("robots (--robot NAME, or a robot.toml)", *columns)
    for name in robot_names():
        try:
            robot = load_robot(name, check=False)
        except RobotError as error:
            table.add_row(name, f"unusable: {error}", "", "", "")
            continue
        sets = ", ".join(f"{s} (default)" if s == robot.default_parameters else s for s in robot.parameters)
        forward, lateral, yaw = robot.command_limits
        limits = f"{forward:g} m/s, {lateral:g} m/s, {yaw:g} rad/s"
        table.add_row(name, robot.title, str(robot.num_joints), sets, limits)
    return table


_TERRAINS = {
    "flat": "level ground, no targets",
    "slope_fd": "up a ramp, walking forward; steeper with the level",
    "slope_bd": "the same ramp, walking backward",
    "stairs_fd": "up a flight of stairs, walking forward; higher steps with the level",
    "stairs_bd": "the same stairs, walking backward",
    "wave": "rolling ground; higher waves with the level",
    "obstacle": "five bars across the way, 1 m long and 1 m apart; higher with the level",
}
"""The gauge's terrains and the effect of their level."""


def _terrains() -> Table:
    from ..terrains.gauge_terrains import LEVELS
    from ..terrains.registry import gauge_terrain_names, terrain_names

    table = make_table("terrains (--terrain NAME, --level N)", "name", "levels", "what it is")
    own = gauge_terrain_names()
    for name in terrain_names():
        levels = "none" if name == "flat" else f"{LEVELS[0]} to {LEVELS[-1]}" if name in own else "its own"
        table.add_row(name, levels, _TERRAINS.get(name, "plug-in"))
    return table


def _backends() -> Table:
    from ..backends.registry import list_backends

    table = make_table("backends (--backend NAME)", "name", "available here", "runs on", "what it is", "licence")
    for each in list_backends():
        available = f"no: {each.install}" if each.missing else each.version or "yes"
        table.add_row(each.name, available, each.device, each.note, each.terms)
    return table


def _suites() -> Table:
    from ..gauge.pipelines import make_environments
    from ..gauge.suite import load_suite, suite_names

    table = make_table("suites (--suite NAME, or a .toml file)", "name", "version", "title", "metrics", "environments")
    for name in suite_names():
        suite = load_suite(name)
        terrains = suite.matrix.terrains
        count = len(make_environments(suite, terrains=terrains, frictions=None, payloads=None, level=None))
        shape = f"{count} ({len(terrains)} terrains × {count // len(terrains)} conditions)"
        table.add_row(name, suite.version, suite.title, str(len(suite.metrics.weights)), shape)
    return table


def _scenarios() -> Table:
    from ..studies.trials.scenario import load_scenario, scenario_names

    table = make_table("field trials (--scenario NAME, or a scenario's .toml)", "name", "title", "at most")
    for scenario in map(load_scenario, scenario_names()):
        table.add_row(scenario.name, scenario.title, f"{scenario.seconds:g} s")
    return table


def _tasks() -> Table:
    from ..training.tasks import GROUNDS, TASKS

    table = make_table(
        "tasks (gaitgauge train NAME)", "name", "title", "engine", "worlds", "iterations", "experiment folder"
    )
    for task in TASKS.values():
        run = task.training.run
        table.add_row(
            task.name, task.title, task.backend, str(task.environment.num_envs), str(run.iterations), run.experiment
        )
    table.caption = f"by the body plan of --robot: {', '.join(GROUNDS)}"
    return table


def _policies() -> Table:
    from ..policy.base import PolicyError
    from ..policy.finding import LOG_ROOT, find_policy, latest_checkpoint, policy_names

    table = make_table("policies (a name, or any policy file)", "name", "file", "robot", "contract", "saved")
    for column in table.columns:
        column.no_wrap = column.header != "robot"  # where a sentence may stand that says what is wrong
    for name in policy_names():
        try:
            path = find_policy(name)
        except PolicyError:
            table.add_row(name, "none yet", "", "", "")
            continue
        table.add_row(name, *_policy_row(path))
    for run in sorted((r for r in LOG_ROOT.glob("*/*") if r.is_dir()), key=lambda r: r.name, reverse=True):
        for path in filter(None, (latest_checkpoint(run), *run.glob("best.pt"))):
            table.add_row("", *_policy_row(path))
    return table


def _policy_row(path: Path) -> tuple[str, str, str, str]:
    """Return file, robot, contract hash and time of a policy; an error stands in the place of the robot."""
    from ..policy.base import PolicyError
    from ..policy.contract import ContractError
    from ..policy.loading import load_policy

    shown = path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
    saved = f"{datetime.fromtimestamp(path.stat().st_mtime):%Y-%m-%d %H:%M}"
    try:
        contract = load_policy(path).contract
    except (PolicyError, ContractError) as error:
        return str(shown), f"unusable: {error}", "", saved
    return str(shown), contract.robot, contract.hash[:_HASH], saved


def _presets() -> Table:
    from ..policy.foreign.presets import presets

    table = make_table(
        "presets (--contract NAME, or preset = NAME in a contract.toml)", "name", "whose", "joints", "observation"
    )
    for each in presets().values():
        order = f"{'leg by leg' if each.order == 'legs' else 'kind by kind'}, {' '.join(each.legs)}"
        terms = ", ".join(f"{t.name} × {_numbers(t.scale)}" for t in each.observation)
        table.add_row(each.name, each.title, order, terms)
    return table


def _zoo() -> Table:
    from ..policy.foreign.zoo import zoo

    columns = ("what it is", "file", "robot", "observation", "from", "licence", "left open by its authors, or to know")
    table = make_table("public policies that are known by their content (gaitgauge evaluate FILE)", *columns)
    for each in zoo().values():
        words = (each.robot, each.observed(), each.source, each.licence, each.note or each.remark or "")
        table.add_row(each.title, each.file, *words)
    return table


LISTS: dict[str, Callable[[], Table]] = {
    "robots": _robots,
    "terrains": _terrains,
    "backends": _backends,
    "suites": _suites,
    "scenarios": _scenarios,
    "policies": _policies,
    "presets": _presets,
    "zoo": _zoo,
    "tasks": _tasks,
}
"""Tables of ``gaitgauge list``, by kind."""
