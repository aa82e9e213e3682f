"""Random numbers of the episodes: observation noise and action latency, independent of batch order, device and threads."""

from __future__ import annotations

import random
import zlib
from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
import torch

from ...policy.observation_table import HEIGHT_SCAN, OBSERVATIONS
from ..episodes import Episode
from ..suite import Noise

TABLE_STEPS = 2000
"""Control steps of a seed that are drawn in advance at a time."""
BLOCK_STEPS = 32
"""Control steps that are looked up for all worlds at a time."""


class NoiseStream(ABC):
    """Draws for K worlds: half widths times uniform numbers in [-1, 1), and delays. Every episode has a stream of its own."""

    tables: tuple[torch.Tensor, ...] = ()
    """Memory that ``draw`` reads, and that ``assign`` may replace by other memory."""

    @abstractmethod
    def assign(self, world: int, episode: Episode, steps: int = TABLE_STEPS) -> None:
        """Read an episode's stream in a world, up to ``steps`` control steps from its start."""

    @abstractmethod
    def draw(self, step: torch.Tensor) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """Return noise by observation term and delay [substeps] of every world.

        Args:
            step: place in each world's stream, in control steps, (…, K) int64.

        Returns:
            ``{term: (…, K, width)}`` in physical units, and (…, K) int64.
        """


