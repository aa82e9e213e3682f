"""How the prisms of a height field are shared among threads: nothing but time may depend on it, and no loss is silent."""

import field_contacts
import mujoco
import mujoco_warp
import numpy as np
import pytest
from gaitgauge.backends.upstream.height_fields import repair as fields
from gaitgauge.terrains.registry import make_terrain
from mujoco_warp._src import collision_driver

TERRAIN = make_terrain("wave", 7)
COUNT = 60


NAMES = tuple(field_contacts.SHAPES)

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _repaired():
    fields.HEIGHT_FIELDS.apply()


def _together() -> mujoco.MjModel:
    """All shapes as free bodies of one world, which meet the field and not each other."""
    spec = mujoco.MjSpec()
    for name, (kind, size, _) in field_contacts.SHAPES.items():
        body = spec.worldbody.add_body(name=name)
        body.add_freejoint()
        sizes = [float(s) for s in size.split()]
        shape = getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")
        body.add_geom(
            type=shape,
            size=sizes + [0.0] * (3 - len(sizes)),
            margin=field_contacts.MARGIN,
            mass=1,
            contype=2,
            conaffinity=1,
        )
    heights = TERRAIN.height_field
    top = float(heights.heights.max())
    rows, columns = heights.heights.shape
    field = spec.add_hfield(name="field", nrow=rows, ncol=columns)
    field.size = np.array([*heights.half_size, top, heights.base])
    field.userdata = (heights.heights / top).astype(np.float32).ravel()
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname="field",
        pos=[*heights.center, 0.0],
        contype=1,
        conaffinity=2,
    )
    model = spec.compile()
    model.hfield_data[:] = (heights.heights / top).ravel()
    return model


def _poses() -> np.ndarray:
    return np.concatenate([field_contacts.poses(name, TERRAIN, COUNT) for name in NAMES], axis=1)


def _rows(data: mujoco_warp.Data) -> np.ndarray:
    """World, geom, number within the pair, distance, position, frame of each contact, in one order: (contacts, 16)."""
    number, contact = int(data.nacon.numpy()[0]), data.contact
    columns = [contact.worldid, contact.geom, contact.geomcollisionid, contact.dist, contact.pos, contact.frame]
    rows = np.concatenate([c.numpy()[:number].reshape(number, -1).astype(np.float64) for c in columns], axis=1)
    return rows[np.lexsort(rows.T[::-1])]


@pytest.fixture(scope="module")
def whole() -> np.ndarray:
    fields.HEIGHT_FIELDS.apply()
    data = field_contacts.collided(_together(), _poses())
    assert not data.overflow.numpy().any()
    return _rows(data)


def test_shapes_in_one_world_touch_as_each_alone_does(whole):
    model = _together()
    for index, name in enumerate(NAMES):
        geom = model.body(name).geomadr[0]
        alone = field_contacts.collided(field_contacts.model_of(name, TERRAIN), _poses()[:, 7 * index : 7 * index + 7])
        mine = whole[(whole[:, 1:3] == geom).any(axis=1)]
        theirs = _rows(alone)
        assert len(mine) == len(theirs) > COUNT / 2
        assert np.array_equal(mine[:, [0, 3]], theirs[:, [0, 3]])
        assert np.allclose(mine[:, 4:8], theirs[:, 4:8], atol=1e-5)


@pytest.mark.parametrize("threads", [1, 7, 1000])
def test_contacts_do_not_depend_on_how_many_threads_share_them(monkeypatch, whole, threads):
    monkeypatch.setattr(fields, "_SERIAL_THREADS", threads)
    assert np.array_equal(_rows(field_contacts.collided(_together(), _poses())), whole)


def test_contacts_do_not_depend_on_the_order_in_which_pairs_come(monkeypatch, whole):
    random = np.random.default_rng(0)

    def shuffled(model, data, context, table):
        count = int(data.ncollision.numpy()[0])
        order = random.permutation(count)
        for array in (context.collision_pair, context.collision_pairid, context.collision_worldid):
            values = array.numpy()
            values[:count] = values[order]
            array.assign(values)
        fields.convex_narrowphase(model, data, context, table)

    monkeypatch.setattr(collision_driver, "convex_narrowphase", shuffled)
    assert np.array_equal(_rows(field_contacts.collided(_together(), _poses())), whole)


@pytest.mark.parametrize("short", ["_PRISMS", "_TOUCHES"])
def test_worlds_that_lose_contacts_say_so_and_the_others_keep_theirs(monkeypatch, whole, short):
    monkeypatch.setattr(fields, short, (0, 20))
    data = field_contacts.collided(_together(), _poses())
    alarm = data.overflow.numpy()
    assert set(alarm) == {0, int(mujoco_warp.OverflowType.HFIELD)}
    rows = _rows(data)
    assert np.array_equal(rows[alarm[rows[:, 0].astype(int)] == 0], whole[alarm[whole[:, 0].astype(int)] == 0])


def _chosen(distances: np.ndarray, points: np.ndarray, normals: np.ndarray) -> list[int]:
    """The rule for the contacts of one shape: the deepest, the farthest from it, and two far from the line and its ends."""
    first = int(np.argmin(distances))
    chosen, normal = [first], normals[first]
    while len(chosen) < min(4, len(points)):
        corners = points[chosen]
        if len(chosen) == 1:
            far = np.linalg.norm(points - corners[0], axis=1)
        elif len(chosen) == 2:
            far = np.abs((points - corners[0]) @ np.cross(normal, corners[0] - corners[1]))
        else:
            far = np.abs((points - corners[0]) @ np.cross(normal, corners[0] - corners[2]))
            far += np.abs((points - corners[1]) @ np.cross(normal, corners[1] - corners[2]))
        far[chosen] = -1.0
        if 0.0 < far.max() < 1e-3:
            break
        chosen.append(int(np.argmax(far)))
    return chosen


def test_of_all_contacts_those_are_chosen_that_the_rule_names(monkeypatch):
    kept, plain = [], fields.empty_lists
    monkeypatch.setattr(fields, "empty_lists", lambda *sizes: kept.append(plain(*sizes)) or kept[-1])
    data = field_contacts.collided(
        field_contacts.model_of("trunk", TERRAIN), field_contacts.poses("trunk", TERRAIN, COUNT)
    )
    rows, touches = _rows(data), kept[0].touches.numpy()
    spans, prisms = kept[0].spans.numpy(), kept[0].prisms.numpy()
    several = 0
    for world in range(COUNT):  # one pair in each, but in which place?
        written = rows[rows[:, 0] == world]
        if len(written) == 0:
            continue
        deepest = written[0]
        matches = []
        for first, listed in spans[: int(data.ncollision.numpy()[0])]:
            places = prisms[first : first + listed, 1]
            found = touches[places[places >= 0]]
            matches += [(first, listed)] if np.any(np.all(found["position"] == deepest[5:8], axis=1)) else []
        ((first, listed),) = matches
        places = dict.fromkeys(int(p) for p in prisms[first : first + listed, 1] if p >= 0)
        found = touches[[p for p in places if np.isfinite(touches[p]["distance"])]]
        picked = found[_chosen(found["distance"], found["position"], found["normal"])]
        assert np.array_equal(picked["position"], written[:, 5:8]), world
        several += len(found) > 4
    assert several > 5
