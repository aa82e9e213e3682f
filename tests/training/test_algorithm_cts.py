from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from gaitgauge.training.algorithms.cts import CTS
from gaitgauge.training.algorithms.optimization import FlatGradients
from gaitgauge.training.algorithms.symmetry import passes
from gaitgauge.training.configuration import ConfigurationError, NetworkConfiguration
from gaitgauge.training.environment.configuration import Ramp
from gaitgauge.training.networks import CtsActor, CtsCritic, Widths, command_entries, student_architecture
from gaitgauge.training.run.runner import TrainingRunner
from rsl_rl.modules.distribution import GaussianDistribution
from toy_training import ACTIONS, FRAME, PRIVILEGED, ToyEnv, toy_configuration, toy_contract, toy_mirror


def build(encoder: str = "moe", steps: int = 8, **algorithm) -> tuple[CTS, ToyEnv]:
    torch.manual_seed(0)
    env = ToyEnv()
    configuration = toy_configuration(encoder=encoder, steps=steps, algorithm=algorithm)
    algorithm = CTS.build(
        env.get_observations(),
        configuration,
        num_actions=env.num_actions,
        command_entries=(6, 7, 8),
        mirror=toy_mirror(),
    )
    return algorithm, env


def rollout(algorithm: CTS, env: ToyEnv) -> None:
    obs = env.get_observations()
    with torch.inference_mode():
        for _ in range(algorithm.storage.num_steps):
            obs, rewards, dones, extras = env.step(algorithm.act(obs))
            algorithm.store_outcome(rewards, dones, extras)
        algorithm.compute_returns(obs)


def has_gradient(module) -> bool:
    return any(p.grad is not None and bool(p.grad.abs().sum() > 0) for p in module.parameters())


def test_published_sizes():
    """Parameter counts measured on the published networks."""

    def count(module):
        return sum(p.numel() for p in module.parameters())

    widths = Widths(environments=8, frame=45, history=5, privileged=263, actions=12, command_entries=(6, 7, 8))
    for encoder, expected in (("mlp", 255_264), ("moe", 1_088_264), ("moe_ng", 1_080_584)):
        network = NetworkConfiguration(student_encoder=encoder)
        architecture, arguments = student_architecture(network, widths)
        actor = CtsActor(network, privileged_width=263, architecture=architecture, arguments=arguments)
        assert count(actor.student.encoder) == expected
        assert count(actor.teacher_encoder) == 274_720
        assert count(actor.student.actor) == 205_708
        assert count(CtsCritic(network, privileged_width=263)) == 315_905


def test_latents_are_unit_vectors_and_experts_can_be_blind():
    algorithm, env = build("moe_ng")
    obs = env.get_observations()
    latent, weights = algorithm.actor.student_latent(obs["history"])
    assert latent.shape == (8, 8) and weights.shape == (8, 4)
    assert torch.allclose(latent.norm(dim=-1), torch.ones(8))
    assert torch.allclose(weights.sum(dim=-1), torch.ones(8))
    assert torch.allclose(algorithm.actor.teacher_latent(obs["privileged"]).norm(dim=-1), torch.ones(8))
    # Another command changes what the gate says, but not what the experts say.
    other = obs["history"].clone().unflatten(1, (5, FRAME))
    other[:, :, 6:9] += 1.0
    encoder = algorithm.actor.student.encoder
    seen = encoder.seen
    assert 6 not in seen and 5 in seen and len(seen) == FRAME - 3
    assert not torch.allclose(algorithm.actor.student_latent(other.flatten(1))[1], weights)


def test_split_and_storage_order():
    algorithm, env = build()
    split = algorithm.storage.split
    assert split.order.tolist() == [1, 2, 3, 5, 6, 7, 0, 4]
    assert (split.num_teacher, split.num_student) == (6, 2)
    obs = env.get_observations()
    frames = obs["policy"].clone()
    with torch.inference_mode():
        actions = algorithm.act(obs)
        assert torch.equal(actions[split.order], algorithm.storage.actions[0])
        _, rewards, dones, extras = env.step(actions)  # overwrites the observation buffers in place
        algorithm.store_outcome(rewards, dones, extras)
    assert torch.equal(algorithm.storage.policy[0], frames[split.order])
    assert torch.equal(algorithm.storage.student_history[0, :, -FRAME:], frames[[0, 4]])
    assert torch.equal(algorithm.storage.dones[0].bool(), dones[split.order])


