"""Build the Warp kernel that solves a world from ``solve.cu`` and the sizes of a robot."""

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
"""Rows of the Jacobian in shared memory. A robot that lies on the ground has more, which stay in global memory."""
_SHARED_BYTES = 47 * 1024
"""Static shared memory of a block: 48 KiB of a GPU, less one in reserve."""
_MOST_WORLDS = 4
"""Most worlds of a block."""
_PROGRAM = Template(Path(__file__).with_name("solve.cu").read_text())


@wp.struct
class Problem:
    """Input of a solve: N worlds, V degrees of freedom, R rows of constraints. Units are SI."""

    tolerance: wp.array[float]
    """Largest gradient and improvement at the end, (N,) or (1,)."""
    search_tolerance: wp.array[float]
    """Tolerance of the search along a line, in units of ``tolerance``, (N,) or (1,)."""
    inertia_row: wp.array[int]
    """Row of each element of the inertia matrix's lower half."""
    inertia_column: wp.array[int]
    """Column of each element."""
    inertia: wp.array2d[float]
    """Elements of the inertia matrix, (N, elements)."""
    smooth_force: wp.array2d[float]
    """Force without the constraints, (N, V)."""
    smooth_acceleration: wp.array2d[float]
    """Acceleration without constraints, (N, V)."""
    start: wp.array2d[float]
    """Initial acceleration, (N, V)."""
    dry: wp.array[int]
    """Rows of joint friction, which come first, (N,)."""
    rows: wp.array[int]
    """All rows, (N,); may exceed the capacity."""
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
    """Largest force of joint friction, (N, R)."""
    contact_row: wp.array2d[int]
    """Rows of each contact of all worlds, the normal's first; negative for none."""
    contact_size: wp.array[int]
    """Number of rows of each contact."""
    contact_friction: wp.array[vec5]
    """Coefficients: two of sliding, one of torsion [m], two of rolling [m]."""
    impratio_root: wp.array[float]
    """1 / sqrt(impratio), (N,) or (1,)."""


@wp.struct
class Solution:
    """Output of a solve, in MuJoCo's terms."""

    acceleration: wp.array2d[float]
    """(N, V)."""
    momentum: wp.array2d[float]
    """Inertia times acceleration, (N, V)."""
    constraint_force: wp.array2d[float]
    """Force of the constraints by degree of freedom, (N, V)."""
    row_force: wp.array2d[float]
    """(N, R)."""
    state: wp.array2d[int]
    """State of each row, (N, padded R): 0 satisfied, 1 quadratic, 2 linear on the negative side, 3 on the positive side, 4 cone."""
    iterations: wp.array[int]
    """Number of iterations, (N,)."""
    overflow: wp.array[int]
    """Alarms, including that of the iterations' limit, (N,)."""


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """Sizes that a kernel is compiled for."""

    dofs: int
    """Degrees of freedom."""
    stride: int
    """Numbers in a row of the Jacobian, unused ones at its end included; a multiple of 4."""
    most_rows: int
    """Most rows of a world."""
    padded_rows: int
    """Most rows in arrays that mujoco_warp reads in whole tiles: Jacobian, stiffness and state."""
    elements: int
    """Elements of the inertia matrix's lower half that are not always zero."""
    elliptic: bool
    """True where contacts have elliptic cones."""

    @property
    def floats(self) -> int:
        """Return the count of numbers in shared memory for each world."""
        vectors, arrays = (7, 7) if self.elliptic else (5, 5)
        return (_STAGED_ROWS + 2 * self.dofs + vectors) * self.stride + arrays * self.row_room

    @property
    def row_room(self) -> int:
        """Return the count of numbers of an array of rows in shared memory, in whole 16 bytes."""
        return 4 * -(-self.most_rows // 4)

    @property
    def worlds(self) -> int:
        """Return the number of worlds that fit into a block's shared memory."""
        return min(_SHARED_BYTES // (4 * self.floats), _MOST_WORLDS)


def program_text(sizes: Sizes) -> str:
    """Return the text of ``solve.cu`` for one set of sizes."""
    derived = {name: getattr(sizes, name) for name in ("floats", "worlds", "row_room")}
    own = asdict(sizes) | {"elliptic": int(sizes.elliptic)}
    return _PROGRAM.substitute(own | derived, staged=_STAGED_ROWS, limit_reached=int(OverflowType.ITERATIONS))


@cache
def solve_kernel(sizes: Sizes) -> Any:
    """Build the kernel for one set of sizes; it takes ``Problem``, ``Solution``, most iterations, most steps of a search."""

    @wp.func_native(program_text(sizes))
    def solve_world(
        world: int, problem: Problem, solution: Solution, most_iterations: int, most_trials: int
    ) -> None: ...

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(problem: Problem, solution: Solution, most_iterations: int, most_trials: int) -> None:
        world, _ = wp.tid()  # type: ignore[misc]
        solve_world(world, problem, solution, most_iterations, most_trials)

    return kernel
