"""What a model's motors are taken for where nobody has described them."""

import mujoco
import pytest
from gaitgauge.robots.describing.motor_guess import guess_motors
from gaitgauge.robots.describing.surveying import Survey
from unseen_robot import LEGS, write_unseen


@pytest.mark.parametrize("gear", [1.0, 3.0, -3.0])
def test_a_servo_s_gains_are_those_of_its_joint(tmp_path, gear):
    """Behind a gear of 3 a servo sees three times the angle, and its torque counts three times: 20 N·m/rad become 180."""
    mjcf = write_unseen(tmp_path)
    servos = "".join(
        f'<position joint="{kind}.{leg[0]}" kp="20" kv="0.5" gear="{gear:g}" forcerange="-8 8"/>'
        for leg in LEGS
        for kind in ("spread", "swing", "bend")
    )
    mjcf.write_text(mjcf.read_text().replace("</mujoco>", f"<actuator>{servos}</actuator></mujoco>"))
    spec = mujoco.MjSpec.from_file(str(mjcf))
    model = spec.compile()
    survey = Survey(mjcf, spec, model)
    drafted = guess_motors(survey, survey.hinges, 0.5, model)
    assert drafted["stiffness"][0] == pytest.approx([20.0 * gear**2] * 12)
    assert drafted["damping"][0] == pytest.approx([0.5 * gear**2] * 12)
    assert drafted["torque_limit"][0] == pytest.approx([8.0 * abs(gear)] * 12)
