"""A quadruped as a newcomer writes it: a box for the trunk, four legs of two sticks each, nothing for feet, nothing of motors."""

from pathlib import Path

LINK, RADIUS, MASS = 0.2, 0.02, 7.3
"""Length of a thigh and of a shank [m], half their width [m], and mass [kg]."""
SHANKS = {
    "capsule": f'<geom type="capsule" fromto="0 0 0 0 0 {-LINK}" size="{RADIUS}" mass="0.2"/>',
    "cylinder": f'<geom type="cylinder" fromto="0 0 0 0 0 {-LINK}" size="{RADIUS}" mass="0.2"/>',
    "ellipsoid": f'<geom type="ellipsoid" pos="0 0 {-LINK / 2}" size="{RADIUS} {RADIUS / 2} {LINK / 2}" mass="0.2"/>',
    "box": f'<geom type="box" pos="0 0 {-LINK / 2}" size="{RADIUS} {RADIUS} {LINK / 2}" mass="0.2"/>',
    "mesh": '<geom type="mesh" mesh="cone" mass="0.2"/>',
}
"""Shapes of a shank that hangs from its knee."""
PLATE = f'<geom type="box" pos="0 0 {-LINK}" size="0.08 0.03 0.01" mass="0.05"/>'
"""A flat foot, long across its shank."""
_CONE = (
    '<asset><mesh name="cone" vertex="0.05 0.05 0 -0.05 0.05 0 -0.05 -0.05 0 0.05 -0.05 0 '
    f'0.01 0.01 {-LINK} -0.01 0.01 {-LINK} -0.01 -0.01 {-LINK} 0.01 -0.01 {-LINK}"/></asset>'
)


def _leg(name: str, forward: int, left: int, shank: str) -> str:
    return f"""
      <body name="{name}_hip" pos="{0.18 * forward} {0.06 * left} 0">
        <joint name="{name}_abduction" axis="1 0 0" range="-0.8 0.8"/>
        <geom type="sphere" size="0.03" mass="0.3" contype="0" conaffinity="0"/>
        <body name="{name}_thigh" pos="0 {0.04 * left} 0">
          <joint name="{name}_swing" axis="0 1 0" range="-1.5 2.5"/>
          <geom type="capsule" fromto="0 0 0 0 0 {-LINK}" size="{RADIUS}" mass="0.4"/>
          <body name="{name}_shank" pos="0 0 {-LINK}">
            <joint name="{name}_knee" axis="0 1 0" range="-2.6 -0.2"/>
            {shank}
          </body>
        </body>
      </body>"""


def write_stick(folder: Path, shank: str = SHANKS["capsule"], *, default: str = "") -> Path:
    """Write the model."""
    legs = (("fl", 1, 1), ("fr", 1, -1), ("rl", -1, 1), ("rr", -1, -1))
    path = folder / "stick.xml"
    path.write_text(
        f"""<mujoco model="stick">
  <compiler angle="radian" autolimits="true"/>
  {default}
  {_CONE if "cone" in shank else ""}
  <worldbody>
    <body name="trunk">
      <freejoint/>
      <geom type="box" size="0.2 0.08 0.05" mass="{MASS - 4 * 0.9:g}"/>
      {"".join(_leg(*leg, shank) for leg in legs)}
    </body>
  </worldbody>
</mujoco>
"""
    )
    return path
