"""Likelihoods and draws of many poses at once by Warp, on a CUDA device or, for tests, a CPU.

Warp is imported only where it is used: it is an optional dependency, takes most of a second to import, and pays off
only for large batches.
"""

import ctypes
import importlib.util
import shlex
import sys
from functools import cache
from typing import Any, Literal

Device = Literal["auto", "cpu", "cuda", "warp-cpu"]
"""Device that evaluates likelihoods: `cpu` = the Numba kernels; `warp-cpu` = the Warp kernels on a CPU, for tests."""

LARGE = 10_000_000
"""Number of look-ups in one call from which on `auto` uses a CUDA device.

Two CPU cores need 50 ms for these (2·10⁸ per second, measured). Copying two views of 640 by 480 pixels, 20 MB, takes
about 2 ms at 10 GB/s, so that the choice is right on any device that is faster than the CPU.
"""


def chosen(device: Device, lookups: int) -> str | None:
    """Return the name of the Warp device for a call with this many look-ups; None = the Numba kernels."""
    if device == "auto":
        return "cuda" if lookups >= LARGE and missing() is None else None
    return {"cpu": None, "cuda": "cuda", "warp-cpu": "cpu"}[device]


@cache
def missing() -> str | None:
    """Return what is missing to evaluate on a CUDA device, and what to do; None if nothing is."""
    if importlib.util.find_spec("warp") is None:
        return f"warp-lang is not installed; {shlex.quote(sys.executable)} -m pip install 'modeler[gpu]'"
    without = "leave `device` out, or give `device` cpu"
    try:
        ctypes.CDLL("nvcuda.dll" if hasattr(ctypes, "WinDLL") else "libcuda.so.1")
    except OSError:
        return f"there is no NVIDIA driver on this machine; {without}"
    if not warp().is_cuda_available():
        return f"Warp finds no CUDA device that the installed driver can use; {without}"
    return None


@cache
def warp() -> Any:
    """Return the initialised Warp module; it only prints errors."""
    import warp as wp

    wp.config.log_level = 40
    wp.init()
    return wp
