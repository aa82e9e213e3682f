"""Training beside a measured robot: which constants the ranges of randomization miss, and offsets around the measured ones."""

import torch
from gaitgauge.robots import JointParameters
from gaitgauge.training.environment.configuration import RandomizationConfiguration
from gaitgauge.training.environment.domain_randomization import MotorParameters, outside


def test_measured_constants_outside_of_the_ranges_are_named():
    ranges = RandomizationConfiguration()
    joints = ("FL_hip_joint", "FL_calf_joint")
    one = (1.0, 1.0)
    measured = JointParameters(
        stiffness=one, damping=one, torque_limit=one, armature=one, joint_damping=one, friction_loss=one,
        stiffness_factor=(1.0, 0.86), damping_factor=(1.05, 0.95), target_offset=(-0.05, 0.0), delay=0.03, measured="a test",
    )  # fmt: skip
    found = outside(ranges, measured, joints)
    assert found == [
        "stiffness of FL_calf was measured outside of 0.9 to 1.1 (environment.randomization.stiffness), up to 0.86",
        "motor_offset of FL_hip was measured outside of -0.035 to 0.035 (environment.randomization.motor_offset), up to -0.05",
        "delay of all joints was measured outside of 0 to 0.02 (environment.randomization.delay), up to 0.03",
    ]


def test_motor_offsets_are_drawn_around_the_measured_ones():
    ranges = RandomizationConfiguration(motor_offset=(-0.01, 0.01))
    motors = MotorParameters(ranges, 4, 2, "cpu", offset=(0.1, -0.2))
    motors.redraw(torch.full((4, 10), 0.5), torch.ones(4, dtype=torch.bool))
    torch.testing.assert_close(motors.by_name()["motor_offset"], torch.tensor([[0.1, -0.2]]).expand(4, 2))
