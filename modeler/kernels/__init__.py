"""Compiled functions: arrays in, arrays out; no package types, no hidden randomness."""

import os
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path

from numba.core import config, event

# Numba asks a threading layer for the number of threads, from several threads too: OpenMP's, as Open3D needs libgomp.
config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]  # pyright: ignore[reportAttributeAccessIssue]
# Threads of Open3D that spin at the end of each short loop delay each other on a busy machine.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def drop_stale(folder: Path) -> None:
    """Delete the compiled kernels of a folder that are older than any source file there.

    Numba keeps a kernel while its own file is unchanged, although it contains functions inlined from other files.
    """
    newest = max(path.stat().st_mtime for path in folder.glob("*.py"))
    for index in (folder / "__pycache__").glob("*.nbi"):
        with suppress(OSError):  # another process was faster, or no permission
            if index.stat().st_mtime < newest:
                index.unlink()


def compiled(module: str, name: str) -> bool:
    """Return whether the current version of a kernel has been compiled on this machine."""
    kernel = getattr(import_module(f"modeler.kernels.{module}"), name)
    return any(Path(str(kernel.stats.cache_path)).glob(f"{module}.{name}-*.nbi"))


def on_compiling(report: Callable[[str], None]) -> None:
    """Call `report` with the name of the module when the compilation of a kernel begins."""

    class Reporter(event.Listener):
        def on_start(self, event: event.Event) -> None:
            assert event.data is not None
            path = Path(event.data["dispatcher"].py_func.__code__.co_filename)
            if path.parent == Path(__file__).parent:
                report(path.stem)

        def on_end(self, event: event.Event) -> None:
            """Do nothing."""

    event.register("numba:compile", Reporter())


drop_stale(Path(__file__).parent)