def test_time_outs_are_bootstrapped():
    algorithm, env = build()
    obs = env.get_observations()
    with torch.inference_mode():
        algorithm.act(obs)
        values = algorithm.storage.values[0].clone()
        time_outs = torch.zeros(8, dtype=torch.bool)
        time_outs[5] = True
        algorithm.store_outcome(torch.zeros(8), time_outs, {"time_outs": time_outs})
    expected = torch.zeros(8)
    expected[3] = 0.99 * values[3]  # environment 5 is block row 3
    assert torch.allclose(algorithm.storage.rewards[0], expected)


def test_minibatches_are_stratified_and_complete():
    algorithm, _ = build()
    storage = algorithm.storage
    teacher, student = storage.minibatch_rows(4)
    assert teacher.shape == (4, 12) and student.shape == (4, 4)
    environment = torch.arange(8).repeat(8)
    assert bool((environment[teacher] < 6).all()) and bool((environment[student] >= 6).all())
    everything = torch.cat((teacher.flatten(), student.flatten())).sort().values
    assert torch.equal(everything, torch.arange(64))
    storage.student_history[..., 0] = torch.arange(16.0).view(8, 2)
    wide = torch.zeros(8, 8)
    wide[:, 6:] = storage.student_history[..., 0]
    rows = storage.student_rows(student)
    assert torch.equal(storage.student_history[..., 0].flatten()[rows], wide.flatten()[student])
    with pytest.raises(ValueError, match="do not fill 100 minibatches"):
        storage.minibatch_rows(100)


@pytest.mark.parametrize("part", ["value", "teacher surrogate", "student surrogate", "latent"])
def test_gradient_flow(part):
    """The teacher encoder learns through the actor on teacher samples only, the student encoder from latents only."""
    algorithm, env = build("moe")
    rollout(algorithm, env)
    storage = algorithm.storage
    split, actor, critic = storage.split, algorithm.actor, algorithm.critic
    if part == "latent":
        loss, _ = algorithm.losses.student(torch.arange(8))
    else:
        algorithm.losses.settings = replace(algorithm.losses.settings, value_coefficient=float(part == "value"))
        algorithm.losses.entropy_coefficient.zero_()
        advantages = storage.advantages
        if part == "value":
            advantages.zero_()
        elif part == "teacher surrogate":
            advantages[:, split.num_teacher :] = 0.0
        else:
            advantages[:, : split.num_teacher] = 0.0
        teacher, student = storage.minibatch_rows(1)
        loss, _ = algorithm.losses.policy(teacher[0], student[0])
    loss.backward()
    expected = {
        #                    teacher encoder, student encoder, actor, critic
        "value": (False, False, False, True),
        "teacher surrogate": (True, False, True, False),
        "student surrogate": (False, False, True, False),
        "latent": (False, True, False, False),
    }[part]
    modules = (actor.teacher_encoder, actor.student.encoder, actor.student.actor, critic)
    assert tuple(has_gradient(m) for m in modules) == expected


def test_optimizers_share_no_parameter_and_miss_none():
    algorithm, _ = build()
    policy = {id(p) for g in algorithm.optimizer.param_groups for p in g["params"]}
    student = {id(p) for g in algorithm.student_optimizer.param_groups for p in g["params"]}
    everything = {id(p) for m in (algorithm.actor, algorithm.critic) for p in m.parameters()}
    assert not policy & student and policy | student == everything


