import sys
from pathlib import Path

import pytest
from gaitgauge.robots import JointParameters, Robot

# The robots are shared by several test files.
sys.path.insert(0, str(Path(__file__).parent))

from hopper import HOPPER, HOPPER_MJCF
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


@pytest.fixture
def write_hopper(tmp_path):
    """Writes a user's robot, with pieces of text replaced, and returns the path of its robot.toml."""

    def write(*changes: tuple[str, str], mjcf: tuple[str, str] = ("", "")) -> Path:
        description = HOPPER
        for old, new in changes:
            assert old in description
            description = description.replace(old, new)
        assert mjcf[0] in HOPPER_MJCF
        (tmp_path / "model").mkdir(exist_ok=True)
        (tmp_path / "model" / "hopper.xml").write_text(HOPPER_MJCF.replace(*mjcf) if mjcf[0] else HOPPER_MJCF)
        path = tmp_path / "robot.toml"
        path.write_text(description)
        return path

    return write
