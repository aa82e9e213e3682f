"""Fill structures of arrays for kernels by the names of their fields."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp


def to_warp(values: Any, dtype: type) -> Any:
    """Copy a constant table to the current Warp device."""
    return wp.array(np.ascontiguousarray(values), dtype=dtype)


def filled(kind: Any, *sources: object, **values: Any) -> Any:
    """Fill a Warp structure with ``values`` or the first source's attribute of a field's name; raise ``TypeError`` for neither.

    NumPy arrays are copied to the current Warp device, in the field's type.
    """
    made = kind()
    for name, field in kind.vars.items():
        source = next((s for s in sources if hasattr(s, name)), None)
        if name not in values and source is None:
            raise TypeError(f"nothing gives the field '{name}' of {kind.key} a value")
        value = values[name] if name in values else getattr(source, name)
        setattr(made, name, to_warp(value, field.type.dtype) if isinstance(value, np.ndarray) else value)
    return made
