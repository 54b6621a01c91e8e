"""Compiled functions: arrays in, arrays out; no package types, no hidden randomness."""

import os
from collections.abc import Callable
from pathlib import Path

from numba.core import config, event

# Numba asks a threading layer for the number of threads, from several threads too: OpenMP's, as Open3D needs libgomp.
config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]  # pyright: ignore[reportAttributeAccessIssue]
# Threads of Open3D that spin at the end of each short loop delay each other on a busy machine.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")


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
