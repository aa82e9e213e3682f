"""Run parts of mujoco_warp's step that do not need each other side by side on a GPU.

mujoco_warp launches about seventy kernels a substep in a row. The robot's dynamics are many small ones, which leave a GPU nearly
idle, and contacts with height fields, of convex and of simple shapes each wait for their slowest few pairs. None of these reads
what another writes: in streams of their own they fill each other's gaps. Every kernel does what it did.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar

import mujoco_warp
import warp as wp
from mujoco_warp import Data, Model
from mujoco_warp._src import collision_driver, constraint, forward, smooth, solver
from mujoco_warp._src.collision_core import create_collision_context
from mujoco_warp._src.types import BroadphaseType, CollisionType, DisableBit, EnableBit, GeomType, IntegratorType

_TABLE = collision_driver.MJ_COLLISION_TABLE.items()
_SIMPLE = [pair for pair, how in _TABLE if how == CollisionType.PRIMITIVE]
_FIELDS = [pair for pair, how in _TABLE if how == CollisionType.CONVEX and GeomType.HFIELD in pair]
_CONVEX = [pair for pair, how in _TABLE if how == CollisionType.CONVEX and GeomType.HFIELD not in pair]
_NEEDED = DisableBit.CONSTRAINT | DisableBit.CONTACT | DisableBit.NATIVECCD


class Branch:
    """Launches beside those that follow in the present stream; on a CPU they run in turn."""

    _streams: ClassVar[dict[tuple[str, str], wp.Stream]] = {}

    def __init__(self, name: str) -> None:
        """Begin when the present stream's work so far is done."""
        device = wp.get_device()
        self._stream: wp.Stream | None = None
        if device.is_cuda:
            if (key := (str(device), name)) not in self._streams:
                self._streams[key] = wp.Stream(device)
            self._stream = self._streams[key]
            self._stream.wait_stream(wp.get_stream(device))

    @contextmanager
    def __call__(self) -> Iterator[None]:
        """Direct launches inside the context to the branch."""
        with wp.ScopedStream(self._stream, sync_enter=False):
            yield

    def join(self) -> None:
        """Make the present stream wait for the branch."""
        if self._stream is not None:
            wp.wait_stream(self._stream)


def knows(model: Model, data: Data) -> bool:
    """Return whether ``step`` can take mujoco_warp's place: an Euler step of bodies alone, in any order of the contacts."""
    option = model.opt
    return (
        option.integrator == IntegratorType.EULER
        and option.broadphase == BroadphaseType.NXN
        and not option.enableflags & (EnableBit.SLEEP | EnableBit.ENERGY)
        and not option.disableflags & _NEEDED
        and not (option.deterministic or option.run_rne_postconstraint or model.has_sdf_geom)
        and model.nsensor + model.nactuator + model.ntendon + model.nflex + model.ncam + model.nlight == 0
        and model.callback.contactfilter is model.callback.control is None
        and data.naconmax > 0
    )


def step(model: Model, data: Data) -> None:
    """Advance by one substep, as ``mujoco_warp.step`` does."""
    if not knows(model, data):
        mujoco_warp.step(model, data)
        return
    smooth.kinematics(model, data)
    dynamics = Branch("dynamics")
    with dynamics():
        smooth.com_pos(model, data)
        smooth.crb(model, data)
        forward.fwd_velocity(model, data)
        forward.fwd_actuation(model, data)
        forward.fwd_acceleration(model, data, factorize=True)
    _collide(model, data)
    dynamics.join()
    constraint.make_constraint(model, data)
    solver.solve(model, data)
    forward.euler(model, data)


def _collide(model: Model, data: Data) -> None:
    """Find the contacts, as mujoco_warp's ``collision`` does."""
    context = create_collision_context(data.naconmax)
    data.ncollision.zero_()
    data.nacon.zero_()
    collision_driver.nxn_broadphase(model, data, context)
    fields, simple = Branch("fields"), Branch("simple shapes")
    with fields():
        collision_driver.convex_narrowphase(model, data, context, _FIELDS)
    collision_driver.convex_narrowphase(model, data, context, _CONVEX)
    with simple():
        collision_driver.primitive_narrowphase(model, data, context, _SIMPLE)
    fields.join()
    simple.join()
