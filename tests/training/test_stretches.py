"""Stretches of a run: other settings from a fraction of it on, and the same results after a stop in any of them."""

from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import patch

import pytest
import torch
import yaml
from gaitgauge.robots import load_robot
from gaitgauge.training.configuration import ConfigurationError
from gaitgauge.training.environment import environment as environment_module
from gaitgauge.training.environment.configuration import EnvironmentConfiguration, ScheduleConfiguration, Stretch
from gaitgauge.training.environment.policy_interface import joint_parameters, training_contract
from gaitgauge.training.environment.stretches import check_stretches, settings_in
from gaitgauge.training.processes import Processes
from gaitgauge.training.run import fitting
from gaitgauge.training.run.checkpoint import read_checkpoint
from gaitgauge.training.run.fitting import Fit, iterations_that_fit
from gaitgauge.training.run.plan import prepare
from gaitgauge.training.run.request import TrainRequest
from gaitgauge.training.run.resuming import resume_run
from gaitgauge.training.run.runner import TrainingRunner
from gaitgauge.training.run.seeding import seed_everything
from gaitgauge.training.tasks import TaskError, find_task, scaling
from gaitgauge_fake_engine import FakeBackend, FakeScript
from small_environment import STAIRS, idle, make
from toy_training import toy_configuration

LAST = Stretch(
    name="last",
    begin=0.5,
    settings="environment.rewards.tracking_sigma=0.1 environment.terrain.tiles.flat.share=0.5 environment.randomization.friction=0.5,0.6 "
    "environment.rewards.turn_error=-1 environment.rewards.turn_error_time=0.3",
)
STEPS, TOTAL = 6, 4


@pytest.fixture(scope="module", autouse=True)
def scripted():
    with patch.object(
        environment_module, "make_backend", lambda name, scene, **_: FakeBackend(scene, script=FakeScript())
    ):
        yield