class ReferenceStream(NoiseStream):
    """Python's generator seeded with the episode's seed, drawn in the published order (gauge protocol §4).

    A control step draws uniform numbers for joint positions, joint velocities, base and imu linear velocity and base and
    imu angular velocity (all in that order), then one whole number for the delay, whatever the episode does. Episodes of
    one seed therefore share one table. What no observation contains is drawn and forgotten.
    """

    def __init__(self, noise: Noise, joints: int, worlds: int, device: torch.device) -> None:
        self._noise, self._joints, self._device = noise, joints, device
        self._seeds: dict[int, int] = {}
        self._generators: list[random.Random] = []
        self._length = 0
        self._uniform = torch.zeros(0, 0, 2 * joints + 3, device=device)
        self._delays = torch.zeros(0, 0, dtype=torch.int64, device=device)
        self._row = torch.zeros(worlds, dtype=torch.int64, device=device)
        half = [noise.joint_position] * joints + [noise.joint_velocity] * joints + [0.05] * 3
        half += [noise.base_angular_velocity] * 3 + [0.05] * 3 + [noise.base_angular_velocity] * 3
        self._half = half
        self._observed = [*range(2 * joints), *range(len(half) - 3, len(half))]

    def assign(self, world: int, episode: Episode, steps: int = TABLE_STEPS) -> None:
        """See ``NoiseStream.assign``."""
        if steps > self._length:
            more = -(-(steps - self._length) // TABLE_STEPS) * TABLE_STEPS
            uniform, delays = self._tables(self._generators, more)
            self._uniform = torch.cat((self._uniform, uniform), dim=1)
            self._delays = torch.cat((self._delays, delays), dim=1)
            self._length += more
        if episode.seed not in self._seeds:
            generator = random.Random(episode.seed)
            uniform, delays = self._tables([generator], self._length)
            self._seeds[episode.seed] = len(self._seeds)
            self._generators.append(generator)
            self._uniform = torch.cat((self._uniform, uniform))
            self._delays = torch.cat((self._delays, delays))
        self._row[world] = self._seeds[episode.seed]

    @property
    def tables(self) -> tuple[torch.Tensor, ...]:  # type: ignore[override]
        """See ``NoiseStream.tables``."""
        return self._uniform, self._delays

    def _tables(self, generators: Sequence[random.Random], count: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the next ``count`` control steps of some generators: (G, count, W) in physical units, and delays (G, count)."""
        uniform = np.zeros((len(generators), count, len(self._observed)), dtype=np.float32)
        delays = np.zeros((len(generators), count), dtype=np.int64)
        low, latency = -np.asarray(self._half)[self._observed], self._noise.latency
        for row, generator in enumerate(generators):
            draw, delay, steps = generator.random, generator.randint, range(len(self._half))
            drawn = [([draw() for _ in steps], delay(0, latency)) for _ in range(count)]
            unit = np.array([numbers for numbers, _ in drawn]).reshape(count, -1)[:, self._observed]
            uniform[row] = low + (-low - low) * unit  # as random.uniform does
            delays[row] = [number for _, number in drawn]
        return torch.tensor(uniform, device=self._device), torch.tensor(delays, device=self._device)

    def draw(self, step: torch.Tensor) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """See ``NoiseStream.draw``. A place beyond what was asked for with ``assign`` gives some other numbers."""
        at = torch.clamp(self._row * self._length + step, max=len(self._seeds) * self._length - 1)
        values = self._uniform.flatten(0, 1).index_select(0, at.flatten()).view(*step.shape, -1)
        j = self._joints
        terms = {
            "joint_position": values[..., :j],
            "joint_velocity": values[..., j : 2 * j],
            "base_angular_velocity_b": values[..., -3:],
        }
        return terms, self._delays.flatten()[at]


_COUNTER_ORDER = (
    "joint_position",
    "joint_velocity",
    "base_angular_velocity_b",
    "projected_gravity_b",
    "base_linear_velocity_b",
)
"""The project's own observations by their index in a ``CounterStream``; scores depend on it."""


class CounterStream(NoiseStream):
    """A hash of (episode, control step, index): every episode has a stream of its own, with no state to carry."""

    def __init__(self, noise: Noise, joints: int, worlds: int, device: torch.device, *, scan: int = 0) -> None:
        """Prepare numbers for K worlds; ``scan``: points of the height scan, 0 for none."""
        self._noise = noise
        self._key = torch.zeros(worlds, dtype=torch.int64, device=device)
        without = {*_COUNTER_ORDER} if scan else {*_COUNTER_ORDER, HEIGHT_SCAN}
        noisy = [OBSERVATIONS[name] for name in _COUNTER_ORDER]
        noisy += [o for o in OBSERVATIONS.values() if o.noise is not None and o.name not in without]
        self._widths = {each.name: scan if each.name == HEIGHT_SCAN else each.width or joints for each in noisy}
        half = [each.half_width(noise) for each in noisy for _ in range(self._widths[each.name])]
        self._half = torch.tensor(half, device=device)
        own = sum(self._widths[name] for name in _COUNTER_ORDER)
        index = [*range(own)]
        for each in noisy[len(_COUNTER_ORDER) :]:
            # a plug-in's numbers depend on its name alone, not on what else is installed
            start = own + 1 + zlib.crc32(each.name.encode())
            index += range(start, start + self._widths[each.name])
        # the delay's index comes behind those of the project's own
        self._index = torch.tensor([*index, own], dtype=torch.int64, device=device)

    def assign(self, world: int, episode: Episode, steps: int = TABLE_STEPS) -> None:
        """See ``NoiseStream.assign``."""
        low, high = zlib.crc32(episode.key.encode()), zlib.crc32(episode.key[::-1].encode())
        self._key[world] = (high << 31) ^ low

    def draw(self, step: torch.Tensor) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """See ``NoiseStream.draw``."""
        unit = uniform_hash(self._key[:, None], step[..., None], self._index)
        delay = (unit[..., -1] * (self._noise.latency + 1)).to(torch.int64)
        values = (2.0 * unit[..., :-1] - 1.0) * self._half
        return dict(zip(self._widths, values.split(list(self._widths.values()), dim=-1), strict=True)), delay


def uniform_hash(key: torch.Tensor, step: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    """Return uniform numbers in [0, 1) from integers, the same on every device (the SplitMix64 finalizer over a Weyl sequence).

    Arguments are int64 and broadcast against each other; returns float32 with 24 random bits.
    """
    state = key + step * 0x5851F42D4C957F2D + index * -0x61C8864680B583EB
    state = (state ^ _shift(state, 30)) * -0x40A7B892E31B1A47
    state = (state ^ _shift(state, 27)) * -0x6B2FB644ECCEEE15
    state = state ^ _shift(state, 31)
    return _shift(state, 40).to(torch.float32) / float(1 << 24)


def _shift(value: torch.Tensor, bits: int) -> torch.Tensor:
    """Shift int64 to the right, filled up with zeros."""
    return (value >> bits) & ((1 << (64 - bits)) - 1)


def make_stream(
    noise: Noise, joints: int, worlds: int, device: torch.device, *, scan: int = 0
) -> ReferenceStream | CounterStream:
    """Return the stream that a suite asks for; ``scan``: points of the height scan, for which the published stream has no noise."""
    if noise.stream == "reference":
        return ReferenceStream(noise, joints, worlds, device)
    return CounterStream(noise, joints, worlds, device, scan=scan)


class NoiseReader:
    """Reads K streams step by step, many steps at a time."""

    def __init__(self, stream: NoiseStream, worlds: int, device: torch.device) -> None:
        self._stream, self._device = stream, device
        self._offset = torch.zeros(worlds, dtype=torch.int64, device=device)
        self._ahead = torch.arange(BLOCK_STEPS, device=device)[:, None]
        self._block: list[tuple[dict[str, torch.Tensor], torch.Tensor]] = []
        self._now = 0

    def begin(self, worlds: Sequence[int], episodes: Sequence[Episode], starts: Sequence[int], steps: int) -> None:
        """Let some worlds read other streams from the next step on.

        Args:
            starts: the places in them at which to begin, in control steps.
            steps: none of them reads more than this number of control steps.
        """
        for world, episode, start in zip(worlds, episodes, starts, strict=True):
            self._stream.assign(world, episode, start + steps)
        at = torch.tensor(worlds, device=self._device)
        self._offset[at] = torch.tensor(starts, device=self._device) - self._now
        self._block = []

    def next(self) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """Return noise by observation term, (K, width), and delays, (K,), of the next control step."""
        if not self._block:
            terms, delays = self._stream.draw(self._now + self._ahead + self._offset)
            columns = [value.unbind(0) for value in terms.values()]
            self._block = [
                (dict(zip(terms, values, strict=True)), delay)
                for *values, delay in reversed(list(zip(*columns, delays.unbind(0), strict=True)))
            ]
        self._now += 1
        return self._block.pop()
