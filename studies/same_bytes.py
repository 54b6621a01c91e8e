"""Build the same sequences with this tree and with that of another commit, and compare the results byte by byte.

    make same COMMIT=main

The bundled sequences are built, and `../shared/data/cap` where it is present, each with
`--prior table --seed 0`. The status is 1 where a file differs or a build fails in one tree only.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

HOME: Final = Path(__file__).resolve().parent.parent
COMPARED: Final = ("trajectory.txt", "odometry.txt", "graph.g2o", "model.ply", "cloud.ply")
BUNDLED: Final = HOME / "sequences" / "bundled"
CAP: Final = HOME.parent / "shared" / "data" / "cap"
_OPTIONS: Final = ("--prior", "table", "--seed", "0")


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare two trees."""
    parser = argparse.ArgumentParser(prog="python -m studies same_bytes", description=__doc__)
    parser.add_argument("commit", help="the other tree, as git names it")
    parser.add_argument("--sequences", nargs="+", type=Path, metavar="FOLDER", help="instead of those above")
    options = parser.parse_args(arguments)
    sequences = [folder.resolve() for folder in options.sequences or _sequences()]
    with tempfile.TemporaryDirectory(prefix="same-") as folder:
        other, runs = Path(folder, "tree"), Path(folder, "runs")
        added = subprocess.run(["git", "-C", HOME, "worktree", "add", "--quiet", "--detach", other, options.commit])
        if added.returncode:
            return 2  # git has printed the reason
        try:
            return int(any([_differs(sequence, other, runs / sequence.name) for sequence in sequences]))
        finally:
            subprocess.run(["git", "-C", HOME, "worktree", "remove", "--force", other], check=True)


def _sequences() -> list[Path]:
    """Return the sequences that are compared by default."""
    return [
        *sorted(folder.parent for folder in BUNDLED.glob("*/scene_camera.json")),
        *([CAP] if CAP.exists() else []),
    ]


def _differs(sequence: Path, other: Path, runs: Path) -> bool:
    """Build a sequence with both trees and print a line for each file; return whether anything differs."""
    statuses = [_built(tree, sequence, runs / name) for tree, name in ((HOME, "this"), (other, "other"))]
    print(f"{sequence.name}: exit status {statuses[0]} here, {statuses[1]} there", flush=True)
    same = [(name, *(_bytes(runs / side / name) for side in ("this", "other"))) for name in COMPARED]
    for name, here, there in same:
        verdict = "missing in both" if here is there is None else "same" if here == there else "DIFFERENT"
        print(f"  {name:<16}{verdict}", flush=True)
    return statuses[0] != statuses[1] or any(here != there or here is None for _, here, there in same)


def _built(tree: Path, sequence: Path, run: Path) -> int:
    """Build a sequence with the program of a tree; return its exit status."""
    command = [sys.executable, "-m", "modeler", "build", sequence, "--out", run, *_OPTIONS]
    run.parent.mkdir(parents=True, exist_ok=True)
    with open(run.with_suffix(".log"), "wb") as log:
        ended = subprocess.run(command, cwd=tree, env={**os.environ, "PYTHONPATH": str(tree)}, stdout=log, stderr=log)
    if ended.returncode not in (0, 3):
        print(run.with_suffix(".log").read_text(errors="replace")[-2000:], file=sys.stderr)
    return ended.returncode


def _bytes(file: Path) -> bytes | None:
    """Return what a file holds; None if there is none."""
    return file.read_bytes() if file.exists() else None


if __name__ == "__main__":
    sys.exit(main())