def build(folder, *, seed=0, messages=None):
    folder.mkdir(exist_ok=True)
    seed_everything(seed)
    schedule = ScheduleConfiguration(horizon_steps=STEPS * TOTAL, stretches=(LAST,))
    environment = make(num_envs=12, terrain=STAIRS, schedule=schedule)
    physics = {"trained": [list(environment.configuration.randomization.friction)]}
    return TrainingRunner(
        environment,
        toy_configuration(steps=STEPS, run={"random_episode_start": True, "save_interval": 3}),
        contract=replace(environment.contract, provenance={**environment.contract.provenance, "physics": physics}),
        task="toy",
        log_dir=folder,
        physics=lambda settings: {"trained": [list(settings.randomization.friction)]},
        message=None if messages is None else messages.append,
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder, messages = tmp_path_factory.mktemp("run"), []
    run = build(folder, messages=messages)
    run.learn(TOTAL)
    return folder, run, messages


def test_a_run_changes_its_settings_at_the_fraction_given(whole):
    folder, run, messages = whole
    assert run.env.stretch == 1 and run.env.configuration.rewards.tracking_sigma == 0.1
    friction = run.env._bodies["friction"]
    assert 0.5 <= float(friction.min()) <= float(friction.max()) <= 0.6
    assert run.env.kind.tolist() != make(num_envs=12, terrain=STAIRS).kind.tolist()
    assert [text[:77] for text in messages if text.startswith("Stretch")] == [
        "Stretch 'last' begins after iteration 2: environment.rewards.tracking_sigma=0"
    ]
    written = {path.name: read_checkpoint(path)["training"]["environment"]["stretch"] for path in folder.glob("*.pt")}
    assert written == {"model_2.pt": 0, "model_3.pt": 1, "model_4.pt": 1}, "the boundary is a checkpoint"
    assert run.contract.provenance["physics"]["trained"] == [[0.2, 1.25], [0.5, 0.6]]


def test_levels_and_the_schedule_go_on_in_the_next_stretch(tmp_path):
    env = make(num_envs=12, terrain=STAIRS, schedule=ScheduleConfiguration(horizon_steps=8, stretches=(LAST,)))
    idle(env, 4)
    env.parts.memory.level.copy_(torch.arange(12) % 3)
    assert env.stretch_ends
    assert env.next_stretch() == LAST and not env.stretch_ends
    assert env.parts.memory.level.tolist() == [0, 1, 2] * 4
    assert float(env.progress) == 0.5 and env.common_step_counter == 4


def test_a_run_from_a_finished_policy_begins_in_the_last_stretch():
    env = make(num_envs=2, schedule=ScheduleConfiguration(begin=1.0, stretches=(LAST,)))
    assert env.stretch == 1 and not env.stretch_ends


@pytest.mark.parametrize("robot", ["go1", "anymal_c"])
def test_the_last_stretch_fits_other_robots(robot):
    settings = find_task("rough", robot=robot).environment
    whole = load_robot(robot)
    contract = training_contract(whole, joint_parameters(whole, settings), settings)
    check_stretches(settings, whole, contract)
    last = settings_in(settings, 1)
    assert last.randomization.foot_torsion == (0.0, 1.0) and last.randomization.motor_speed == (1.0, 5.0)
    assert last.rewards.joint_speed_limits == -0.15


def test_a_robot_of_unknown_motor_speeds_has_a_last_stretch_without_them():
    whole = load_robot("go1")
    slow = replace(whole.parameters["gauge"], no_load_speed=None, full_torque_speed=None)
    whole = replace(whole, parameters={"gauge": slow})
    task = find_task("rough")
    with patch.object(scaling, "load_robot", lambda name: whole if name == "go1" else load_robot(name)):
        settings, _ = scaling.scaled(task.environment, task.training, "go1")
    contract = training_contract(whole, slow, settings)
    check_stretches(settings, whole, contract)
    last = settings_in(settings, 1)
    assert last.randomization.motor_speed == (1.0, 1.0) and last.rewards.joint_speed_limits == 0.0
    assert last.rewards.turn_error == -6.0
    judged = Stretch(name="judged", begin=0.5, settings="environment.rewards.joint_speed_limits=-1")
    asked = replace(settings, schedule=ScheduleConfiguration(stretches=(judged,)))
    with pytest.raises(ConfigurationError, match="does not say how fast its motors turn"):
        check_stretches(asked, whole, contract)


@pytest.mark.parametrize("stop", [2, pytest.param(3, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.slow)])
def test_a_run_that_stops_in_any_stretch_goes_on_exactly(whole, tmp_path, stop):
    """``stop`` 2 is the boundary: the checkpoint is of the first stretch, and what comes is of the second."""
    folder, _, _ = whole
    stopped = folder / f"model_{stop}.pt"
    if not stopped.exists():
        stopped = tmp_path / "first" / stopped.name
        build(tmp_path / "first").learn(stop)
    resumed = build(tmp_path / "second", seed=5)
    resume_run(resumed, stopped)
    resumed.learn(TOTAL - stop)
    a, b = (read_checkpoint(each / "model_4.pt") for each in (folder, tmp_path / "second"))
    for name, value in a["actor_state_dict"].items():
        assert torch.equal(value, b["actor_state_dict"][name]), name
    for name, value in a["training"]["environment"]["memory"].items():
        assert torch.equal(value, b["training"]["environment"]["memory"][name]), name
    assert torch.equal(a["training"]["log"]["reward_sum"], b["training"]["log"]["reward_sum"])


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("environment.num_envs=3", "'environment.num_envs=3'; it may change environment.… settings of commands, "),
        ("training.run.seed=3", "'training.run.seed=3'; it may change"),
        ("environment.terrain.levels=2", "'odd' of environment.schedule has 2 levels of terrain"),
        ("environment.physics.substeps=5", "'odd' of environment.schedule makes another policy contract"),
        ("environment.rewards.progres=1", "unknown setting 'environment.rewards.progres'"),
        ("environment.randomization.motor_speed=1,2 environment.physics.torque_speed_limit=false", "does nothing"),
    ],
)
def test_a_stretch_that_does_not_fit_is_refused_before_the_run(setting, words):
    odd = ScheduleConfiguration(stretches=(Stretch(name="odd", begin=0.5, settings=setting),))
    with pytest.raises(ValueError, match=words):
        make(num_envs=2, schedule=odd)


