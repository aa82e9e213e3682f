"""Examine a robot for its owner: the finding of every check as a sentence, and the stance with its gains."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from ...files.parsing import build, parse_json
from ..anatomy.body_plan import (
    body_plan,
    default_pose,
    foot_centers,
    joint_ranges,
    lowest_point,
    mirror_image,
    sole_geoms,
)
from ..anatomy.feet import shank_end
from ..anatomy.limbs import joint_chain
from ..anatomy.roles import WORDS, anatomy
from ..base import JointParameters, Robot
from ..loading import RobotError
from .apart import run_apart
from .checking import DEPTH_TOLERANCE, ModelChecks
from .standing import balance, folded, sag, stand

if TYPE_CHECKING:
    import mujoco

_TRAINING_TIMESTEP = 0.005
_GO2 = (15.206, 0.426)
"""Mass [kg] and leg length [m] of the Go2."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Result of one check."""

    check: str
    """Its name."""
    passed: bool
    sentence: str
    """The finding, or the fault and the remedy."""
    needed_for: str
    """Part of the project that fails with the check, or ``everything``."""


def examine(robot: Robot) -> list[Finding]:
    """Check a robot's model in a process of its own; checks that need a part found missing are left out."""
    try:
        text = run_apart(partial(_findings, robot), robot.mjcf)
    except RobotError as error:
        return [Finding(check="model", passed=False, sentence=str(error), needed_for="everything")]
    return [build(Finding, row, "a finding", RobotError) for row in parse_json(text, "the findings", RobotError)]


def _findings(robot: Robot) -> str:
    found: list[Finding] = []

    def note(check: str, look: Callable[[], str], needed_for: str = "everything") -> None:
        try:
            passed, sentence = True, look()
        except RobotError as error:
            passed, sentence = False, str(error).removeprefix(f"robot '{robot.name}': ")
        found.append(Finding(check=check, passed=passed, sentence=sentence, needed_for=needed_for))

    checks = ModelChecks(robot)
    for name in ModelChecks.ORDER:
        note(name.replace("_", " "), getattr(checks, name))
    if all(f.passed for f in found):
        note("legs", partial(_legs, robot))
        note("foot shapes", partial(_foot_shapes, robot), "what is rewarded and judged of feet")
        note("parts", partial(_parts, robot), "a start at rest")
        note("pose", partial(folded, robot))
        note("load", partial(sag, robot))
        two = len(robot.foot_names) == 2
        note(
            "standing", partial(balance if two else stand, robot), "standing without a policy" if two else "everything"
        )
        note("mirror image", partial(_mirror, robot), "training with symmetry")
        note("joint ranges", partial(_ranges, robot), "the metric dof_limits and the reward joint_limits")
        note("motor law", partial(_motor_law, robot), "training, whose physics steps 5 ms")
        note("measure", partial(_measure, robot))
        note("parameters", partial(_parameters, robot), "the suites that ship with the project")
        note("SDK order", partial(_sdk, robot), "export of a deploy.yaml")
    return json.dumps([asdict(finding) for finding in found])


def _legs(robot: Robot) -> str:
    plan, build = body_plan(robot), anatomy(robot)
    legs = f"{len(plan.legs)} legs of {plan.leg_length:.3f} m ({', '.join(leg.name for leg in build.legs)})"
    others = sorted({role.partition("_")[0] for role in build.roles} - {"hip", "knee", "ankle"})
    rest = f", joints of {', '.join(others)}" if others else ""
    return f"{WORDS[build.plan]}: {legs}{rest}; the base stands {plan.standing_height:.3f} m high in the default pose"


def _foot_shapes(robot: Robot) -> str:
    """Check that the centre of a foot's shape, which is the foot's position, is not in the middle of a shank."""
    model, data = default_pose(robot)
    base, heights, roles = model.body(robot.base_body).id, [], anatomy(robot).roles
    order = {model.joint(name).id: i for i, name in enumerate(robot.joint_names)}
    for name, sole, center in zip(
        robot.foot_names, sole_geoms(model, robot), foot_centers(model, data, robot), strict=True
    ):
        heights.append(float(center[2]) - min(lowest_point(model, data, geom) for geom in sole))
        chain = joint_chain(model, int(model.geom_bodyid[sole[0]]), base)
        knee = bool(chain) and len(sole) == 1 and roles[order[chain[-1]]] == "knee"
        end = shank_end(model, data, sole[0], data.xanchor[chain[-1]]) if knee else None
        if end is not None:
            raise RobotError(
                f"the foot '{name}' is {end.length:.3g} m long: its centre, which counts as the foot's position, is {heights[-1]:.3f} m "
                "above where it meets the ground; add a small sphere at its end, and name that in foot_names or foot_shapes"
            )
    return f"in the default pose the centre of a foot is up to {max(heights):.3f} m above where it meets the ground"


