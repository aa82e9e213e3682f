"""The kernel that solves a world: ``solve.cu`` with the sizes of a robot, as a Warp kernel."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from string import Template
from typing import Any

import warp as wp
from mujoco_warp._src.types import OverflowType, vec5

LANES = 32
"""Threads of a GPU that solve a world together, and the most degrees of freedom."""
_STAGED_ROWS = 44
"""Rows of the Jacobian that are copied into shared memory. Robots that lie on the ground have more: these are read where they are."""
_SHARED_BYTES = 47 * 1024
"""Static shared memory of a block: a GPU gives 48 KiB, of which one is not ours."""
_MOST_WORLDS = 4
"""Worlds that a block solves."""
_PROGRAM = Template(Path(__file__).with_name("solve.cu").read_text())


@wp.struct
class Problem:
    """What a solve reads: N worlds, V degrees of freedom, R rows of constraints. Units are SI."""

    tolerance: wp.array[float]
    """At which gradient and improvement to stop, (N,) or (1,)."""
    search_tolerance: wp.array[float]
    """Of the search along a line, in units of the former, (N,) or (1,)."""
    inertia_row: wp.array[int]
    """Row of each element of the inertia matrix's lower half."""
    inertia_column: wp.array[int]
    """Its column."""
    inertia: wp.array2d[float]
    """(N, elements)."""
    smooth_force: wp.array2d[float]
    """Of all but the constraints, (N, V)."""
    smooth_acceleration: wp.array2d[float]
    """Without constraints, (N, V)."""
    start: wp.array2d[float]
    """Acceleration to begin with, (N, V)."""
    dry: wp.array[int]
    """Rows of joint friction, which come first, (N,)."""
    rows: wp.array[int]
    """All rows, (N,); may be more than there is room for."""
    limits: wp.array[int]
    """Rows of limits, which come next, (N,)."""
    owner: wp.array2d[int]
    """Degree of freedom of a row of joint friction, contact of a row of a contact, (N, R)."""
    jacobian: wp.array3d[float]
    """(N, padded R, stride)."""
    stiffness: wp.array2d[float]
    """Inverse regularization: the second derivative of a row's cost, (N, padded R)."""
    reference: wp.array2d[float]
    """Reference acceleration, (N, R)."""
    loss: wp.array2d[float]
    """Most force of joint friction, (N, R)."""
    contact_row: wp.array2d[int]
    """Rows of each contact of all worlds, its normal's first; negative where it has none."""
    contact_size: wp.array[int]
    """How many."""
    contact_friction: wp.array[vec5]
    """Two of sliding, one of torsion [m], two of rolling [m]."""
    impratio_root: wp.array[float]
    """1 / sqrt(impratio), (N,) or (1,)."""


@wp.struct
class Solution:
    """What a solve writes, in MuJoCo's terms."""

    acceleration: wp.array2d[float]
    """(N, V)."""
    momentum: wp.array2d[float]
    """Inertia times acceleration, (N, V)."""
    constraint_force: wp.array2d[float]
    """By degree of freedom, (N, V)."""
    row_force: wp.array2d[float]
    """(N, R)."""
    state: wp.array2d[int]
    """Of each row, (N, padded R): 0 satisfied, 1 quadratic, 2 linear on the negative side, 3 on the positive side, 4 cone."""
    iterations: wp.array[int]
    """That it took, (N,)."""
    overflow: wp.array[int]
    """Alarms, to which that of the iterations' limit is added, (N,)."""


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """What a kernel is compiled for."""

    dofs: int
    """Degrees of freedom."""
    stride: int
    """Numbers in a row of the Jacobian, unused ones at its end included; a multiple of 4."""
    most_rows: int
    """Rows of a world that there is room for."""
    padded_rows: int
    """The same in arrays that mujoco_warp reads in whole tiles: Jacobian, stiffness and state."""
    elements: int
    """Elements of the inertia matrix's lower half that are not always zero."""
    elliptic: bool
    """Whether contacts have elliptic cones."""

    @property
    def floats(self) -> int:
        """Numbers in shared memory for each world."""
        vectors, arrays = (7, 7) if self.elliptic else (5, 5)
        return (_STAGED_ROWS + 2 * self.dofs + vectors) * self.stride + arrays * self.row_room

    @property
    def row_room(self) -> int:
        """Numbers of an array of rows in shared memory, whole 16 bytes."""
        return 4 * -(-self.most_rows // 4)

    @property
    def worlds(self) -> int:
        """How many worlds a block has shared memory for."""
        return min(_SHARED_BYTES // (4 * self.floats), _MOST_WORLDS)


def program_text(sizes: Sizes) -> str:
    """``solve.cu`` for one set of sizes."""
    return _PROGRAM.substitute(
        asdict(sizes) | {"elliptic": int(sizes.elliptic)},
        floats=sizes.floats,
        worlds=sizes.worlds,
        row_room=sizes.row_room,
        staged=_STAGED_ROWS,
        limit_reached=int(OverflowType.ITERATIONS),
    )


@cache
def solve_kernel(sizes: Sizes) -> Any:
    """The kernel for one set of sizes. Its arguments: ``Problem``, ``Solution``, most iterations, most steps of a search."""

    @wp.func_native(program_text(sizes))
    def solve_world(
        world: int, problem: Problem, solution: Solution, most_iterations: int, most_trials: int
    ) -> None: ...

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(problem: Problem, solution: Solution, most_iterations: int, most_trials: int) -> None:
        world, _ = wp.tid()  # type: ignore[misc]
        solve_world(world, problem, solution, most_iterations, most_trials)

    return kernel
