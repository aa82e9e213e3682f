# mypy: ignore-errors
# ruff: noqa: UP018, RUF046 - a variable that changes in a kernel's loop must be made by int()
"""Sort contacts and constraint rows, so that the same start gives the same bits on a GPU.

mujoco_warp 3.17 numbers contacts and rows in the order in which threads come by. Sums over them then differ in their
last bits from run to run, and legged motion lets them grow. The engine's own deterministic mode fixes the order of each
sum; the order of what is summed is fixed here: contacts by world and geoms after collision detection, and each world's
rows by kind and contact before the solver.
"""

# Warp reads the annotations of structs and kernels: no ``from __future__ import annotations`` here.
import mujoco_warp
import warp as wp
from mujoco_warp._src.types import vec5

from ..warp.structures import filled

wp.set_module_options({"enable_backward": False})

_LAST = wp.constant(wp.int64(0x7FFFFFFFFFFFFFFF))
"""Key of the unused places behind the contacts."""


@wp.struct
class ContactFields:
    """All that mujoco_warp stores of each contact before there are constraints."""

    dist: wp.array[float]
    pos: wp.array[wp.vec3]
    frame: wp.array[wp.mat33]
    includemargin: wp.array[float]
    friction: wp.array[vec5]
    solref: wp.array[wp.vec2]
    solreffriction: wp.array[wp.vec2]
    solimp: wp.array[vec5]
    dim: wp.array[int]
    geom: wp.array[wp.vec2i]
    worldid: wp.array[int]
    type: wp.array[int]
    geomcollisionid: wp.array[int]
    adhesion: wp.array[float]


@wp.struct
class RowFields:
    """All that mujoco_warp stores of each constraint row before the solver."""

    type: wp.array2d[int]
    id: wp.array2d[int]
    pos: wp.array2d[float]
    margin: wp.array2d[float]
    D: wp.array2d[float]
    vel: wp.array2d[float]
    aref: wp.array2d[float]
    frictionloss: wp.array2d[float]
    J: wp.array3d[float]


@wp.struct
class RowCounts:
    """Number of each world's rows, by kind in their order."""

    equality: wp.array[int]
    friction: wp.array[int]
    limit: wp.array[int]
    all: wp.array[int]


def _with_spare(kind: type, source: object) -> tuple:
    """Return a structure over the source's arrays, and one over other memory of that size."""
    return filled(kind, source), filled(kind, **{name: wp.empty_like(getattr(source, name)) for name in kind.vars})


class CanonicalOrder:
    """Scratch memory for sorting one engine's contacts and rows, and the launches that do it."""

    def __init__(self, model: mujoco_warp.Model, data: mujoco_warp.Data) -> None:
        if model.is_sparse:
            raise NotImplementedError("rows of a sparse Jacobian cannot be brought into order")
        self._geoms, self._columns = model.ngeom, data.efc.J.shape[2]
        self._contacts, self._spare_contacts = _with_spare(ContactFields, data.contact)
        self._rows, self._spare_rows = _with_spare(RowFields, data.efc)
        self._counts = filled(RowCounts, equality=data.ne, friction=data.nf, limit=data.nl, all=data.nefc)
        self._keys = wp.zeros(2 * data.naconmax, dtype=wp.int64)
        self._order = wp.zeros(2 * data.naconmax, dtype=int)
        self._row_order = wp.zeros((data.nworld, data.njmax), dtype=int)

    def sort_contacts(self, data: mujoco_warp.Data) -> None:
        """Order contacts by world, geoms and number within the pair; between collision detection and constraints."""
        count = data.naconmax
        wp.launch(contact_keys, dim=count, inputs=[data.nacon, self._geoms, self._contacts, self._keys, self._order])
        wp.utils.radix_sort_pairs(self._keys, self._order, count)
        wp.launch(move_contacts, dim=count, inputs=[data.nacon, 1, self._order, self._contacts, self._spare_contacts])
        wp.launch(move_contacts, dim=count, inputs=[data.nacon, 0, self._order, self._spare_contacts, self._contacts])

    def sort_rows(self, data: mujoco_warp.Data) -> None:
        """Order each world's constraint rows by kind and contact; between constraints and solver."""
        worlds, rows = data.nworld, data.njmax
        wp.launch(order_rows, dim=worlds, inputs=[self._counts, rows, self._rows.id, self._row_order])
        for gather, source, target in ((1, self._rows, self._spare_rows), (0, self._spare_rows, self._rows)):
            inputs = [data.nefc, gather, self._columns, self._row_order, source, target]
            wp.launch(move_rows, dim=(worlds, rows), inputs=inputs)
        wp.launch(address_contacts, dim=(worlds, rows), inputs=[self._counts, self._rows.id, data.contact.efc_address])


