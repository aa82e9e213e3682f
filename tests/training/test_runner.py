import json
import os
import signal
from pathlib import Path

import pytest
import torch
from gaitgauge.policy.loading import load_policy
from gaitgauge.training.run.checkpoint import (
    CheckpointError,
    checkpoint_entries,
    read_checkpoint,
    trim_checkpoint,
    write_checkpoint,
)
from gaitgauge.training.run.resuming import TrainingDivergedError, begin_with, resume_run, save_run, stored_network
from gaitgauge.training.run.runner import TrainingRunner
from gaitgauge.training.run.scoring import ScoreReport
from gaitgauge.training.run.seeding import seed_everything
from toy_training import ToyEnv, toy_configuration, toy_contract, toy_mirror


def make(
    log_dir: Path | None = None,
    *,
    seed: int = 0,
    env: ToyEnv | None = None,
    task: str = "toy",
    configuration=None,
    **arguments,
):
    seed_everything(seed)
    return TrainingRunner(
        env or ToyEnv(seed=seed),
        configuration or toy_configuration(),
        contract=toy_contract(),
        task=task,
        log_dir=log_dir,
        **arguments,
    )


def flat(state, prefix=""):
    if isinstance(state, torch.Tensor):
        return {prefix: state}
    if isinstance(state, dict):
        items = state.items()
    elif isinstance(state, list | tuple):
        items = enumerate(state)
    else:
        return {prefix: state}
    return {k: v for name, entry in items for k, v in flat(entry, f"{prefix}.{name}").items()}


def assert_same(a, b, skip=()):
    a, b = flat(a), flat(b)
    assert a.keys() == b.keys()
    for name in a:
        if any(s in name for s in skip):
            continue
        if isinstance(a[name], torch.Tensor):
            assert torch.equal(a[name], b[name]), name
        else:
            assert a[name] == b[name], name


@pytest.mark.parametrize("encoder", [pytest.param("mlp", marks=pytest.mark.slow), "moe"])
def test_continuing_equals_never_having_stopped(tmp_path, encoder):
    whole, first, second = (tmp_path / n for n in ("whole", "first", "second"))
    for folder in (whole, first, second):
        folder.mkdir()
    configuration = toy_configuration(encoder=encoder)
    make(whole, configuration=configuration).learn(4)
    make(first, configuration=configuration).learn(2)
    # Another seed: everything that matters must come from the checkpoint.
    resumed = make(second, seed=7, configuration=configuration)
    resume_run(resumed, first / "model_2.pt")
    resumed.learn(2)
    a, b = read_checkpoint(whole / "model_4.pt"), read_checkpoint(second / "model_4.pt")
    assert a["iter"] == b["iter"] == 4
    # Wall-clock time and the run's name are all that may differ.
    assert_same(a, b, skip=("total_time", "contract", "checksum"))  # the checksum is of the contract too


def test_a_checkpoint_is_a_policy(tmp_path):
    runner = make(tmp_path)
    outcome = runner.learn(1)
    policy = load_policy(outcome.checkpoint)
    assert policy.contract.provenance["iteration"] == 1
    session = policy.session(8)
    obs = ToyEnv(seed=3).get_observations()
    action = session.act(obs["policy"])
    # One frame after a start from zeros: the same history for both.
    history = torch.zeros(8, 5, 45)
    history[:, -1] = obs["policy"]
    with torch.no_grad():
        expected = runner.alg.actor.student(history)
    assert torch.allclose(action, expected, atol=1e-6)


def test_rsl_rl_log_keys(tmp_path):
    seen = []
    make(tmp_path, progress=seen.append, configuration=toy_configuration(steps=24)).learn(2)
    keys = set(seen[-1].scalars)
    assert {
        "Train/mean_reward",
        "Train/mean_episode_length",
        "Train/mean_reward_teacher",
        "Loss/value",
        "Loss/surrogate",
        "Loss/entropy",
        "Loss/learning_rate",
        "Loss/latent",
        "Loss/load_balance",
        "Policy/mean_std",
        "Perf/total_fps",
        "Perf/collection_time",
        "Perf/learning_time",
        "Metrics/reward",
        "Episode/level",
    } <= keys
    assert seen[-1].iteration == 2 and seen[-1].scalars["Perf/total_steps"] == 2 * 24 * 8
    assert list(tmp_path.glob("events.out.tfevents.*"))
    assert json.loads((tmp_path / "run.json").read_text())["outcome"] == "finished"


