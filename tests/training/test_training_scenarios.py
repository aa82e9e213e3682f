"""Scenario files in a share of the training worlds, on the scripted engine; expected values are the files'."""

from dataclasses import replace
from unittest.mock import patch

import pytest
import torch
from gaitgauge.policy.loading import load_policy
from gaitgauge.robots.anatomy.body_plan import base_mass
from gaitgauge.robots.registry import load_robot
from gaitgauge.studies.trials.running import run_each
from gaitgauge.studies.trials.scenario import (
    Force,
    Ground,
    Leg,
    Patch,
    Payload,
    Scenario,
    Start,
    Success,
    scenario_text,
)
from gaitgauge.terrains.course import Stretch
from gaitgauge.training.configuration import ConfigurationError
from gaitgauge.training.environment.configuration import EnvironmentConfiguration, RandomizationConfiguration
from gaitgauge.training.environment.environment import TrainingEnvironment
from gaitgauge.training.environment.scenarios import read_scenarios
from gaitgauge.training.tasks import find_task
from small_environment import FALLS_END, FLAT, NO_PUSH, STILL, gliding, idle, make

SAME = RandomizationConfiguration(
    friction=(0.5, 0.5),
    base_mass=(0.0, 0.0),
    base_com=(0.0, 0.0),
    motor_offset=(0.0, 0.0),
    delay=(0.0, 0.0),
)
PUSHED = Scenario(
    name="pushed",
    title="Pushed, loaded, slippery and late",
    friction=0.9,
    ground=Ground(
        begin=-20.0,
        width=60.0,
        stretches=(Stretch(length=20.8), Stretch(length=3.0, rise=0.5), Stretch(length=30.0)),
    ),
    start=Start(yaw=0.3, spread=(0.0, 0.0, 0.0)),
    commands=(Leg(seconds=0.1, velocity=(0.0, 0.0, 0.0)), Leg(seconds=0.2, velocity=(0.8, -0.4, 1.0))),
    forces=(Force(direction="left", newtons=(40.0, 40.0), begin=(0.04, 0.04), seconds=(0.06, 0.06)),),
    patches=(Patch(begin=0.1, seconds=0.04, friction=0.1),),
    payload=Payload(kilograms=3.0, place=(0.1, 0.0, 0.05)),
    latency=0.03,
    success=Success(survive=True),
)
PLAIN = Scenario(
    name="plain",
    title="Walks on",
    friction=0.6,
    commands=(Leg(seconds=0.4, velocity=(0.5, 0.0, 0.0)),),
    success=Success(survive=True),
)
KNOWN = {"terrain": FLAT, "reset": STILL, "push": NO_PUSH, "termination": FALLS_END, "randomization": SAME}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenarios")
    for scenario in (PUSHED, PLAIN):
        (folder / f"{scenario.name}.toml").write_text(scenario_text(scenario))
    return folder


def played(files, *, variation=0.0, names=("pushed", "plain"), **settings):
    """Two worlds of training, one for each scenario."""
    paths = tuple(str(files / f"{name}.toml") for name in names)
    settings = {"randomization": SAME, "scenario_variation": variation, "scenario_share": 0.5, **settings}
    return make(2 + len(names), scenarios=paths, **settings)


