"""Compile the kernels ahead of the first registration, in one process for each half of a run."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from modeler.system.processes import environment

if TYPE_CHECKING:
    from modeler.pipeline import Modeler
    from modeler.types import Array, RayImage

_USED = (
    "bands",
    "planes",
    "lie_group",
    "point_likelihood",
    "photometric",
    "point_to_plane",
    "scores",
    "gauss_newton",
    "mixture",
)
_USED_TO_FUSE = ("votes", "tsdf", "relief", "marching_cubes", "point_clouds")


def compile_kernels(say: Callable[[str], None]) -> None:
    """Compile missing kernels and say how far that is; they are kept for later commands, if they can be.

    Does nothing if they are compiled. Failures here are ignored: kernels are then compiled, or reported, at first use.
    """
    from modeler import kernels
    from modeler.kernels import cache

    missing = [name for name, job in _JOBS.items() if not cache.kept(*job.last)]
    if not missing:
        return
    begun: set[str] = set()
    lock = threading.Lock()
    total = len(_USED) + (len(_USED_TO_FUSE) if "fusion" in missing else 0)

    def note(module: str, often: str = "once on this machine") -> None:
        with lock:
            if module not in begun:
                expected = "" if begun else ", half a minute on two idle cores"
                begun.add(module)
                say(f"compiling kernels, {often}: {len(begun)} of {total}{expected}")

    place = cache.writable()
    if place is None:
        say(f"compiled kernels cannot be kept in {cache.folder()}; make room there, or set NUMBA_CACHE_DIR")
        kernels.on_compiling(lambda module: note(module, "for this command alone"))
        return

    if place != cache.folder():
        say(f"compiled kernels are kept in {place}, as {cache.folder()} cannot be written")

    def follow(process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        with process.stdout as lines:
            for line in lines:
                note(line.strip())

    processes = [
        subprocess.Popen(
            [sys.executable, "-c", f"from modeler.runs.compiling import work; work({job!r})"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            cwd=os.path.dirname(__file__),  # the current folder may hold settings of Numba
            env=environment(),
        )
        for job in missing
    ]
    threads = [threading.Thread(target=follow, args=[process], daemon=True) for process in processes]
    try:
        for thread in threads:
            thread.start()
        for process in processes:
            process.wait()
    finally:
        for process in processes:
            process.terminate()
    for thread in threads:
        thread.join()


def _registration() -> None:
    """Register two frames of a bundled sequence."""
    modeler, (target, source), _ = _prepared()
    modeler.register(source, target)


def _fusion() -> None:
    """Compare the colours of two frames of a bundled sequence, and fuse them."""
    from modeler.verdict.colour_fit import Comparison

    modeler, views, trajectory = _prepared()
    by_frame = {view.index: view for view in views}
    if (compared := Comparison.of(by_frame, trajectory)) is not None:
        compared.fit()
    modeler.fuser.fuse(by_frame, trajectory)


def _prepared() -> tuple[Modeler, list[RayImage], dict[int, Array]]:
    """Return a modeler, two views of a bundled sequence, and its true object_from_camera (4, 4)."""
    from modeler import se3
    from modeler.pipeline import Modeler
    from modeler.sequences import bundled, open_sequence

    sequence, modeler = open_sequence(bundled("box")), Modeler()
    frames = [sequence.frame(index) for index in sequence.indices[:2]]
    scene = modeler.segmenter.scene(frames)
    views = [modeler.prepare(frame, scene).view for frame in frames]
    truth = sequence.truth() or {}
    return modeler, [view for view in views if view is not None], {k: se3.inverse(truth[k]) for k in truth}


class _Job(NamedTuple):
    work: Callable[[], None]
    last: tuple[str, str]
    """Module and name of a kernel that it compiles last."""


_JOBS = {
    "registration": _Job(_registration, ("point_likelihood", "classify")),
    "fusion": _Job(_fusion, ("tsdf", "_observe")),
}


def work(job: str) -> None:
    """Do one job, and print the module of each kernel that it compiles."""
    from modeler import kernels

    kernels.on_compiling(lambda module: print(module, flush=True))
    _JOBS[job].work()
