"""The paper's baselines and ablations: AC-MoE, MCP, HIM and DreamWaQ on a tiny problem."""

from dataclasses import replace

import pytest
import torch
from gaitgauge.policy.loading import load_policy
from gaitgauge.training.algorithms.him import sinkhorn, swapped_prediction
from gaitgauge.training.algorithms.methods import find_method
from gaitgauge.training.algorithms.ppo import PPO
from gaitgauge.training.configuration import METHODS, ConfigurationError, HimConfiguration, TrainingConfiguration
from gaitgauge.training.run.checkpoint import checkpoint_entries, read_checkpoint, trim_checkpoint, write_checkpoint
from gaitgauge.training.run.resuming import begin_with, resume_run, stored_network
from gaitgauge.training.run.runner import TrainingRunner
from gaitgauge.training.run.seeding import seed_everything
from toy_training import ACTIONS, FRAME, ToyEnv, toy_configuration, toy_contract, toy_mirror

NEW = ("ac_moe", "mcp", "him", "dreamwaq")
FEW = [m if m in ("ac_moe", "him") else pytest.param(m, marks=pytest.mark.slow) for m in NEW]
"""One of each kind; the others' whole runs are slow tests."""
ESTIMATORS = ("him", "dreamwaq")


class MovingEnv(ToyEnv):
    """The toy, whose robots move as they are told: there is a velocity to estimate."""

    def _observe(self, actions: torch.Tensor) -> None:
        super()._observe(actions)
        self.privileged[:, :3] = 0.5 * self.command


def settings(method: str, *, encoder: str = "mlp", steps: int = 8, **algorithm) -> TrainingConfiguration:
    return toy_configuration(encoder=encoder, steps=steps, algorithm={"method": method} | algorithm)


def build(method: str, **algorithm) -> tuple[PPO, ToyEnv]:
    torch.manual_seed(0)
    env = MovingEnv()
    return find_method(method).build(
        env.get_observations(),
        settings(method, **algorithm),
        num_actions=ACTIONS,
        command_entries=(6, 7, 8),
        mirror=toy_mirror(),
    ), env


def rollout(algorithm: PPO, env: ToyEnv) -> None:
    obs = env.get_observations()
    with torch.inference_mode():
        for _ in range(algorithm.storage.num_steps):
            obs, rewards, dones, extras = env.step(algorithm.act(obs))
            algorithm.store_outcome(rewards, dones, extras)
        algorithm.compute_returns(obs)


def runner(method: str, folder=None, *, seed: int = 0, environments: int = 8, **arguments) -> TrainingRunner:
    seed_everything(seed)
    configuration = arguments.pop("configuration", None) or settings(method)
    return TrainingRunner(
        MovingEnv(environments, seed=seed),
        configuration,
        contract=toy_contract(),
        task="toy",
        log_dir=folder,
        **arguments,
    )


def has_gradient(module) -> bool:
    parameters = module.parameters() if hasattr(module, "parameters") else [module]
    return any(p.grad is not None and bool(p.grad.abs().sum() > 0) for p in parameters)


def test_every_method_has_a_name_and_an_algorithm():
    assert all(issubclass(find_method(name), PPO) for name in METHODS) and len({*map(find_method, METHODS)}) == 5


