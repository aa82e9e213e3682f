"""The conformance checks must fail engines that are wrong: MuJoCo's engine with one fault at a time."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from gaitgauge.backends import BackendError, Capability, PhysicsState, Randomization, Support
from gaitgauge.backends.conformance import Outcome, all_checks, make_bench, run_check
from gaitgauge.backends.conformance.reference import rotated
from gaitgauge.backends.mujoco import MujocoBackend

CHECKS = {check.name: check for check in all_checks()}


def altered(state, **changes):
    return PhysicsState(**{f.name: getattr(state, f.name) for f in fields(PhysicsState)} | changes)


class StateFault(MujocoBackend):
    """An engine whose state is reported wrongly."""

    @property
    def state(self):
        return self.spoil(super().state)


class QuaternionXyzw(StateFault):
    def spoil(self, state):
        return altered(state, base_quaternion_w=state.base_quaternion_w.roll(-1, dims=-1))


class AngularVelocityInWorld(StateFault):
    def spoil(self, state):
        turned = [rotated(q, v) for q, v in zip(state.base_quaternion_w, state.base_angular_velocity_b, strict=True)]
        return altered(state, base_angular_velocity_b=torch.tensor(np.array(turned)))


class VelocityOfTheCenterOfMass(StateFault):
    def spoil(self, state):
        arm = torch.tensor([0.021112, 0.0, -0.005366], dtype=torch.float64)
        swing = torch.linalg.cross(state.base_angular_velocity_b, arm.expand(len(state.time), 3))
        turned = [rotated(q, v) for q, v in zip(state.base_quaternion_w, swing, strict=True)]
        return altered(state, base_linear_velocity_w=state.base_linear_velocity_w + torch.tensor(np.array(turned)))


class FeetInAnotherOrder(StateFault):
    def spoil(self, state):
        return altered(state, foot_position_w=state.foot_position_w[:, [1, 0, 3, 2]])


class MomentAboutTheOrigin(StateFault):
    def spoil(self, state):
        about_origin = state.ground_moment_w + torch.linalg.cross(state.contact_center_w, state.ground_force_w)
        return altered(state, ground_moment_w=about_origin)


class TrunkIsWholeBase(StateFault):
    def spoil(self, state):
        return altered(state, trunk_contact_force_w=state.body_contact_force_w[:, 0])


class TrunkFeelsNothing(StateFault):
    def spoil(self, state):
        return altered(state, trunk_contact_force_w=torch.zeros_like(state.trunk_contact_force_w))


class FootForceStays(StateFault):
    """A reset leaves a force of the step before it."""

    field = "foot_contact_force_w"

    def step(self, *args, **kwargs):
        super().step(*args, **kwargs)
        self.kept = getattr(self._state, self.field).clone()

    def spoil(self, state):
        return altered(state, **{self.field: getattr(self, "kept", getattr(state, self.field))})


class TrunkForceStays(FootForceStays):
    field = "trunk_contact_force_w"


class FootForceCountedTwice(StateFault):
    def spoil(self, state):
        bodies = state.body_contact_force_w.clone()
        bodies[:, [3, 6, 9, 12]] += state.foot_contact_force_w
        return altered(state, body_contact_force_w=bodies)


class DivergenceHidden(StateFault):
    def spoil(self, state):
        return altered(state, diverged=torch.zeros_like(state.diverged))


class LateTargets(MujocoBackend):
    def step(self, joint_targets, *, delay=None, **rest):
        later = None if delay is None else (delay + 1).clamp_max(self.scene.physics.substeps)
        super().step(joint_targets, delay=later, **rest)


class LateSample(MujocoBackend):
    def step(self, joint_targets, *, sample_at=None, **rest):
        later = None if sample_at is None else torch.where(sample_at > 0, sample_at % 10 + 1, sample_at)
        super().step(joint_targets, sample_at=later, **rest)


class StepsEverybody(MujocoBackend):
    def step(self, joint_targets, *, worlds=None, **rest):
        super().step(joint_targets, **rest)


class ResetsForceNever(MujocoBackend):
    def apply_force(self, force_w):
        self.force = force_w.clone()
        super().apply_force(force_w)

    def reset(self, *args, **kwargs):
        super().reset(*args, **kwargs)
        if hasattr(self, "force"):
            super().apply_force(self.force)


class PushesAngularVelocityInWorld(MujocoBackend):
    def push(self, worlds=None, *, linear_velocity_w=None, angular_velocity_b=None):
        if angular_velocity_b is not None:
            q = self.state.base_quaternion_w
            filled = torch.where(angular_velocity_b.isnan(), self.state.base_angular_velocity_b, angular_velocity_b)
            back = q * torch.tensor([1, -1, -1, -1])
            angular_velocity_b = torch.tensor(np.array([rotated(a, v) for a, v in zip(back, filled, strict=True)]))
        super().push(worlds, linear_velocity_w=linear_velocity_w, angular_velocity_b=angular_velocity_b)


class RandomizationFault(MujocoBackend):
    """An engine that misunderstands randomization."""

    def randomize(self, randomization, worlds=None):
        super().randomize(self.spoil(randomization), worlds)


class FrictionNeverAboveItsOwn(RandomizationFault):
    def spoil(self, randomization):
        friction = randomization.friction
        return randomization if friction is None else replace(randomization, friction=friction.clamp_max(0.4))


class FrictionOfTheFirstWorld(RandomizationFault):
    def spoil(self, randomization):
        friction = randomization.friction
        return randomization if friction is None else replace(randomization, friction=friction[:1].expand_as(friction))


class FeetOfTheFirstWorld(RandomizationFault):
    def spoil(self, randomization):
        torsion = randomization.foot_torsion
        return randomization if torsion is None else replace(randomization, foot_torsion=torsion[:1].expand_as(torsion))


class SoftnessIgnored(RandomizationFault):
    def spoil(self, randomization):
        return replace(randomization, foot_softness=None)


class CenterOfMassMirrored(RandomizationFault):
    def spoil(self, randomization):
        shift = randomization.base_com_offset
        mirror = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
        return randomization if shift is None else replace(randomization, base_com_offset=shift * mirror)


class MassesIgnored(RandomizationFault):
    def spoil(self, randomization):
        return replace(randomization, base_mass_offset=None, link_mass_scale=None)


class ForgetsAtReset(MujocoBackend):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.built = True

    def reset(self, *args, **kwargs):
        if hasattr(self, "built"):
            self.randomize(Randomization(base_mass_offset=torch.zeros(self.num_worlds)))
        super().reset(*args, **kwargs)


class SceneFault(MujocoBackend):
    """An engine that builds another scene than it was asked for."""

    def __init__(self, scene, **rest):
        super().__init__(self.spoil(scene), **rest)


class SpeedIgnored(SceneFault):
    def spoil(self, scene):
        return replace(scene, physics=replace(scene.physics, torque_speed_limit=False))


class BrakesAsItDrives(SceneFault):
    def spoil(self, scene):
        driving = scene.parameters.driving_torque_limit
        return replace(scene, parameters=replace(scene.parameters, torque_limit=driving))


class MotorSpeedIgnored(RandomizationFault):
    def spoil(self, randomization):
        return replace(randomization, motor_speed=None)


class SpeedOfThePeriod(MujocoBackend):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.begin, self._limits = None, replace(self._limits)
        bounds = self._limits.bounds
        object.__setattr__(self._limits, "bounds", lambda velocity: bounds(self.begin))

    def step(self, *args, **kwargs):
        self.begin = self.state.joint_velocity.numpy().copy()
        super().step(*args, **kwargs)


class KickingContacts(SceneFault):
    """MuJoCo as it was trained on: a stiff cone, and too few iterations for it."""

    def spoil(self, scene):
        return replace(scene, physics=replace(scene.physics, impratio=100.0))


class TooFewIterations(SceneFault):
    def spoil(self, scene):
        return replace(scene, physics=replace(scene.physics, iterations=3))


class LegsPass(SceneFault):
    def spoil(self, scene):
        return replace(scene, physics=replace(scene.physics, self_collision=False))


class CondimIgnored(SceneFault):
    def spoil(self, scene):
        return replace(scene, physics=replace(scene.physics, foot_condim=None))


class CondimNeverAboveThree(SceneFault):
    def spoil(self, scene):
        return replace(scene, physics=replace(scene.physics, foot_condim=3))


class SwallowsRequests(MujocoBackend):
    @classmethod
    def capabilities(cls):
        nothing = Capability(support=Support.NONE)
        return {**super().capabilities(), "external_force": nothing, "boxes": nothing, "motor_offset": nothing}


class OneRowForAll(MujocoBackend):
    def apply_force(self, force_w):
        super().apply_force(force_w.expand(self.num_worlds, 3))


class LastTerrainFirst(MujocoBackend):
    def reset(self, start, worlds=None):
        index = start.terrain_index
        wrapped = None if index is None else index % len(self.scene.terrains)
        super().reset(replace(start, terrain_index=wrapped), worlds)


class ErrorsOfItsOwn(MujocoBackend):
    def step(self, joint_targets, *, substeps=None, **rest):
        if substeps == 0:
            raise ValueError("nstep must be > 0")
        super().step(joint_targets, substeps=substeps, **rest)


class RefusesTooLate(MujocoBackend):
    def step(self, joint_targets, *, delay=None, **rest):
        super().step(joint_targets, **rest)
        if delay is not None:
            super().step(None, delay=delay, **rest)


class OverPromises(MujocoBackend):
    def apply_force(self, force_w):
        raise BackendError("external forces are not there in this engine; leave them out of the task")


FAULTS = [
    (TrunkForceStays, "state/fields"),
    (FootForceStays, "state/fields"),
    (QuaternionXyzw, "reset/state"),
    (AngularVelocityInWorld, "reset/state"),
    (AngularVelocityInWorld, "kinematics/frames"),
    (VelocityOfTheCenterOfMass, "kinematics/frames"),
    (FeetInAnotherOrder, "kinematics/feet"),
    (MomentAboutTheOrigin, "contact/moment"),
    (FootForceCountedTwice, "contact/feet"),
    (KickingContacts, "contact/training"),
    pytest.param(TooFewIterations, "contact/training", marks=pytest.mark.slow),
    (LegsPass, "contact/legs"),
    (CondimIgnored, "contact/torsion"),
    (CondimNeverAboveThree, "contact/torsion"),
    (FeetOfTheFirstWorld, "contact/foot_change"),
    (SoftnessIgnored, "contact/foot_change"),
    (DivergenceHidden, "health/divergence"),
    (LateTargets, "motors/latency"),
    (SpeedIgnored, "motors/speed_limit"),
    (BrakesAsItDrives, "motors/speed_limit"),
    (SpeedOfThePeriod, "motors/speed_limit"),
    (MotorSpeedIgnored, "motors/speed"),
    (LateSample, "stepping/sample_at"),
    (StepsEverybody, "stepping/mask"),
    (ResetsForceNever, "disturbance/force_reset"),
    (PushesAngularVelocityInWorld, "disturbance/push"),
    (FrictionNeverAboveItsOwn, "friction/incline"),
    (FrictionNeverAboveItsOwn, "friction/bodies"),
    (FrictionOfTheFirstWorld, "friction/braking"),
    (TrunkIsWholeBase, "contact/trunk"),
    (TrunkFeelsNothing, "contact/trunk"),
    (CenterOfMassMirrored, "model/base_com"),
    (CenterOfMassMirrored, "model/base_com_motion"),
    (MassesIgnored, "model/base_mass"),
    (MassesIgnored, "model/base_mass_motion"),
    (MassesIgnored, "model/link_mass_motion"),
    (MassesIgnored, "model/link_mass"),
    (ForgetsAtReset, "model/persistence"),
    (SwallowsRequests, "refusal/external_force"),
    (SwallowsRequests, "refusal/boxes"),
    (SwallowsRequests, "refusal/motor_offset"),
    (OverPromises, "refusal/external_force"),
    (OneRowForAll, "refusal/arguments"),
    (LastTerrainFirst, "refusal/arguments"),
    (ErrorsOfItsOwn, "refusal/arguments"),
    (RefusesTooLate, "refusal/arguments"),
]


@pytest.mark.parametrize(("engine", "check"), FAULTS, ids=lambda v: v if isinstance(v, str) else v.__name__)
def test_fault_is_caught(engine, check):
    result = run_check(CHECKS[check], make_bench(engine))
    assert result.outcome is Outcome.FAILED
    # by the comparison, not by the fault breaking the check itself
    assert "Error: " not in result.detail


def test_what_an_engine_cannot_do_is_neither_passed_nor_failed():
    result = run_check(CHECKS["disturbance/force"], make_bench(SwallowsRequests))
    assert result.outcome is Outcome.NOT_SUPPORTED
    assert "external_force" in result.detail