@wp.kernel
def contact_keys(
    count: wp.array[int], geoms: int, contacts: ContactFields, keys: wp.array[wp.int64], order: wp.array[int]
) -> None:
    """Number each contact by its world and geoms alone."""
    contact = wp.tid()
    order[contact] = contact
    key = _LAST
    if contact < count[0]:
        pair = contacts.geom[contact]
        key = wp.int64(contacts.worldid[contact]) * wp.int64(geoms) + wp.int64(pair[0])
        key = (key * wp.int64(geoms) + wp.int64(pair[1])) * wp.int64(64)
        key += wp.int64(contacts.geomcollisionid[contact])
    keys[contact] = key


@wp.kernel
def move_contacts(
    count: wp.array[int], gather: int, order: wp.array[int], source: ContactFields, target: ContactFields
) -> None:
    """Copy contacts, in the given order or as they lie."""
    contact = wp.tid()
    if contact >= count[0]:
        return
    origin = contact
    if gather != 0:
        origin = order[contact]
    target.dist[contact] = source.dist[origin]
    target.pos[contact] = source.pos[origin]
    target.frame[contact] = source.frame[origin]
    target.includemargin[contact] = source.includemargin[origin]
    target.friction[contact] = source.friction[origin]
    target.solref[contact] = source.solref[origin]
    target.solreffriction[contact] = source.solreffriction[origin]
    target.solimp[contact] = source.solimp[origin]
    target.dim[contact] = source.dim[origin]
    target.geom[contact] = source.geom[origin]
    target.worldid[contact] = source.worldid[origin]
    target.type[contact] = source.type[origin]
    target.geomcollisionid[contact] = source.geomcollisionid[origin]
    target.adhesion[contact] = source.adhesion[origin]


@wp.func
def row_key(row: int, equality: int, friction: int, limit: int, id: int) -> wp.int64:
    """Return a row's key: its kind first, then its joint or contact."""
    kind = wp.int64(3)
    if row < equality:
        kind = wp.int64(0)
    elif row < equality + friction:
        kind = wp.int64(1)
    elif row < equality + friction + limit:
        kind = wp.int64(2)
    return kind * wp.int64(4294967296) + wp.int64(id)


@wp.kernel
def order_rows(counts: RowCounts, capacity: int, id: wp.array2d[int], order: wp.array2d[int]) -> None:
    """Sort a world's rows by insertion: stable, so that a contact's rows keep their order; quick for nearly sorted rows."""
    world = wp.tid()
    e, f, j = counts.equality[world], counts.friction[world], counts.limit[world]
    for row in range(wp.min(counts.all[world], capacity)):
        key = row_key(row, e, f, j, id[world, row])
        place = int(row)
        while place > 0:
            before = order[world, place - 1]
            if row_key(before, e, f, j, id[world, before]) <= key:
                break
            order[world, place] = before
            place -= 1
        order[world, place] = row


@wp.kernel
def move_rows(
    count: wp.array[int], gather: int, columns: int, order: wp.array2d[int], source: RowFields, target: RowFields
) -> None:
    """Copy constraint rows, in the given order or as they lie."""
    world, row = wp.tid()
    if row >= count[world]:
        return
    origin = row
    if gather != 0:
        origin = order[world, row]
    target.type[world, row] = source.type[world, origin]
    target.id[world, row] = source.id[world, origin]
    target.pos[world, row] = source.pos[world, origin]
    target.margin[world, row] = source.margin[world, origin]
    target.D[world, row] = source.D[world, origin]
    target.vel[world, row] = source.vel[world, origin]
    target.aref[world, row] = source.aref[world, origin]
    target.frictionloss[world, row] = source.frictionloss[world, origin]
    for column in range(columns):
        target.J[world, row, column] = source.J[world, origin, column]


@wp.kernel
def address_contacts(counts: RowCounts, id: wp.array2d[int], address: wp.array2d[int]) -> None:
    """Tell each contact where its rows are now."""
    world, row = wp.tid()
    first = counts.equality[world] + counts.friction[world] + counts.limit[world]
    if row < first or row >= counts.all[world]:
        return
    contact = id[world, row]
    number = int(0)
    while row - number - 1 >= first and id[world, row - number - 1] == contact:
        number += 1
    address[contact, number] = row