@pytest.mark.parametrize(
    ("method", "loss", "reached"),
    [
        ("ac_moe", "surrogate", {"teacher_encoder", "actor", "std"}),
        ("ac_moe", "value", {"teacher_encoder", "gate", "critic"}),
        ("ac_moe", "balance", {"teacher_encoder", "gate"}),
        ("ac_moe", "student", {"encoder"}),
        ("mcp", "surrogate", {"teacher_encoder", "actor"}),
        ("mcp", "value", {"critic"}),
        ("mcp", "student", {"encoder"}),
        ("him", "surrogate", {"actor", "std"}),
        ("him", "value", {"critic"}),
        ("him", "student", {"encoder", "target_encoder", "prototypes"}),
        ("dreamwaq", "surrogate", {"actor", "std"}),
        ("dreamwaq", "value", {"critic"}),
        ("dreamwaq", "student", {"encoder", "decoder"}),
    ],
)
def test_gradients_reach_what_they_should_and_nothing_else(method, loss, reached):
    algorithm, env = build(method, load_balance_coefficient=float(loss == "balance"))
    rollout(algorithm, env)
    actor, losses = algorithm.actor, algorithm.losses
    losses.settings = replace(losses.settings, value_coefficient=float(loss == "value"))
    losses.entropy_coefficient.zero_()
    if loss in ("value", "balance"):
        algorithm.storage.advantages.zero_()
    if loss == "student":
        losses.prepare_student()
        losses.student(torch.arange(16))[0].backward()
    else:
        losses.policy(*(rows[0] for rows in algorithm.storage.minibatch_rows(1)))[0].backward()
    parts = {
        "encoder": actor.student.encoder,
        "actor": actor.student.actor if method in ESTIMATORS else actor.student.actor.trunk,
        "critic": algorithm.critic,
    }
    for name in ("teacher_encoder", "target_encoder", "prototypes", "decoder"):
        if hasattr(actor, name):
            parts[name] = getattr(actor, name)
    if method != "mcp":
        parts["std"] = actor.distribution
    found = {name for name, part in parts.items() if has_gradient(part)}
    if hasattr(actor.student.actor, "gate"):
        assert has_gradient(actor.student.actor.gate) == bool(reached & {"gate", "actor"})
    assert found == reached - {"gate"}


@pytest.mark.parametrize("method", NEW)
def test_optimizers_share_no_parameter_and_miss_none(method):
    algorithm, _ = build(method)
    policy = {id(p) for g in algorithm.optimizer.param_groups for p in g["params"]}
    student = {id(p) for g in algorithm.student_optimizer.param_groups for p in g["params"]}
    assert not policy & student
    assert policy | student == {id(p) for m in (algorithm.actor, algorithm.critic) for p in m.parameters()}


@pytest.mark.parametrize("symmetry", ["none", "augment", "alternate"])
@pytest.mark.parametrize("method", NEW)
def test_the_policy_has_not_moved_before_it_learns_and_all_of_it_learns(method, symmetry):
    algorithm, env = build(method, symmetry=symmetry)
    before = [p.detach().clone() for p in (*algorithm.actor.parameters(), *algorithm.critic.parameters())]
    rollout(algorithm, env)
    algorithm.losses.prepare_policy()
    groups = [rows[0] for rows in algorithm.storage.minibatch_rows(2)]
    _, metrics = algorithm.losses.policy(*groups)
    surrogate, kl = metrics[1].item(), metrics[3].item()
    assert kl == pytest.approx(0.0, abs=1e-5)
    if symmetry == "none":  # a ratio of one
        advantages = algorithm.storage.advantages.flatten()
        assert surrogate == pytest.approx(-sum(advantages[rows].mean().item() for rows in groups), abs=1e-4)
    losses = algorithm.update()
    after = (*algorithm.actor.parameters(), *algorithm.critic.parameters())
    assert all(not torch.equal(a, b) for a, b in zip(before, after, strict=True))
    assert losses["skipped_minibatches"] == 0 and all(v == v for v in losses.values())
    assert ("load_balance" in losses) == (method == "ac_moe") and algorithm.action_std.shape == (ACTIONS,)


FALLS = {"ac_moe": ("latent",), "mcp": ("latent",), "him": ("velocity", "contrast")}
FALLS["dreamwaq"] = ("velocity", "reconstruction")


