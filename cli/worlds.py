"""Makes worlds to be watched: from the names of a policy and a terrain to a robot that walks."""

from __future__ import annotations

from typing import Any

from ..backends.registry import choose_device
from ..gauge.suite import load_suite
from ..policy.base import Policy
from ..policy.loading import load_policy
from ..policy.robot_of import robot_for
from ..robots import load_robot
from ..terrains.gauge_terrains import LEVELS
from ..terrains.registry import gauge_terrain_names, make_terrain
from .play_session import PlaySession
from .policies import policy_file


class WorldMaker:
    """What all worlds of one command share. Policies are loaded once."""

    def __init__(
        self,
        *,
        backend: str,
        device: str | None,
        seed: int,
        trust: bool,
        robot: str | None = None,
        suite: str = "gaitgauge-1",
    ) -> None:
        """Take the options of ``gaitgauge play`` of these names.

        Raises:
            BackendError: no such engine or device.
            SuiteError: no such suite.
        """
        self._trust, self._robot = trust, robot
        where = choose_device(backend, device)
        self._settings: dict[str, Any] = {"backend": backend, "device": where, "seed": seed, "suite": load_suite(suite)}
        self._policies: dict[str, Policy] = {}

    def make(self, choice: str, terrain: str, level: int | None, friction: float, label: str) -> PlaySession:
        """A robot with a policy on a terrain.

        Raises:
            PolicyError, ContractError, TerrainError, BackendError, UserError: one sentence on what is wrong.
        """
        ground = make_terrain(terrain, level)
        if choice not in self._policies:
            asked = None if self._robot is None else load_robot(self._robot)
            self._policies[choice] = load_policy(policy_file(choice), asked, trust=self._trust)
        policy = self._policies[choice]
        body = robot_for(policy.contract, self._robot)
        return PlaySession(policy, body, ground, friction=friction, label=label, **self._settings)

    @staticmethod
    def default_level(terrain: str) -> int | None:
        """The level where none is given: the middle one, None for a terrain without levels."""
        return LEVELS[len(LEVELS) // 2 - 1] if terrain != "flat" and terrain in gauge_terrain_names() else None