def _parts(robot: Robot) -> str:
    """Check that colliding parts are not inside each other in the default pose."""
    import mujoco

    model, data = default_pose(robot)
    mujoco.mj_fwdPosition(model, data)
    deepest = min(data.contact, key=lambda contact: contact.dist, default=None)
    if deepest is not None and deepest.dist < -DEPTH_TOLERANCE:
        first, second = (_part(model, int(geom)) for geom in deepest.geom)
        raise RobotError(
            f"robot '{robot.name}': in its default pose {first} is {-deepest.dist:.3f} m inside {second}, and every start "
            "pushes them apart; mend default_joint_position or the shapes, or exclude the contact of the two bodies in the model"
        )
    return "no part is inside another in the default pose"


def _part(model: mujoco.MjModel, geom: int) -> str:
    """Describe a geom in words."""
    name, body = model.geom(geom).name, model.body(int(model.geom_bodyid[geom]))
    shape = f"the geom '{name}'" if name else "a geom"
    return f"{shape} of the body '{body.name or body.id}'"


def _mirror(robot: Robot) -> str:
    pairs = sorted({tuple(sorted((i, j))) for i, j in enumerate(mirror_image(robot).foot)})
    names = ", ".join(" and ".join(dict.fromkeys(robot.foot_names[i] for i in pair)) for pair in pairs)
    return f"left and right are mirror images: {names}"


def _ranges(robot: Robot) -> str:
    ranges = zip(robot.joint_names, robot.driven_by_velocity, joint_ranges(robot), strict=True)
    free = [name for name, wheel, bounds in ranges if not wheel and not np.isfinite(bounds).all()]
    if free:
        raise RobotError(f"{len(free)} joints have no range in the model ('{free[0]}' …); give them one")
    return "every joint with a target of angle has a range"


def damped_share(robot: Robot, motors: JointParameters) -> float:
    """Return the largest share of joint speed that the explicit motor law removes in one training step in the default pose.

    The law acts by damping, or along the line on which torque falls with speed; from 2 on joints swing ever further.
    """
    import mujoco

    model, data = default_pose(robot)
    at = model.jnt_dofadr[[model.joint(name).id for name in robot.joint_names]]
    model.dof_armature[at] = motors.armature
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    inertia[at, at] += _TRAINING_TIMESTEP * np.array(motors.joint_damping)  # passive damping is integrated implicitly
    slope = np.array(motors.damping)
    if motors.full_torque_speed is not None and motors.no_load_speed is not None:
        driving = np.array(motors.driving_torque_limit or motors.torque_limit)
        slope = np.maximum(slope, driving / np.subtract(motors.no_load_speed, motors.full_torque_speed))
    damping = np.zeros_like(inertia)
    damping[at, at] = slope
    return float(np.abs(np.linalg.eigvals(_TRAINING_TIMESTEP * np.linalg.solve(inertia, damping))).max())


def _motor_law(robot: Robot) -> str:
    name = "training" if "training" in robot.parameters else robot.default_parameters
    share = damped_share(robot, robot.parameters[name])
    if share >= 2.0:
        raise RobotError(
            f"the motors of parameters.{name} take {share:.1f} times a joint's speed away in a step of "
            f"{1e3 * _TRAINING_TIMESTEP:g} ms, which must stay below 2, or joints swing ever further; give armature, the "
            "motors' rotor inertia, or lower damping"
        )
    return f"in a step of {1e3 * _TRAINING_TIMESTEP:g} ms motors take up to {share:.1f} times a joint's speed away; below 2 is stable"


def _measure(robot: Robot) -> str:
    """Say how a robot's torques compare with those of the Go2, for which some suites state metrics in watts and newton metres."""
    plan = body_plan(robot)
    load = 9.81 * plan.mass * plan.leg_length
    times = load / (9.81 * _GO2[0] * _GO2[1])
    return (
        f"weight times leg length is {load:.3g} N·m, {times:.2g} times a Go2's: suites of fixed measure (robogauge-1.1 and its kin) "
        "judge its torque and power as a Go2's; others, such as gaitgauge-1, judge them in its own measure"
    )


def _parameters(robot: Robot) -> str:
    if "gauge" not in robot.parameters:
        raise RobotError(f"suites need the parameter set 'gauge'; the robot has {', '.join(robot.parameters)}")
    return f"parameter sets: {', '.join(robot.parameters)}"


def _sdk(robot: Robot) -> str:
    if robot.sdk_joint_names is None:
        raise RobotError("the order of the maker's SDK is not known; give sdk_joint_names")
    return "the order of the maker's SDK is known"