def test_first_minibatch_has_ratio_one_and_matches_a_plain_calculation():
    algorithm, env = build("mlp")
    rollout(algorithm, env)
    storage = algorithm.storage
    teacher, student = (rows[0] for rows in storage.minibatch_rows(2))
    loss, metrics = algorithm.losses.policy(teacher, student)
    value, surrogate, entropy, kl, _ = metrics.tolist()
    advantages = storage.advantages.flatten()
    assert surrogate == pytest.approx(-float(advantages[teacher].mean() + advantages[student].mean()), abs=1e-5)
    assert kl == pytest.approx(0.0, abs=1e-6)
    rows = torch.cat((teacher, student))
    # Values have not moved, so that clipping their step changes nothing.
    errors = (storage.values.flatten() - storage.returns.flatten())[rows]
    assert value == pytest.approx(float(errors.square().mean()), rel=1e-4)
    assert entropy == pytest.approx(ACTIONS * 1.4189385, rel=1e-5)
    assert float(loss.detach()) == pytest.approx(surrogate + value - 0.01 * entropy, rel=1e-5)


def test_entropy_bonus_follows_the_run():
    algorithm, env = build("mlp", entropy_coefficient=Ramp(start=0.01, end=0.002, begin=0.5, until=1.0))
    rollout(algorithm, env)
    teacher, student = (rows[0] for rows in algorithm.storage.minibatch_rows(2))
    for progress, expected in ((0.0, 0.01), (0.75, 0.006), (2.0, 0.002)):
        algorithm.follow(torch.tensor(progress))
        loss, metrics = algorithm.losses.policy(teacher, student)
        value, surrogate, entropy, _, _ = metrics.tolist()
        assert float(loss.detach()) == pytest.approx(surrogate + value - expected * entropy, rel=1e-4)


def test_the_divergence_aimed_at_follows_the_run():
    algorithm, _ = build(desired_kl=Ramp(start=0.01, end=0.002, begin=0.5, until=1.0))
    for progress, factor in ((0.0, 1.0), (0.75, 1.0), (2.0, 1 / 1.5)):  # 0.007 is too far where 0.002 is the aim
        algorithm.follow(torch.tensor(progress))
        algorithm.learning_rate = 1e-3
        algorithm._adapt_learning_rate(torch.tensor(0.007))
        assert algorithm.learning_rate == pytest.approx(factor * 1e-3)


def test_load_balance_is_a_sum_over_the_experts():
    algorithm, env = build("moe")
    rollout(algorithm, env)
    algorithm.update()
    rows = torch.arange(8)
    loss, metrics = algorithm.losses.student(rows)
    assert float(loss.detach()) == pytest.approx(float(metrics[0]) + 0.01 * float(metrics[1]), rel=1e-5)
    history = algorithm.storage.student_history.flatten(0, 1)[rows]
    weights = algorithm.actor.student_latent(history)[1].detach().mean(dim=0)
    assert float(metrics[1]) == pytest.approx(float((weights - 0.25).square().sum()), rel=1e-4)


def test_learning_rate_follows_the_divergence():
    algorithm, _ = build()
    for kl, expected in ((0.03, 1e-3 / 1.5), (0.01, 1e-3), (0.001, 1.5e-3), (0.0, 1e-3), (float("nan"), 1e-3)):
        algorithm.learning_rate = 1e-3
        algorithm._adapt_learning_rate(torch.tensor(kl))
        assert algorithm.learning_rate == pytest.approx(expected)
    for kl, bound in ((1.0, 1e-5), (1e-4, 1e-2)):
        algorithm.learning_rate = bound
        algorithm._adapt_learning_rate(torch.tensor(kl))
        assert algorithm.learning_rate == pytest.approx(bound)
    assert algorithm.optimizer.param_groups[0]["lr"] is algorithm._rate


def test_gradient_clip_and_non_finite_gradients():
    algorithm, _ = build()
    parameters = algorithm.actor.student_parameters()
    for p in parameters:
        p.grad = torch.full_like(p, 3.0)
    gradients = FlatGradients(parameters, extra=2)
    gradients.extra.fill_(5.0)
    gradients.gather()
    norm, skipped = gradients.clip(1.0)
    assert gradients.extra.tolist() == [5.0, 5.0]
    assert (
        float(norm) == pytest.approx(3.0 * sum(p.numel() for p in parameters) ** 0.5, rel=1e-5)
        and float(skipped) == 0.0
    )
    assert torch.nn.utils.get_total_norm([p.grad for p in parameters]) == pytest.approx(1.0, rel=1e-3)
    parameters[0].grad[0] = float("inf")
    _, skipped = gradients.clip(1.0)
    assert float(skipped) == 1.0 and all(bool((p.grad == 0).all()) for p in parameters)


