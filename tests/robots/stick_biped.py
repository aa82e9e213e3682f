"""A biped as a newcomer writes it, with arms on a waist if asked for: boxes and sticks, soles of four balls."""

from pathlib import Path

THIGH, SHANK, SOLE, HIP = 0.3, 0.28, 0.05, 0.1
"""Lengths of thigh and shank, height of the ankle above the ground, and half the distance of the hips [m]."""
MASS = 8.0 + 2 * (3 * 0.5 + 1.5 + 1.0 + 0.6)
ARMS_MASS = 0.1 + 2 * (0.1 + 0.5 + 0.4 + 0.1)
"""Masses without arms, and of arms and head [kg]."""


def _leg(side: str, left: int) -> str:
    balls = "".join(
        f'<geom type="sphere" size="0.01" pos="{x} {y} {0.01 - SOLE}" mass="0.05"/>'
        for x in (-0.06, 0.12)
        for y in (-0.04, 0.04)
    )
    return f"""
      <body name="{side}_a" pos="0 {HIP * left} -0.05"><joint name="{side}_a" axis="0 0 1" range="-1 1"/>
        <inertial mass="0.5" pos="0 0 0" diaginertia="0.001 0.001 0.001"/>
        <body name="{side}_b"><joint name="{side}_b" axis="1 0 0" range="-0.5 0.5"/>
          <inertial mass="0.5" pos="0 0 0" diaginertia="0.001 0.001 0.001"/>
          <body name="{side}_c"><joint name="{side}_c" axis="0 1 0" range="-1.5 1.5"/>
            <geom type="capsule" fromto="0 0 -0.05 0 0 {0.05 - THIGH}" size="0.04" mass="2"/>
            <body name="{side}_d" pos="0 0 {-THIGH}"><joint name="{side}_d" axis="0 1 0" range="0 2.4"/>
              <geom type="capsule" fromto="0 0 -0.05 0 0 {0.08 - SHANK}" size="0.03" mass="1"/>
              <body name="{side}_e" pos="0 0 {-SHANK}"><joint name="{side}_e" axis="0 1 0" range="-0.9 0.6"/>
                <inertial mass="0.1" pos="0 0 0" diaginertia="0.0005 0.0005 0.0005"/>
                <body name="{side}_f"><joint name="{side}_f" axis="1 0 0" range="-0.3 0.3"/>
                  <geom type="box" pos="0.03 0 {0.02 - SOLE}" size="0.08 0.03 0.008" mass="0.3" contype="0" conaffinity="0"/>
                  {balls}
                </body>
              </body>
            </body>
          </body>
        </body>
      </body>"""


def _arm(side: str, left: int) -> str:
    return f"""
        <body name="{side}_g" pos="0 {0.18 * left} 0.3"><joint name="{side}_g" axis="0 1 0" range="-2 2"/>
          <inertial mass="0.1" pos="0 0 0" diaginertia="0.0005 0.0005 0.0005"/>
          <body name="{side}_h"><joint name="{side}_h" axis="1 0 0" range="-2 2"/>
            <geom type="capsule" fromto="0 0 -0.03 0 0 -0.17" size="0.03" mass="0.5"/>
            <body name="{side}_i" pos="0 0 -0.2"><joint name="{side}_i" axis="0 1 0" range="-2 0.1"/>
              <geom type="capsule" fromto="0 0 -0.03 0 0 -0.17" size="0.025" mass="0.4"/>
              <body name="{side}_j" pos="0 0 -0.2"><joint name="{side}_j" axis="0 0 1" range="-2 2"/>
                <geom type="sphere" size="0.03" mass="0.1"/>
              </body>
            </body>
          </body>
        </body>"""


def write_biped(folder: Path, *, arms: bool = False, default: str = "", more: str = "") -> Path:
    """Write the model."""
    trunk = '<geom type="box" pos="0 0 0.2" size="0.07 0.1 0.15" mass="4"/>'
    upper = (
        f'<body name="torso" pos="0 0 0.05"><joint name="turn" axis="0 0 1" range="-1 1"/>{trunk}'
        f'<body name="face" pos="0 0 0.4"><joint name="nod" axis="0 1 0" range="-1 1"/>'
        f'<geom type="sphere" size="0.06" mass="0.1"/></body>{_arm("l", 1)}{_arm("r", -1)}</body>'
        if arms
        else trunk
    )
    path = folder / "stickman.xml"
    path.write_text(
        f"""<mujoco model="stickman">
  <compiler angle="radian" autolimits="true"/>
  {default}
  <worldbody>
    <body name="pelvis">
      <freejoint/>
      <geom name="pelvis_box" type="box" size="0.07 0.1 0.05" mass="4"/>
      {upper}{_leg("l", 1)}{_leg("r", -1)}
    </body>
  </worldbody>
  {more}
</mujoco>
"""
    )
    return path
