import sys
from pathlib import Path

import pytest
from gaitgauge.robots import JointParameters, Robot

# The unseen robot is shared by several test files.
sys.path.insert(0, str(Path(__file__).parent))

from unseen_robot import LEGS, write_unseen


@pytest.fixture(scope="session")
def unseen(tmp_path_factory):
    """The unseen robot with its knees bent by 1 rad: forwards in front, backwards behind; joints legs last."""
    mjcf = write_unseen(tmp_path_factory.mktemp("unseen"))
    kinds = ("bend", "spread", "swing")
    pose = {
        "bend": lambda leg: leg[1] * leg[5] * 1.0,
        "swing": lambda leg: -leg[1] * leg[4] * 0.5,
        "spread": lambda _: 0.0,
    }
    same = (1.0,) * 12
    motors = JointParameters(
        stiffness=(60.0,) * 12,
        damping=same,
        torque_limit=(60.0,) * 12,
        armature=(0.02,) * 12,
        joint_damping=same,
        friction_loss=same,
    )
    return Robot(
        name="unseen",
        title="Unseen",
        mjcf=mjcf,
        joint_names=tuple(f"{kind}.{leg[0]}" for kind in kinds for leg in LEGS),
        default_joint_position=tuple(pose[kind](leg) for kind in kinds for leg in LEGS),
        base_body="corpus",
        foot_names=tuple(leg[0] for leg in LEGS),
        foot_shapes=tuple(f"sole of {leg[0]}" for leg in LEGS),
        collision_bodies=("corpus", *(f"femur.{leg[0]}" for leg in LEGS)),
        trunk_shapes=("shell",),
        stand_height=0.6,
        default_parameters="gauge",
        parameters={"gauge": motors},
        command_limits=(1.5, 0.7, 1.5),
    )
