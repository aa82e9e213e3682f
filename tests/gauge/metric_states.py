"""Instants of a motion, and what the metrics of a suite make of them."""

import torch
from gaitgauge.gauge.instants import Instants
from gaitgauge.gauge.metrics import MetricEvaluator
from gaitgauge.gauge.play.sampling import GRAVITY
from gaitgauge.gauge.suite import load_suite
from gaitgauge.robots.anatomy.body_plan import total_mass
from scipy.spatial.transform import Rotation
from scripted_gauge import GO2

REFERENCE, OWN = load_suite("robogauge-1.1"), load_suite("gaitgauge-1")
CPU = torch.device("cpu")
SPAN = 0.5656  # foot to foot across the diagonal in the default pose [m]


def rows(*values):
    return torch.tensor(values, dtype=torch.float64).reshape(1, -1)


def turned(roll=0.0, pitch=0.0, yaw=0.0):
    turn = Rotation.from_euler("xyz", [roll, pitch, yaw], degrees=True)
    return torch.from_numpy(turn.as_quat(scalar_first=True))[None]


def scalar(value):
    return torch.tensor([value], dtype=torch.float64)


def evaluator(suite, robot=GO2):
    return MetricEvaluator(suite.metrics, robot, GRAVITY * total_mass(robot), CPU, torch.float64)


def evaluate(suite, state, command=(0.0, 0.0, 0.0), limits=(1.0, 1.0, 1.5), friction=0.6, before=None):
    known = before is not None
    torque = state.joint_torque if before is None else before
    metrics = evaluator(suite)
    instants = Instants(
        state=state,
        command=rows(*command),
        limits=rows(*limits),
        friction=scalar(friction),
        torque_before=torque,
        torque_known=torch.tensor([known]),
        constants=metrics.constants,
    )
    values = metrics.evaluate(instants)
    found = metrics.with_quality(values, torch.tensor([True]), [1])
    names = (*suite.metrics.weights, "quality")
    return dict(zip(names, found[0].tolist(), strict=True))
