"""Compiled functions: arrays in, arrays out; no package types, no hidden randomness."""

import hashlib
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
    """Delete the compiled kernels of a folder if its source files are not those that they were compiled from.

    Numba keeps a kernel while its own file is unchanged, although it contains functions inlined from other files. Dates
    do not tell: a file copied with its date may be older than the kernels that it changes.
    """
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*.py")):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    compiled_from = folder / "__pycache__" / "kernels.sha256"
    with suppress(OSError):
        if compiled_from.read_text() == digest.hexdigest():
            return
    for index in compiled_from.parent.glob("*.nbi"):
        with suppress(OSError):  # another process was faster, or no permission
            index.unlink()
    with suppress(OSError):
        compiled_from.parent.mkdir(exist_ok=True)
        compiled_from.write_text(digest.hexdigest())


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
