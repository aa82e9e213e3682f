"""Write the hand-made trotting controller as a policy file: a baseline that a trained policy has to beat.

The file depends on nothing but this script and the robot: the same bytes come out every time.

    python benchmarks/make_trot_policy.py trot.gauge.pt
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.native import StoredNetwork, save_policy
from gaitgauge.robots import load_robot
from gaitgauge.robots.anatomy.body_plan import total_mass

# The Go2's legs, as its model file has them [m].
GEOMETRY: dict[str, Any] = {
    "hip_position": [[0.1934, 0.0465, 0.0], [0.1934, -0.0465, 0.0], [-0.1934, 0.0465, 0.0], [-0.1934, -0.0465, 0.0]],
    "thigh_offset": 0.0955,
    "link_length": 0.213,
}
# Found by hand and by random search over falls and tracking errors in the mujoco engine: level ground, friction 0.6, the
# gauge's noise and latency, commands up to the limits and their reversal.
GAIT: dict[str, Any] = {
    "damping": 0.206,
    "foot_x": [0.17, -0.215],
    "foot_y": 0.137,
    "height": 0.31,
    "period": 0.391,
    "duty": 0.56,
    "clearance": 0.07,
    "limits": [1.15, 0.65, 1.9],
    "acceleration": [1.932, 1.165, 4.227],
    "placement_gain": 0.136,
    "velocity_gain": 3.438,
    "attitude_gain": 0.194,
    "attitude_damping": 0.052,
    "yaw_gain": 0.439,
    "support": 0.894,
    "velocity_filter": 0.069,
    "yaw_filter": 0.2,
    "leading": 0.037,
    "yaw_force": 18.539,
}


def make() -> tuple[Any, StoredNetwork]:
    """The policy's contract and network."""
    robot = load_robot("go2")
    contract = standard_contract(
        robot, provenance={"made_by": "benchmarks/make_trot_policy.py", "kind": "hand-made trot"}
    )
    motors = robot.parameters[robot.default_parameters]
    arguments = {
        "default_joint_position": list(robot.default_joint_position),
        "action_scale": contract.action_scale[0],
        "stiffness": motors.stiffness[0],
        "control_period": contract.control_period,
        "mass": round(total_mass(robot), 3),
        **GEOMETRY,
        **GAIT,
    }
    return contract, StoredNetwork(architecture="trot", arguments=arguments, state_dict={})


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("destination", type=Path, help="file to write")
    destination = parser.parse_args().destination
    contract, network = make()
    save_policy(destination, contract, network)
    print(f"wrote {destination}, contract {contract.hash[:12]}")


if __name__ == "__main__":
    main()
