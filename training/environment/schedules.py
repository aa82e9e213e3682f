"""Values that change with training progress, on the device: reading them costs no synchronisation."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ..configuration import ConfigurationError, Ramp


class RampTable:
    """Several ramps evaluated together."""

    def __init__(self, ramps: Sequence[Ramp | float], device: torch.device | str) -> None:
        """Put the ramps on the device; a plain number is a ramp that never moves.

        Raises:
            ConfigurationError: a ramp ends before it begins.
        """
        moving = [ramp if isinstance(ramp, Ramp) else Ramp(start=ramp, end=ramp) for ramp in ramps]
        for ramp in moving:
            if ramp.until < ramp.begin:
                raise ConfigurationError(
                    f"a ramp begins at {ramp.begin:g} and ends at {ramp.until:g} of the run; 'until' must not be before 'begin'"
                )
        rows = [(r.start, r.end - r.start, r.begin, 1.0 / max(r.until - r.begin, 1e-9)) for r in moving]
        start, change, begin, rate = torch.tensor(rows, dtype=torch.float32, device=device).reshape(-1, 4).unbind(1)
        self._start, self._change, self._begin, self._rate = (t.contiguous() for t in (start, change, begin, rate))

    def at(self, progress: torch.Tensor) -> torch.Tensor:
        """Return values (R,) at a fraction of the run, a scalar tensor."""
        return self._start + self._change * ((progress - self._begin) * self._rate).clamp(0.0, 1.0)
