"""An observation from outside: the file of the guide, as a plug-in that is installed, and as module:name in a training."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import gaitgauge
import pytest
import torch
from gaitgauge.cli.main import app
from gaitgauge.gauge.play.noise import make_stream
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy import observation_table
from gaitgauge.policy.contract import ContractError, ObservationTerm, kind_of_observations, standard_contract
from gaitgauge.policy.export.files import ExportError, deploy_settings, mjlab_metadata
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.observation import ObservationBuilder
from gaitgauge.policy.observation_table import GROUP, OBSERVATIONS, Observation, ObservationError, register
from gaitgauge.robots import load_robot
from gaitgauge.training.algorithms.symmetry import SymmetryError, build_mirror
from gaitgauge.training.configuration import ConfigurationError
from gaitgauge.training.environment.configuration import ObservationConfiguration
from gaitgauge.training.environment.own_terms import policy_observations
from test_observation import EPISODES, make_inputs, make_state
from typer.testing import CliRunner

GUIDE = Path(gaitgauge.__path__[0]) / "docs" / "guides" / "your-observation.md"
ROBOT = load_robot("go2")
SMALL = (
    "training.run.iterations=2",
    "training.algorithm.minibatches=1",
    "training.run.steps_per_iteration=4",
    "training.network.actor_hidden=8",
    "training.network.critic_hidden=8",
    "training.network.teacher_hidden=8",
    "training.network.student_hidden=8",
)


@pytest.fixture
def module(tmp_path, monkeypatch):
    """The folder of the guide's module, on the import path; what it made known is forgotten afterwards."""
    known = dict(OBSERVATIONS)
    text = re.search(r"<!-- file: foot_load.py -->\n```python\n(.*?)```", GUIDE.read_text(), re.S)[1]
    (tmp_path / "foot_load.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    sys.modules.pop("foot_load", None)
    OBSERVATIONS.clear()
    OBSERVATIONS.update(known)


@pytest.fixture
def installed(module):
    """The same with the files of an installed distribution."""
    folder = module / "foot_load-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: foot-load\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(
        f"[{GROUP}]\nfoot_load = foot_load:FOOT_LOAD\nother = foot_load:FOOT_LOAD\n"
    )
    return module


def with_foot_load():
    contract = standard_contract(ROBOT)
    return replace(contract, observation=(*contract.observation, ObservationTerm(name="foot_load", scale=(0.01,))))


def test_the_gauge_builds_it(installed):
    contract = with_foot_load()
    assert contract.frame_width == 49 and kind_of_observations(contract) == "measurable"
    load = 100.0 * torch.rand(EPISODES, 4)
    state, (command, action) = replace(make_state(), foot_normal_force=load), make_inputs()
    stream = make_stream(load_suite("gaitgauge-1").noise, 12, EPISODES, torch.device("cpu"))
    noise, _ = stream.draw(torch.arange(EPISODES))
    built = ObservationBuilder(contract, ROBOT, EPISODES).build(state, command, action, noise)
    assert noise["foot_load"].shape == (EPISODES, 4) and 2.0 < noise["foot_load"].abs().max() <= 5.0
    torch.testing.assert_close(built[:, 45:], 0.01 * (load + noise["foot_load"]))
    plain = ObservationBuilder(standard_contract(ROBOT), ROBOT, EPISODES)
    assert torch.equal(plain.build(state, command, action, noise), built[:, :45])


def test_noise_of_other_observations_and_delays_stay_as_they_are(installed):
    noise = load_suite("gaitgauge-1").noise
    before, delays = make_stream(noise, 12, 8, torch.device("cpu")).draw(torch.arange(8))
    with_foot_load()
    after, same = make_stream(noise, 12, 8, torch.device("cpu")).draw(torch.arange(8))
    assert after.keys() - before.keys() == {"foot_load"} and torch.equal(delays, same)
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_symmetry_mirrors_it(installed):
    mirror = build_mirror(ObservationConfiguration(), contract=with_foot_load(), robot=ROBOT)
    frame = torch.randn(3, 49)
    assert torch.equal(mirror.policy(frame)[:, 45:], frame[:, [46, 45, 48, 47]])
    register(Observation(name="unmirrored", build=lambda s, c, a: c, width=3, unit=""))
    contract = standard_contract(ROBOT)
    unknown = replace(contract, observation=(*contract.observation, ObservationTerm(name="unmirrored", scale=(1.0,))))
    with pytest.raises(SymmetryError, match="'unmirrored' is not known"):
        build_mirror(ObservationConfiguration(), contract=unknown, robot=ROBOT)