@pytest.mark.parametrize("method", [m if m == "him" else pytest.param(m, marks=pytest.mark.slow) for m in NEW])
def test_losses_fall_and_the_toy_is_learned(method):
    seen = []
    configuration = settings(method, steps=16, epochs=4, entropy_coefficient=0.0)
    configuration = replace(configuration, network=replace(configuration.network, initial_std=0.5))
    made = runner(method, environments=32, configuration=configuration, progress=lambda p: seen.append(p.scalars))
    test_env = MovingEnv(256, seed=5)

    def error() -> float:
        with torch.no_grad():
            groups = test_env.get_observations()
            actions = made.alg.actor.student(groups["history"].unflatten(1, (5, FRAME)))
        return float((actions[:, :3] - test_env.command).square().mean())

    before = error()
    made.learn(9)
    # the noise of MCP is a product that the others have as a number: it settles later
    assert error() < (0.95 if method == "mcp" else 0.7) * before
    assert seen[-1]["Metrics/reward"] > seen[0]["Metrics/reward"] + 0.1
    for name in FALLS[method]:
        assert seen[-1][f"Loss/{name}"] < 0.8 * seen[0][f"Loss/{name}"], name
    assert ("Train/mean_reward_teacher" in seen[-1]) == (method not in ESTIMATORS)


@pytest.mark.parametrize("method", FEW)
def test_a_run_is_resumed_exactly_and_its_checkpoint_is_a_policy(method, tmp_path):
    whole = runner(method)
    whole.learn(3)
    runner(method, tmp_path).learn(2)
    resumed = runner(method, seed=7)
    resume_run(resumed, tmp_path / "model_2.pt")
    resumed.learn(1)
    for part in ("actor", "critic"):
        for ours, theirs in zip(
            getattr(resumed.alg, part).state_dict().values(),
            getattr(whole.alg, part).state_dict().values(),
            strict=True,
        ):
            assert torch.equal(ours, theirs), part
    entries = read_checkpoint(tmp_path / "model_2.pt")
    policy = load_policy(tmp_path / "model_2.pt")
    observation = MovingEnv(8, seed=3).get_observations()["policy"]
    history = torch.zeros(8, 5, FRAME)
    history[:, -1] = observation
    student = resumed.alg.actor.student
    student.load_state_dict(entries["state_dict"])
    with torch.no_grad():
        torch.testing.assert_close(policy.session(8).act(observation), student(history), rtol=0, atol=1e-5)


def bare_policy(method, path, *, bootstrap_iterations):
    """Write an untrained policy alone; settings of a run that begins with it, and its network."""
    run = replace(settings(method).run, bootstrap_iterations=bootstrap_iterations, nonfinite_limit=0.5)
    configuration = replace(settings(method), run=run)
    network = stored_network(runner(method, configuration=configuration))
    write_checkpoint(path, checkpoint_entries(toy_contract(), network, {}))
    return configuration, network


@pytest.mark.parametrize("method", NEW)
def test_beginning_with_a_bare_policy(method, tmp_path):
    """It stands still until what it lacks is learned for it."""
    configuration, network = bare_policy(method, tmp_path / "policy.pt", bootstrap_iterations=2)
    begun = runner(method, seed=5, configuration=configuration)
    begin_with(begun, tmp_path / "policy.pt")
    for _ in range(2):
        assert begun.alg.bootstrap is not None
        begun.learn(1)
        for name, value in network.state_dict.items():
            assert torch.equal(stored_network(begun).state_dict[name], value), name
        assert "Loss/value" in begun.logger.scalars
    assert begun.alg.bootstrap is None
    begun.learn(1)
    assert "Loss/surrogate" in begun.logger.scalars


