"""What a call takes: processor time, and memory above what was in use before."""

from __future__ import annotations

import time
from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any


def measured(make: Callable[..., Any], arguments: tuple[Any, ...], warm: tuple[Any, ...]) -> tuple[Any, float, float]:
    """Return what a call gives, its processor time in s and its peak of memory in MB, in a process of its own.

    Args:
        make: what to measure.
        arguments: what it is called with.
        warm: what it is called with before, so that imports and compilation do not count.
    """
    context = get_context("spawn")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_measure, args=(make, arguments, warm, there))
    process.start()
    there.close()
    result, seconds, megabytes = here.recv()
    process.join()
    return result, seconds, megabytes


def _measure(make: Callable[..., Any], arguments: tuple[Any, ...], warm: tuple[Any, ...], answer: Connection) -> None:
    make(*warm)
    Path("/proc/self/clear_refs").write_text("5")  # reset the peak
    before = _status("VmRSS")
    began = time.process_time()
    result = make(*arguments)
    seconds = time.process_time() - began
    answer.send((result, seconds, (_status("VmHWM") - before) / 1024.0))


def _status(name: str) -> int:
    """Return an entry of the process's status in kB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:"))