def test_logged_reward_is_the_mean_of_finished_episodes():
    runner = make()
    rewards, dones = torch.arange(8.0), torch.zeros(8, dtype=torch.bool)
    for step in range(8):
        done = dones.clone()
        done[3] = step == 1
        done[4] = step == 3
        runner.logger.add_step(
            rewards, done, {"log": {"a": torch.tensor(float(step)), "b": torch.tensor(float("nan"))}}
        )
    assert runner.logger.collect() == {"Episode/a": 3.5}
    assert list(runner.logger.returns) == [6.0, 16.0]
    assert list(runner.logger.group_returns["student"]) == [16.0]
    assert list(runner.logger.group_returns["teacher"]) == [6.0]
    assert runner.logger.episode_length.tolist() == [8.0, 8.0, 8.0, 6.0, 4.0, 8.0, 8.0, 8.0]


def test_the_log_keeps_the_last_hundred_episodes_of_each_group():
    logger = make().logger
    for number in range(64):
        logger.add_step(8.0 * number + torch.arange(8.0), torch.ones(8, dtype=torch.bool), {})
        if number % 8 == 7:
            logger.collect()
    ended = [float(i) for i in range(8 * 64)]  # one a step and world; every fourth world is the student's
    assert list(logger.returns) == ended[-100:] and list(logger.lengths) == [1.0] * 100
    assert list(logger.group_returns["student"]) == ended[::4][-100:]
    assert list(logger.group_returns["teacher"]) == [e for e in ended if e % 4][-100:]


@pytest.mark.usefixtures("hangups")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_writes_a_checkpoint(tmp_path, number):
    messages = []
    runner = make(
        tmp_path, message=messages.append, progress=lambda p: p.iteration == 3 and os.kill(os.getpid(), number)
    )
    before = signal.getsignal(number)
    outcome = runner.learn(1000)
    assert outcome.reason == "signal" and outcome.exit_code == 128 + number
    assert outcome.iteration == 4 and outcome.checkpoint == tmp_path / "model_4.pt"
    assert read_checkpoint(outcome.checkpoint)["iter"] == 4
    assert any(number.name in m for m in messages)
    assert signal.getsignal(number) is before


def test_a_signal_writes_a_checkpoint_where_nobody_can_be_told(tmp_path):
    def message(_):
        raise OSError("the terminal is gone")

    runner = make(
        tmp_path, message=message, progress=lambda p: p.iteration == 3 and os.kill(os.getpid(), signal.SIGTERM)
    )
    assert runner.learn(1000).checkpoint == tmp_path / "model_4.pt"


def test_under_nohup_a_closed_terminal_stops_nothing(tmp_path):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        runner = make(tmp_path, progress=lambda p: p.iteration == 1 and os.kill(os.getpid(), signal.SIGHUP))
        assert runner.learn(2).reason == "finished"
    finally:
        signal.signal(signal.SIGHUP, before)


def test_time_limit(tmp_path):
    outcome = make(tmp_path).learn(1000, max_seconds=0.0)
    assert outcome.reason == "time" and outcome.iteration == 1 and outcome.checkpoint.exists()


def test_nan_in_the_environment_is_counted_and_stops_the_run(tmp_path):
    env = ToyEnv()
    runner = make(tmp_path, env=env, configuration=toy_configuration(run={"nonfinite_limit": 0.2}))
    runner.learn(1)
    env.poison = 2
    runner.learn(1)  # 1 of 8 environments: below the limit, kept out of learning
    assert runner.logger.scalars["Physics/nonfinite_samples"] == 8
    assert all(torch.isfinite(p).all() for p in runner.alg.actor.parameters())
    strict = make(tmp_path, env=env)
    limit = r"8 of 64 environment samples are not finite \(training\.run\.nonfinite_limit is 0\.01\); "
    with pytest.raises(TrainingDivergedError, match=rf"{limit}.* The last checkpoint, '.*model_2\.pt', is intact\.$"):
        strict.learn(1)
    assert read_checkpoint(tmp_path / "model_2.pt")["iter"] == 2
    assert json.loads((tmp_path / "run.json").read_text())["outcome"] == "diverged"
    with pytest.raises(TrainingDivergedError, match=r"^Iteration 0: 8 of 64 .* a reward has diverged\.$"):
        make(tmp_path / "new", env=env).learn(1)  # there is no checkpoint yet


