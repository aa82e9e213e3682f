"""Settings from the command line, and the tasks they apply to."""

from dataclasses import dataclass, replace

import pytest
from gaitgauge.robots import load_robot
from gaitgauge.training.environment.policy_interface import training_contract
from gaitgauge.training.environment.stretches import without
from gaitgauge.training.overrides import TaskError, apply_overrides, override_keys
from gaitgauge.training.tasks import TASKS, find_task


@dataclass(frozen=True, kw_only=True)
class Wheel:
    name: str = "front"
    radius: float = 0.3


@dataclass(frozen=True, kw_only=True)
class Engine:
    power: float = 1.0
    gears: int = 5
    cooling: float | None = 0.5


@dataclass(frozen=True, kw_only=True)
class Car:
    engine: Engine = Engine()
    wheels: tuple[Wheel, ...] = (Wheel(), Wheel(name="rear"))
    seats: tuple[int, int] = (2, 3)
    colours: tuple[str, ...] = ("red",)
    open_roof: bool = False
    label: str = "a"
    limit: int | None = None


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("engine.power=2", Car(engine=Engine(power=2.0))),
        ("engine.power=-1e-3", Car(engine=Engine(power=-1e-3))),
        ("engine.gears = 6", Car(engine=Engine(gears=6))),
        ("engine.cooling=none", Car(engine=Engine(cooling=None))),
        ("engine.cooling=3", Car(engine=Engine(cooling=3.0))),
        ("wheels.rear.radius=0.4", Car(wheels=(Wheel(), Wheel(name="rear", radius=0.4)))),
        ("seats=1,2", Car(seats=(1, 2))),
        ("seats=(4, 5)", Car(seats=(4, 5))),
        ("colours=blue,green,grey", Car(colours=("blue", "green", "grey"))),
        ("open_roof=True", Car(open_roof=True)),
        ("label=x=y", Car(label="x=y")),
        ("limit=7", Car(limit=7)),
    ],
)
def test_values_take_the_field_s_type(override, expected):
    changed = apply_overrides(Car(), [override])
    assert changed == expected
    assert type(changed.engine.power) is float and type(changed.engine.gears) is int


def test_later_settings_win_and_the_original_stays():
    car = Car()
    assert apply_overrides(car, ["label=b", "label=c"]).label == "c"
    assert car == Car()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("engine.powr=2", r"unknown setting 'engine.powr'; the nearest are: engine.power"),
        ("power=2", r"engine.power"),
        ("engine.power.x=2", r"unknown setting 'engine.power.x'"),
        ("wheels.middle.radius=1", r"unknown setting .*wheels.front.radius"),
        ("wheels.0.radius=1", r"unknown setting .*wheels.front.radius"),  # a stretch names it otherwise
        ("wheels.2.radius=1", r"unknown setting"),
        (f"wheels.{'9' * 5000}.radius=1", r"unknown setting"),
        ("qqqqqq=1", r"settings begin with: colours, engine, label"),
        ("engine=2", r"'engine' is a group of 3 settings; set one of them: engine.power"),
        ("wheels=2", r"'wheels' cannot be set|'wheels' is a group"),
        ("label", r"'label' is no setting; write key=value"),
        ("=3", r"no setting"),
        ("engine.gears=2.5", r"'engine.gears' is '2.5'; it must be a whole number"),
        ("engine.power=fast", r"'engine.power' is 'fast'; it must be a number"),
        ("engine.power=nan", r"must be a finite number"),
        ("engine.cooling=x", r"must be a number, or none"),
        ("engine.power=inf", r"must be a finite number"),
        ("open_roof=perhaps", r"must be true or false"),
        ("label" + "x" * 10_000, r"'label.*…' is no setting|is no setting"),
        ("x" * 10_000 + "=1", r"unknown setting 'x"),
        ("seats=1,2,3", r"must be 2 values separated by commas"),
    ],
)
def test_mistakes_are_named(override, message):
    with pytest.raises(TaskError, match=message):
        apply_overrides(Car(), [override])


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("environment.randomization.stiffness=-1,1", r"'environment.randomization.stiffness' is '-1'"),
        ("environment.randomization.damping=0.5,1e300", r"'environment.randomization.damping' is '1e300'"),
        (
            "environment.randomization.motor_speed=0,1",
            r"^'environment.randomization.motor_speed' is '0'; it must be greater than or equal to 0.01$",
        ),
        (
            "environment.randomization.motor_speed=1,101",
            r"motor_speed' is '101'; it must be less than or equal to 100$",
        ),
        ("environment.randomization.motor_speed=2,1", r"motor_speed is 2 to 1; it must rise"),
        ("environment.randomization.friction=2,1", r"friction is 2 to 1; it must rise"),
        ("environment.randomization.delay=-0.1,0", r"'environment.randomization.delay' is '-0.1'"),
        ("environment.commands.stages.0.forward=1,-1", r"forward is 1 to -1; it must rise"),
        ("environment.reset.joint_scale=2,1", r"joint_scale is 2 to 1; it must rise"),
        ("environment.rewards.sigma_linear_range=2,1", r"sigma_linear_range is 2 to 1; it must rise"),
        ("environment.rewards.sigma_yaw_range=1,1", r"sigma_yaw_range is 1 to 1; it must rise"),
        ("environment.terrain.leave_distance=-1", r"'environment.terrain.leave_distance' is '-1'"),
        ("environment.reset.footprint=1e300,1", r"'environment.reset.footprint' is '1e300'"),
        ("environment.rewards.trunk_area=-1,1", r"'environment.rewards.trunk_area' is '-1'"),
        ("training.algorithm.clip=1e300", r"'training.algorithm.clip' is '1e300'"),
        ("training.algorithm.learning_rate_range=1e-5,1e300", r"'training.algorithm.learning_rate_range' is '1e300'"),
        ("environment.joints.armature=-1", r"'environment.joints.armature' is '-1'; .*, or none"),
        ("environment.joints.friction_loss=1e300", r"'environment.joints.friction_loss' is '1e300'"),
        ("environment.physics.self_collision=legs", r"self_collision' is 'legs'; it must be true or false"),
        (
            "environment.episode_length=1e-9",
            r"episode_length is 1e-09 s; it must be at least one control period, 0.02 s",
        ),
        ("environment.terrain.shape.stair_riser=-1,0", r"'environment.terrain.shape.stair_riser' is '-1'"),
        ("environment.terrain.shape.slope_gradient=0.1,-1", r"'environment.terrain.shape.slope_gradient' is '-1'"),
        (
            "environment.terrain.shape.obstacle_shares=0,0,0,0,0",
            r"obstacle_shares are all 0; at least one must be above 0",
        ),
        (
            "environment.terrain.shape.obstacle_shares=-1,0,1,1,0",
            r"'environment.terrain.shape.obstacle_shares' is '-1'",
        ),
        ("training.algorithm.desired_kl.end=-1", r"desired_kl goes from 0.01 to -1; both must be greater than zero"),
    ],
)
def test_no_setting_is_impossible(override, message):
    with pytest.raises(TaskError, match=message):
        find_task("go2-cts", [override])


