"""Run mujoco_warp's Newton solver in one kernel: 32 threads of a warp solve a robot in shared memory.

mujoco_warp launches a dozen kernels for each iteration of its solver, which pass matrices of 18 x 18 through the GPU's memory.
For robots of up to 32 degrees of freedom a whole solve fits on the chip: one launch, and each world stops on its own. The method
is mujoco_warp's and MuJoCo's: Newton's steps on the convex cost of accelerations, an exact search along each, the same criteria
to stop. Minimum, options and number of iterations are therefore the same. mujoco_warp itself solves models with equalities,
tendons, sparse matrices, sleeping bodies or the conjugate gradient.
"""

from __future__ import annotations

import warp as wp
from mujoco_warp import Data, Model
from mujoco_warp._src import solver
from mujoco_warp._src.solver import solve as plain_solve
from mujoco_warp._src.types import ConeType, DisableBit, EnableBit, IntegratorType, SolverType

from ...warp.structures import filled
from ..repair import Repair
from .kernel import LANES, Problem, Sizes, Solution, solve_kernel


def sizes_of(model: Model, data: Data) -> Sizes:
    """Return the sizes that the kernel is compiled for."""
    return Sizes(
        dofs=model.nv,
        stride=model.nv_pad,
        most_rows=data.njmax,
        padded_rows=data.efc.D.shape[1],
        elements=model.M_colind.shape[0],
        elliptic=model.opt.cone == ConeType.ELLIPTIC,
    )


def knows(model: Model, data: Data) -> bool:
    """Return whether the kernel can solve worlds of this model."""
    option = model.opt
    return (
        option.solver == SolverType.NEWTON
        and option.integrator != IntegratorType.DISCRETE
        and not option.enableflags & EnableBit.SLEEP
        and option.noslip_iterations == 0
        and not model.is_sparse
        and model.neq == 0
        and model.ntendon == 0
        and 0 < model.nv <= LANES
        and model.nv_pad % 4 == 0
        and data.njmax > 0
        and sizes_of(model, data).worlds > 0
    )


def problem_of(model: Model, data: Data) -> Problem:
    """Return the input of a solve, in mujoco_warp's arrays."""
    option, rows, contact = model.opt, data.efc, data.contact
    return filled(
        Problem,
        tolerance=option.tolerance,
        search_tolerance=option.ls_tolerance,
        inertia_row=model.M_hinit_i,
        inertia_column=model.M_colind,
        inertia=data.M,
        smooth_force=data.qfrc_smooth,
        smooth_acceleration=data.qacc_smooth,
        start=data.qacc_smooth if option.disableflags & DisableBit.WARMSTART else data.qacc_warmstart,
        dry=data.nf,
        limits=data.nl,
        rows=data.nefc,
        owner=rows.id,
        jacobian=rows.J,
        stiffness=rows.D,
        reference=rows.aref,
        loss=rows.frictionloss,
        contact_row=contact.efc_address,
        contact_size=contact.dim,
        contact_friction=contact.friction,
        impratio_root=option.impratio_invsqrt,
    )


def solution_of(data: Data) -> Solution:
    """Return the output of a solve, in mujoco_warp's arrays."""
    return filled(
        Solution,
        acceleration=data.qacc,
        momentum=data.efc.Ma,
        constraint_force=data.qfrc_constraint,
        row_force=data.efc.force,
        state=data.efc.state,
        iterations=data.solver_niter,
        overflow=data.overflow,
    )


def solve(model: Model, data: Data) -> None:
    """Find the accelerations and the forces of the constraints, by the kernel or by mujoco_warp."""
    if not knows(model, data):
        plain_solve(model, data)
        return
    sizes = sizes_of(model, data)
    wp.launch(
        solve_kernel(sizes),
        dim=(data.nworld, LANES if data.qacc.device.is_cuda else 1),
        inputs=[problem_of(model, data), solution_of(data), model.opt.iterations, model.opt.ls_iterations],
        block_dim=LANES * sizes.worlds,
    )


def _install() -> None:
    solver.solve = solve


FUSED_SOLVER = Repair(project="mujoco-warp", versions=">=3.17,<3.18", fault="the speed of its solver", install=_install)