def test_a_stretch_leaves_ground_alone_that_the_task_does_not_have():
    """A task with tiles of its own inherits the last stretch of those on all terrains."""
    task = find_task("go2-cts")
    ground = task.environment.terrain
    flat = replace(ground, tiles=tuple(tile for tile in ground.tiles if tile.name == "flat"))
    found = settings_in(replace(task.environment, terrain=flat), 1)
    assert [tile.name for tile in found.terrain.tiles] == ["flat"]
    assert found.rewards.turn_error == -6.0 and found.terrain.tiles[0].share == 0.18


def test_stretches_follow_in_order():
    late = ScheduleConfiguration(stretches=(replace(LAST, begin=0.7), LAST))
    with pytest.raises(
        ConfigurationError, match=r"stretches begin at \[0.7, 0.5\] of the run; they must follow in order"
    ):
        settings_in(EnvironmentConfiguration(schedule=late), 1)


def test_a_setting_of_the_command_line_holds_in_every_stretch():
    own = find_task("go2-moe-cts").environment
    given = find_task("go2-moe-cts", ["environment.physics.cone=pyramidal"]).environment
    assert settings_in(own, 1).physics.cone == "elliptic" and settings_in(own, 0).physics.cone == "pyramidal"
    assert settings_in(given, 1).physics == replace(settings_in(own, 1).physics, cone="pyramidal")


def test_a_setting_of_one_stretch_holds_in_it_alone():
    """Beside the same one for the whole run, which leaves the stretch out otherwise."""
    sigma = "environment.terrain.tiles.flat.sigma"
    given = find_task("go2-moe-cts", [f"{sigma}=0.75", f"precise: {sigma} = 0.5"]).environment
    tiles = [settings_in(given, stretch).terrain.tiles[-1] for stretch in (0, 1)]
    assert [(tile.name, tile.sigma) for tile in tiles] == [("flat", 0.75), ("flat", 0.5)]
    assert settings_in(given, 1).physics == settings_in(find_task("go2-moe-cts").environment, 1).physics


@pytest.mark.parametrize(
    ("task", "setting", "words"),
    [
        ("go2-cts", "late:environment.seed=1", "is for stretch 'late'; its stretches are: precise"),
        ("go2-flat", "precise:environment.seed=1", "is for stretch 'precise'; the task has no stretches"),
        ("go2-cts", "precise:environment.seed", "is no setting of a stretch; write precise:environment.…=value"),
    ],
)
def test_a_setting_of_no_stretch_is_refused(task, setting, words):
    with pytest.raises(TaskError, match=words):
        find_task(task, [setting])


def test_the_iterations_that_fit_are_those_of_both_stretches():
    """By hand: 1000 - 35 = 965 s and 10 iterations done; 90 of 100 iterations at 1 s and 10 at 1.4 s, so 975 / 1.04."""
    assert iterations_that_fit(done=10, each=1.0, left=1000.0, begins=[0.9]) == int(975 / 1.04)
    assert iterations_that_fit(done=10, each=2.0, left=1000.0, begins=[]) == 10 + 500
    assert iterations_that_fit(done=10, each=2.0, left=1.0, begins=[]) == 11


RECORDED = {
    "go2-moe-cts": (
        126.5,
        [(40, 0.510), (60, 0.536), (100, 0.494), (200, 0.479), (500, 0.459), (1, 0.472)],
        30.5,
        0.626,
    ),
    "go2-dreamwaq": (
        122.5,
        [(40, 0.442), (60, 0.414), (100, 0.435), (200, 0.397), (500, 0.391), (1, 0.382)],
        30.3,
        0.555,
    ),
    "kernels of the last stretch not cached": (90.0, [(1, 0.382)], 240.0, 0.555),
    "four times as fast": (100.0, [(50, 0.13), (1, 0.10)], 40.0, 0.14),
}
"""Of runs with a limit of 20 minutes on an H200: seconds before the first iteration; iterations of the first stretch and seconds for
each, the last for all others; seconds to build the last stretch; seconds for an iteration of it. The last two are invented."""


