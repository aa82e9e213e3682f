"""The solver in one kernel against mujoco_warp's own, and against MuJoCo in double precision."""

import mujoco
import mujoco_warp
import numpy as np
import pytest
import torch
import warp as wp
from gaitgauge.backends import ResetState
from gaitgauge.backends.mujoco_warp import MujocoWarpBackend
from gaitgauge.backends.upstream.fused_solver import solve as fused
from mujoco_warp._src import solver
from mujoco_warp_scenes import BOXES, FINE, FLAT, TRAINING, scene, upright

FEW, MANY = 3, 30
"""Spheres under the body: contacts with four rows each, of which 44 rows are copied into shared memory."""
MOST_ROWS = 256
"""One number for all, so that few kernels are compiled."""
NO_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
DEVICES = ("cpu", pytest.param("cuda:0", marks=[pytest.mark.gpu, NO_GPU]))


def model_of(spheres, *, options="", extra="", joints=4, condim=3):
    """A body on spheres that lie on the ground in a ring, with a chain of hinges on top: dry friction and a limit that is violated."""
    angles = 2.0 * np.pi * np.arange(spheres) / spheres
    ball = f'<geom type="sphere" size="0.02" condim="{condim}" friction="0.5 0.02 0.01"'
    geoms = "".join(f'{ball} pos="{0.3 * np.cos(a):.4f} {0.2 * np.sin(a):.4f} -0.05"/>' for a in angles)
    chain = "".join(
        f'<body pos="0.1 0 0.05"><joint name="j{i}" axis="0 {1 - i % 2} {i % 2}" frictionloss="{0.1 * (i % 3)}" limited="true" '
        f'range="{-1 if i else 0.1} 1"/><geom type="capsule" size="0.01 0.04" mass="0.2" contype="0" conaffinity="0"/>'
        for i in range(joints)
    )
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="0.005" iterations="50" {options}/><worldbody>'
        f'<geom name="floor" type="plane" size="1 1 1" condim="1"/><body pos="0 0 0.069"><freejoint/><geom type="box" size="0.2 0.1 0.02"/>'
        f"{geoms}{chain}{'</body>' * joints}</body></worldbody>{extra}</mujoco>"
    )


def velocities(model, worlds):
    """Some slide, some press, some slip in their joints."""
    return np.random.default_rng(7).normal(scale=0.6, size=(worlds, model.nv))


def moving(model, worlds=16):
    """mujoco_warp's model, and data of worlds that move."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    m = mujoco_warp.put_model(model)
    m.opt.warn_overflow = 0
    d = mujoco_warp.put_data(model, data, nworld=worlds, njmax=MOST_ROWS, nconmax=64)
    d.qvel.assign(velocities(model, worlds).astype(np.float32))
    return m, d


def rows_in_order(types, numbers, geoms):
    """Indices that order each world's rows by kind and by joint or geom: on a GPU contacts take their places as its threads arrive."""
    of_contact = types >= int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)
    owners = np.where(of_contact, geoms.max(axis=1)[np.where(of_contact, numbers, 0)], numbers)
    return np.stack([np.lexsort((owner, kind)) for owner, kind in zip(owners, types, strict=True)])


def test_rows_do_not_depend_on_the_order_of_contacts():
    kinds = mujoco.mjtConstraint
    friction, contact = int(kinds.mjCNSTR_FRICTION_DOF), int(kinds.mjCNSTR_CONTACT_ELLIPTIC)
    types = np.array([[friction, friction, contact, contact, contact, contact]] * 2)
    geoms = np.array([[0, 7], [0, 5], [0, 5], [0, 7]])  # the second world found them the other way round
    numbers = np.array([[6, 7, 0, 0, 1, 1], [7, 6, 2, 2, 3, 3]])
    assert rows_in_order(types, numbers, geoms).tolist() == [[0, 1, 4, 5, 2, 3], [1, 0, 2, 3, 4, 5]]


