"""Damages inputs and run folders, or puts special files there: each is read, or refused in one line, in bounded time.

    python -m studies fuzz --inputs 100000 --seed 0        all formats, one after the other
    python -m studies fuzz --target mcap --inputs 1000     one format, in this process

What fails is kept, with the traceback, in the folder that the message names.
"""

from __future__ import annotations

import argparse
import logging
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import FrameType

import numpy as np

from modeler.types import InputError
from studies.fuzz.mutate import mutated
from studies.fuzz.special import SPECIAL, remove, replace_by
from studies.fuzz.targets import TARGETS, fresh

MAX_CPU_S = 20
"""No damaged input may compute for longer: intact ones take milliseconds."""
MAX_S = 200
"""Nor may it wait for longer, on a machine that does other work as well."""
SPECIAL_SHARE = 0.03
"""In so many cases something else than a regular file lies there."""
MAX_BYTES = 6 << 30
"""Address space of one process."""


def main() -> int:
    """Fuzz and return the exit status: 0 if nothing was found."""
    parser = argparse.ArgumentParser(
        prog="python -m studies fuzz", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--inputs", type=int, default=100_000, help="how many in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--target", choices=TARGETS, help="only this one, in this process")
    parser.add_argument("--jobs", type=int, default=1, help="how many formats at a time")
    options = parser.parse_args()
    if options.target is not None:
        return one(options.target, options.inputs, options.seed)
    total, began = sum(target.share for target in TARGETS.values()), time.monotonic()

    def status(name: str) -> int:
        count = round(options.inputs * TARGETS[name].share / total)
        words = ["fuzz", "--target", name, "--inputs", str(count), "--seed", str(options.seed)]
        return subprocess.run([sys.executable, "-m", "studies", *words], check=False).returncode

    with ThreadPoolExecutor(options.jobs) as pool:
        failed = [
            f"{name} (status {ended})" for name, ended in zip(TARGETS, pool.map(status, TARGETS), strict=True) if ended
        ]
    print(f"{options.inputs} inputs in {time.monotonic() - began:.0f} s; failed: {', '.join(failed) or 'none'}")
    return 1 if failed else 0


def one(name: str, count: int, seed: int) -> int:
    """Fuzz one format; a crash of the process leaves the input where it is."""
    warnings.simplefilter("error")
    logging.getLogger().addHandler(Loud())
    resource.setrlimit(resource.RLIMIT_AS, (MAX_BYTES, MAX_BYTES))
    signal.signal(signal.SIGALRM, _late)
    signal.signal(signal.SIGPROF, _late)
    target, rng = TARGETS[name], np.random.default_rng([seed, *name.encode()])
    shared = Path("/dev/shm")
    folder = Path(tempfile.mkdtemp(prefix="fuzz", dir=shared if shared.is_dir() else None))
    path, files = fresh(target, folder / "in")
    intact = {file: file.read_bytes() for file in files}
    target.read(path)
    read = refused = 0
    began, slowest = time.monotonic(), 0.0
    for turn in range(count):
        file = files[int(rng.integers(len(files)))]
        if rng.random() < SPECIAL_SHARE:
            replace_by(list(SPECIAL)[int(rng.integers(len(SPECIAL)))], file)
        else:
            file.write_bytes(mutated(intact[file], list(intact.values()), rng))
        start = time.monotonic()
        signal.alarm(MAX_S)
        signal.setitimer(signal.ITIMER_PROF, MAX_CPU_S)
        try:
            target.read(path)
            read += 1
        except InputError as error:
            refused += 1
            if "\n" in str(error) or len(str(error)) > 2000:
                return _keep(folder, f"{name} {turn}: not one line: {error}")
        except BaseException:
            return _keep(folder, f"{name} {turn}: {traceback.format_exc()}")
        finally:
            signal.alarm(0)
            signal.setitimer(signal.ITIMER_PROF, 0.0)
        slowest = max(slowest, time.monotonic() - start)
        remove(file)
        file.write_bytes(intact[file])
    took, most = time.monotonic() - began, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    print(
        f"{name:12} {count:6d} inputs: {read} read, {refused} refused; {took:.0f} s, at most {slowest:.1f} s, {most} MB"
    )
    subprocess.run(["rm", "-r", str(folder)], check=True)
    return 0


class Loud(logging.Handler):
    """Takes whatever is logged for a failure: it would be a second line on stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        """Fail."""
        if record.levelno >= logging.WARNING:
            raise AssertionError(f"logged: {record.getMessage()}")


def _late(number: int, frame: FrameType | None) -> None:
    raise TimeoutError(f"took longer than {MAX_CPU_S} s of computing, or {MAX_S} s in all")


def _keep(folder: Path, what: str) -> int:
    print(f"{what}\nthe input is in {folder}")
    return 1


if __name__ == "__main__":
    sys.exit(main())