@pytest.mark.parametrize(
    "method", ["cts", "him", *(pytest.param(m, marks=pytest.mark.slow) for m in NEW if m != "him")]
)
def test_a_bare_policy_still_stands_still_in_a_resumed_run(method, tmp_path):
    """Its critic and teacher were untrained, and full updates began at once."""
    configuration, network = bare_policy(method, tmp_path / "policy.pt", bootstrap_iterations=3)
    whole = runner(method, seed=5, configuration=configuration)
    begin_with(whole, tmp_path / "policy.pt")
    whole.learn(4)
    begun = runner(method, tmp_path, seed=5, configuration=configuration)
    begin_with(begun, tmp_path / "policy.pt")
    begun.learn(2)
    resumed = runner(method, tmp_path, seed=7, configuration=configuration)
    resume_run(resumed, tmp_path / "model_2.pt")
    resumed.learn(1)
    for name, value in network.state_dict.items():
        assert torch.equal(stored_network(resumed).state_dict[name], value), name
    assert resumed.alg.bootstrap is None and "bootstrap" not in read_checkpoint(tmp_path / "model_3.pt")
    resumed.learn(1)
    for part in ("actor", "critic"):
        for name, value in getattr(whole.alg, part).state_dict().items():
            assert torch.equal(getattr(resumed.alg, part).state_dict()[name], value), name


@pytest.mark.parametrize(
    ("method", "trimmed"),
    [
        pytest.param(m, t, marks=() if m == "him" or (m in ("cts", "ac_moe") and not t) else pytest.mark.slow)
        for m in ("cts", *NEW)
        for t in (False, True)
    ],
)
def test_a_bare_policy_still_stands_still_in_a_run_that_begins_with_its_checkpoint(method, trimmed, tmp_path):
    """Of three iterations two were done: one is left, and what they learned is taken over."""
    configuration, network = bare_policy(method, tmp_path / "policy.pt", bootstrap_iterations=3)
    first = runner(method, tmp_path, seed=5, configuration=configuration)
    begin_with(first, tmp_path / "policy.pt")
    first.learn(2)
    path = tmp_path / "model_2.pt"
    if trimmed:
        trim_checkpoint(path, path := tmp_path / "trimmed.pt")
    begun = runner(method, seed=7, configuration=configuration)
    begin_with(begun, path)
    critic = read_checkpoint(tmp_path / "model_2.pt")["average"]["critic_state_dict"]
    assert all(torch.equal(value, critic[name]) for name, value in begun.alg.critic.state_dict().items())
    assert begun.alg.bootstrap is not None
    begun.learn(1)
    for name, value in network.state_dict.items():
        assert torch.equal(stored_network(begun).state_dict[name], value), name
    assert begun.alg.bootstrap is None
    begun.learn(1)
    assert "Loss/surrogate" in begun.logger.scalars


@pytest.mark.parametrize("method", METHODS)
def test_a_minibatch_that_is_not_finite_spoils_nothing_learned_for_a_bare_policy(method):
    algorithm, env = build(method, epochs=3, minibatches=2)
    algorithm.follow_student(2)
    rollout(algorithm, env)
    before = [p.clone() for p in algorithm.critic.parameters()]
    algorithm.storage.returns[0, 0] = torch.nan
    report = algorithm.update()
    assert report["skipped_minibatches"] == 3.0, "one of two, in each of three passes"
    assert all(torch.isfinite(torch.tensor(value)) for value in report.values())
    after = list(algorithm.critic.parameters())
    assert all(torch.isfinite(p).all() for p in (*algorithm.actor.parameters(), *after))
    assert not all(torch.equal(a, b) for a, b in zip(after, before, strict=True)), "the other minibatch counts"
    rollout(algorithm, env)
    assert algorithm.update()["skipped_minibatches"] == 0.0


def test_what_a_bare_policy_lacks_learns_from_samples_of_the_latent():
    """The noise of the samples was zero until training went on as usual: the decoder saw means alone."""
    algorithm, env = build("dreamwaq")
    algorithm.follow_student(2)
    drawn = []
    for _ in range(2):
        rollout(algorithm, env)
        algorithm.update()
        drawn.append(algorithm.losses.noise.clone())
        assert drawn[-1].std().item() == pytest.approx(1.0, abs=0.2)
    assert not torch.equal(*drawn)


