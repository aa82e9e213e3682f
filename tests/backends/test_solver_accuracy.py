"""mujoco_warp's solver against float64, as ``benchmarks/solver_accuracy.py`` measures it."""

import mujoco
import numpy as np
import pytest
import solver_accuracy as accuracy


def test_the_float64_solution_is_mujocos():
    """A box that slides on one corner, with dry friction on a hinge: MuJoCo's own accelerations."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option cone="elliptic" impratio="10" tolerance="0" iterations="200" jacobian="dense"/><worldbody>'
        '<geom type="plane" size="1 1 1"/><body pos="0 0 0.099"><freejoint/><geom type="sphere" size="0.1" condim="6"/>'
        '<body pos="0 0 0.1"><joint axis="0 1 0" frictionloss="0.05"/><geom type="capsule" size="0.02 0.1" pos="0.1 0 0" '
        'contype="0" conaffinity="0"/></body></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    data.qvel[:] = (0.5, 0.1, -0.2, 0.3, 0.0, 0.0, 0.4)
    mujoco.mj_forward(model, data)
    assert data.ncon == 1
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    dry = np.full(data.nefc, np.nan)
    dry[data.efc_type == mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF] = 0.05
    contact = data.contact[0]
    rows = contact.efc_address + np.arange(contact.dim)
    problem = accuracy.Problem(
        mass=mass,
        smooth=data.qfrc_smooth.copy(),
        jacobian=data.efc_J.reshape(data.nefc, model.nv).copy(),
        reference=data.efc_aref.copy(),
        stiffness=data.efc_D.copy(),
        dry=dry,
        cones=[(rows, contact.friction[: contact.dim - 1].copy(), float(contact.friction[0] / np.sqrt(10.0)))],
    )
    np.testing.assert_allclose(problem.solve(np.zeros(model.nv)), data.qacc, atol=1e-6 * np.abs(data.qacc).max())


@pytest.mark.slow
def test_single_precision_comes_near_with_few_iterations(capsys):
    accuracy.main(["--worlds", "16", "--states", "2", "--walk", "15"])
    table = [line.split() for line in capsys.readouterr().out.splitlines()]
    rows = {(int(r[0]), float(r[1])): [float(v) for v in r[2:]] for r in table if len(r) == 11}
    assert set(rows) == set(accuracy.SETTINGS)
    for setting in ((100, 1e-6), (20, 1e-6)):
        base, joints, most = rows[setting][1], rows[setting][4], rows[setting][8]
        assert base < 1e-5
        assert joints < 5e-4
        assert most < 20, "a limit of 20 iterations would have acted"
    assert rows[100, 1e-3][1] > rows[100, 1e-6][1]
