"""What Newton's importer made of a robot, held against MuJoCo's compiler."""

import mujoco
import numpy as np


def body(inertia: str, quaternion: str = "1 0 0 0") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody><body><freejoint/><geom size="0.1"/>
        <inertial pos="0 0 0" mass="2" diaginertia="{inertia}" quat="{quaternion}"/></body></worldbody></mujoco>"""
    )


def test_principal_axes_may_be_named_in_another_order():
    """A cyclic change of the axes, as in ANYmal C's base: the same body, though the three numbers stand elsewhere."""
    from gaitgauge.backends.newton.import_check import import_differences  # takes seconds

    assert import_differences(body("0.03 0.01 0.02"), body("0.01 0.02 0.03", "0.5 0.5 0.5 0.5"), np.arange(1)) == []


def test_another_inertia_is_said():
    from gaitgauge.backends.newton.import_check import import_differences

    (sentence,) = import_differences(body("0.01 0.02 0.025"), body("0.01 0.02 0.03"), np.arange(1))
    assert sentence == "body_inertia is off by 0.005"
