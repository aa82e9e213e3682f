"""Does an engine keep the physics contract? Checks that run against any ``PhysicsBackend``, a third party's included.

``run_conformance(name)`` runs them all and returns one result for each; nothing here prints, and nothing needs pytest.
The expected values come from plain MuJoCo (C) loops and closed formulas in ``reference``, never from another engine of
this package.
"""

from .bench import Bench, ConformanceError
from .check import Check
from .suite import CheckResult, Outcome, all_checks, make_bench, run_check, run_conformance

__all__ = [
    "Bench",
    "Check",
    "CheckResult",
    "ConformanceError",
    "Outcome",
    "all_checks",
    "make_bench",
    "run_check",
    "run_conformance",
]
