"""Processor seconds of a build by stage, on one thread: `python -m studies bench.stages SEQUENCE [OPTION …]`.

Every stage counts without the stages that it calls, so that they add up; the options are those of `modeler build`.
"""

from __future__ import annotations

import gc
import os
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack, contextmanager
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Final
from unittest.mock import patch

IMPORTS, REST = "imports", "the rest"
STAGES: Final = {
    "modeler.cli.build._opened": "reading and survey",
    "modeler.composition.compose.scene": "segmentation",
    "modeler.pipeline.modeler.prepare": "segmentation",
    "modeler.kernels.cache.KernelCache.load_overload": "loading kernels",
    "modeler.pipeline.pairs.Registrations.register": "registration",
    "modeler.pipeline.tracking.Tracker.again": "registration",
    "modeler.pipeline.run.Run._solve": "focal length and graph",
    "modeler.fusion.fuser.Fuser.fuse": "fusion",
    "modeler.pipeline.run.widened": "fusion",
    "modeler.pipeline.run.judged": "verdict",
    "modeler.viz.stream.RerunStream.__call__": "recording and previews",
    "modeler.viz.stream.RerunStream.close": "recording and previews",
    "modeler.export.run_folder.RunFolder.write": "files",
}
"""What is measured as which stage."""


class Clock:
    """Seconds by stage: of the innermost stage at any time."""

    def __init__(self) -> None:
        """Begin with what runs before any stage."""
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._stages, self._since = [REST], time.process_time()

    @contextmanager
    def stage(self, name: str) -> Any:
        """Count what happens meanwhile as a stage."""
        self._count()
        self._stages.append(name)
        try:
            yield
        finally:
            self._count()
            self._stages.pop()

    def timed(self, work: Callable[..., Any], name: str) -> Callable[..., Any]:
        """Return a function that does the same as another, and is counted as a stage."""

        def counted(*arguments: Any, **named: Any) -> Any:
            with self.stage(name):
                return work(*arguments, **named)

        return counted

    def _count(self) -> None:
        now = time.process_time()
        self.seconds[self._stages[-1]] += now - self._since
        self._since = now


def main() -> int:
    """Build, and print the table."""
    gc.disable()  # as the program does until all is imported
    os.environ |= {"NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    clock = Clock()
    clock.seconds[IMPORTS] = time.process_time()
    with ExitStack() as patches, tempfile.TemporaryDirectory() as folder:
        with clock.stage(IMPORTS):
            from modeler.cli import main as run
            from modeler.viz.stream import load

            load()
            for path, name in STAGES.items():
                owner, _, attribute = path.rpartition(".")
                work = getattr(resolve_name(owner), attribute)
                patches.enter_context(patch(path, clock.timed(work, name)))
        with clock.stage(REST):
            status = run(["build", *sys.argv[1:], "--out", str(Path(folder) / "run")])
    for name, seconds in (
        *sorted(clock.seconds.items(), key=lambda stage: -stage[1]),
        ("all", sum(clock.seconds.values())),
    ):
        print(f"{name:28}{seconds:8.2f}")
    return status


if __name__ == "__main__":
    sys.exit(main())
