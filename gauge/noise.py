"""Random numbers of the episodes: observation noise and action latency, independent of batch order, device and threads."""

from __future__ import annotations

import random
import zlib
from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from .episodes import Episode
from .suite import Noise

TABLE_STEPS = 2000
"""Control steps that are drawn in advance at a time."""


class NoiseStream(ABC):
    """Draws for K episodes at work: half widths times uniform numbers in [-1, 1), and delays."""

    @abstractmethod
    def assign(self, slot: int, episode: Episode) -> None:
        """Start an episode's stream in a slot."""

    def reserve(self, steps: int) -> None:  # noqa: B027  (only tables need it)
        """Be ready for episodes of ``steps`` control steps."""

    @abstractmethod
    def draw(self, step: torch.Tensor) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """Noise by observation term and delay [substeps] of every slot.

        Args:
            step: number of control steps that each episode has behind it, (K,) int64.

        Returns:
            ``{term: (K, width)}`` in physical units, and (K,) int64.
        """


class ReferenceStream(NoiseStream):
    """Python's generator seeded with the episode's seed, drawn in the published order (gauge protocol §4).

    A control step draws uniform numbers for joint positions, joint velocities, base and imu linear velocity and base and
    imu angular velocity (all in that order), then one whole number for the delay, whatever the episode does. Episodes of
    one seed therefore share one table.
    """

    def __init__(self, noise: Noise, joints: int, slots: int, device: torch.device) -> None:
        self._noise, self._joints, self._device = noise, joints, device
        self._seeds: list[int] = []
        self._generators: list[_PythonGenerator] = []
        self._length = TABLE_STEPS
        self._uniform = torch.zeros(0, self._length, 2 * joints + 12, device=device)
        self._delays = torch.zeros(0, self._length, dtype=torch.int64, device=device)
        self._row = torch.zeros(slots, dtype=torch.int64, device=device)
        half = [noise.joint_position] * joints + [noise.joint_velocity] * joints + [0.05] * 3
        half += [noise.base_angular_velocity] * 3 + [0.05] * 3 + [noise.base_angular_velocity] * 3
        self._half = half

    def assign(self, slot: int, episode: Episode) -> None:
        """See ``NoiseStream.assign``."""
        if episode.seed not in self._seeds:
            generator = _PythonGenerator(episode.seed)
            uniform, delays = self._tables([generator], self._length)
            self._seeds.append(episode.seed)
            self._generators.append(generator)
            self._uniform = torch.cat((self._uniform, uniform))
            self._delays = torch.cat((self._delays, delays))
        self._row[slot] = self._seeds.index(episode.seed)

    def _tables(self, generators: Sequence[_PythonGenerator], count: int) -> tuple[torch.Tensor, torch.Tensor]:
        """The next ``count`` control steps of some generators: (G, count, W) in physical units, and delays (G, count)."""
        drawn = [g.draw(count, len(self._half), self._noise.latency) for g in generators]
        uniform = np.stack([low_to_high(u, self._half) for u, _ in drawn])
        delays = np.stack([d for _, d in drawn])
        return (
            torch.tensor(uniform, dtype=torch.float32, device=self._device),
            torch.tensor(delays, device=self._device),
        )

    def reserve(self, steps: int) -> None:
        """See ``NoiseStream.reserve``."""
        while self._length < steps:
            uniform, delays = self._tables(self._generators, TABLE_STEPS)
            self._uniform = torch.cat((self._uniform, uniform), dim=1)
            self._delays = torch.cat((self._delays, delays), dim=1)
            self._length += TABLE_STEPS

    def draw(self, step: torch.Tensor) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """See ``NoiseStream.draw``. Call ``reserve`` before an episode can get beyond the table."""
        values = self._uniform[self._row, step]
        j = self._joints
        terms = {
            "joint_position": values[:, :j],
            "joint_velocity": values[:, j : 2 * j],
            "base_angular_velocity_b": values[:, -3:],
        }
        return terms, self._delays[self._row, step]


