"""Contacts of single shapes with a height field: those of mujoco_warp, as repaired here, against MuJoCo's."""

import field_contacts
import numpy as np
import pytest
from gaitgauge.backends.upstream.height_fields.repair import HEIGHT_FIELDS
from gaitgauge.terrains.registry import make_terrain

TERRAIN = make_terrain("wave", 5)
STEEP = make_terrain("wave", 10)
COUNT = 200


@pytest.mark.slow
@pytest.mark.parametrize("terrain", [TERRAIN, STEEP], ids=["level 5", "level 10"])
@pytest.mark.parametrize("name", field_contacts.SHAPES)
def test_the_deepest_contact_with_a_wave_is_mujocos(name, terrain):
    HEIGHT_FIELDS.apply()
    model, qpos = field_contacts.model_of(name, terrain), field_contacts.poses(name, terrain, COUNT)
    seen = field_contacts.compare(
        field_contacts.contacts_of_mujoco(model, qpos), field_contacts.contacts_of_mujoco_warp(model, qpos)
    )
    assert len(seen["depth"]) > 0.5 * COUNT
    assert np.all(np.abs(seen["only"]) < 2e-5), "only what just touches may be a contact in one engine alone"
    # Where a shape's axis is below the ground two ways out are nearly as short, and the engines may choose unlike.
    depth = np.abs(seen["depth"])
    assert np.quantile(depth, 0.95) < 2e-4
    assert depth.max() < 1.5e-3
    assert np.median(seen["angle"]) < 0.5
    assert np.mean(seen["angle"] > 10.0) < 0.1
    assert np.median(seen["apart"]) < 1e-3


@pytest.mark.slow
def test_a_spheres_contacts_lie_between_it_and_the_ground():
    HEIGHT_FIELDS.apply()
    model, qpos = field_contacts.model_of("foot", TERRAIN), field_contacts.poses("foot", TERRAIN, COUNT)
    radius = float(field_contacts.SHAPES["foot"][1])
    for row, found in zip(qpos, field_contacts.contacts_of_mujoco_warp(model, qpos), strict=True):
        for distance, normal, position in found:
            assert normal[2] > -0.01
            # on the line along the normal through the centre, halfway between the surfaces
            assert np.allclose(row[:3] - position, (radius + 0.5 * distance) * normal, atol=2e-5)
