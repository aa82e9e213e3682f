"""The training environment as rsl_rl and the learner see it, on the scripted engine."""

import math
from dataclasses import fields, replace
from itertools import pairwise

import pytest
import torch
from gaitgauge.robots.anatomy.body_plan import joint_ranges
from gaitgauge.robots.registry import load_robot
from gaitgauge.training.configuration import ConfigurationError
from gaitgauge.training.environment.configuration import (
    CommandConfiguration,
    CommandStage,
    EnvironmentConfiguration,
    JointConfiguration,
    PushConfiguration,
    RandomizationConfiguration,
    ResetConfiguration,
    RewardConfiguration,
    TerminationConfiguration,
)
from gaitgauge.training.environment.domain_randomization import MotorParameters, draw_bodies
from gaitgauge.training.environment.environment import TrainingEnvironment
from gaitgauge_fake_engine import FakeBackend, FakeScript
from small_environment import FLAT, STAIRS, gliding, idle, make

NEVER = math.inf


def times(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_surface():
    environment = make(6)
    assert (environment.num_envs, environment.num_actions, environment.max_episode_length) == (6, 12, 1250)
    observations, reward, done, extras = idle(environment)
    assert {name: tuple(observations[name].shape) for name in observations.keys()} == {  # noqa: SIM118
        "policy": (6, 45),
        "history": (6, 225),
        "privileged": (6, 263),
    }
    assert all(observations[name].dtype == torch.float32 for name in ("policy", "history", "privileged"))
    assert reward.shape == (6,) and reward.dtype == torch.float32
    assert done.shape == (6,) and done.dtype == torch.int64
    assert extras["time_outs"].shape == (6,)
    assert "log" not in extras
    again = environment.get_observations()
    assert all(torch.equal(again[name], observations[name]) for name in ("policy", "history", "privileged"))


def test_setting_the_episode_length_copies_in_place():
    environment = make()
    buffer = environment.episode_length_buf
    environment.episode_length_buf = torch.full((8,), 1249)
    assert environment.episode_length_buf is buffer
    _, _, done, extras = idle(environment)
    assert done.tolist() == [1] * 8 and extras["time_outs"].tolist() == [1.0] * 8
    assert environment.episode_length_buf.tolist() == [0] * 8


def test_nothing_handed_out_changes_later():
    environment = make(script=gliding(0.3), seed=3)
    action = torch.zeros(8, 12)
    handed = [environment.get_observations()]
    copies = [handed[0].clone()]
    for _ in range(9):
        observations, reward, done, extras = environment.step(action)
        everything = {**observations, "reward": reward, "done": done, "time_outs": extras["time_outs"]}
        everything |= extras.get("log", {})
        handed.append(everything)
        copies.append({name: value.clone() for name, value in everything.items()})
    for given, copy in zip(handed, copies, strict=True):
        for name in copy.keys():  # noqa: SIM118
            assert torch.equal(given[name], copy[name]), name


def test_action_becomes_targets_with_the_drawn_latency():
    delayed = RandomizationConfiguration(motor_offset=(0.0, 0.0), delay=(0.02, 0.02))
    environment = make(script=FakeScript(joint_law="track"), randomization=delayed)
    action = torch.full((8, 12), 0.4)
    default = environment.parts.default_pose
    environment.step(action)
    assert environment.backend.state.joint_position[0].tolist() == pytest.approx(default.tolist(), abs=1e-6)
    environment.step(action)
    assert environment.backend.state.joint_position[0].tolist() == pytest.approx((default + 0.1).tolist(), abs=1e-6)


def test_latency_is_uniform_over_whole_substeps():
    environment = make(4000)
    counts = torch.bincount(environment.parts.delay(), minlength=5)
    assert len(counts) == 5
    assert (counts.float() / 4000).tolist() == pytest.approx([0.2] * 5, abs=0.03)
    assert make(randomization=RandomizationConfiguration(delay=(0.0, 0.0))).parts.delay() is None


def test_falls_and_divergence_end_episodes_without_time_out():
    script = FakeScript(fall_time=times(0.1, NEVER, NEVER, NEVER), diverge_time=times(NEVER, 0.1, NEVER, NEVER))
    environment = make(4, script=script)
    finished = torch.zeros(4)
    for _ in range(8):
        observations, reward, done, extras = idle(environment)
        finished += done
        assert extras["time_outs"].sum() == 0
        for name in ("policy", "history", "privileged"):
            assert observations[name].isfinite().all(), name
        assert reward.isfinite().all()
    assert finished.tolist() == [1.0, 1.0, 0.0, 0.0]
    log = extras["log"]
    assert float(log["Episode_Termination/trunk_contact"]) == pytest.approx(0.5)
    assert float(log["Episode_Termination/diverged"]) == pytest.approx(0.5)
    assert float(log["Physics/nan_resets"]) == 1.0


def test_tilt_ends_an_episode():
    rolling = FakeScript(
        motion=lambda b: (
            torch.zeros_like(b.force_w),
            torch.tensor([10.0, 0.0, 0.0]).to(b.force_w).expand_as(b.force_w),
        )
    )
    environment = make(script=rolling, termination=TerminationConfiguration(tilt=0.5))
    ends = [bool(idle(environment)[2].any()) for _ in range(3)]
    assert ends == [False, False, True], "10 rad/s take 0.05 s to 0.5 rad"
    assert not any(
        bool(idle(make(script=rolling, termination=TerminationConfiguration(tilt=None)))[2].any()) for _ in range(4)
    )


def test_the_trunk_ends_an_episode_only_where_it_is_told_to():
    """A robot that is stopped by its head, or rests on its trunk, has not fallen unless the task says so."""
    lying = FakeScript(fall_time=times(0.04, 0.04))
    for newtons, ends in ((None, False), (1.0, True), (1000.0, False)):
        environment = make(2, script=lying, termination=TerminationConfiguration(trunk_contact=newtons, tilt=None))
        done = [bool(idle(environment)[2].any()) for _ in range(4)]
        assert any(done) == ends, newtons
        weight = environment.backend.state.trunk_contact_force_w[:, 2]
        assert ends or (weight > 100.0).all()
        assert ("trunk_contact" in environment.parts.terminations.names) == (newtons is not None)


def test_impossible_joint_speed_counts_as_divergence():
    environment = make(termination=TerminationConfiguration(joint_velocity=5.0))
    environment.backend.state.joint_velocity[2] = 50.0
    _, reward, done, _ = idle(environment)
    assert done.tolist() == [0, 0, 1, 0, 0, 0, 0, 0]
    assert reward[2] == 0.0


def test_leaving_the_tile_is_a_time_out():
    environment = make(8, script=gliding(8.0), terrain=STAIRS)
    stairs = environment.kind == 0
    # The end is 4.75 m away from the middle. Robots start up to 1 m off it: the way out is 3.75 m to 8.2 m long.
    left = torch.zeros(8)
    for step in range(54):
        _, _, done, extras = idle(environment)
        assert torch.equal(done.float(), extras["time_outs"])
        left += done
        if step < 23:
            assert left.sum() == 0
    assert (left[stairs] >= 1).all()
    assert (left[~stairs] == 0).all(), "level ground does not end"


def test_first_observation_after_a_reset_is_fresh():
    """Push, pose, ground and joints of the new episode, not those of the old one."""
    environment = make(
        64,
        script=FakeScript(fall_time=torch.full((64,), 0.1, dtype=torch.float64)),
        terrain=STAIRS,
        reset=ResetConfiguration(),
    )
    while not (result := idle(environment))[2].any():
        pass
    observations, state, parts = result[0], environment.backend.state, environment.parts
    privileged = observations["privileged"]
    w, _, _, z = state.base_quaternion_w.float().unbind(1)
    yaw = 2 * torch.atan2(z, w)
    velocity = state.base_linear_velocity_w.float()
    forward = torch.cos(yaw) * velocity[:, 0] + torch.sin(yaw) * velocity[:, 1]
    assert torch.allclose(privileged[:, 0], 2.0 * forward, atol=1e-5)
    assert velocity.abs().max() <= 0.5 + 1e-6 and velocity.std() > 0.2
    assert torch.allclose(privileged[:, 3:6], 0.25 * state.base_angular_velocity_b.float(), atol=1e-6)
    assert torch.allclose(privileged[:, 6:9], torch.tensor([0.0, 0.0, -1.0]).expand(64, 3), atol=1e-6)
    assert torch.allclose(privileged[:, 12:24], state.joint_position.float() - parts.default_pose, atol=1e-6)
    assert (privileged[:, 24:76] == 0).all(), "no velocities, actions, forces, torques or accelerations yet"
    ground = torch.tensor(
        [
            float(environment.palette.terrains[t].height(float(p[0]), float(p[1])))
            for t, p in zip(environment.backend.terrain_index.tolist(), state.base_position_w, strict=True)
        ]
    )
    middle = 76 + 93  # the scan point below the base
    expected = (state.base_position_w[:, 2].float() - 0.5 - ground).clamp(-1, 1) * 2.5
    assert torch.allclose(privileged[:, middle], expected, atol=1e-3)
    assert torch.equal(observations["history"], observations["policy"].repeat(1, 5)), "as the robot's controller begins"


def test_episodes_start_above_the_highest_ground_below_the_robot():
    spread = replace(STAIRS, spread_probability=1.0)
    environment = make(200, terrain=spread)
    state = environment.backend.state
    for index, position in zip(environment.backend.terrain_index.tolist(), state.base_position_w.tolist(), strict=True):
        terrain = environment.palette.terrains[index]
        below = float(terrain.height(position[0], position[1]))
        assert position[2] >= below + environment.robot.stand_height - 1e-3
        assert position[2] <= below + environment.robot.stand_height + 0.4
    assert state.base_position_w[:, :2].abs().max() > 2.5


def test_joints_start_within_their_limits():
    environment = make(300, reset=ResetConfiguration())
    position = environment.backend.state.joint_position.float()
    lower, upper = torch.from_numpy(joint_ranges(environment.robot)).float().unbind(1)
    assert (position >= lower - 1e-6).all() and (position <= upper + 1e-6).all()
    assert (position.std(dim=0) > 0.02).all()


def test_pushes_change_the_velocity_of_the_worlds_due():
    kicked = PushConfiguration(interval=0.2, linear=0.4, angular=0.6)
    environment = make(400, push=kicked)
    velocity = environment.backend.state.base_linear_velocity_w
    pushed = torch.zeros(400, dtype=torch.bool)
    for _ in range(10):
        before = velocity.clone()
        idle(environment)
        now = (velocity != before).any(dim=1)
        assert not (pushed & now).any(), "once per interval"
        assert 10 < now.sum() < 80, "worlds have their own clocks"
        pushed |= now
    assert pushed.all()
    assert (velocity[:, 2] == 0).all()
    assert velocity[:, :2].abs().max() <= 0.4 and velocity[:, :2].std() == pytest.approx(0.4 / 3**0.5, rel=0.15)


def test_pushes_add_or_replace():
    for add, expected in ((True, 2.0), (False, 0.0)):
        pushes = PushConfiguration(interval=0.02, linear=0.0, angular=0.0, add=add)
        environment = make(push=pushes)
        environment.backend.state.base_linear_velocity_w[:, 0] = 2.0
        idle(environment)
        assert environment.backend.state.base_linear_velocity_w[:, 0].tolist() == [expected] * 8


def test_randomization_ranges():
    ranges = RandomizationConfiguration(
        friction=(0.3, 0.9),
        foot_torsion=(0.0, 1.5),
        foot_softness=(0.5, 2.0),
        stiffness=(0.8, 1.1),
        motor_offset=(-0.02, 0.05),
        motor_speed=(1.0, 2.5),
    )
    environment = make(2000, randomization=ranges)
    drawn = environment.backend.randomized
    for values, (low, high) in (
        (drawn.friction, (0.3, 0.9)),
        (drawn.foot_torsion, (0.0, 1.5)),
        (drawn.foot_softness, (0.5, 2.0)),
        (drawn.base_mass_offset, (-1.0, 1.0)),
        (drawn.link_mass_scale, (0.9, 1.1)),
        (drawn.base_com_offset, (-0.03, 0.03)),
        (drawn.stiffness_scale, (0.8, 1.1)),
        (drawn.damping_scale, (0.9, 1.1)),
        (drawn.motor_strength, (0.8, 1.2)),
        (drawn.motor_speed, (1.0, 2.5)),
        (drawn.motor_offset, (-0.02, 0.05)),
    ):
        assert low - 1e-6 <= values.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < values.max() <= high + 1e-6
        assert float(values.mean()) == pytest.approx((low + high) / 2, abs=0.03 * (high - low))


def test_torsion_of_the_feet_is_at_its_ends_in_a_share_of_the_worlds():
    ranges = RandomizationConfiguration(foot_torsion=(0.5, 1.5), foot_torsion_ends=0.4)
    torsion = draw_bodies(ranges, 4000, 3, torch.Generator().manual_seed(0))["foot_torsion"]
    shares = [float((torsion == end).float().mean()) for end in (0.5, 1.5)]
    assert shares == pytest.approx([0.4, 0.4], abs=0.03)
    between = torsion[(torsion > 0.5) & (torsion < 1.5)]
    assert float(between.mean()) == pytest.approx(1.0, abs=0.05) and float(between.std()) == pytest.approx(
        12**-0.5, abs=0.03
    )


@pytest.mark.parametrize(
    ("time", "shares"), [(0.0, [1.0] * 4), (0.05, [1.0 - math.exp(-0.4 * k) for k in (1, 2, 1, 2)])]
)
def test_the_error_of_a_turn_is_averaged_from_the_draw_of_its_command(time, shares):
    stage = CommandStage(begin=0.0, forward=(0.0, 0.0), lateral=(0.0, 0.0), yaw=(1.0, 1.0))
    turning = CommandConfiguration(
        stages=(stage,), interval=0.04, dynamic=False, extreme_probability=0.0, straight_probability=0.0
    )
    rewards = RewardConfiguration(turn_error=-2.0, turn_error_time=time)
    environment = make(script=gliding(yaw=0.4), commands=turning, rewards=rewards)
    summed = environment.parts.memory.episode_rewards[:, environment.parts.rewards.names.index("turn_error")]
    totals = [0.0]
    for _ in shares:
        idle(environment)
        totals.append(float(summed[0]))
    paid = [later - earlier for earlier, later in pairwise(totals)]
    assert paid == pytest.approx([-2.0 * 0.02 * 0.6 * share for share in shares], rel=1e-5)


def test_motors_that_nobody_varies_are_not_written(monkeypatch):
    """An engine that cannot vary them can be trained on."""
    written = set()
    really = FakeBackend.randomize

    def randomize(engine, randomization, worlds=None):
        written.update(f.name for f in fields(randomization) if getattr(randomization, f.name) is not None)
        really(engine, randomization, worlds)

    monkeypatch.setattr(FakeBackend, "randomize", randomize)
    make(randomization=RandomizationConfiguration(motor_strength=(0.9, 0.9), motor_offset=(0.0, 0.0)))
    assert not written & {"foot_torsion", "foot_softness"}
    assert written & set(MotorParameters.NEUTRAL) == {"stiffness_scale", "damping_scale", "motor_strength"}


def test_motor_speeds_that_would_do_nothing_are_refused():
    faster = RandomizationConfiguration(motor_speed=(1.0, 2.5))
    with pytest.raises(
        ConfigurationError,
        match=r"^environment\.randomization\.motor_speed is 1 to 2\.5 while environment\.physics\.torque_speed_limit is off, .* at 1,1$",
    ):
        make(randomization=faster, physics={"torque_speed_limit": False})
    make(physics={"torque_speed_limit": False})


def test_soft_limits_of_joint_speeds_are_a_share_of_the_motors_own():
    def limits(environment):
        parts = environment.parts
        return parts.read(parts.inputs, parts.memory, parts.action, parts.progress()).soft_speed

    weights = RewardConfiguration(joint_speed_limits=-0.3, soft_speed_limit=0.8)
    assert limits(make(rewards=weights)).reshape(4, 3).unique().tolist() == pytest.approx([0.8 * 15.65, 0.8 * 30.0])
    assert limits(make()).isinf().all()


def test_joint_speeds_of_motors_that_nobody_knows_are_not_judged(monkeypatch):
    weights = RewardConfiguration(joint_speed_limits=-0.3)
    nobody_knows = replace(load_robot("go2").parameters["training"], no_load_speed=None, full_torque_speed=None)
    monkeypatch.setattr("gaitgauge.training.environment.environment.joint_parameters", lambda *_: nobody_knows)
    with pytest.raises(
        ConfigurationError,
        match=r"^environment\.rewards\.joint_speed_limits is -0\.3, but .* 'go2' does not say .*, or set it to 0$",
    ):
        make(rewards=weights, physics={"torque_speed_limit": False})


def test_motors_are_redrawn_for_reset_worlds_only():
    environment = make(4, script=FakeScript(fall_time=times(0.1, NEVER, NEVER, 0.1)))
    drawn = environment.backend.randomized
    before = {name: getattr(drawn, name).clone() for name in ("stiffness_scale", "motor_offset", "friction")}
    while not idle(environment)[2].any():
        pass
    for name in ("stiffness_scale", "motor_offset"):
        changed = (getattr(drawn, name) != before[name]).any(dim=1)
        assert changed.tolist() == [True, False, False, True]
    assert torch.equal(drawn.friction, before["friction"])


def test_a_run_from_before_motor_speeds_goes_on_with_those_of_the_data_sheet():
    speeds = RandomizationConfiguration(motor_speed=(2.0, 3.0))
    environment = make(4, randomization=speeds)
    saved = environment.state_dict()
    del saved["motors"]["motor_speed"]
    environment.load_state_dict(saved)
    assert environment.backend.randomized.motor_speed.unique().tolist() == [1.0]


def test_commands_hold_for_their_interval():
    commands = CommandConfiguration(
        stages=(CommandStage(begin=0.0, forward=(-1.0, 1.0), lateral=(-1.0, 1.0), yaw=(-1.0, 1.0)),),
        interval=0.2,
        extreme_probability=0.0,
    )
    environment = make(commands=commands)
    command = environment.parts.memory.command.clone()
    for interval in range(3):
        for step in range(10):
            assert torch.equal(environment.parts.memory.command, command), (interval, step)
            observations = idle(environment)[0]
        assert not (environment.parts.memory.command == command).all(dim=1).any()
        command = environment.parts.memory.command.clone()
        assert torch.allclose(observations["policy"][:, 6:9], command * torch.tensor([2.0, 2.0, 0.25]))


def test_log_keys_and_values():
    environment = make(script=gliding(0.0), log_interval=4, terrain=STAIRS)
    environment.episode_length_buf = torch.full((8,), 1248)
    logs = [idle(environment)[3].get("log") for _ in range(8)]
    assert [log is not None for log in logs] == [False, False, False, True] * 2
    log = logs[3]
    names = set(log)
    assert {"Episode_Reward/linear_tracking", "Episode_Termination/time_out", "Curriculum/stairs_up"} <= names
    assert {"Curriculum/flat", "Physics/overflow_worlds", "Physics/nan_resets", "Metrics/yaw_rate_error"} <= names
    assert all(isinstance(value, torch.Tensor) and value.dim() == 0 for value in log.values())
    assert float(log["Episode_Termination/time_out"]) == 1.0
    assert 0.0 < float(log["Episode_Reward/linear_tracking"]) <= 1.0
    assert logs[7]["Episode_Reward/linear_tracking"] == log["Episode_Reward/linear_tracking"], "kept without new ends"


def test_rewards_are_per_second_that_was_played_also_where_episodes_began_at_random():
    logs = {}
    for age in (0, 60):
        environment = make(script=gliding(0.0), log_interval=1, terrain=STAIRS, episode_length=1.5)
        environment.episode_length_buf = torch.full((8,), age)
        while not (step := idle(environment))[2].all():
            pass
        logs[age] = step[3]["log"]
    names = [name for name in logs[0] if name.startswith("Episode_Reward/")]
    assert any(float(logs[0][name]) != 0.0 for name in names)
    whole, part = (float(logs[age]["Episode_Reward/base_height"]) for age in (0, 60))
    assert part == pytest.approx(whole, rel=0.15)  # a fifth of it, where ages count as steps


def test_reward_is_the_sum_of_the_logged_terms():
    environment = make(4, script=gliding(0.2), log_interval=1)
    total = torch.zeros(4)
    for _ in range(5):
        total += idle(environment)[1]
    assert torch.allclose(environment.parts.memory.episode_rewards.sum(dim=1), total, atol=1e-6)


def test_dynamic_sigma():
    environment = make(5, terrain=replace(STAIRS, levels=9))
    memory, parts = environment.parts.memory, environment.parts
    assert environment.kind.tolist() == [0, 0, 0, 1, 1]
    commands = [[1.0, -0.5, 1.5], [2.0, 1.5, 3.0], [0.2, 0.0, 0.5], [2.0, 1.0, 2.0], [0.0, 0.0, 0.0]]
    memory.command.copy_(torch.tensor(commands))
    memory.level.copy_(torch.tensor([0, 8, 8, 2, 2]))
    m0 = math.exp(0.1) - 1.0
    expected = [
        [0.25 + 0.5 * m0 * 0.25, 0.25, 0.25 + 0.5 * m0 * 0.25],
        [0.5, 0.5, 0.5],
        [0.25, 0.25, 0.25],
        [0.25, 0.25, 0.25],
        [0.25, 0.25, 0.25],
    ]
    assert torch.allclose(parts.read.sigma(memory), torch.tensor(expected), atol=1e-6)
    fixed = make(5, terrain=replace(STAIRS, levels=9), rewards=RewardConfiguration(dynamic_sigma=False))
    fixed.parts.memory.command.copy_(torch.tensor(commands))
    fixed.parts.memory.level.fill_(8)
    assert torch.equal(fixed.parts.read.sigma(fixed.parts.memory), torch.full((5, 3), 0.25))


def test_joint_constants_can_be_overridden():
    joints = JointConfiguration(armature=0.02, friction_loss=0.0)
    parameters = make(joints=joints).backend.scene.parameters
    assert parameters.armature == (0.02,) * 12 and parameters.friction_loss == (0.0,) * 12
    assert parameters.stiffness == (20.0,) * 12
    with pytest.raises(
        ValueError,
        match=r"^environment.joints.parameters is 'nope', but robot 'go2' has no parameter set 'nope'; it has gauge, training",
    ):
        make(joints=JointConfiguration(parameters="nope"))


def test_mistakes():
    with pytest.raises(ValueError, match="capture=True needs a CUDA device"):
        TrainingEnvironment(
            EnvironmentConfiguration(num_envs=2, terrain=FLAT), backend="fake", device="cpu", capture=True
        )
    with pytest.raises(ValueError, match="num_envs is 0"):
        make(0)
    with pytest.raises(
        ValueError, match=r"joints\.moving is waist, but no joint is rigid; set environment\.joints\.rigid"
    ):
        make(joints=JointConfiguration(moving=("waist",)))


def test_same_seed_same_run():
    def run(seed):
        environment = make(6, seed=seed, script=FakeScript(), push=PushConfiguration(interval=0.1))
        return idle(environment, 12)[0]

    first, second, other = run(1), run(1), run(2)
    assert torch.equal(first["history"], second["history"])
    assert not torch.equal(first["history"], other["history"])
