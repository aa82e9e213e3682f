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
        rows = []
        for ramp in ramps:
            if isinstance(ramp, Ramp):
                if ramp.until < ramp.begin:
                    raise ConfigurationError(
                        f"a ramp begins at {ramp.begin:g} and ends at {ramp.until:g} of the run; "
                        "'until' must not be before 'begin'"
                    )
                rows.append((ramp.start, ramp.end - ramp.start, ramp.begin, 1.0 / max(ramp.until - ramp.begin, 1e-9)))
            else:
                rows.append((float(ramp), 0.0, 0.0, 0.0))
        start, change, begin, rate = torch.tensor(rows, dtype=torch.float32, device=device).reshape(-1, 4).unbind(1)
        self._start, self._change, self._begin, self._rate = (t.contiguous() for t in (start, change, begin, rate))

    def at(self, progress: torch.Tensor) -> torch.Tensor:
        """Return values (R,) at a fraction of the run, a scalar tensor."""
        return self._start + self._change * ((progress - self._begin) * self._rate).clamp(0.0, 1.0)
