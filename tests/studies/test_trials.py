"""Field trials on an engine without physics, whose robots do what their script says, and a moment of MuJoCo."""

import math
from dataclasses import replace
from functools import partial
from unittest.mock import patch

import numpy as np
import pytest
import torch
from gaitgauge.gauge.chance.intervals import wilson_interval
from gaitgauge.gauge.suite import SuiteError
from gaitgauge.policy.loading import load_policy
from gaitgauge.robots.anatomy.body_plan import base_mass
from gaitgauge.studies.trials import running
from gaitgauge.studies.trials.running import Trial, draws, run_each, run_scenario
from gaitgauge.studies.trials.scenario import (
    Failure,
    Force,
    Ground,
    Leg,
    Patch,
    Payload,
    Scenario,
    ScenarioError,
    Start,
    Success,
)
from gaitgauge.terrains.course import Stretch
from gaitgauge_fake_engine import FakeBackend, FakeScript
from scripted_gauge import GO2, ScriptedPolicy

STAND = Leg(seconds=0.2, velocity=(0.0, 0.0, 0.0))
AHEAD = Leg(seconds=4.0, velocity=(1.0, 0.0, 0.0))


@pytest.fixture(autouse=True, scope="module")
def coarse(tmp_path_factory):
    """A suite of two substeps, which an engine in Python takes sooner than ten."""
    path = tmp_path_factory.mktemp("suites") / "coarse.toml"
    path.write_text(
        'extends = "gaitgauge-1"\nname = "coarse"\n[physics]\ntimestep = 0.01\nsubsteps = 2\n[noise]\nlatency = 1\n'
    )
    scenario.suite = str(path)


def scenario(*commands: Leg, **settings: object) -> Scenario:
    given = {"suite": scenario.suite} | {
        "start": Start(spread=(0.0, 0.0, 0.0)),
        "success": Success(survive=True),
        "torque_speed_limit": False,
    }
    return Scenario(name="own", title="One's own", friction=0.6, commands=commands, **(given | settings))


def play(
    trial: Scenario, policy: ScriptedPolicy | None = None, *, robots: int = 1, gain: float = math.inf, **script: object
) -> tuple[list[Trial], list[torch.Tensor]]:
    """Robots that take up the commanded speed at up to ``gain`` [m/s²]. Returns what came of them, and the forces on them."""
    policy = policy or ScriptedPolicy()
    forces = []
    speed = torch.zeros(robots, dtype=torch.float64)

    def motion(backend: FakeBackend) -> tuple[torch.Tensor, torch.Tensor]:
        nonlocal speed
        command = policy.seen[-1][:robots, 6:9].double() / torch.tensor([2.0, 2.0, 0.25])
        forces.append(backend.force_w.clone())
        step = gain * backend.scene.physics.timestep
        speed = speed + (command[:, 0] - speed).clamp(-step, step)
        nothing = torch.zeros_like(speed)
        return torch.stack((speed, command[:, 1], nothing), dim=1), torch.stack(
            (nothing, nothing, command[:, 2]), dim=1
        )

    make = partial(_fake, script=FakeScript(motion=motion, **script))
    with patch.object(running, "make_backend", make):
        return run_scenario(policy, GO2, trial, range(robots)), forces


def _fake(name: str, scene: object, *, device: str, threads: int, script: FakeScript) -> FakeBackend:
    return FakeBackend(scene, script=script)


def test_speeds_and_times_of_a_robot_that_accelerates_evenly():
    """2 m/s² from rest after 0.2 s of standing, up to 4 m/s."""
    run = Leg(seconds=5.0, velocity=(4.0, 0.0, 0.0), until_x=12.0)
    [trial], _ = play(scenario(STAND, run, STAND, success=Success(speed=3.9, beyond=11.0)), gain=2.0)
    assert trial.outcome == "success"
    # the mean over 0.1 s lags by 0.04 s behind the speed at a step's end, which is 3.9 m/s after 1.95 s
    assert trial.speed_time == pytest.approx(2.0, abs=0.011)
    assert trial.tracking_error < 0.02  # all but the first of the steps that count are at 4 m/s
    assert trial.peak_speed == pytest.approx(4.0)
    # 4 m in the first 2 s, and 7 m more
    assert trial.reached == pytest.approx(2.0 + 7.0 / 4.0, abs=0.03)
    assert trial.mean_speed == pytest.approx(11.0 / 3.75, abs=0.03)
    # the runway's end comes 2 s later than 4 m, and the robot stands there for 0.2 s more
    assert trial.seconds == pytest.approx(0.2 + 4.0 + 0.2, abs=0.05)


def test_who_does_not_get_there_has_missed_and_says_how_far_it_came():
    [trial], _ = play(scenario(STAND, replace(AHEAD, seconds=2.0), success=Success(beyond=2.0)), gain=0.5)
    # 0.5 m/s² for 2 s are 1 m
    assert (trial.outcome, trial.reached, trial.mean_speed) == ("missed", None, None)
    assert trial.progress == pytest.approx(0.5, abs=0.01)