@pytest.mark.parametrize("done", [0.0, 0.3])
@pytest.mark.parametrize("recorded", RECORDED.values(), ids=RECORDED)
def test_a_fitted_run_ends_between_96_and_99_percent_of_its_time(recorded, done, monkeypatch):
    """Also a run that begins where ``done`` of its schedules counts as done."""
    starting, first, building, last = recorded
    times = [seconds for count, seconds in first for _ in range(count)]
    clock, steps, begin = starting, 24, 0.6
    monkeypatch.setattr(fitting, "time", SimpleNamespace(monotonic=lambda: clock))
    schedule = ScheduleConfiguration(begin=done, stretches=(replace(LAST, begin=begin),))
    env = SimpleNamespace(
        stretch=0, cfg=SimpleNamespace(schedule=schedule), set_horizon=lambda steps: horizons.append(steps)
    )
    run = SimpleNamespace(env=env, iteration=0, log_dir=None, processes=Processes(), message=lambda text: None)
    run.configuration = SimpleNamespace(run=SimpleNamespace(steps_per_iteration=steps))
    run.settings = {"training": {"run": {}}, "environment": {"schedule": {}}}
    fit, total, horizons, entered = Fit(run, 20_000, 1200.0 - starting), 20_000, [20_000 * steps], 0
    while run.iteration < total:
        clock += last if env.stretch else times[min(run.iteration, len(times) - 1)]
        run.iteration += 1
        total = fit.total(total, 1200.0 - clock)
        reached = run.iteration * steps >= round(begin * total * steps) - round(done * total * steps)
        assert reached or not env.stretch, "the stretch lies ahead again"
        if reached and not env.stretch:
            env.stretch, entered, clock = 1, run.iteration, clock + building
    assert 0.96 * 1200 <= clock <= 0.99 * 1200
    assert horizons[-1] == total * steps == run.settings["environment"]["schedule"]["horizon_steps"]
    assert begin - 0.02 <= done + entered / total <= (begin + 0.02 if building < 100 else 0.75)


def test_schedules_of_a_run_that_begins_within_them_are_spread_from_there():
    schedule = ScheduleConfiguration(
        horizon_steps=40, begin=0.25, stretches=(LAST, replace(LAST, name="never", begin=1.0))
    )
    env = make(num_envs=4, terrain=STAIRS, schedule=schedule)
    idle(env, 2)
    env.set_horizon(16)
    assert float(env.progress) == pytest.approx(0.25 + 2 / 16) and not env.stretch_ends
    idle(env, 2)
    assert float(env.progress) == pytest.approx(0.5) and env.next_stretch() == LAST
    idle(env, 9)
    assert not env.stretch_ends, "a stretch at 1 never begins"


def test_a_run_fits_its_schedules_into_the_time(tmp_path, monkeypatch):
    monkeypatch.setattr(fitting, "SKIPPED", 1)
    monkeypatch.setattr(fitting, "MEASURED", 1)
    monkeypatch.setattr(fitting, "iterations_that_fit", lambda **given: 3 if given["begins"] == [0.5] else 0)
    messages: list[str] = []
    run = build(tmp_path / "run", messages=messages)
    run.settings = {"training": {"run": {"iterations": 4}}, "environment": {"schedule": {"horizon_steps": 24}}}
    outcome = run.learn(TOTAL, max_seconds=600.0, fit=True)
    assert outcome.iteration == 3 and outcome.reason == "finished"
    assert float(run.env.progress) == pytest.approx(1.0) and run.env.stretch == 1
    assert any(text.startswith("3 iterations of 4 fit into the time, ") for text in messages)
    agent, env = (
        yaml.safe_load((tmp_path / "run" / "params" / f"{name}.yaml").read_text()) for name in ("agent", "env")
    )
    assert agent["run"]["iterations"] == 3 and env["schedule"]["horizon_steps"] == 18
    stored = read_checkpoint(tmp_path / "run" / "model_3.pt")["training"]["settings"]
    assert stored == {"training": {"run": {"iterations": 3}}, "environment": {"schedule": {"horizon_steps": 18}}}


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({"fit": True}, "no limit to fit into; add --time"),
        ({"fit": True, "seconds": 9.0, "resume": "x"}, "keeps its length"),
    ],
)
def test_fitting_needs_a_limit_and_a_new_run(request_, words):
    with pytest.raises(ConfigurationError, match=words):
        prepare(TrainRequest(task="toy", **request_))