@pytest.mark.parametrize(("bare", "minibatches"), [(True, 4), (False, 8)])
def test_skipped_minibatches_are_a_share_of_those_of_the_iteration(tmp_path, monkeypatch, bare, minibatches):
    """Two passes over two minibatches, for the policy and for the student; for a bare policy there is one learner."""
    runner = make(tmp_path, configuration=toy_configuration(run={"nonfinite_limit": 1.9 / minibatches}))
    if bare:
        runner.alg.follow_student(5)
    compute = runner.alg.compute_returns
    runner.learn(1)

    def broken(obs):
        compute(obs)
        runner.alg.storage.returns[0, 0] = torch.nan  # one sample, in one minibatch of each of two passes

    monkeypatch.setattr(runner.alg, "compute_returns", broken)
    with pytest.raises(
        TrainingDivergedError, match=f"2 of {minibatches} minibatches .* lower training.algorithm.learn"
    ):
        runner.learn(1)


def test_broken_weights_are_never_written(tmp_path):
    runner = make(tmp_path)
    runner.learn(1)
    before = (tmp_path / "model_1.pt").read_bytes()
    with torch.no_grad():
        runner.alg.actor.student.actor[0].weight[0, 0] = float("nan")
    with pytest.raises(TrainingDivergedError, match="not finite"):
        save_run(runner, tmp_path / "model_1.pt")
    assert (tmp_path / "model_1.pt").read_bytes() == before


class SlowScorer:
    """Gives each checkpoint's score back one call later."""

    suite = "quick"

    def __init__(self, scores):
        self.scores, self.waiting = scores, []

    def submit(self, path, iteration):
        scores = {"score": self.scores[iteration], "velocity": 0.1}
        self.waiting.append(ScoreReport(path=path, iteration=iteration, scores=scores))

    def drain(self, seconds, stop=None):
        reports, self.waiting = self.waiting, []
        return reports

    @property
    def pending(self):
        return len(self.waiting)

    def close(self):
        pass


def test_best_is_chosen_by_the_gauge(tmp_path, monkeypatch):
    monkeypatch.setattr("gaitgauge.policy.finding.LOG_ROOT", tmp_path)
    tmp_path = tmp_path / "toy" / "run"  # alone under its root: other tests have a best.pt, too
    tmp_path.mkdir(parents=True)
    scorer = SlowScorer({1: 0.2, 2: 0.6, 3: 0.4})
    seen = []
    configuration = toy_configuration(run={"gauge_interval": 1})
    runner = make(tmp_path, scorer=scorer, configuration=configuration, progress=seen.append)
    runner.learn(3)
    assert (runner.best_score, runner.best_iteration) == (0.6, 2)
    assert read_checkpoint(tmp_path / "best.pt")["iter"] == 2
    assert seen[-1].scalars["Gauge/quick/score"] == 0.4
    assert [progress.next_score for progress in seen] == [1, 1, None]
    assert load_policy("best").contract == load_policy(tmp_path / "model_2.pt").contract
    resumed = make(tmp_path, seed=1)
    resume_run(resumed, tmp_path / "model_3.pt")
    assert resumed.best_score == 0.6
    # The score of iteration 2 came back before checkpoint 1 was resumed from: the same run directory remembers it.
    resume_run(resumed, tmp_path / "model_1.pt")
    assert (resumed.best_score, resumed.best_iteration) == (0.6, 2)


@pytest.mark.parametrize("late", [False, True])
def test_every_score_is_told_and_that_the_last_one_is_not_waited_for(tmp_path, monkeypatch, late):
    scorer, said = SlowScorer({1: 0.6, 2: 0.4}), []
    configuration = toy_configuration(run={"gauge_interval": 1, "gauge_wait": 0.0})
    runner = make(tmp_path, scorer=scorer, configuration=configuration, message=said.append)
    if late:
        monkeypatch.setattr(scorer, "drain", lambda *_: [])
    runner.learn(2)
    told = [text.split(":")[0] for text in said if "score" in text]
    scored = ["Best gauge score so far", "Gauge score 0.4000 at iteration 2, best 0.6000 at iteration 1."]
    assert told == (["The last checkpoint has no score"] if late else scored)


def test_resume_refuses_what_does_not_fit(tmp_path):
    make(tmp_path).learn(1)
    path = tmp_path / "model_1.pt"
    with pytest.raises(CheckpointError, match="of task 'toy', this run trains 'other'"):
        resume_run(make(task="other"), path)
    worlds = (
        "8 environments in each process, this run 16; leave --num-envs and environment.num_envs out, or .* --init-from"
    )
    with pytest.raises(CheckpointError, match=worlds):
        resume_run(make(env=ToyEnv(num_envs=16)), path)
    with pytest.raises(CheckpointError, match="network"):
        resume_run(make(configuration=toy_configuration(encoder="mlp")), path)
    damaged = tmp_path / "damaged.pt"
    damaged.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(CheckpointError, match="damaged"):
        resume_run(make(), damaged)
    with pytest.raises(CheckpointError, match="cannot be read"):
        resume_run(make(), tmp_path / "none.pt")