def test_next_states_are_those_of_the_step_after_and_ends_have_none():
    algorithm, env = build("him")
    obs, following = env.get_observations(), []
    with torch.inference_mode():
        for _ in range(8):
            obs, rewards, dones, extras = env.step(algorithm.act(obs))
            following.append(obs["privileged"].clone())
            algorithm.store_outcome(rewards, dones, extras)
        algorithm.compute_returns(obs)
    assert torch.equal(algorithm.storage.next_state, torch.stack(following)[..., : 3 + FRAME])
    rows = torch.arange(64)
    goes_on = algorithm.losses.samples(rows)[3]
    assert torch.equal(goes_on, 1.0 - algorithm.storage.dones.flatten())
    # What follows an end belongs to another episode: it changes no loss.
    algorithm.storage.dones[3, 2] = 1.0
    first = algorithm.losses.student(rows)[0]
    algorithm.storage.next_state[3, 2] += 5.0
    torch.testing.assert_close(algorithm.losses.student(rows)[0], first)


def test_codes_are_equal_in_size_and_swapped_predictions_are_cross_entropies():
    torch.manual_seed(0)
    scores, counts = torch.rand(64, 4), torch.ones(64)
    counts[5] = 0.0
    codes = sinkhorn(scores, counts, HimConfiguration(sinkhorn_iterations=100))
    torch.testing.assert_close(codes.sum(dim=1), counts)
    torch.testing.assert_close(codes.sum(dim=0), torch.full((4,), 63 / 4), rtol=1e-3, atol=0)
    # Two samples, each nearest to a prototype of its own: codes are nearly one-hot, predictions softmax(cosine / 0.5).
    certain = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    settings_ = HimConfiguration(temperature=0.5, code_sharpness=0.01)
    expected = torch.log(torch.tensor(1.0 + 2.718281828**-2.0))
    torch.testing.assert_close(swapped_prediction(certain, certain, torch.ones(2), settings_), expected)


def test_the_estimated_velocity_is_trusted_as_the_worlds_agree():
    algorithm, env = build("dreamwaq")
    rollout(algorithm, env)
    velocity = env.get_observations()["privileged"][:, :3]
    history = env.get_observations()["history"]
    returns = algorithm.storage.returns
    expected = 1.0 - torch.tanh(returns.std() / returns.mean().abs())
    assert algorithm.actor.trust.item() == pytest.approx(expected.item(), rel=1e-5)
    assert torch.equal(algorithm.storage.student_latent[..., :3], algorithm.storage.privileged[..., :3]), "not yet"
    with torch.no_grad():
        algorithm.actor.trust.fill_(1.0)
        first, second = (algorithm.actor.acted_on(history, velocity) for _ in range(2))
        assert torch.equal(first[:, :3], algorithm.actor.student_latent(history)[0][:, :3])
        assert not torch.equal(first[:, 3:], second[:, 3:]), "a sample of the latent"


@pytest.mark.parametrize("method", NEW)
def test_networks_that_do_not_fit_are_refused(method):
    observations = MovingEnv().get_observations()
    with pytest.raises(ConfigurationError, match=f"the method '{method}' .* takes 'mlp'"):
        find_method(method).build(
            observations, settings(method, encoder="moe"), num_actions=ACTIONS, command_entries=(6, 7, 8)
        )
    if method in ESTIMATORS:
        observations["privileged"] = observations["privileged"][:, :20]
        with pytest.raises(ConfigurationError, match=r"20 wide; the method .* needs .* 48 entries"):
            find_method(method).build(observations, settings(method), num_actions=ACTIONS)
    if method == "mcp":
        with pytest.raises(ConfigurationError, match="hides the command"):
            find_method(method).build(observations, settings(method), num_actions=ACTIONS)


def test_unknown_methods_are_refused():
    with pytest.raises(ConfigurationError, match="method is 'ppo'; allowed are cts, ac_moe, mcp, him, dreamwaq"):
        settings("ppo")