def test_non_finite_minibatches_are_counted_and_leave_the_weights_finite():
    algorithm, env = build("moe")
    rollout(algorithm, env)
    algorithm.storage.advantages[0, 0] = float("nan")
    losses = algorithm.update()
    assert losses["skipped_minibatches"] == 2  # one sample, in one minibatch of each of two passes
    assert all(torch.isfinite(p).all() for p in algorithm.actor.parameters())
    assert all(v == v for v in losses.values())


def test_actions_and_values_are_float32_in_any_precision():
    algorithm, env = build("mlp", precision="bfloat16")
    groups = env.get_observations()
    with algorithm.losses.autocast():
        latent = algorithm.actor.teacher_latent(groups["privileged"])
        mean, value = (
            algorithm.actor.action_mean(latent, groups["policy"]),
            algorithm.critic.value(latent, groups["privileged"]),
        )
    assert mean.dtype == value.dtype == torch.float32
    assert not torch.equal(mean, mean.bfloat16().float())


def test_two_alternate_passes_see_what_an_augmented_one_sees():
    algorithm, env = build("mlp", symmetry="augment")
    rollout(algorithm, env)
    storage, mirror = algorithm.storage, algorithm.losses.mirror
    history = storage.student_history.flatten(0, 1)
    with torch.no_grad():
        algorithm.losses.mirrored_latent.copy_(algorithm.actor.student_latent(mirror.history(history))[0])
        algorithm.losses.targets.normal_()
        algorithm.losses.mirrored_targets.normal_()
    teacher, student = (rows[0] for rows in storage.minibatch_rows(2))
    in_history = storage.student_rows(student)
    whole = algorithm.losses.policy(teacher, student)[1][:2]
    error = algorithm.losses.student(in_history)[0]
    algorithm.losses.settings = replace(algorithm.losses.settings, symmetry="alternate")
    halves, errors = [], []
    for turned in passes(2, alternate=True):
        value, surrogate, _, kl, _ = algorithm.losses.policy(turned(teacher), turned(student))[1]
        halves.append(torch.stack((value, surrogate)))
        errors.append(algorithm.losses.student(turned(in_history))[0])
        assert float(kl) == pytest.approx(0.0, abs=1e-6)
    assert not torch.allclose(halves[0], halves[1])
    torch.testing.assert_close((halves[0] + halves[1]) / 2, whole)
    torch.testing.assert_close((errors[0] + errors[1]) / 2, error)


@pytest.mark.parametrize("symmetry", ["none", "augment", "alternate"])
@pytest.mark.parametrize("encoder", ["mlp", "moe", "moe_ng"])
def test_update_runs_and_reports(encoder, symmetry):
    algorithm, env = build(encoder, symmetry=symmetry)
    before = [p.detach().clone() for p in (*algorithm.actor.parameters(), *algorithm.critic.parameters())]
    rollout(algorithm, env)
    losses = algorithm.update()
    after = (*algorithm.actor.parameters(), *algorithm.critic.parameters())
    assert all(not torch.equal(a, b) for a, b in zip(before, after, strict=True))
    assert ("load_balance" in losses) == (encoder != "mlp") and ("symmetry" in losses) == (symmetry == "augment")
    assert losses["skipped_minibatches"] == 0 and algorithm.storage.step == 0