def test_files_of_others_without_a_name_for_it_are_not_written(installed):
    with pytest.raises(ExportError, match="no name for the observation 'foot_load'"):
        deploy_settings(with_foot_load(), ROBOT)
    assert mjlab_metadata(with_foot_load()) == {}


@pytest.mark.parametrize("setting", ["foot_load", "foot_load:FOOT_LOAD"])
def test_a_training_uses_it_and_its_policy_plays(installed, setting, monkeypatch):
    monkeypatch.chdir(installed)
    command = [
        "train",
        "go2-flat",
        "--backend",
        "fake",
        "--device",
        "cpu",
        "--num-envs",
        "8",
        "--no-score",
        "--no-film",
    ]
    done = CliRunner().invoke(
        app, [*command, "--log-root", "logs", *SMALL, f"environment.observations.policy={setting}"]
    )
    assert done.exit_code == 0, done.output
    policy = load_policy(next(installed.rglob("model_2.pt")), ROBOT)
    assert [t.name for t in policy.contract.observation][-1] == "foot_load"
    assert policy.contract.observation[-1].scale == (0.01,)
    assert policy.session(2).act(torch.zeros(2, 49)).shape == (2, 12)


def test_module_and_name_are_known_in_this_process_alone(module):
    with pytest.raises(ContractError, match="unknown observation term 'foot_load'; choose from: base_linear"):
        with_foot_load()
    made = policy_observations(ObservationConfiguration(policy=("foot_load:FOOT_LOAD",)))
    assert [each.name for each in made] == ["foot_load"] and with_foot_load().frame_width == 49


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (("nothing",), "unknown observation term 'nothing'"),
        (("no_such_module:x",), "is its folder on PYTHONPATH"),
        (("foot_load:foot_load",), "must be a gaitgauge.policy.observation_table.Observation"),
        (("foot_load:FOOT_LOAD", "foot_load"), "name it once"),
        (("joint_position",), "has 'joint_position' already"),
        (("other",), "'other' is no gaitgauge.policy.observation_table.Observation of that name"),
    ],
)
def test_wrong_settings_are_one_sentence(installed, settings, message):
    with pytest.raises(ConfigurationError, match=message):
        policy_observations(ObservationConfiguration(policy=settings))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda state, command, action: state.nothing, "raised AttributeError"),
        (lambda state, command, action: command[:, :2], r"shape \(6, 2\); \(6, 3\) is needed"),
        (lambda state, command, action: sys.exit(3), "raised SystemExit"),
    ],
)
def test_a_function_that_fails_is_one_sentence(module, build, message):
    register(Observation(name="broken", build=build, width=3, unit=""))
    contract = standard_contract(ROBOT)
    contract = replace(contract, observation=(*contract.observation, ObservationTerm(name="broken", scale=(1.0,))))
    with pytest.raises(ObservationError, match=message):
        ObservationBuilder(contract, ROBOT, EPISODES).build(make_state(), *make_inputs())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "two words"}, "no usable name"),
        ({"build": 3}, "a function is needed"),
        ({"width": 0}, "1 to 1000"),
        ({"mirror": (1.0,)}, "1 entries in mirror; its width is 3"),
        ({"mirror_source": (0, 0, 1)}, "every entry once"),
        ({"scale": (1.0, 2.0)}, "2 entries in scale"),
    ],
)
def test_a_malformed_entry_is_one_sentence(changes, message):
    with pytest.raises(ObservationError, match=message):
        replace(OBSERVATIONS["base_angular_velocity_b"], **changes)


def test_nothing_takes_a_name_of_the_project():
    taken = replace(OBSERVATIONS["command"], scale=(1.0,))
    with pytest.raises(ObservationError, match="taken"):
        observation_table.register(taken)