def test_every_key_can_be_set_to_what_it_is():
    task = TASKS["go2-moe-cts"]
    for key in override_keys(task):
        section = key.partition(".")[0]
        if section not in ("environment", "training"):
            continue
        value = task
        for name in key.split("."):
            if isinstance(value, tuple):
                value = next((v for v in value if getattr(v, "name", None) == name), None) or value[int(name)]
            else:
                value = getattr(value, name)
        text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
        held = replace(task, environment=without(task.environment, {key}))  # a stretch leaves what a command gives
        assert task.with_overrides([f"{key}={text}"]) == held, key


def test_tasks():
    methods = {"go2-moe-cts": "cts", "go2-cts": "cts", "go2-moe-ng": "cts", "go2-ac-moe": "ac_moe", "go2-mcp": "mcp"}
    methods |= {"go2-him": "him", "go2-dreamwaq": "dreamwaq"}
    bipeds = ["g1-walk", "g1-rough", "g1-walk-dreamwaq", "g1-rough-dreamwaq"]
    assert list(TASKS) == [*methods, "go2-flat", "go2-sprint", "toy", *bipeds]
    moe, plain, flat, sprint = map(find_task, ("go2-moe-cts", "go2-cts", "go2-flat", "go2-sprint"))
    for name, method in methods.items():
        task = find_task(name)
        assert task.environment == moe.environment and task.training.algorithm.method == method
        assert replace(task.training.algorithm, method="cts") == moe.training.algorithm
        assert task.training.run.experiment == name.replace("-", "_")
    assert moe.training.network.student_encoder == "moe" and plain.training.network.student_encoder == "mlp"
    assert [t.name for t in flat.environment.terrain.tiles] == ["flat"]
    assert sprint.environment.commands.stages[-1].forward == (-2.0, 4.5)


@pytest.mark.parametrize("switch", ["commands.dynamic", "rewards.dynamic_sigma", "commands.curriculum"])
def test_each_training_strategy_of_the_paper_is_on_and_has_one_switch(switch):
    group, name = switch.split(".")
    on = find_task("go2-moe-cts").environment
    off = find_task("go2-moe-cts", [f"environment.{switch}=false"]).environment
    assert getattr(getattr(on, group), name) is True
    assert off == replace(on, **{group: replace(getattr(on, group), **{name: False})})


