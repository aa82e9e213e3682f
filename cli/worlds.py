"""Make worlds to be watched: from the names of a policy and a terrain to a robot that walks."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any

from ..backends.registry import choose_device
from ..gauge.ground_rules import build_terrain
from ..gauge.motors import with_parameters
from ..gauge.suite import load_suite
from ..policy.base import Policy
from ..policy.loading import own_contract
from ..robots import Robot
from ..studies.naming import distinct_names
from ..terrains.gauge_terrains import LEVELS
from ..terrains.registry import gauge_terrain_names
from .play_session import PlaySession
from .policies import open_policy
from .requests import PlayRequest


class WorldMaker:
    """Make worlds as one ``gaitgauge play`` asks for them. Policies are loaded once."""

    def __init__(self, request: PlayRequest) -> None:
        """Find device and suite. Raises BackendError: no such engine or device; SuiteError: no such suite."""
        self._request = request
        self._settings: dict[str, Any] = {
            "backend": request.backend,
            "device": choose_device(request.backend, request.device),
            "seed": request.seed,
            "suite": load_suite(request.suite),
        }
        self._policies: dict[str, tuple[Policy, Robot]] = {}

    def make(self, choice: str, terrain: str, level: int | None, friction: float, label: str) -> PlaySession:
        """Return a robot with a policy on a terrain; raise Policy-, Contract-, Robot-, Terrain-, BackendError or UserError."""
        if choice not in self._policies:
            self._policies[choice] = open_policy(
                choice,
                self._request.robot,
                trust=self._request.trust,
                contract_file=own_contract(choice, self._request.contract),
            )
        policy, robot = self._policies[choice]
        suite = self._settings["suite"]
        robot = with_parameters(suite, robot, self._request.parameters)
        ground = build_terrain(suite.ground, robot, terrain, level)
        return PlaySession(policy, robot, ground, friction=friction, label=label, **self._settings)

    def make_all(self, policies: Sequence[str], terrain: str, level: int | None, friction: float) -> list[PlaySession]:
        """Return a world for each policy, or raise as ``make`` does and leave none."""
        with ExitStack() as stack:
            sessions = []
            for policy, label in zip(policies, distinct_names(policies), strict=True):
                sessions.append(self.make(policy, terrain, level, friction, label))
                stack.callback(sessions[-1].close)
            stack.pop_all()
        return sessions

    @staticmethod
    def default_level(terrain: str) -> int | None:
        """Return the level where none is given: the middle one, None for a terrain without levels."""
        return LEVELS[len(LEVELS) // 2 - 1] if terrain != "flat" and terrain in gauge_terrain_names() else None
