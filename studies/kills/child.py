"""A `modeler` that notes what it registers and, if it is told to, kills itself at a change of the disk.

python -m studies.kills.child LOG CHANGE build SEQUENCE --out RUN …       CHANGE 0: never
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from typing import Any

from modeler.baselines import IcpRegistrar
from modeler.cli import main
from modeler.registration import VisibilityRegistrar
from modeler.types import ViewPair

_MAKING = os.O_CREAT | os.O_TRUNC


def run(log: Path, change: int, arguments: list[str]) -> int:
    """Run a command of `modeler` and return its status.

    Args:
        log: a line is added to it for every registration that begins, and for every change of the run folder,
            or of the folder that what a command writes lies in.
        change: kill the process before this one, counted from 1; 0: none.
        arguments: what follows `modeler`.
    """
    notes = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    out = os.path.abspath(arguments[arguments.index("--out") + 1])
    folder = out if arguments[0] == "build" else os.path.dirname(out)  # where others write what replaces it
    changes = 0

    def heard(event: str, values: tuple[Any, ...]) -> None:
        nonlocal changes
        made = event == "open" and isinstance(values[2], int) and values[2] & _MAKING
        if not made and event not in ("os.rename", "os.remove", "os.mkdir", "os.rmdir"):
            return
        if isinstance(values[0], int):  # a pipe that is open
            return
        if not os.path.abspath(os.fsdecode(values[0])).startswith(folder):
            return
        changes += 1
        if changes == change:
            os.kill(os.getpid(), signal.SIGKILL)
        os.write(notes, f"change {event} {os.path.basename(os.fsdecode(values[0]))}\n".encode())

    for kind in (IcpRegistrar, VisibilityRegistrar):
        _note(kind, notes)
    sys.addaudithook(heard)
    return main(arguments)


def _note(kind: Any, notes: int) -> None:
    """Let a registrar tell of every pair that it begins with."""
    posterior_of = kind.posterior_of

    def noted(self: Any, pair: ViewPair) -> Any:
        os.write(notes, f"pair {pair.source.index} {pair.target.index}\n".encode())
        return posterior_of(self, pair)

    kind.posterior_of = noted


if __name__ == "__main__":
    sys.exit(run(Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]))