def test_who_falls_has_failed_whatever_it_did_before():
    fall = torch.tensor([math.inf, 1.5], dtype=torch.float64)
    trials, _ = play(
        scenario(STAND, replace(AHEAD, seconds=2.0), success=Success(beyond=1.0)), robots=2, fall_time=fall
    )
    assert [t.outcome for t in trials] == ["success", "fell"]
    assert trials[1].reached == pytest.approx(1.0, abs=0.03) and trials[1].seconds < 2.2 == trials[0].seconds


def test_a_robot_that_diverged_has_fallen_and_its_numbers_are_numbers():
    [trial], _ = play(
        scenario(STAND, replace(AHEAD, seconds=1.0)), diverge_time=torch.tensor([1.0], dtype=torch.float64)
    )
    assert (trial.outcome, trial.diverged) == ("fell", True)
    assert trial.peak_speed == pytest.approx(1.0) and trial.tracking_error == pytest.approx(0.0, abs=0.1)
    assert all(map(math.isfinite, trial.path[-1]))


def test_the_operator_brings_the_robot_back_to_its_line():
    start = Start(y=0.0, yaw=0.5, spread=(0.0, 0.3, 0.3))
    steered = scenario(replace(AHEAD, seconds=6.0, steer=True), start=start)
    trials, _ = play(steered, robots=2)
    for trial in trials:
        x, y = trial.path[-1][:2]
        assert abs(math.cos(0.5) * y - math.sin(0.5) * x) < 0.03
    assert max(abs(draws(steered, seed)[0][1]) for seed in range(2)) > 0.05


def test_pulls_act_in_the_robot_s_own_heading_for_as_long_as_was_drawn():
    pull = Force(direction="left", newtons=(30.0, 40.0), begin=(0.5, 0.6), seconds=(0.2, 0.3), every=1.0)
    pulled = scenario(replace(STAND, seconds=2.5), forces=(pull,), start=Start(yaw=math.pi / 2, spread=(0.0, 0.0, 0.0)))
    [trial], forces = play(pulled)
    assert len(trial.pulls) == 2 and trial.pulls == draws(pulled, 0)[1]
    for pull in trial.pulls:
        assert 30.0 <= pull.newtons <= 40.0 and 0.2 <= pull.seconds <= 0.3
        acting = [f for f in forces if abs(float(f.norm()) - pull.newtons) < 1e-6]
        assert len(acting) * 0.01 == pytest.approx(pull.seconds, abs=0.021)
        # left of a robot that looks along +y is -x
        assert torch.allclose(acting[0], torch.tensor([[-pull.newtons, 0.0, 0.0]], dtype=torch.float64), atol=1e-6)
    assert {p.newtons for p in draws(pulled, 1)[1]}.isdisjoint(p.newtons for p in trial.pulls)


def test_sides_of_pulls_are_drawn():
    pull = Force(direction="side", newtons=(1.0, 1.0), begin=(0.0, 0.0), seconds=(0.1, 0.1))
    sides = [draws(scenario(STAND, forces=(pull,)), seed)[1][0].direction for seed in range(50)]
    assert 15 < sides.count((0.0, 1.0)) < 35 and set(sides) == {(0.0, 1.0), (0.0, -1.0)}


def test_lying_on_the_ground_is_a_fall_unless_it_is_allowed():
    def lies(allowed: bool) -> str:
        class Lying(FakeBackend):
            @property
            def state(self):
                state = super().state
                state.trunk_contact_force_w[:] = 50.0
                return state

        trial = scenario(replace(STAND, seconds=1.0), failure=Failure(lying=False if allowed else 0.5))
        make = lambda name, scene, **_: Lying(scene)  # noqa: E731
        with patch.object(running, "make_backend", make):
            return run_scenario(ScriptedPolicy(), GO2, trial, [0])[0].outcome

    assert (lies(False), lies(True)) == ("fell", "success")


def test_wilson_interval():
    # 18 of 20, by hand: centre (0.9 + 0.09604) / 1.19207, reach 1.64420 sqrt(0.0045 + 0.0024010)
    assert wilson_interval(0.9, 20) == pytest.approx((0.6990, 0.9721), abs=1e-4)
    assert wilson_interval(0.0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)


def test_what_happens_to_a_robot_depends_on_neither_the_others_nor_threads():
    policy = load_policy("pretrained")
    pull = Force(direction="side", newtons=(100.0, 150.0), begin=(0.1, 0.2), seconds=(0.2, 0.3))
    ground = Ground(begin=0.3, stretches=(Stretch(length=3.0, rise=0.5, steps=5),))
    trial = scenario(
        replace(STAND, seconds=0.1),
        replace(AHEAD, seconds=0.4),
        forces=(pull,),
        ground=ground,
        start=Start(),
        suite="gaitgauge-1",
    )

    def paths(seeds: range, threads: int = 1) -> np.ndarray:
        """Where the robots' bases were after every step, (robots, steps, 3)."""
        rows: list[np.ndarray] = []
        run_scenario(
            policy, GO2, trial, seeds, threads=threads, watch=lambda s, _: rows.append(s.base_position_w.numpy().copy())
        )
        return np.stack(rows, axis=1)

    # torch works on up to sixteen at a time, and on those that are left over in another way
    together = paths(range(16), threads=2)
    apart = np.concatenate([paths(range(6)), paths(range(6, 11)), paths(range(11, 15)), paths(range(15, 16))])
    assert np.array_equal(together, apart)
    assert len({row[-1].tobytes() for row in together}) == 16


