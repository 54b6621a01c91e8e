"""Run commands in hostile environments, and tell where one ends in a traceback, hangs, or leaves a process behind.

    python -m studies hostile --count 500 --seed 0
    python -m studies hostile --first 173 --jobs 12 --seconds 300      on a machine with 16 cores

Each trial is one command under one to three faults: settings of libraries, damaged caches of kernels, what lies in the
current folder, limits, closed streams, a viewer that stays silent, a signal at any moment. A command must end with
0, 2 or 3, or by the signal; what it says of a fault is one line. What fails is listed, and the status is 1.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from modeler.kernels import cache
from modeler.runs.compiling import compile_kernels
from modeler.sequences import write_bop
from studies.formats.image_folders import small_frames, small_truth

_FEW: Final = ("--prior", "table", "--method", "icp")
COMMANDS: Final[Mapping[str, tuple[str, ...]]] = {
    "info": ("info", "{scene}"),
    "register": ("register", "{scene}", "0", "1", "--prior", "table", "--method", "icp"),
    "build": ("build", "{scene}", "--out", "{out}/run", *_FEW),
    "batch": ("batch", "{scene}", "--out", "{out}/runs", "--workers", "1", *_FEW),
    "convert": ("convert", "{scene}", "--out", "{out}/scene"),
    "report": ("report", "{run}", "--out", "{out}/report.html"),
    "export": ("export", "{run}", "--out", "{out}/model.obj"),
    "suggest": ("suggest", "{run}"),
}
"""Arguments; `{out}` is an empty folder, `{scene}` a sequence of three small frames, `{run}` its model."""
_MODULES: Final = ("numpy", "json", "rerun", "numba", "pyarrow", "modeler", "sitecustomize", "encodings")
_SETTINGS: Final = {
    "NUMBA_OPT": ("0", "nonsense"),
    "NUMBA_CPU_NAME": ("generic", "nonsense"),
    "NUMBA_THREADING_LAYER": ("tbb", "workqueue", "nonsense"),
    "NUMBA_NUM_THREADS": ("1", "0", "-1", "9" * 40),
    "NUMBA_DISABLE_JIT": ("1",),
    "NUMBA_BOUNDSCHECK": ("1",),
    "NUMBA_DEBUG": ("1",),
    "RERUN": ("off", "nonsense"),
    "RERUN_FLUSH_NUM_BYTES": ("nonsense", "0"),
    "RERUN_STRICT": ("1",),
    "HOME": ("/dev/null", "", "/nowhere"),
    "XDG_CACHE_HOME": ("/dev/null", "relative"),
    "TMPDIR": ("/nowhere",),
    "LC_ALL": ("C", "nonsense"),
    "TERM": ("dumb", ""),
    "COLUMNS": ("1", "0", "nonsense"),
    "PYTHONOPTIMIZE": ("2",),
    "OMP_NUM_THREADS": ("nonsense", "0"),
}
_LIMITS: Final = ("-n 8", "-n 40", "-n 300", "-f 100", "-f 2000", "-v 400000", "-v 3000000", "-s 256")
_ENDED: Final = (0, 2, 3)
_LIMIT_S: Final = 150.0  # with kernels to compile; where the machine is idle, as below
_LEAVES_S: Final = 10.0  # after a signal
_CHILDREN_S: Final = 1.0  # after the command


@dataclass
class Trial:
    """One command and its faults."""

    folder: Path
    """Its own, with `out`, `here` and `cache` in it."""
    environment: dict[str, str]
    """Of the command."""
    shell: str = 'exec "$@"'
    """Starts the command."""
    signalled: tuple[int, float] | None = None
    """Number and moment in s of a signal."""
    options: tuple[str, ...] = ()
    """Further ones of a build."""
    said: list[str] = field(default_factory=list)
    """Its faults in words."""

    @property
    def here(self) -> Path:
        """The current folder of the command."""
        return self.folder / "here"


def settings(trial: Trial, rng: np.random.Generator) -> None:
    """Change a setting of a library."""
    name = rng.choice(list(_SETTINGS))
    trial.environment[name] = rng.choice(_SETTINGS[name])
    trial.said.append(f"{name}={trial.environment[name][:20]}")


def damaged_cache(trial: Trial, rng: np.random.Generator) -> None:
    """Damage kernels, or let none be kept."""
    files = [path for path in (trial.folder / "cache").rglob("*") if path.is_file()]
    how = str(rng.choice(["empty", "cut", "flip", "fifo", "folder", "link", "none"]))
    trial.said.append(f"kernels: {how}")
    for path in [files[k] for k in rng.choice(len(files), 2)] if how != "none" else ():
        data = bytearray(path.read_bytes()) if path.is_file() else bytearray(1)
        path.unlink(missing_ok=True)
        match how:
            case "empty":
                path.touch()
            case "cut":
                path.write_bytes(data[: len(data) // 2])
            case "flip":
                data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
                path.write_bytes(data)
            case "fifo":
                os.mkfifo(path)
            case "folder":
                path.mkdir()
            case _:
                path.symlink_to("/dev/zero")
    if how == "none":
        trial.environment |= {"NUMBA_CACHE_DIR": "/dev/null/kernels", "HOME": "/dev/null"}


def hostile_folder(trial: Trial, rng: np.random.Generator) -> None:
    """Put files into the current folder that libraries look for."""
    for name in _MODULES:
        (trial.here / f"{name}.py").write_text(f"open({str(trial.folder / 'ran')!r}, 'w').close()")
    (trial.here / ".numba_config.yaml").write_text(str(rng.choice(["opt: nonsense", "disable_jit: 1", "{[", "3"])))
    trial.said.append("files in the current folder")


def limits(trial: Trial, rng: np.random.Generator) -> None:
    """Limit what the command may use."""
    limit = str(rng.choice(_LIMITS))
    trial.shell = f"ulimit {limit}; {trial.shell}"
    trial.said.append(f"ulimit {limit}")


def streams(trial: Trial, rng: np.random.Generator) -> None:
    """Close or fill the standard streams."""
    how = str(rng.choice([">&-", "2>&-", "<&-", "> /dev/full", "2> /dev/full", "< /dev/zero"]))
    trial.shell = f"{trial.shell} {how}"
    trial.said.append(how)


def sent(trial: Trial, rng: np.random.Generator) -> None:
    """Send a signal."""
    number = int(rng.choice([signal.SIGINT, signal.SIGTERM, signal.SIGHUP]))
    trial.signalled = number, float(rng.uniform(0.0, 15.0))
    trial.said.append(f"signal {number} after {trial.signalled[1]:.1f} s")


FAULTS: Final[tuple[Callable[[Trial, np.random.Generator], None], ...]] = (
    settings,
    damaged_cache,
    hostile_folder,
    limits,
    streams,
    sent,
)


def outcome(trial: Trial, command: tuple[str, ...]) -> str:
    """Run the command of a trial, and return what is wrong with how it ends: nothing is ""."""
    began_s = time.monotonic()
    with open(trial.folder / "said", "w+b") as said:
        process = subprocess.Popen(
            ["bash", "-c", trial.shell, "-", sys.executable, "-P", "-m", "modeler", *command, *trial.options],
            cwd=trial.here,
            env=trial.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=said,
            start_new_session=True,
        )
        allowed: set[int] = {*_ENDED}
        fault = ""
        try:
            if trial.signalled is not None:
                number, after_s = trial.signalled
                allowed |= {128 + number, -number, 1}
                try:
                    process.wait(after_s)
                except subprocess.TimeoutExpired:
                    process.send_signal(number)
            process.wait(_busy() * (_LIMIT_S if trial.signalled is None else _LEAVES_S))
        except subprocess.TimeoutExpired:
            fault = f"does not end in {time.monotonic() - began_s:.0f} s"
        until_s = time.monotonic() + _busy() * _CHILDREN_S
        while process.poll() is not None and _members(process.pid) and time.monotonic() < until_s:
            time.sleep(0.05)
        if left := _members(process.pid):
            fault = fault or f"leaves a process behind: {'; '.join(left)}"
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        said.seek(0)
        words = said.read().decode(errors="replace")
    if ">&-" in trial.shell or "/dev/full" in trial.shell:
        allowed.add(1)
    if fault:
        return fault
    if "Traceback" in words or "panicked" in words or process.returncode not in allowed:
        return f"ends with status {process.returncode}: {words[-400:]}"
    return "runs a file of the current folder" if (trial.folder / "ran").exists() else ""


def _members(group: int) -> list[str]:
    """Return the command lines of the processes of a group that run; those that nobody has buried yet do not."""
    found = []
    for entry in Path("/proc").iterdir():
        with suppress(OSError):  # it has ended meanwhile
            state, _, number = (entry / "stat").read_text().rpartition(")")[2].split()[:3]
            if entry.name.isdecimal() and int(number) == group and state not in "ZX":
                found.append((entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")[:200])
    return found


def _busy() -> float:
    """Return how many times longer work takes as others wait for the processors, too."""
    return max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


def main() -> int:
    """Run the trials and return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m studies hostile", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--count", type=int, default=500, help="number of the last trial")
    parser.add_argument("--first", type=int, default=1, help="number of the first")
    parser.add_argument("--jobs", type=int, default=1, help="how many trials at a time")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no trial after so long")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/hostile"), help="folder of the trials, which is emptied")
    options = parser.parse_args()
    out = options.out.absolute()
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    compile_kernels(print)
    root = str(Path(cache.__file__).parents[2])
    environment = {**os.environ, "PYTHONPATH": root}
    scene, run = out / "scene", out / "run"
    write_bop(scene, small_frames(3), small_truth(3), depth_scale_mm=1.0)
    built = [sys.executable, "-m", "modeler", "build", str(scene), "--out", str(run), *_FEW]
    assert subprocess.run(built, env=environment, check=False, stderr=subprocess.DEVNULL).returncode in _ENDED
    began_s = time.monotonic()

    def tried(number: int) -> str | None:
        """Return what is wrong with the end of a trial; None if there was no time for it."""
        if time.monotonic() - began_s > options.seconds:
            return None
        rng = np.random.default_rng([options.seed, number])
        name, folder = str(rng.choice(list(COMMANDS))), out / f"{number:04d}"
        trial = Trial(folder, {**environment, "NUMBA_CACHE_DIR": str(folder / "cache")})
        for part in ("out", "here"):
            (folder / part).mkdir(parents=True)
        shutil.copytree(cache.folder(), folder / "cache" / cache.folder().name)
        for k in rng.choice(len(FAULTS), rng.integers(1, 4), replace=False):
            FAULTS[k](trial, rng)
        if name == "build" and rng.random() < 0.3:
            trial.options = ("--connect", address)
            trial.said.append("a silent viewer")
        command = tuple(word.format(out=folder / "out", scene=scene, run=run) for word in COMMANDS[name])
        fault = outcome(trial, command)
        print(f"{number:4d} {name:9} {'; '.join(trial.said):60} {fault or 'ended well'}", flush=True)
        shutil.rmtree(folder)
        return fault

    with socket.create_server(("127.0.0.1", 0)) as silent, ThreadPoolExecutor(options.jobs) as pool:
        address = f"rerun+http://127.0.0.1:{silent.getsockname()[1]}/proxy"
        faults = [fault for fault in pool.map(tried, range(options.first, options.count + 1)) if fault is not None]
    failed = sum(map(bool, faults))
    print(f"{failed} of {len(faults)} trials failed in {time.monotonic() - began_s:.0f} s")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
