"""Find objects with models: rendered on a cluttered table, followed, and in captures of which half made the model.

    python -m studies tracking --half held-out --jobs 16 --seconds 400         # rendered shapes
    python -m studies tracking --jobs 16 --captures ../shared/data/* --record  # and captures, half an hour on 16 cores

On the rendered table and in captures each frame stands for itself: any rotation, anywhere in view. On the table no mask
is given, six cameras see it, 0 to 60 % of the object are hidden, and every fourth scene is without it. A model built of
half of the frames of a turned shape is sought in the others. Of a capture, models of the even and of the odd frames are
sought in the other half, where the poses of the whole run are the reference, and in frames of the other captures, where
it is absent. A pose is right below 5° and 5 mm, or below a tenth of the diameter in BOP's MSSD;
turns of a symmetric model are allowed in both.

Baselines get the mask, on the table the true one: point pair features (with OpenCV, if it is installed) and FPFH with
RANSAC, each with ICP of the model's cloud. ICP and small_gicp start from the last pose: 15° and 10 mm off where frames
stand for themselves, the method's own where a shape is followed, 6° a frame. They are told what those that find an
object have to find, so that their rows stand beside that of the tracker with the same mask and the same last pose.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TypeVar

import numba
import numpy as np
from scipy import stats

from modeler.sequences import open_sequence
from studies.results.tables import FOLDER, record
from studies.results_file import earlier_results
from studies.tracking.trials import MSSD, OURS, PARTS, Trial, built, followed, in_capture, on_table, shapes, turned

T = TypeVar("T")
_ABSENT_FRAMES = 3  # of each other capture
_SEED = 1000  # of shapes' first scenes, apart
_PARTS = ("captures", "table", "turned", "followed")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study; the status is 1 if nothing is found: then the study is broken."""
    parser = argparse.ArgumentParser(
        prog="python -m studies tracking", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--captures", nargs="*", type=Path, default=(), metavar="SEQUENCE", help="recordings")
    parser.add_argument("--half", choices=("tuning", "held-out"), default="tuning", help="which shapes")
    parser.add_argument("--shapes", type=int, default=24, metavar="N", help="rendered shapes, in all")
    parser.add_argument("--scenes", type=int, default=24, metavar="N", help="scenes of each")
    parser.add_argument("--parts", nargs="*", choices=_PARTS, default=_PARTS, help="what is measured")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes, each with one thread")
    parser.add_argument("--seconds", type=float, default=np.inf, metavar="S", help="begin nothing after as long")
    parser.add_argument("--out", type=Path, default=Path("runs/tracking"), metavar="DIR", help="runs and results")
    parser.add_argument("--record", action="store_true", help="put the figures into their file")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    until_s = time.monotonic() + options.seconds
    captures = [path for path in options.captures if "captures" in options.parts and _is_sequence(path)]
    for _ in _done(
        [partial(built, path, part, options.out) for path in captures for part in (*PARTS, "whole")], options.jobs
    ):
        print("built", file=sys.stderr)
    names = tuple(shapes(options.half, options.shapes))
    work: list[Callable[[], list[Trial]]] = [
        partial(in_capture, path, part, other, options.out, _ABSENT_FRAMES)
        for path in captures
        for part in PARTS
        for other in captures
    ]
    if "table" in options.parts:
        work += [
            partial(on_table, name, names, range(_SEED * number + some, _SEED * number + min(some + 4, options.scenes)))
            for some in range(0, options.scenes, 4)
            for number, name in enumerate(names)
        ]
    kinds = {"turned": partial(turned, out=options.out), "followed": followed}
    each = [partial(kind, name) for name in names for part, kind in kinds.items() if part in options.parts]
    after = len(work) // 2  # those that end early have half of the table, and all else
    work[after:after] = each
    path = options.out / "trials.jsonl"
    trials = [Trial(**json.loads(line)) for line in earlier_results(path)]
    if not trials:
        with path.open("w") as file:
            for some in _done(work, options.jobs, until_s):
                trials += some
                file.writelines(json.dumps(asdict(trial)) + "\n" for trial in some)
                file.flush()
                print(f"{len(trials)} trials", file=sys.stderr)
    rows = table(trials)
    for row in rows:
        print(" | ".join(map(str, row)))
    if options.record:
        record(FOLDER / "tracking.json", rows)
    return 0 if any(trial.there and trial.right for trial in trials) else 1


def _is_sequence(path: Path) -> bool:
    """Return whether a path is a recording with frames, and not a page about some."""
    return path.is_dir() and len(open_sequence(path).indices) > 1


def _done(work: Sequence[Callable[[], T]], jobs: int, until_s: float = np.inf) -> Iterator[T]:
    """Yield the results of work as they come, of what begins until a time; those that fail are said on stderr."""
    context = multiprocessing.get_context("spawn")  # kernels' threads do not survive a fork
    with ProcessPoolExecutor(jobs, mp_context=context, initializer=numba.set_num_threads, initargs=(1,)) as pool:
        futures = [pool.submit(one) for one in work]
        for future in as_completed(futures):
            if time.monotonic() > until_s:
                for one in futures:
                    one.cancel()
            if future.cancelled():
                continue
            try:
                yield future.result()
            except Exception as error:
                print(f"failed: {error}", file=sys.stderr)


def table(trials: Sequence[Trial]) -> list[list[str | float]]:
    """Return a row for each cell and method."""
    table = [trial for trial in trials if trial.group == "table"]
    trusted, rest = (
        [t for t in trials if t.group == f"captures, model {which}"] for which in ("trusted", "not trusted")
    )
    cells = {
        "table, at least 70 % visible": [t for t in table if t.visible >= 0.7],
        "table, 40 to 70 % visible": [t for t in table if 0.4 <= t.visible < 0.7],
        "table, absent": [t for t in table if t.visible == 0.0],
        "turned, model built": [t for t in trials if t.group == "turned, model trusted"],
        "turned, model not trusted": [t for t in trials if t.group == "turned, model not trusted"],
        "followed": [t for t in trials if t.group == "followed"],
        "captures, other half": [t for t in trusted if t.visible > 0.0],
        "captures, absent": [t for t in trusted if t.visible == 0.0],
        "captures, other half, model not trusted": [t for t in rest if t.visible > 0.0],
        "captures, absent, model not trusted": [t for t in rest if t.visible == 0.0],
    }
    methods = sorted(
        {trial.method for trial in trials}, key=lambda name: ("from the last" in name, not name.startswith(OURS), name)
    )
    rows: list[list[str | float]] = []
    for name, cell in cells.items():
        for method in methods:
            mine = [trial for trial in cell if trial.method == method]
            if mine:
                rows.append([f"{name}, `{method}`", *_figures(mine)])
    return rows


def _figures(trials: Sequence[Trial]) -> list[str | float]:
    """Return the figures of a row."""
    seconds = f"{np.median([trial.seconds for trial in trials]):.2f}"
    if trials[0].visible == 0.0:
        said = sum(trial.there for trial in trials)
        return [len(trials), "", "", "", "", "", f"{said}", seconds]
    count, right = len(trials), [trial for trial in trials if trial.right]
    usable, nees = [t for t in trials if t.usable], [t.nees for t in trials if np.isfinite(t.nees)]
    inside = np.mean([6.0 * one < stats.chi2.ppf(0.95, 6) for one in nees]) if nees else np.nan
    return [
        count,
        f"{100.0 * len(right) / count:.0f} %",
        f"{100.0 * np.mean([trial.there and trial.mssd < MSSD for trial in trials]):.0f} %",
        f"{np.median([t.error_deg for t in right]):.2f}°, {1000.0 * np.median([t.error_m for t in right]):.1f} mm"
        if right
        else "",
        f"{np.mean(nees):.2f}, {100.0 * inside:.0f} %" if nees else "",
        f"{sum(trial.right for trial in usable)} of {len(usable)}",
        f"{sum(not trial.there for trial in trials)}",
        seconds,
    ]


if __name__ == "__main__":
    sys.exit(main())