def test_a_scenario_is_played_as_its_file_says(files):
    environment = played(files)
    backend, memory = environment.backend, environment.parts.memory
    assert backend.scene.terrains[int(memory.terrain_index[2])].height(5.0, 0.0) == pytest.approx(0.5, abs=1e-6)
    assert backend.state.base_quaternion_w[2].tolist() == pytest.approx([0.98877, 0.0, 0.0, 0.14944], abs=1e-4)
    own = base_mass(load_robot("go2"))
    assert backend.randomized.base_mass_offset.tolist() == pytest.approx([0.0, 0.0, 3.0, 0.0])
    shift = 3.0 / (3.0 + own)
    assert backend.randomized.base_com_offset[2].tolist() == pytest.approx([0.1 * shift, 0.0, 0.05 * shift], abs=1e-6)
    frictions, forces, commands, done = [], [], [], []
    for _ in range(16):
        commands.append(memory.command[2].tolist())
        _, _, ended, extras = idle(environment)
        frictions.append(round(float(backend.randomized.friction[2]), 3))
        forces.append(float(backend.force_w[2].norm()))
        done.append((int(ended[2]), float(extras["time_outs"][2])))
    assert commands == [[0.0] * 3] * 5 + [pytest.approx([0.8, -0.4, 1.0])] * 10 + [[0.0] * 3]
    assert frictions[:15] == [0.9] * 5 + [0.1] * 2 + [0.9] * 8
    assert [f > 0.0 for f in forces[:15]] == [False] * 2 + [True] * 3 + [False] * 10
    assert max(forces) == pytest.approx(40.0, rel=1e-5)
    assert done == [(0, 0.0)] * 14 + [(1, 1.0), (0, 0.0)]
    assert backend.randomized.friction[[0, 1, 3]].tolist() == pytest.approx([0.5, 0.5, 0.6])
    assert extras["log"]["Scenarios/episodes"] == 1.0


def test_a_push_turns_with_the_robot(files):
    environment = played(files, names=("pushed",), scenario_share=0.3)
    idle(environment, 3)
    left = torch.tensor([-0.29552, 0.95534, 0.0])  # of a heading of 0.3 rad
    assert torch.allclose(environment.backend.force_w[2].float(), 40.0 * left, atol=1e-3)


def test_actions_come_late_by_more_than_a_control_period(files):
    """30 ms are one control period of 20 ms and two physics steps of 5 ms."""
    environment = played(files)
    asked = []
    step = environment.backend.step

    def note(targets, *, delay=None, **options):
        asked.append((targets.clone(), delay.tolist()))
        step(targets, delay=delay, **options)

    with patch.object(environment.backend, "step", note):
        for number in (1.0, 2.0, 3.0):
            environment.step(torch.full((4, 12), number))
    default = environment.parts.default_pose
    scale = environment.contract.action_scale
    offsets = [((targets - default) / torch.tensor(scale)).mean(dim=1).tolist() for targets, _ in asked]
    assert [o[2] for o in offsets] == pytest.approx([0.0, 1.0, 2.0], abs=1e-5)
    assert [o[3] for o in offsets] == pytest.approx([1.0, 2.0, 3.0], abs=1e-5)
    assert asked[0][1] == [0, 0, 2, 0]


def test_episodes_vary_about_the_file(files):
    environment = played(files, variation=0.2)
    heard, rubbed = [], []
    for _ in range(60):
        idle(environment)
        heard.append(float(environment.parts.memory.command[3, 0]))
        rubbed.append(float(environment.backend.randomized.friction[3]))
    assert len(set(heard)) >= 3 and 0.4 <= min(heard) < 0.5 < max(heard) <= 0.6
    assert len(set(rubbed)) >= 3 and 0.48 <= min(rubbed) < max(rubbed) <= 0.72


def test_worlds_of_scenarios_have_no_level(files):
    environment = played(files, script=gliding(0.3))
    names = [tile.name for tile in environment.palette.tiles]
    assert names == ["flat", "scenarios"] and environment.parts.kind.tolist() == [0, 0, 1, 1]
    idle(environment, 8)
    log = environment._log()
    assert "Curriculum/scenarios" not in log and log["Curriculum/mean_level"] == 0.0