def solved(model, function, *, device="cpu", monkeypatch=None):
    """Accelerations, constraint forces by degree of freedom and row, states, and iterations."""
    with wp.ScopedDevice(device):
        m, d = moving(model)
        monkeypatch.setattr(solver, "solve", function)
        mujoco_warp.forward(m, d)
        count = int(d.nefc.numpy()[0])
        order = rows_in_order(*(a.numpy()[:, :count] for a in (d.efc.type, d.efc.id)), d.contact.geom.numpy())
        return {
            "acceleration": d.qacc.numpy(),
            "joint force": d.qfrc_constraint.numpy(),
            "row force": np.take_along_axis(d.efc.force.numpy()[:, :count], order, axis=1),
            "state": np.take_along_axis(d.efc.state.numpy()[:, :count], order, axis=1),
            "iterations": d.solver_niter.numpy(),
            "momentum": d.efc.Ma.numpy(),
        }


def assert_same(found, expected, tolerance=1e-4):
    """Rows of many contacts on one plane share their forces in nearly equal ways: these are compared less strictly."""
    for name, factor in (("acceleration", 0.1), ("momentum", 0.1), ("joint force", 1.0), ("row force", 30.0)):
        size = np.abs(expected[name]).max()
        np.testing.assert_allclose(found[name], expected[name], rtol=0.0, atol=factor * tolerance * size, err_msg=name)
    np.testing.assert_array_equal(found["state"], expected["state"])


CONES = [
    pytest.param('cone="pyramidal"', 3, id="pyramid"),
    pytest.param('cone="pyramidal"', 1, id="without friction"),
    pytest.param('cone="elliptic"', 1, id="cone without friction"),
    pytest.param('cone="elliptic"', 3, id="cone"),
    pytest.param('cone="elliptic" impratio="100"', 4, id="cone with torsion"),
    pytest.param('cone="elliptic" impratio="10"', 6, id="cone with torsion and rolling"),
]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("spheres", [FEW, MANY])
@pytest.mark.parametrize(("cone", "condim"), CONES)
def test_it_finds_what_mujoco_warp_finds(spheres, cone, condim, device, monkeypatch):
    model = model_of(spheres, options=cone, condim=condim)
    expected = solved(model, fused.plain_solve, device=device, monkeypatch=monkeypatch)
    found = solved(model, fused.solve, device=device, monkeypatch=monkeypatch)
    assert_same(found, expected)
    sliding = {4} if "elliptic" in cone and condim > 1 else set()
    assert set(np.unique(found["state"])) == {0, 1, 2, 3} | sliding, "not all kinds of rows were met"
    assert np.mean(found["iterations"] == expected["iterations"]) > 0.9
    assert found["row force"].shape[1] > (3 + 44 if spheres == MANY and condim > 1 else 0)


@pytest.mark.parametrize("spheres", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("cone", "condim"), CONES)
def test_it_is_as_near_to_double_precision_as_mujoco_warp(spheres, cone, condim, monkeypatch):
    model = model_of(spheres, options=f'tolerance="0" {cone}', condim=condim)
    found, plain = (solved(model, function, monkeypatch=monkeypatch) for function in (fused.solve, fused.plain_solve))
    exact = {"acceleration": [], "joint force": []}
    for velocity in velocities(model, 16):
        data = mujoco.MjData(model)
        data.qvel[:] = velocity
        mujoco.mj_forward(model, data)
        exact["acceleration"].append(data.qacc.copy())
        exact["joint force"].append(data.qfrc_constraint.copy())
    for name, values in exact.items():
        size = np.abs(values).max()
        off, plain_off = (np.abs(result[name] - values).max() / size for result in (found, plain))
        assert off < 1e-3
        assert off < 1.5 * plain_off + 1e-5


def test_the_minimum_has_no_gradient(monkeypatch):
    """M a - tau - J' f = 0 where it has converged; the result may not depend on where it began."""
    model = model_of(FEW)
    warm = solved(model, fused.solve, monkeypatch=monkeypatch)
    cold = solved(
        model_of(FEW, extra='<option><flag warmstart="disable"/></option>'), fused.solve, monkeypatch=monkeypatch
    )
    assert_same(warm, cold, tolerance=1e-4)
    assert not np.array_equal(warm["iterations"], cold["iterations"]), "both began at the same place"