@pytest.mark.parametrize("symmetry", [pytest.param("none", marks=pytest.mark.slow), "augment"])
def test_beginning_with_a_bare_policy(tmp_path, symmetry):
    """First a teacher and a critic for the student, which stands still and acts everywhere; then both go on."""
    settings = toy_configuration(
        algorithm={"symmetry": symmetry, "epochs": 12}, run={"bootstrap_iterations": 6, "nonfinite_limit": 0.5}
    )
    mirror = toy_mirror() if symmetry != "none" else None
    trained = make(configuration=settings, mirror=mirror)
    trained.learn(2)
    network = stored_network(trained)
    write_checkpoint(tmp_path / "policy.pt", checkpoint_entries(toy_contract(), network, {}))

    runner = make(seed=5, configuration=settings, mirror=mirror)
    begin_with(runner, tmp_path / "policy.pt")
    for name, value in network.state_dict.items():
        assert torch.equal(stored_network(runner).state_dict[name], value)
    observations = runner.env.get_observations()
    alg, order = runner.alg, runner.alg.storage.split.order
    with torch.inference_mode():
        alg.act(observations)
        mean = alg.storage.action_mean[0]
        history, frame = observations["history"][order], observations["policy"][order]
        assert torch.allclose(mean, alg.actor.action_mean(alg.actor.student_latent(history)[0], frame), atol=1e-6)

    def error():
        with torch.no_grad():
            seen = runner.env.get_observations()
            latent = alg.actor.teacher_latent(seen["privileged"]) - alg.actor.student_latent(seen["history"])[0]
            return float(latent.square().mean())

    before = error()
    for _ in range(6):
        assert runner.alg.bootstrap is not None
        std = runner.alg.actor.output_std.clone()
        runner.learn(1)
        assert {"Loss/teacher_latent", "Loss/value"} <= runner.logger.scalars.keys()
        for name, value in network.state_dict.items():
            assert torch.equal(stored_network(runner).state_dict[name], value)
        assert torch.equal(runner.alg.actor.output_std, std)
    assert runner.alg.bootstrap is None and error() < 0.5 * before
    runner.learn(1)
    assert "Loss/surrogate" in runner.logger.scalars
    changed = stored_network(runner).state_dict
    assert not torch.equal(changed["actor.0.weight"], network.state_dict["actor.0.weight"])


def test_slim_checkpoints_keep_weights_and_progress(tmp_path):
    configuration = toy_configuration(run={"keep_episodes": False})
    make(tmp_path, configuration=configuration).learn(1)
    entries = read_checkpoint(tmp_path / "model_1.pt")
    assert entries["training"]["environment"] is None  # the toy has no progress of its own
    said = []
    resumed = make(seed=7, configuration=configuration, message=said.append)
    resume_run(resumed, tmp_path / "model_1.pt")
    assert "episodes start anew" in said[0] and resumed.iteration == 1
    assert_same(resumed.alg.save(), {k: entries[k] for k in resumed.alg.save()})
    resumed.learn(1)


def test_a_trimmed_checkpoint_begins_training_with_its_teacher(tmp_path):
    """It is a policy, holds no weight twice, and cannot be resumed."""
    make(tmp_path).learn(2)
    trim_checkpoint(tmp_path / "model_2.pt", tmp_path / "trimmed.pt")
    whole, trimmed = torch.load(tmp_path / "model_2.pt"), torch.load(tmp_path / "trimmed.pt")
    average = whole["average"]
    assert_same(average["actor_state_dict"], trimmed["actor_state_dict"])
    bias = trimmed["actor_state_dict"]["student.actor.0.bias"]
    assert bias.data_ptr() == trimmed["state_dict"]["actor.0.bias"].data_ptr()
    assert load_policy(str(tmp_path / "trimmed.pt")).contract.provenance["iteration"] == 2
    runner = make(seed=3)
    begin_with(runner, tmp_path / "trimmed.pt")
    assert runner.alg.bootstrap is None
    assert_same(runner.alg.actor.state_dict(), average["actor_state_dict"])
    assert_same(runner.alg.critic.state_dict(), average["critic_state_dict"])
    assert trimmed["training"]["progress"] == whole["training"]["progress"]
    with pytest.raises(CheckpointError, match="holds networks only; begin a new run with them: --init-from"):
        resume_run(runner, tmp_path / "trimmed.pt")