def test_a_run_goes_on_where_it_was(files):
    first, second = (played(files, variation=0.2, seed=4) for _ in range(2))
    idle(first, 4)
    second.load_state_dict(first.state_dict())
    for environment in (first, second):
        idle(environment, 9)
    assert torch.equal(first.parts.memory.command, second.parts.memory.command)
    assert torch.equal(first.backend.force_w, second.backend.force_w)
    assert torch.equal(first.backend.randomized.friction, second.backend.randomized.friction)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"commands": (Leg(seconds=1.0, velocity=(0.5, 0.0, 0.0), until_x=0.3),)}, "until_x, which depends on where"),
        ({"commands": (Leg(seconds=1.0, velocity=(3.0, 0.0, 0.0)),)}, "at most 2; raise environment.commands.stages"),
        ({"commands": (Leg(seconds=30.0, velocity=(0.1, 0.0, 0.0)),)}, "lasts 30 s, longer than"),
        (
            {
                "commands": (Leg(seconds=8.0, velocity=(1.0, 0.0, 0.0)),),
                "ground": Ground(stretches=(Stretch(length=9.0), Stretch(length=1.0, rise=0.2, steps=2))),
            },
            "ground that changes more than 5.7 m from",
        ),
    ],
)
def test_what_a_training_world_cannot_play_is_refused_in_one_sentence(tmp_path, changed, words):
    path = tmp_path / "own.toml"
    path.write_text(scenario_text(replace(PLAIN, name="own", **changed)))
    with pytest.raises(ConfigurationError, match=words):
        read_scenarios(EnvironmentConfiguration(scenarios=(str(path),)))


def test_a_folder_stands_for_its_files_and_too_few_worlds_are_refused(files, tmp_path):
    assert [s.name for s in read_scenarios(EnvironmentConfiguration(scenarios=(str(files),)))] == ["plain", "pushed"]
    with pytest.raises(ConfigurationError, match=r"holds no \.toml file"):
        read_scenarios(EnvironmentConfiguration(scenarios=(str(tmp_path),)))
    with pytest.raises(ConfigurationError, match="2 scenarios, but environment"):
        make(4, scenarios=(str(files),))
    task = find_task("go2-moe-cts", [f"environment.scenarios={files}/plain.toml,{files}/pushed.toml"])
    assert len(task.environment.scenarios) == 2


def test_what_is_left_out_is_said(files, caplog):
    path = files.parent / "fast.toml"
    path.write_text(scenario_text(replace(PLAIN, name="fast", success=Success(beyond=0.15))))
    read_scenarios(EnvironmentConfiguration(scenarios=(str(path),)))
    assert "scenario 'fast' says what success or a fall is" in caplog.text


@pytest.mark.slow
def test_what_falls_in_a_trial_falls_in_training(tmp_path):
    """The shipped policy in MuJoCo, by the gauge's trial and in training worlds: felled by a push, and not by a walk."""
    policy = load_policy("pretrained")
    hard = Force(direction="left", newtons=(450.0, 450.0), begin=(0.5, 0.5), seconds=(0.3, 0.3))
    walk = (Leg(seconds=0.5, velocity=(0.0, 0.0, 0.0)), Leg(seconds=1.5, velocity=(0.5, 0.0, 0.0)))
    shoved = replace(PLAIN, name="shoved", commands=walk, forces=(hard,))
    walking = replace(PLAIN, name="walking", commands=walk)
    for scenario in (shoved, walking):
        (tmp_path / f"{scenario.name}.toml").write_text(scenario_text(scenario))
    robot = load_robot("go2")
    trials = run_each(policy, robot, [(scenario, seed) for scenario in (shoved, walking) for seed in range(3)])
    assert [trial.outcome for trial in trials] == ["fell"] * 3 + ["success"] * 3
    settings = [f"environment.scenarios={tmp_path}", "environment.scenario_share=0.75", "environment.num_envs=8"]
    settings += ["environment.terrain.levels=1", "environment.terrain.variants=1"]
    settings += ["environment.terrain.highest_start_level=0", "environment.scenario_variation=0.05"]
    task = find_task("go2-moe-cts", settings)
    environment = TrainingEnvironment(task.environment, backend="mujoco", device="cpu", fuse=False)
    session, observations = policy.session(8, device="cpu"), environment.get_observations()
    fell, over = torch.zeros(8, dtype=torch.bool), torch.zeros(8, dtype=torch.bool)
    with torch.inference_mode():
        for _ in range(100):
            observations, _, done, extras = environment.step(session.act(observations["policy"]))
            ended = done.bool()
            fell |= ended & ~over & (extras["time_outs"] == 0.0)
            over |= ended
            session.reset(ended)
    environment.close()
    assert fell[2:].tolist() == [True] * 3 + [False] * 3 and bool(over[2:].all())
