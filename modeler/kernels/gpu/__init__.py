"""Likelihoods and draws of many poses at once by Warp: one source that runs on a CUDA device and, for tests, a CPU.

What is here imports Warp only where it is used: it is an extra, takes most of a second to import, and pays for large
work only.
"""

import ctypes
import importlib.util
from functools import cache
from typing import Any, Literal

Device = Literal["auto", "cpu", "cuda", "warp-cpu"]
"""Where likelihoods are evaluated: `cpu` = the kernels of Numba; `warp-cpu` = those of Warp on a CPU, for tests."""

LARGE = 10_000_000
"""Points looked up under poses in one call from which on `auto` takes a CUDA device.

Two CPU cores need 50 ms for these (2·10⁸ a second were measured). Sending two views of 640 by 480 pixels, 20 MB, takes
about 2 ms at the 10 GB/s of a usual bus, so that the choice is right on any device that beats the CPU at all.
"""


def chosen(asked: Device, lookups: int) -> str | None:
    """Return the name of Warp's device for a call of so many look-ups; None = the kernels of Numba."""
    if asked == "auto":
        return "cuda" if lookups >= LARGE and missing() is None else None
    return {"cpu": None, "cuda": "cuda", "warp-cpu": "cpu"}[asked]


@cache
def missing() -> str | None:
    """Return what is missing here to evaluate on a CUDA device, and what to do; None where nothing is."""
    if importlib.util.find_spec("warp") is None:
        return "warp-lang is not installed; pip install 'modeler[gpu]'"
    without = "leave --device out, or give --device cpu"
    try:
        ctypes.CDLL("nvcuda.dll" if hasattr(ctypes, "WinDLL") else "libcuda.so.1")
    except OSError:
        return f"there is no NVIDIA driver on this machine; {without}"
    if not warp().is_cuda_available():
        return f"Warp finds no CUDA device that the installed driver can use; {without}"
    return None


@cache
def warp() -> Any:
    """Return Warp, made ready; it says nothing but errors."""
    import warp as wp

    wp.config.log_level = 40
    wp.init()
    return wp
