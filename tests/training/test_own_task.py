"""A task of one's own, with a reward, an end, an observation and an event of its own: the example is the test."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from gaitgauge.robots import load_robot
from gaitgauge.terrains import training_tiles
from gaitgauge.training.algorithms.symmetry import SymmetryError, build_mirror
from gaitgauge.training.configuration import ConfigurationError
from gaitgauge.training.environment.configuration import (
    EnvironmentConfiguration,
    OwnEvent,
    OwnObservation,
    OwnReward,
    OwnTermination,
    RewardConfiguration,
    TerminationConfiguration,
)
from gaitgauge.training.environment.curriculum import build_palette
from gaitgauge.training.environment.own_terms import resolve
from gaitgauge.training.environment.policy_interface import training_contract
from gaitgauge.training.environment.terrain_configuration import TerrainConfiguration, TileConfiguration
from gaitgauge.training.tasks import TaskError, find_task
from gaitgauge_fake_engine import FakeScript
from small_environment import FLAT, idle, make, scripted_environment

FOLDER = Path(__file__).parents[2] / "examples" / "own_task"


@pytest.fixture
def example(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    yield "quiet_walk:TASK"
    sys.modules.pop("quiet_walk", None)


def environment_of(task, script):
    settings = replace(task.environment, num_envs=4)
    return scripted_environment(settings, script)


def test_the_example_trains_with_its_own_terms(example):
    task = find_task(example, ["training.run.iterations=7", "environment.rewards.own.soft_landing.weight=-2.0"])
    assert (task.name, task.environment.schedule.horizon_steps) == (example, 7 * 24)
    rolling = FakeScript(
        motion=lambda b: (torch.zeros_like(b.force_w), torch.tensor([2.0, 0.0, 0.0]).to(b.force_w).expand_as(b.force_w))
    )
    environment = environment_of(task, rolling)
    observations = environment.get_observations()
    assert observations["privileged"].shape == (4, 264)
    assert torch.allclose(observations["privileged"][:, -1], environment.backend.state.base_position_w[:, 2].float())
    for _ in range(100):
        extras = idle(environment)[3]
        if "log" in extras:
            log = extras["log"]
    assert float(log["Episode_Termination/load_lost"]) == 1.0, "2 rad/s take a quarter of a second to 0.5 rad"
    assert log["Episode_Reward/soft_landing"].isfinite()
    assert environment.backend.force_w[:, 1].abs().max() > 0.0, "the wind blows after 100 steps"


def test_an_own_reward_is_weighted_like_any_other(example):
    settings = RewardConfiguration(own=(OwnReward(name="tall", function="quiet_walk:soft_landing", weight=3.0),))
    plain, own = make(4), make(4, rewards=settings)
    assert own.parts.rewards.names == (*plain.parts.rewards.names, "tall")


@pytest.mark.parametrize(
    ("function", "message"),
    [
        ("soft_landing", r"rewards.own.mine.function is 'soft_landing'; write module:function"),
        (
            "no_such_module:f",
            r"'no_such_module:f', but No module named 'no_such_module'; is its folder on PYTHONPATH\?",
        ),
        ("math:no_such_function", r"module 'math' has no function 'no_such_function'"),
    ],
)
def test_functions_that_are_not_there(function, message):
    with pytest.raises(ConfigurationError, match=message):
        make(2, rewards=RewardConfiguration(own=(OwnReward(name="mine", function=function, weight=1.0),)))


BROKEN = """import sys, torch
def fails(*_, **__): return {}["missing"]
def ends(*_, **__): sys.exit(3)
def nothing(*_, **__): pass
def number(*_, **__): return 1.0
def wide(*_, **__): return torch.zeros(2, 7)
def long(*_, **__): return torch.zeros(99)
class Plain: pass
from gaitgauge.training.environment.commands import CommandGenerator
class Late(CommandGenerator):
    def draw(self, *_, **__): raise OSError("\\x1b[31mno\\nline")
class Strict(CommandGenerator):
    def __init__(self): pass
