"""What the independent engines do not simulate is refused, not left out."""

from dataclasses import replace

import mujoco
import pytest
from gaitgauge.backends import BackendError, PhysicsOptions, Scene
from gaitgauge.backends.sequential.robot import read_robot
from gaitgauge.robots import load_robot
from gaitgauge.terrains.base import Terrain

GO2 = load_robot("go2")


def _stiffen(spec):
    for joint in spec.joints:
        if joint.name in GO2.joint_names:
            joint.stiffness = [40.0, 0.0, 0.0]


def _tie(spec):
    spec.add_equality(
        type=mujoco.mjtEq.mjEQ_JOINT,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        name1=GO2.joint_names[2],
        name2=GO2.joint_names[1],
    )


@pytest.mark.parametrize(("change", "what"), [(_stiffen, "springs in its joints"), (_tie, "equalities")])
def test_springs_and_equalities_are_refused(tmp_path, change, what):
    spec = mujoco.MjSpec.from_file(str(GO2.mjcf))
    change(spec)
    for name in ("meshdir", "texturedir"):
        setattr(spec, name, str((GO2.mjcf.parent / getattr(spec, name)).resolve()))
    (tmp_path / "go2.xml").write_text(spec.to_xml())

    def scene(robot):
        flat = (Terrain(name="flat", family="flat"),)
        return Scene(
            robot=robot,
            parameters=GO2.parameters["gauge"],
            terrains=flat,
            terrain_index=(0,),
            physics=PhysicsOptions(foot_condim=3),
        )

    assert len(read_robot(scene(GO2)).links) == 13
    with pytest.raises(BackendError, match=f"robot 'go2' has {what}, which this engine does not simulate"):
        read_robot(scene(replace(GO2, mjcf=tmp_path / "go2.xml")))
