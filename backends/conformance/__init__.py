"""Check that an engine keeps the physics contract: any ``PhysicsBackend``, a third party's included.

``run_conformance(name)`` runs all checks and returns one result for each; nothing here prints, and nothing needs pytest.
Expected values come from plain MuJoCo (C) loops and closed formulas in ``reference``, never from another engine.
"""

from .bench import Bench, ConformanceError
from .check import Check
from .suite import CheckResult, Outcome, all_checks, make_bench, run_check, run_conformance

__all__ = [
    "Bench", "Check", "CheckResult", "ConformanceError", "Outcome", "all_checks", "make_bench", "run_check",
    "run_conformance",
]  # fmt: skip