def test_a_policy_of_another_control_period_is_refused():
    policy = ScriptedPolicy()
    policy.contract = replace(policy.contract, control_period=0.01)
    with pytest.raises(SuiteError, match=r"made for a control period of 0\.01 s, suite 'coarse' runs 0\.02 s"):
        play(scenario(STAND), policy)


def test_a_control_period_above_that_of_means_is_refused(tmp_path):
    path = tmp_path / "slow.toml"
    path.write_text(
        'extends = "gaitgauge-1"\nname = "slow"\n[physics]\ntimestep = 0.01\nsubsteps = 30\n'
        "[metrics]\ninterval = 30\n[noise]\nlatency = 0\n"
    )
    policy = ScriptedPolicy()
    policy.contract = replace(policy.contract, control_period=0.3)
    with pytest.raises(SuiteError, match=r"control period is 0\.3 s, and what is noted here every 0\.1 s needs one"):
        play(scenario(STAND, suite=str(path)), policy)


class Watched(FakeBackend):
    """Keeps friction and first joint target of all worlds after each step."""

    def __init__(self, scene):
        super().__init__(scene)
        self.friction, self.acting, self.delays = [], [], []

    def step(self, *arguments, **options):
        super().step(*arguments, **options)
        self.delays.append(options["delay"])
        self.friction.append(self.randomized.friction.clone())
        self.acting.append(self.targets[:, 0].clone())

    def play(self, policy, *trials):
        def make(scene):
            self.__init__(scene)
            return self

        return run_each(policy, GO2, [(trial, 0) for trial in trials], backend=make)


def test_patches_change_the_friction_for_their_time_and_payloads_shift_the_mass():
    patch_ = Patch(begin=0.1, seconds=0.06, friction=0.2)
    load = Payload(kilograms=2.0, place=(0.1, 0.0, -0.05))
    slipping = scenario(replace(STAND, seconds=0.3), patches=(patch_,))
    worlds = Watched.__new__(Watched)
    worlds.play(ScriptedPolicy(), slipping, scenario(replace(STAND, seconds=0.3), payload=load))
    assert [f[0].item() for f in worlds.friction[:10]] == [0.6] * 5 + [0.2] * 3 + [0.6] * 2
    assert {f[1].item() for f in worlds.friction} == {0.6}
    assert worlds.randomized.base_mass_offset.tolist() == [0.0, 2.0]
    share = 2.0 / (2.0 + base_mass(GO2))
    assert worlds.randomized.base_com_offset[1].tolist() == pytest.approx([0.1 * share, 0.0, -0.05 * share])


def test_a_latency_of_more_than_a_control_period_delays_every_target():
    """Actions count the steps; with two substeps a period, 50 ms are five substeps: two periods and one substep."""
    steps = iter(range(1, 100))
    policy = ScriptedPolicy(lambda observation: torch.full((len(observation), 12), float(next(steps))))
    still = replace(STAND, seconds=0.2)
    worlds = Watched.__new__(Watched)
    worlds.play(policy, scenario(still, latency=0.05), scenario(still, latency=0.0))
    late, prompt = (torch.stack(worlds.acting)[:, i].numpy() for i in range(2))
    # the policy is asked for one robot after the other: the second one's actions are one count, 0.25 rad, ahead
    assert late[2:] + 0.25 == pytest.approx(prompt[:-2]) and np.ptp(late[:2]) == 0.0
    assert np.diff(prompt) == pytest.approx(0.5)
    assert all(delay.tolist() == [1, 0] for delay in worlds.delays)


def test_scenarios_side_by_side_have_the_outcomes_that_they_have_alone():
    policy = load_policy("pretrained")
    common = {"suite": "gaitgauge-1", "start": Start()}
    slow = scenario(replace(AHEAD, seconds=0.3), payload=Payload(kilograms=3.0), latency=0.03, **common)
    steps = Ground(begin=0.3, stretches=(Stretch(length=3.0, rise=0.5, steps=5),))
    fast = scenario(replace(STAND, seconds=0.1), replace(AHEAD, seconds=0.4), ground=steps, **common)
    pull = Force(direction="side", newtons=(100.0, 150.0), begin=(0.1, 0.2), seconds=(0.2, 0.3))
    pulled = scenario(replace(AHEAD, seconds=0.4, steer=True), forces=(pull,), **common)
    each = [(slow, 0), (fast, 3), (pulled, 1)]
    assert run_each(policy, GO2, each) == [run_scenario(policy, GO2, s, [seed])[0] for s, seed in each]


def test_scenarios_of_two_suites_are_not_played_side_by_side():
    pair = [(scenario(STAND), 0), (scenario(STAND, suite="gaitgauge-1"), 0)]
    with pytest.raises(ScenarioError, match="'own' and 'own' differ in suite and cannot be played side by side"):
        run_each(ScriptedPolicy(), GO2, pair)
