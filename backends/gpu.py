"""Ask the graphics driver for NVIDIA GPUs without torch or an engine, which take seconds to load."""

from __future__ import annotations

import ctypes
import sys


def gpu_count() -> int:
    """Return the number of NVIDIA GPUs that this process may use, as CUDA counts them; 0 where there is no driver."""
    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return 0
    count = ctypes.c_int(0)
    if driver.cuInit(0) != 0 or driver.cuDeviceGetCount(ctypes.byref(count)) != 0:
        return 0
    return count.value
