"""A quadruped that the project has never seen: other names, another order of legs, axes that point the other way."""

from pathlib import Path

# Legs as the file has them: name, forward, left, sign of the abduction axis, of the swing axis and of the knee's.
LEGS = (
    ("hind_right", -1, -1, -1, 1, -1),
    ("fore_left", 1, 1, 1, -1, -1),
    ("fore_right", 1, -1, 1, 1, 1),
    ("hind_left", -1, 1, -1, -1, 1),
)
UPPER, LOWER, MASS = 0.25, 0.25, 22.0
"""Lengths of the links [m] and mass [kg]."""


def _leg(name: str, forward: int, left: int, spread: int, swing: int, bend: int) -> str:
    # the knee of a hind leg bends backwards, that of a fore leg forwards, whatever the sign of its axis
    low, high = (0.3, 2.6) if bend * forward > 0 else (-2.6, -0.3)
    return f"""
      <body name="coxa.{name}" pos="{0.25 * forward} {0.08 * left} 0">
        <joint name="spread.{name}" axis="{spread} 0 0" range="-0.8 0.8" limited="true"/>
        <geom type="sphere" size="0.05" mass="0.6" contype="0" conaffinity="0"/>
        <body name="femur.{name}" pos="0 {0.07 * left} 0">
          <joint name="swing.{name}" axis="0 {swing} 0" range="-2 2" limited="true"/>
          <geom type="capsule" fromto="0 0 0 0 0 {-UPPER}" size="0.025" mass="1.0"/>
          <body name="tibia.{name}" pos="0 0 {-UPPER}">
            <joint name="bend.{name}" axis="0 {bend} 0" range="{low} {high}" limited="true"/>
            <geom type="capsule" fromto="0 0 0 0 0 {-LOWER}" size="0.02" mass="0.4"/>
            <geom name="sole of {name}" type="sphere" size="0.03" pos="0 0 {-LOWER}" mass="0.05"/>
          </body>
        </body>
      </body>"""


def write_unseen(folder: Path) -> Path:
    """Write the model, without motors, sites or explicit inertias."""
    trunk = MASS - 4 * 2.05
    path = folder / "unseen.xml"
    path.write_text(
        f"""<mujoco model="unseen">
  <compiler angle="radian"/>
  <worldbody>
    <body name="corpus" pos="0 0 1">
      <freejoint/>
      <geom name="shell" type="box" size="0.3 0.1 0.06" mass="{trunk}"/>
      {"".join(_leg(*leg) for leg in LEGS)}
    </body>
  </worldbody>
</mujoco>
"""
    )
    return path
