"""Policies of every kind that people have: made here, with random weights, after files and reports of the field.

Each is loaded with what lies beside it, and its actions are those of its own network on observations made by hand.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from foreign_play import (
    EPISODES,
    GO2,
    UNIT,
    Step,
    TwoArguments,
    check,
    described,
    frame_major,
    layers_of,
    network,
    newest,
    save_onnx,
    script,
    simply,
    standard,
    tensors,
    term_major,
)
from gaitgauge.policy.base import PolicyError
from gaitgauge.policy.importing import import_policy
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.observation import ObservationBuilder
from onnx import TensorProto, helper, numpy_helper
from torch import nn

pytestmark = pytest.mark.usefixtures("programs_run_here")


def test_a_number_stands_for_all_joints_and_entries(tmp_path):
    module = network(45)
    described(tmp_path, "stiffness = 40\ndamping = 1\naction_scale = 0.25\ntarget_range = [-3, 3]\n" + UNIT)
    policy = load_policy(script(tmp_path / "policy.pt", module))
    assert policy.contract.stiffness == (40.0,) * 12
    assert policy.contract.target_range == ((-3.0, 3.0),) * 12
    check(policy, standard, newest, simply(module))


def test_a_history_by_term_newest_first(tmp_path):
    module = network(225)
    described(tmp_path, 'history = { length = 5, order = "term-major-newest-first" }\n' + UNIT)
    policy = load_policy(script(tmp_path / "policy.pt", module))
    check(policy, standard, lambda f: term_major(f, 5, newest_first=True), simply(module))


def test_a_history_without_the_command(tmp_path):
    module = network(3 + 5 * 42)
    others = '"base_angular_velocity_b", "projected_gravity_b", "joint_position", "joint_velocity", "last_action"'
    described(
        tmp_path, f'layout = [{{ terms = ["command"], length = 1 }}, {{ terms = [{others}], length = 5 }}]\n' + UNIT
    )
    policy = load_policy(script(tmp_path / "policy.pt", module))

    def stack(frames: list) -> np.ndarray:
        without = [[t for i, t in enumerate(frame) if i != 2] for frame in frames]
        return np.concatenate((frames[-1][2], frame_major(without, 5)), axis=1)

    check(policy, standard, stack, simply(module))


def test_further_commands_stand_at_a_value(tmp_path):
    module = network(46)
    text = UNIT.replace('"command" }', '"command", scale = [2.0, 2.0, 0.25, 1.0], values = [0.3] }')
    described(tmp_path, text)
    policy = load_policy(script(tmp_path / "policy.pt", module))

    def frame(step: Step, last: np.ndarray, age: int) -> list[np.ndarray]:
        terms = standard(step, last, age)
        height = np.full((EPISODES, 1), 0.3)
        return [*terms[:2], np.concatenate((step.command * [2.0, 2.0, 0.25], height), axis=1), *terms[3:]]

    check(policy, frame, newest, simply(module))
    described(tmp_path, text.replace(", values = [0.3]", ""))
    assumed = load_policy(tmp_path / "policy.pt").contract.provenance["assumed"]
    assert assumed == "the last of 4 commands stays at 0 (values of the term command)"


@pytest.mark.parametrize("at_rest", ["runs", "holds", "zeros"])
def test_gait_clocks_and_constants(tmp_path, at_rest):
    module = network(45 + 4 + 2)
    phase = (
        f'{{ name = "gait_phase", period = 0.5, offsets = [0.0, 0.5], waves = ["cos", "sin"], at_rest = "{at_rest}" }}'
    )
    described(tmp_path, UNIT.replace("]\n", f'{phase}, {{ name = "constant", values = [0.7, -1] }},\n]\n'))
    policy = load_policy(script(tmp_path / "policy.pt", module))
    moved = np.zeros(EPISODES)

    def frame(step: Step, last: np.ndarray, age: int) -> list[np.ndarray]:
        resting = np.linalg.norm(step.command, axis=1) < 0.1
        if age == 0:
            moved[:] = 0.0
        cycles = (moved if at_rest == "holds" else np.full(EPISODES, float(age))) * 0.02 / 0.5
        angles = 2 * np.pi * (cycles[:, None] + [0.0, 0.5])
        waves = np.concatenate((np.cos(angles), np.sin(angles)), axis=1)
        moved[:] += ~resting
        waves = np.where(resting[:, None], 0.0, waves) if at_rest == "zeros" else waves
        return [*standard(step, last, age), waves, np.tile([0.7, -1.0], (EPISODES, 1))]

    check(policy, frame, newest, simply(module))


def test_a_reference_and_an_action_offset_of_its_own(tmp_path):
    module = network(45)
    text = UNIT.replace('"joint_position" }', '"joint_position", reference = 0.0 }')
    described(tmp_path, f"action_offset = {[0.05 * i for i in range(12)]}\naction_scale = 0.5\n{text}")
    policy = load_policy(script(tmp_path / "policy.pt", module))
    check(policy, lambda s, a, n: [*standard(s, a, n)[:3], s.joints, s.speeds, a], newest, simply(module))
    targets = ObservationBuilder(policy.contract, GO2, 1).targets(torch.ones(1, 12))
    np.testing.assert_allclose(targets[0], [0.05 * i + 0.5 for i in range(12)], atol=1e-6)


def test_the_last_action_is_shown_clipped(tmp_path):
    """legged_gym, rl_games and rsl_rl clip before they store it."""
    module = network(45)
    module[-1].weight.mul_(20.0)
    described(tmp_path, "action_clip = 0.8\n" + UNIT)
    policy = load_policy(script(tmp_path / "policy.pt", module))
    check(policy, standard, newest, simply(module), clip=0.8)


def test_the_action_before_the_last_one(tmp_path):
    """walk-these-ways shows two actions."""
    module, seen = network(57), np.zeros((EPISODES, 12))
    described(tmp_path, "action_clip = 0.05\n" + UNIT.replace("]\n", '{ name = "action_before_last" },\n]\n'))
    policy = load_policy(script(tmp_path / "policy.pt", module))

    def frame(step: Step, last: np.ndarray, age: int) -> list[np.ndarray]:
        before = seen.copy() if age else np.zeros_like(seen)
        seen[:] = last
        return [*standard(step, last, age), before]

    check(policy, frame, newest, simply(module), clip=0.05)


# ---- several inputs, several files, a memory -------------------------------------------------------------------------


TWO_INPUTS = 'layout = [{{ input = "{}", length = 1 }}, {{ input = "{}", length = 5, order = "term-major" }}]\n'


def test_a_script_of_two_arguments(tmp_path):
    module = TwoArguments()
    path = script(tmp_path / "policy.pt", module)
    with pytest.raises(PolicyError, match=r"takes 2 inputs \(obs, hist\); give a contract.toml .*input = \"hist\""):
        load_policy(path)
    described(tmp_path, TWO_INPUTS.format("obs", "history") + UNIT)
    with pytest.raises(
        PolicyError, match=r"takes 2 inputs \(obs, hist\); its contract's layout has 2 \(obs, history\)"
    ):
        load_policy(path)
    described(tmp_path, TWO_INPUTS.format("obs", "hist") + UNIT)
    both = lambda x, first: module(x[:, :45], x[:, 45:])  # noqa: E731
    check(load_policy(path), standard, lambda f: np.concatenate((newest(f), term_major(f, 5)), axis=1), both)


def test_an_onnx_file_of_two_inputs(tmp_path):
    module = TwoArguments()
    nodes = [
        *layers_of("e", "obs_history", "latent"),
        helper.make_node("Concat", ["obs", "latent"], ["joined"], axis=1),
        *layers_of("a", "joined", "actions"),
    ]
    weights = [*tensors(module.encoder, "e"), *tensors(module.actor, "a")]
    inputs = {"obs": [1, 45], "obs_history": [1, 225]}
    path = save_onnx(tmp_path / "policy.onnx", nodes, inputs, {"actions": [1, 12]}, weights)
    with pytest.raises(PolicyError, match=r"takes 2 inputs \(obs of 45, obs_history of 225\); give a contract.toml"):
        load_policy(path)
    described(tmp_path, TWO_INPUTS.format("obs", "obs_history") + UNIT)
    policy = load_policy(path)
    assert not policy.row_by_row
    both = lambda x, first: module(x[:, :45], x[:, 45:])  # noqa: E731
    check(policy, standard, lambda f: np.concatenate((newest(f), term_major(f, 5)), axis=1), both)
    described(tmp_path, TWO_INPUTS.format("obs_history", "obs") + UNIT)
    with pytest.raises(PolicyError, match="takes 225 values as its input obs_history; its contract's layout gives 45"):
        load_policy(path)


def test_two_files_one_behind_the_other(tmp_path):
    """walk-these-ways: the body takes the history and what the adaptation module makes of it."""
    adaptation, body = network(225, 2), network(227)
    script(tmp_path / "adaptation_module.pt", adaptation)
    path = script(tmp_path / "body.pt", body)
    described(tmp_path, 'history = { length = 5 }\nencoder = { file = "adaptation_module.pt" }\n' + UNIT)
    run = lambda x, first: body(torch.cat((x, adaptation(x)), dim=1))  # noqa: E731
    check(load_policy(path), standard, lambda f: frame_major(f, 5), run)
    import_policy(path, tmp_path / "own.gauge.pt")
    (tmp_path / "adaptation_module.pt").unlink()
    check(load_policy(tmp_path / "own.gauge.pt", trust=True), standard, lambda f: frame_major(f, 5), run)
    with pytest.raises(PolicyError, match="lacks its encoder: there is no file 'adaptation_module\\.pt' beside it"):
        load_policy(path)


def test_an_encoder_of_the_history_before_the_present_frame(tmp_path):
    encoder, actor = network(225, 8), network(53)
    script(tmp_path / "encoder.pt", encoder)
    layout = 'layout = [{ input = "past", length = 5 }, { input = "now", length = 1 }]\n'
    described(tmp_path, f'{layout}encoder = {{ file = "encoder.pt", input = "past", latent = "first" }}\n' + UNIT)
    policy = load_policy(script(tmp_path / "policy.pt", actor))
    run = lambda x, first: actor(torch.cat((encoder(x[:, :225]), x[:, 225:]), dim=1))  # noqa: E731
    check(policy, standard, lambda f: np.concatenate((frame_major(f, 5), newest(f)), axis=1), run)


def test_an_onnx_file_that_hands_its_state_back(tmp_path):
    """The state of each robot begins with zeros, is carried on, and is reset with its episode."""
    torch.manual_seed(3)
    lstm, actor = nn.LSTM(45, 8).requires_grad_(False), network(8)
    gates = [0, 3, 1, 2]  # torch's order of gates to that of ONNX

    def ordered(value: torch.Tensor) -> np.ndarray:
        return torch.cat([value.chunk(4)[g] for g in gates]).numpy()

    bias = np.concatenate((ordered(lstm.bias_ih_l0), ordered(lstm.bias_hh_l0)))
    weights = [
        numpy_helper.from_array(ordered(lstm.weight_ih_l0)[None], "W"),
        numpy_helper.from_array(ordered(lstm.weight_hh_l0)[None], "R"),
        numpy_helper.from_array(bias[None], "B"),
        numpy_helper.from_array(np.array([0], np.int64), "axis"),
        *tensors(actor, "a"),
    ]
    nodes = [
        helper.make_node("Unsqueeze", ["obs", "axis"], ["sequence"]),
        helper.make_node(
            "LSTM", ["sequence", "W", "R", "B", "", "h_in", "c_in"], ["", "h_out", "c_out"], hidden_size=8
        ),
        helper.make_node("Squeeze", ["h_out", "axis"], ["memory"]),
        *layers_of("a", "memory", "actions"),
    ]
    inputs, states = {"obs": [1, 45]}, {"h_in": [1, 1, 8], "c_in": [1, 1, 8]}
    outputs = {"actions": [1, 12], "h_out": [1, 1, 8], "c_out": [1, 1, 8]}
    path = save_onnx(tmp_path / "policy.onnx", nodes, inputs | states, outputs, weights)
    described(tmp_path, UNIT)
    policy, memory = load_policy(path), [None]

    def run(x: torch.Tensor, first: bool) -> torch.Tensor:
        out, memory[0] = lstm(x[None], None if first else memory[0])
        return actor(out[0])

    check(policy, standard, newest, run)
    described(tmp_path, 'memory = [["h_in", "h_next"]]\n' + UNIT)
    with pytest.raises(
        PolicyError, match="has no 'h_next' that its contract's memory names; inputs are obs, h_in, c_in"
    ):
        load_policy(path)


# ---- types and shapes ------------------------------------------------------------------------------------------------


def test_an_onnx_file_without_a_batch_axis(tmp_path):
    module = network(45)
    path = tmp_path / "policy.onnx"
    save_onnx(path, layers_of("a", "obs", "action"), {"obs": [45]}, {"action": [12]}, tensors(module, "a"))
    described(tmp_path, UNIT)
    check(load_policy(path), standard, newest, simply(module))


def test_half_precision(tmp_path):
    module = network(45)
    described(tmp_path, UNIT)
    path, half = tmp_path / "policy.onnx", TensorProto.FLOAT16
    save_onnx(
        path, layers_of("a", "o", "action"), {"o": [1, 45]}, {"action": [1, 12]}, tensors(module, "a", np.float16), half
    )
    check(load_policy(path), standard, newest, simply(module), tolerance=0.02)
    check(
        load_policy(script(tmp_path / "policy.pt", network(45).half())),
        standard,
        newest,
        simply(module),
        tolerance=0.02,
    )


# ---- sentences -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            'layout = [{ terms = ["joint_torque"] }]',
            "layout has the term 'joint_torque'; the observation has base_angular",
        ),
        (
            'encoder = { file = "e.pt", input = "past" }',
            "encoder.input is 'past'; the inputs that layout names are: none",
        ),
        (
            'observation = [{ name = "gait_phase" }]',
            "observation.gait_phase has no period; give the time of a gait cycle",
        ),
        (
            'observation = [{ name = "command", period = 1.0 }]',
            "observation.command has a period; only gait_phase does",
        ),
        ('observation = [{ name = "constant" }]', "observation.constant has no values; give a list of numbers"),
        (
            'observation = [{ name = "last_action", values = [1.0] }]',
            "last_action has values; only constant and command do",
        ),
        (
            'observation = [{ name = "joint_posision" }]',
            "unknown observation term 'joint_posision'; did you mean 'joint_position'",
        ),
        ('joint_names = ["FL_hip"]', "robot 'go2' has no joint 'FL_hip'; did you mean 'FL_hip_joint'"),
        ('robot = "go3"', "is not installed (there are anymal_c, g1, go1, go2, go2w); did you mean 'go2'"),
        ('action_scale = "big"', "action_scale is 'big'; it must be a number, or a list with one per joint"),
        ("history = { length = 5 }", "takes 45 values, but its contract's observation has 225"),
    ],
)
def test_a_wrong_description_is_one_sentence(tmp_path, text, sentence):
    described(tmp_path, text)
    with pytest.raises(PolicyError) as caught:
        load_policy(script(tmp_path / "policy.pt", network(45)))
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_width_that_a_script_needs_is_said(tmp_path):
    described(tmp_path, UNIT)
    with pytest.raises(
        PolicyError, match=r"takes 48 values, but its contract's observation has 45 \(base_angular_velocity_b 3, "
    ):
        load_policy(script(tmp_path / "policy.pt", network(48)))
    (tmp_path / "contract.toml").unlink()
    with pytest.raises(PolicyError, match=r"takes 48 values, .* preset of the code that trained it: .*legged_gym"):
        load_policy(tmp_path / "policy.pt")