def test_augmentation_of_a_symmetric_policy_changes_nothing():
    """With a policy and critic that act alike in mirrored states, mirrored samples repeat the originals' losses."""
    algorithm, env = build("mlp", symmetry="augment")
    for module in (algorithm.actor.student.actor, algorithm.critic.mlp):
        torch.nn.init.zeros_(module[-1].weight)
        torch.nn.init.zeros_(module[-1].bias)
    rollout(algorithm, env)
    teacher, student = (rows[0] for rows in algorithm.storage.minibatch_rows(2))
    both = algorithm.losses.policy(teacher, student)[1]
    algorithm.losses.mirror, algorithm.losses.settings = None, replace(algorithm.configuration, symmetry="none")
    plain = algorithm.losses.policy(teacher, student)[1]
    assert torch.allclose(both, plain, atol=1e-6)


@pytest.mark.parametrize(
    "encoder", [pytest.param("mlp", marks=pytest.mark.slow), "moe", pytest.param("moe_ng", marks=pytest.mark.slow)]
)
def test_learns_the_toy_task(encoder):
    torch.manual_seed(0)
    seen = []
    configuration = toy_configuration(
        encoder=encoder, steps=16, algorithm={"epochs": 4, "minibatches": 2, "entropy_coefficient": 0.0}
    )
    configuration = replace(configuration, network=replace(configuration.network, initial_std=0.5))
    runner = TrainingRunner(
        ToyEnv(64), configuration, contract=toy_contract(), task="toy", progress=lambda p: seen.append(p.scalars)
    )
    test_env = ToyEnv(256, seed=5)

    def student_error() -> float:
        with torch.no_grad():
            seen = test_env.get_observations()
            actions = runner.alg.actor.student(seen["history"].unflatten(1, (5, FRAME)))
        return float((actions[:, :3] - test_env.command).square().mean())

    before = student_error()
    runner.learn(16)
    assert student_error() < 0.5 * before
    latent = [s["Loss/latent"] for s in seen]
    assert latent[-1] < 0.5 * latent[0]
    assert seen[-1]["Metrics/reward"] > seen[0]["Metrics/reward"] + 0.15


def test_bfloat16_learns_and_keeps_float32_weights():
    algorithm, env = build("moe", precision="bfloat16")
    rollout(algorithm, env)
    losses = algorithm.update()
    assert losses["skipped_minibatches"] == 0
    assert all(p.dtype == torch.float32 for p in algorithm.actor.parameters())
    assert algorithm.storage.student_latent.dtype == torch.float32


def test_saved_state_restores_both_optimizers():
    algorithm, env = build()
    rollout(algorithm, env)
    algorithm.update()
    algorithm.learning_rate = 3e-4
    state = algorithm.save()
    other, _ = build()
    other.load(state)
    assert other.learning_rate == pytest.approx(3e-4)
    assert other.optimizer.param_groups[0]["lr"] is other._rate
    for a, b in ((algorithm.optimizer, other.optimizer), (algorithm.student_optimizer, other.student_optimizer)):
        for p, q in zip(a.state.values(), b.state.values(), strict=True):
            assert torch.equal(p["exp_avg"], q["exp_avg"]) and torch.equal(p["step"], q["step"])


def test_own_gaussian_is_rsl_rls():
    algorithm, _ = build()
    assert isinstance(algorithm.actor.distribution, GaussianDistribution)
    assert torch.equal(algorithm.actor.output_std, torch.ones(ACTIONS))


def test_bad_settings_are_refused():
    with pytest.raises(ConfigurationError, match="allowed are mlp, moe, moe_ng"):
        NetworkConfiguration(student_encoder="lstm")
    with pytest.raises(ConfigurationError, match="needs a CUDA device"):
        build(cuda_graphs=True)
    seen, configuration = ToyEnv().get_observations(), toy_configuration(algorithm={"symmetry": "augment"})
    with pytest.raises(ConfigurationError, match="no mirror maps"):
        CTS.build(seen, configuration, num_actions=ACTIONS)
    with pytest.raises(ConfigurationError, match="'history'"):
        CTS.build(seen.exclude("history"), configuration, num_actions=ACTIONS)


def test_command_entries_and_widths():
    assert command_entries(toy_contract()) == (6, 7, 8)
    assert toy_contract().frame_width == FRAME
    assert all(b > a for a, b in pairwise(command_entries(toy_contract())))
    assert PRIVILEGED == 3 + FRAME + 4 + 12 + 12 + 187
