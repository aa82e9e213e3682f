"""Visual meshes are left out of physics, and compiled once where a robot is checked."""

import mujoco
import numpy as np
import pytest
from gaitgauge.robots import RobotError
from gaitgauge.robots.checks.checking import compiled
from gaitgauge.robots.physical import physical_spec

MODEL = """<mujoco><asset><mesh name="look" {mesh}/><mesh name="hull" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset><worldbody>
<body name="a"><freejoint/><inertial mass="2" pos="0 0 0" diaginertia="1 1 1"/>
<geom type="mesh" mesh="look" contype="0" conaffinity="0"/><geom type="mesh" mesh="hull"/></body>
<body name="b"><geom type="mesh" mesh="look" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""
SHAPE = 'vertex="0 0 0 1 0 0 0 1 0 0 0 1 1 1 1"'


def test_meshes_that_neither_touch_nor_weigh_are_left_out(tmp_path):
    path = tmp_path / "m.xml"
    path.write_text(MODEL.format(mesh=SHAPE))
    whole, model = mujoco.MjModel.from_xml_path(str(path)), physical_spec(path).compile()
    assert (whole.ngeom, model.ngeom) == (3, 2), "the mesh of b gives b its mass"
    np.testing.assert_array_equal(model.body_mass, whole.body_mass)
    path.write_text(
        MODEL.format(mesh=SHAPE).replace(
            '<body name="b"><geom type="mesh" mesh="look" contype="0" conaffinity="0"/></body>', ""
        )
    )
    assert [mesh.name for mesh in physical_spec(path).meshes] == ["hull"]


def test_a_visual_mesh_that_is_lost_or_broken_is_told(tmp_path):
    path = tmp_path / "m.xml"
    text = MODEL.format(mesh='file="look.stl"').replace(
        '<body name="b"><geom type="mesh" mesh="look" contype="0" conaffinity="0"/></body>', ""
    )
    path.write_text(text)
    with pytest.raises(RobotError, match=r"is not a model that MuJoCo can compile: .*look\.stl"):
        compiled(path, whole=True)
    (tmp_path / "look.stl").write_bytes(b"no mesh")
    compiled(path)
    with pytest.raises(RobotError, match="is not a model that MuJoCo can compile"):
        compiled(path, whole=True)
