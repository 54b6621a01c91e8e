"""Compiled functions: arrays in, arrays out; no package types, no hidden randomness."""

import os
from contextlib import suppress
from importlib import import_module
from pathlib import Path

from numba.core import config

# OpenMP is thread-safe (pairs may be registered from several threads) and Open3D needs libgomp anyway.
config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]  # pyright: ignore[reportAttributeAccessIssue]
# Threads that spin at the end of each short loop delay each other on a busy machine.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def drop_stale(folder: Path) -> None:
    """Delete the compiled kernels of a folder that are older than any source file there.

    Numba keeps a kernel while its own file is unchanged, though it contains copies of functions from other files.
    """
    newest = max(path.stat().st_mtime for path in folder.glob("*.py"))
    for index in (folder / "__pycache__").glob("*.nbi"):
        with suppress(OSError):  # another process was quicker, or we may not
            if index.stat().st_mtime < newest:
                index.unlink()


def compiled(module: str, name: str) -> bool:
    """Return whether a kernel as it stands has been compiled on this machine."""
    kernel = getattr(import_module(f"modeler.kernels.{module}"), name)
    return any(Path(str(kernel.stats.cache_path)).glob(f"{module}.{name}-*.nbi"))


drop_stale(Path(__file__).parent)
