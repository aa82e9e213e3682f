"""A robot of one leg, as a user describes it."""

HOPPER_MJCF = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="trunk">
      <freejoint/>
      <geom name="chest" type="box" size="0.1 0.1 0.05" mass="3"/>
      <site name="imu"/>
      <body name="upper" pos="0 0 -0.05">
        <joint name="hip" axis="0 1 0" range="-1 1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.5"/>
        <body name="lower" pos="0 0 -0.2">
          <joint name="left_knee_joint" axis="0 1 0" range="-2 0"/>
          <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.015" mass="0.3"/>
          <geom name="foot" type="sphere" size="0.02" pos="0 0 -0.2"/>
          <site name="foot" pos="0 0 -0.2"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="hip"/>
    <position joint="left_knee_joint"/>
  </actuator>
</mujoco>
"""


HOPPER = """
name = "hopper"
title = "One leg"
mjcf = "model/hopper.xml"
joint_names = ["hip", "left_knee_joint"]
default_joint_position = [0.3, -0.6]
base_body = "trunk"
foot_names = ["foot"]
collision_bodies = ["trunk", "upper", "lower"]
trunk_shapes = ["chest"]
imu_site = "imu"
stand_height = 0.5
command_limits = [0.5, 0, 1]
default_parameters = "soft"

[parameters.soft]
stiffness = 30
damping = { hip = 1.0, knee = 2.0 }
torque_limit = [40, 50]
armature = 0.01
joint_damping = 0
friction_loss = 0.1
"""