class _PythonGenerator:
    """Many draws of ``random.Random(seed)`` at once: the same Mersenne twister, read as whole words through NumPy."""

    def __init__(self, seed: int) -> None:
        state = random.Random(seed).getstate()[1]
        self._twister = np.random.MT19937()
        self._twister.state = {
            "bit_generator": "MT19937",
            "state": {"key": np.array(state[:-1], dtype=np.uint32), "pos": state[-1]},
        }
        self._words = np.zeros(0, dtype=np.uint64)

    def draw(self, count: int, width: int, most: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """``count`` times ``width`` calls of ``random()`` followed by one of ``randint(0, most)``.

        Returns:
            (count, width) in [0, 1), and (count,).
        """
        bits = (most + 1).bit_length()
        uniform, whole = np.zeros((count, width)), np.zeros(count, dtype=np.int64)
        at = 0
        for row in range(count):
            self._need(at + 2 * width + 64)
            pairs = self._words[at : at + 2 * width]
            uniform[row] = ((pairs[0::2] >> 5) * 67108864.0 + (pairs[1::2] >> 6)) / 9007199254740992.0
            at += 2 * width
            while True:  # randint draws again until the number is small enough
                self._need(at + 1)
                number = int(self._words[at]) >> (32 - bits)
                at += 1
                if number <= most:
                    break
            whole[row] = number
        self._words = self._words[at:]
        return uniform, whole

    def _need(self, words: int) -> None:
        if len(self._words) < words:
            more = self._twister.random_raw(max(words, 1 << 16))
            self._words = np.concatenate((self._words, more))


def low_to_high(unit: NDArray[np.float64], half: Sequence[float]) -> NDArray[np.float64]:
    """Numbers in [0, 1) as ``random.uniform(-half, half)`` maps them; ``unit`` (…, W), ``half`` (W,)."""
    low = -np.asarray(half)
    return low + (np.asarray(half) - low) * unit


class CounterStream(NoiseStream):
    """A hash of (episode, control step, index): every episode has a stream of its own, with no state to carry."""

    def __init__(self, noise: Noise, joints: int, slots: int, device: torch.device) -> None:
        self._noise, self._joints = noise, joints
        self._key = torch.zeros(slots, dtype=torch.int64, device=device)
        half = [noise.joint_position] * joints + [noise.joint_velocity] * joints + [noise.base_angular_velocity] * 3
        self._half = torch.tensor(half, device=device)
        self._index = torch.arange(2 * joints + 4, dtype=torch.int64, device=device)

    def assign(self, slot: int, episode: Episode) -> None:
        """See ``NoiseStream.assign``."""
        low, high = zlib.crc32(episode.key.encode()), zlib.crc32(episode.key[::-1].encode())
        self._key[slot] = (high << 31) ^ low

    def draw(self, step: torch.Tensor) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """See ``NoiseStream.draw``."""
        unit = uniform_hash(self._key[:, None], step[:, None], self._index)
        delay = (unit[:, -1] * (self._noise.latency + 1)).to(torch.int64)
        values = (2.0 * unit[:, :-1] - 1.0) * self._half
        j = self._joints
        terms = {
            "joint_position": values[:, :j],
            "joint_velocity": values[:, j : 2 * j],
            "base_angular_velocity_b": values[:, -3:],
        }
        return terms, delay


def uniform_hash(key: torch.Tensor, step: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    """Uniform numbers in [0, 1) from integers, the same on every device (the SplitMix64 finalizer over a Weyl sequence).

    Arguments are int64 and broadcast against each other; returns float32 with 24 random bits.
    """
    state = key + step * 0x5851F42D4C957F2D + index * -0x61C8864680B583EB
    state = (state ^ _shift(state, 30)) * -0x40A7B892E31B1A47
    state = (state ^ _shift(state, 27)) * -0x6B2FB644ECCEEE15
    state = state ^ _shift(state, 31)
    return _shift(state, 40).to(torch.float32) / float(1 << 24)


def _shift(value: torch.Tensor, bits: int) -> torch.Tensor:
    """Logical right shift of int64."""
    return (value >> bits) & ((1 << (64 - bits)) - 1)


def make_stream(noise: Noise, joints: int, slots: int, device: torch.device) -> ReferenceStream | CounterStream:
    """The stream that a suite asks for."""
    return (ReferenceStream if noise.stream == "reference" else CounterStream)(noise, joints, slots, device)