def test_a_body_in_the_air_falls_freely(monkeypatch):
    model = model_of(FEW)
    model.qpos0[2] = 1.0
    model.dof_frictionloss[:] = 0.0
    model.jnt_limited[:] = 0
    found = solved(model, fused.solve, monkeypatch=monkeypatch)
    assert found["row force"].shape[1] == 0
    expected = solved(model, fused.plain_solve, monkeypatch=monkeypatch)
    np.testing.assert_allclose(found["acceleration"], expected["acceleration"], rtol=0.0, atol=1e-4)
    assert found["acceleration"][:, 2].mean() == pytest.approx(-9.81, abs=0.2)
    assert not found["joint force"].any()
    assert not found["iterations"].any()


@pytest.mark.parametrize(
    "model",
    [
        pytest.param(model_of(FEW, options='jacobian="sparse"'), id="sparse"),
        pytest.param(model_of(FEW, options='solver="CG"'), id="conjugate gradient"),
        pytest.param(model_of(FEW, joints=27), id="33 degrees of freedom"),
        pytest.param(
            model_of(FEW, extra='<equality><joint joint1="j0" joint2="j1"/></equality>'), id="equality of two joints"
        ),
        pytest.param(
            model_of(FEW, extra='<tendon><fixed frictionloss="1"><joint joint="j0" coef="1"/></fixed></tendon>'),
            id="tendon",
        ),
    ],
)
def test_what_the_kernel_does_not_know_is_left_to_mujoco_warp(model, monkeypatch):
    calls = []
    monkeypatch.setattr(fused, "plain_solve", lambda *arguments: calls.append(arguments))
    monkeypatch.setattr(fused, "solve_kernel", None)
    solved(model, fused.solve, monkeypatch=monkeypatch)
    assert len(calls) == 1


def test_a_limit_of_iterations_is_kept_and_told(monkeypatch):
    model = model_of(MANY)
    model.opt.iterations = 1
    m, d = moving(model)
    monkeypatch.setattr(solver, "solve", fused.solve)
    mujoco_warp.forward(m, d)
    assert (d.solver_niter.numpy() == 1).all()
    assert (d.overflow.numpy() & int(mujoco_warp.OverflowType.ITERATIONS)).any()


def test_rows_without_a_contact_push_nothing(monkeypatch):
    """Where rows overflow, mujoco_warp counts the rows of a contact that it has left out; what stands there is of another step."""
    m, d = moving(model_of(FEW, options='cone="elliptic"'))
    monkeypatch.setattr(solver, "solve", lambda *_: None)
    mujoco_warp.forward(m, d)
    fused.solve(m, d)
    expected, used = d.qacc.numpy(), int(d.nefc.numpy()[0])
    ids = d.efc.id.numpy()
    ids[:, used:] = 0  # of the first contact, whose rows are elsewhere
    d.efc.id.assign(ids)
    for array in (d.efc.J, d.efc.D, d.efc.aref):
        values = array.numpy()
        values[:, used:] = 1.0
        array.assign(values)
    d.nefc.fill_(MOST_ROWS + 5)
    d.efc.force.fill_(float("nan"))
    fused.solve(m, d)
    assert not d.efc.force.numpy()[:, used:].any()
    np.testing.assert_allclose(d.qacc.numpy(), expected, rtol=0.0, atol=1e-5 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_robots_stand_and_fall_as_with_mujoco_warps_own(device, monkeypatch):
    """Two seconds of robots that drop onto three grounds with limp legs: the same to the accuracy of the solver at first, and
    they come to lie at the same height."""
    states = {}
    for name, function in (("plain", fused.plain_solve), ("fused", fused.solve)):
        monkeypatch.setattr(solver, "solve", function)
        backend = MujocoWarpBackend(scene(FLAT, BOXES, FINE, **TRAINING), device=device)
        backend.reset(ResetState(**upright(backend, torch.tensor([0.4, 0.6, 0.5]))))
        target = torch.zeros((3, 12), device=backend.device)
        early = None
        for step in range(60):
            backend.step(target)
            if step == 4:
                early = backend.state.joint_position.clone().cpu()
        states[name] = (early, backend.state.base_position_w.clone().cpu())
        assert not backend.state.diverged.any()
    torch.testing.assert_close(states["fused"][0], states["plain"][0], rtol=0.0, atol=1e-4)
    torch.testing.assert_close(states["fused"][1][:, 2], states["plain"][1][:, 2], rtol=0.0, atol=0.02)