"""
ENDING = {"raising": "raise ValueError('[/x]')", "leaving": "import sys; sys.exit('bye')", "wrong": "def ("}


@pytest.fixture
def broken(tmp_path, monkeypatch):
    """Modules of somebody's that do what they must not."""
    for name, text in {"broken": BROKEN, **ENDING}.items():
        (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    for name in ("broken", *ENDING):
        sys.modules.pop(name, None)


OF_THEIRS = [
    *(f"broken:{name}" for name in ("fails", "ends", "nothing", "number", "wide", "long", "Plain", "Late", "Strict")),
    *("broken:sys", "broken:fails.x", "raising:f", "leaving:f", "wrong:f", "os:system", "json:loads", "builtins:len"),
    *(".a:f", "a..b:f", "a\0:f", "a:", ":", "x" * 300 + ":f", "\ud800:f", "../a:f", "[/x]:f"),
]
FIRST, DOING = ("rewards",), ("broken:fails", "broken:ends", "broken:long", "leaving:f", "json:loads", "broken:Plain")
"""All are tried as rewards; where names are read alike for the other settings, the rest is for slow tests."""
ALLOWED = {
    # what an event returns is not looked at
    "events": ("broken:nothing", "broken:number", "broken:wide", "broken:long"),
    "observations": ("broken:wide",),
}


@pytest.mark.usefixtures("broken")
@pytest.mark.parametrize(
    ("setting", "function"),
    [
        pytest.param(setting, function, marks=() if setting in FIRST or function in DOING else pytest.mark.slow)
        for setting in ("rewards", "termination", "observations", "events", "generator", "level_rule")
        for function in OF_THEIRS
        if function not in ALLOWED.get(setting, ())
    ],
)
def test_what_somebody_s_function_does_is_one_sentence(setting, function):
    settings = EnvironmentConfiguration()
    own = {
        "rewards": lambda: {"rewards": RewardConfiguration(own=(OwnReward(name="m", function=function, weight=1.0),))},
        "termination": lambda: {
            "termination": TerminationConfiguration(own=(OwnTermination(name="m", function=function),))
        },
        "observations": lambda: {
            "observations": replace(settings.observations, own=(OwnObservation(name="m", function=function),))
        },
        "events": lambda: {"events": (OwnEvent(name="m", function=function),)},
        "generator": lambda: {"commands": replace(settings.commands, generator=function)},
        "level_rule": lambda: {"terrain": replace(FLAT, level_rule=function)},
    }[setting]()
    with pytest.raises(ConfigurationError, match=setting) as caught:
        idle(make(2, **own), 2)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 500


@pytest.mark.parametrize(
    "name", ["raising:TASK", "leaving:TASK", "wrong:TASK", ".a:b", ":", "broken:fails", "\ud800:x"]
)
@pytest.mark.usefixtures("broken")
def test_a_task_of_somebody_s_that_is_none(name):
    with pytest.raises(TaskError, match="task ") as caught:
        find_task(name)
    assert str(caught.value).isprintable()


def test_the_line_is_named(broken):
    mine = OwnReward(name="m", function="broken:fails", weight=1.0)
    with pytest.raises(
        ConfigurationError, match=r"is 'broken:fails', which raised KeyError: 'missing' \(broken.py, line 2\)"
    ):
        idle(make(2, rewards=RewardConfiguration(own=(mine,))))


def test_a_name_that_is_taken():
    mine = OwnTermination(name="tilt", function="math:sin")
    with pytest.raises(ConfigurationError, match=r"termination.own has 'tilt', a name that is taken"):
        make(2, termination=TerminationConfiguration(own=(mine,)))


def test_a_task_that_is_not_there(example):
    with pytest.raises(TaskError, match=r"task 'quiet_walk:TUSK': module 'quiet_walk' has no Task of the name 'TUSK'"):
        find_task("quiet_walk:TUSK")
    with pytest.raises(TaskError, match=r"task 'nowhere:TASK': No module named 'nowhere'; is its folder on PYTHONPATH"):
        find_task("nowhere:TASK")


def test_own_observations_have_no_mirror_image(example):
    environment = find_task(example).environment
    robot = load_robot("go2")
    contract = training_contract(robot, robot.parameters["training"], environment)
    with pytest.raises(SymmetryError, match=r"observation 'base_height' is not known; set .*symmetry=none"):
        build_mirror(environment.observations, contract=contract, robot=robot)


def test_own_terms_are_set_one_by_one(example):
    with pytest.raises(TaskError, match=r"environment\.rewards\.own"):
        find_task(example, ["environment.rewards.own=mine"])


def test_rules_that_settings_name_are_there():
    settings = EnvironmentConfiguration()
    assert resolve(settings.commands.generator, "").__name__ == "CommandGenerator"
    assert resolve(settings.terrain.level_rule, "").__name__ == "next_level"


def test_the_guide_s_task_is_built_at_every_level(monkeypatch, tmp_path):
    """The module that ``docs/guides/your-task.md`` shows: its tile at difficulty 0 too, its task, its reward as in the example."""
    guide = (FOLDER.parents[1] / "docs" / "guides" / "your-task.md").read_text()
    shown = guide.split("```python\n")[1].partition("```")[0]
    (tmp_path / "kerb_walk.py").write_text(shown)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(training_tiles.TILE_KINDS, "kerb", None)  # taken out again at the end
    example = (FOLDER / "quiet_walk.py").read_text()
    reward = shown.partition("def soft_landing")[2].partition("\n\n\n")[0].splitlines()[2:]
    assert len(reward) == 2 and all(line in example for line in reward)
    try:
        task = find_task("kerb_walk:TASK", ["environment.rewards.own.soft_landing.weight=-1"])
    finally:
        sys.modules.pop("kerb_walk", None)
    for level, height in ((0, 0.05), (10, 0.25)):
        tile = training_tiles.make_tile("kerb", level)
        assert [float(tile.height(x, 0.0)) for x in (0.0, 2.5, 3.5)] == [0.0, pytest.approx(height), 0.0]
        assert all(side > 0.0 for box in tile.boxes for side in box.half_size)
    assert [kind.name for kind in task.environment.terrain.tiles] == ["kerb", "flat"]
    kinds = (TileConfiguration(name="kerb", share=1.0, command_limits=(1.0, 0.5, 1.5), sigma=0.5),)
    assert build_palette(TerrainConfiguration(tiles=kinds, levels=3)).index[0, 2].unique().numel() == 1


LOOKING = """
import torch
def looks(inputs):
    if inputs.base_height.mean().item() > 100.0:
        print("high")
    return inputs.base_height
"""


@pytest.fixture
def looking(tmp_path, monkeypatch):
    """A task's environment with a reward that asks the device for a number, and decides by it."""
    (tmp_path / "looking.py").write_text(LOOKING)
    monkeypatch.syspath_prepend(str(tmp_path))
    own = (OwnReward(name="mine", function="looking:looks", weight=1.0),)
    yield lambda: make(2, rewards=RewardConfiguration(own=own))
    sys.modules.pop("looking", None)


@pytest.fixture(params=["told", pytest.param("tried", marks=pytest.mark.slow)])
def no_compiling(request, monkeypatch):
    """PyTorch's compiler gives up at once, as it is known to do after seconds of trying."""
    from torch._dynamo.exc import Unsupported

    def compiled(function, **options):
        def gives_up():
            function()
            raise Unsupported("Data-dependent branching")

        return gives_up

    if request.param == "told":
        monkeypatch.setattr(torch, "compile", compiled)


@pytest.mark.usefixtures("no_compiling")
def test_what_cannot_be_compiled_runs_as_it_is_and_is_said(looking):
    environment, plain = looking(), looking()
    before = environment.state_dict()["memory"]
    environment._fuse(required=False)
    assert re.fullmatch(
        r"the environment's torch parts cannot be compiled \(.+\) and run as they are, which is slower; a function of your "
        r"own in the task may be the cause",
        environment.unfused,
    )
    assert all(torch.equal(value, before[name]) for name, value in environment.parts.memory.by_name().items())
    assert torch.equal(idle(environment, 3)[1], idle(plain, 3)[1])


@pytest.mark.usefixtures("no_compiling")
def test_compiling_can_be_insisted_on(looking):
    with pytest.raises(
        ConfigurationError, match=r"cannot be compiled \(.+\); use fuse=False, on the command line --no-fuse"
    ):
        looking()._fuse(required=True)