def test_the_contract_says_which_commands_a_task_trains():
    limits = {"go2-moe-cts": (2.0, 1.0, 2.0), "go2-flat": (2.0, 1.0, 2.0), "go2-sprint": (4.5, 1.0, 2.0)}
    robot = load_robot("go2")
    for name, expected in limits.items():
        contract = training_contract(robot, robot.parameters["training"], find_task(name).environment)
        assert contract.command_limits == expected, name


def test_unknown_task_names_the_nearest():
    with pytest.raises(TaskError, match=r"unknown task 'go2-moe'; did you mean .*go2-moe-cts.*the tasks are"):
        find_task("go2-moe")


def test_schedules_span_the_run_unless_told_otherwise():
    assert find_task("go2-cts", ["training.run.iterations=50"]).environment.schedule.horizon_steps == 50 * 24
    fixed = find_task("go2-cts", ["training.run.iterations=50", "environment.schedule.horizon_steps=77"])
    assert fixed.environment.schedule.horizon_steps == 77


def test_a_value_that_the_configuration_refuses_is_an_error_of_the_key():
    with pytest.raises(TaskError, match=r"'training.network.student_encoder' cannot be set: .*moe_ng"):
        find_task("go2-cts", ["training.network.student_encoder=transformer"])


def test_task_name_cannot_be_overridden():
    with pytest.raises(TaskError, match="unknown setting 'name'"):
        find_task("go2-cts", ["name=x"])
    assert replace(TASKS["go2-cts"], name="x") != TASKS["go2-cts"]


@pytest.mark.parametrize(
    ("override", "rule"),
    [
        ("environment.num_envs=0", "greater than or equal to 1"),
        ("environment.seed=-1", "greater than or equal to 0"),
        (f"training.run.seed={10**300}", "less than"),
        ("environment.terrain.levels=0", "greater than or equal to 1"),
        ("environment.observations.history_length=1000000000", "less than or equal to 1000"),
        ("environment.commands.flip_probability=1.5", "less than or equal to 1"),
        ("environment.termination.stuck=0", "greater than 0"),
        ("environment.termination.trunk_contact=-1", "greater than or equal to 0"),
        ("environment.rewards.foot_height_over=feet", "'foot' or 'base'"),
        ("environment.schedule.horizon_steps=0", "greater than or equal to 1"),
        ("environment.physics.iterations=0", "greater than or equal to 1"),
        ("environment.terrain.tiles.flat.share=-1", "greater than or equal to 0"),
        ("environment.terrain.promotion_distance=-1e12", "greater than 0"),
        ("environment.terrain.demotion_share=5", "less than or equal to 1"),
        ("environment.terrain.spread_distance=-4", "greater than or equal to 0"),
        ("environment.terrain.spawn_jitter=-5", "greater than or equal to 0"),
        ("environment.terrain.levels=13", "less than or equal to 12"),
        ("environment.terrain.highest_start_level=99", "less than 12"),
        ("environment.terrain.shape.stair_count=0", "greater than or equal to 1"),
        ("environment.terrain.shape.roughness=-1", "greater than or equal to 0"),
        ("environment.terrain.shape.platform_radius=-5", "greater than 0"),
        ("environment.terrain.shape.stair_irregularity=2", "less than or equal to 1"),
        ("environment.terrain.shape.taper=0", "greater than 0"),
        ("environment.terrain.shape.extent=0", "greater than 4"),
        ("environment.rewards.foot_height_scale=0", "greater than 0"),
        ("environment.rewards.foot_height_scale=-1", "greater than 0"),
        ("environment.rewards.base_height_target=0", "greater than 0"),
        ("environment.termination.tilt=0", "greater than 0, or none"),
        ("environment.physics.foot_condim=5", "3, 4 or 6, or none"),
        ("environment.physics.foot_condim=2", "3, 4 or 6, or none"),
        ("training.algorithm.discount=1.5", "less than or equal to 1"),
        ("training.algorithm.discount=-1", "greater than or equal to 0"),
        ("training.algorithm.gae_lambda=-3", "greater than or equal to 0"),
        ("training.algorithm.gae_lambda=2", "less than or equal to 1"),
        ("training.algorithm.desired_kl=-1", "greater than 0, or none"),
        ("training.run.nonfinite_limit=5", "less than or equal to 1"),
        ("training.run.gauge_wait=-5", "greater than or equal to 0"),
    ],
)
def test_settings_have_ranges(override, rule):
    with pytest.raises(TaskError, match=f"{override.partition('=')[0]}' is .*; it must be {rule}"):
        find_task("go2-moe-cts", [override])
