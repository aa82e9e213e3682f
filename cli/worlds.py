"""Makes worlds to be watched: from the names of a policy and a terrain to a robot that walks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..backends.registry import choose_device
from ..gauge.suite import load_suite
from ..policy.base import Policy
from ..policy.its_robot import robot_for
from ..policy.loading import load_policy
from ..robots import load_robot
from ..terrains.gauge_terrains import LEVELS
from ..terrains.registry import gauge_terrain_names, make_terrain
from .play_session import PlaySession, PlaySettings
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
        """Choose an engine.

        Args:
            backend: name of the engine.
            device: where it computes, None for what it is made for.
            seed: of the heading at each start.
            trust: run the program that a policy file carries inside.
            robot: name or path of the robot; None for the one that each policy is for.
            suite: name or path of the suite whose physics, joint parameters and speeds are played with.

        Raises:
            BackendError: no such engine or device.
            SuiteError: no such suite.
        """
        self._backend, self._device = backend, choose_device(backend, device)
        self._seed, self._trust, self._robot = seed, trust, robot
        self._suite = load_suite(suite)
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
        settings = PlaySettings(
            backend=self._backend, device=self._device, friction=friction, seed=self._seed, suite=self._suite
        )
        return PlaySession(policy, robot_for(policy.contract, self._robot), ground, settings, label)

    @staticmethod
    def default_level(terrain: str) -> int | None:
        """The level where none is given: the middle one, None for a terrain without levels."""
        return LEVELS[len(LEVELS) // 2 - 1] if terrain != "flat" and terrain in gauge_terrain_names() else None


def labels(choices: Sequence[str]) -> list[str]:
    """Names of policies for people: as short as they go while they differ."""
    short = [Path(c).name.removesuffix(".pt").removesuffix(".gauge").removesuffix(".onnx") or c for c in choices]
    if len(set(short)) == len(short):
        return short
    longer = ["/".join(Path(c).parts[-2:]) for c in choices]
    return longer if len(set(longer)) == len(longer) else [f"{i}: {c}" for i, c in enumerate(longer, 1)]
