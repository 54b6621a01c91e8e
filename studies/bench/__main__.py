"""Speed on the bundled sequences, against Open3D in the same run and against the committed baseline: `make bench`.

Ratios are of times that alternate pair by pair within one run, so that they carry over between machines and between
busy and idle ones; seconds do not, and are held only to their limits.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from studies.bench import processes

if TYPE_CHECKING:
    from studies.bench.speed import Timing

BASELINE = Path(__file__).with_name("baseline.json")
OUT = Path(__file__).parents[2] / "runs" / "bench" / "bench.json"
RATIOS = {  # name: (ours, the reference)
    "general / Open3D FPFH+RANSAC+ICP": ("visibility general", "Open3D FPFH+RANSAC+ICP"),
    "table / Open3D ICP": ("visibility table", "Open3D ICP"),
    "table, colour / Open3D ICP": ("visibility table, colour", "Open3D ICP"),
}
LIMITS = {
    **dict.fromkeys(RATIOS, 1.0),
    "paper_1e8_s": 10.0,
    "register_warm_s": 3.0,
    "help_s": 1.0,
    "build / Open3D multiway and TSDF": 1.5,
    "build_peak_gb": 1.5,
}


@dataclass(frozen=True)
class Options:
    """What the command line asks for."""

    pairs: int | None
    tolerance: float
    gate: bool
    update: bool


def options() -> Options:
    """Read the command line."""
    parser = argparse.ArgumentParser(prog="python -m studies bench", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--pairs", type=int, help="at most so many pairs a sequence (default: all)")
    parser.add_argument("--tolerance", type=float, default=0.25, help="share by which a ratio may exceed the baseline")
    parser.add_argument("--gate", action="store_true", help="status 1 where a ratio is worse than the baseline allows")
    parser.add_argument("--update", action="store_true", help="write the baseline")
    return Options(**vars(parser.parse_args()))


def main() -> int:
    """Measure, print, write, compare."""
    asked = options()
    figures = processes.figures()  # first, while this process is small: see `processes.run`
    from studies.bench import speed

    timings = list(speed.timings(asked.pairs))
    figures["paper_1e8_s"] = speed.paper_seconds()
    figures |= {name: ratio(timings, *pair) for name, pair in RATIOS.items()}
    baseline = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    for line in (*registrations(timings, speed.cores()), "", *judged(figures, baseline)):
        print(line)
    OUT.parent.mkdir(parents=True, exist_ok=True)
    rows = [{key: None if value != value else value for key, value in asdict(timing).items()} for timing in timings]
    record = {"figures": figures, "limits": LIMITS, "baseline": baseline, "timings": rows}
    OUT.write_text(json.dumps(record, indent=1, allow_nan=False) + "\n")
    if asked.update:
        BASELINE.write_text(json.dumps({name: round(figures[name], 3) for name in RATIOS}, indent=1) + "\n")
    worse = [name for name in baseline if figures[name] > baseline[name] * (1.0 + asked.tolerance)]
    for name in worse:
        print(f"REGRESSION {name}: {figures[name]:.2f}, baseline {baseline[name]:.2f}", file=sys.stderr)
    return 1 if worse and asked.gate and not asked.update else 0


def ratio(timings: list[Timing], ours: str, other: str, sequence: str | None = None) -> float:
    """Return the median over pairs of our time to the other's."""
    taken = {(timing.sequence, timing.source, timing.method): timing.seconds for timing in timings}
    return median(
        seconds / taken[name, source, other]
        for (name, source, method), seconds in taken.items()
        if method == ours and sequence in (None, name)
    )


def registrations(timings: list[Timing], cores: int) -> Iterator[str]:
    """Yield the lines of the table of methods, medians over pairs."""
    references = dict(RATIOS.values())
    heads = ("s", "prepare s", "ratio", "error °", "ESS/s", "M eval/s/core", "kernel %")
    yield f"{'medians over pairs':<36}" + "".join(f"{head:>14}" for head in heads)
    for sequence in (*dict.fromkeys(timing.sequence for timing in timings), None):
        for method in dict.fromkeys(timing.method for timing in timings):
            rows = [timing for timing in timings if timing.method == method and sequence in (None, timing.sequence)]
            counted = [timing for timing in rows if timing.evaluations]
            # The count is of one pair a sequence; its kernel time comes from a run of its own.
            rate = sum(t.evaluations for t in counted) / max(sum(t.kernel_s for t in counted), 1e-9) / cores / 1e6
            share = sum(t.kernel_s for t in counted) / sum(t.counted_s for t in counted) if counted else math.nan
            cells = (
                f"{median(t.seconds for t in rows):.3f}",
                f"{median(t.preparation_s for t in rows):.3f}",
                f"{ratio(timings, method, references[method], sequence):.2f}" if method in references else "",
                f"{median(t.error_deg for t in rows):.2f}",
                f"{median(t.effective_samples / t.seconds for t in rows):.0f}" if method in references else "",
                f"{rate:.1f}" if counted else "",
                f"{100.0 * share:.0f}" if counted else "",
            )
            yield f"{sequence or 'all':<11}{method:<25}" + "".join(f"{cell:>14}" for cell in cells)


def judged(figures: dict[str, float], baseline: dict[str, float]) -> Iterator[str]:
    """Yield the lines of the table of figures against limits and baseline."""
    yield f"{'':<36}{'now':>14}{'limit':>14}{'baseline':>14}"
    for name, value in figures.items():
        limit, before = LIMITS.get(name), baseline.get(name)
        over = "" if limit is None or value <= limit else "  over the limit"
        limit_text, before_text = ("" if number is None else f"{number:.2f}" for number in (limit, before))
        yield f"{name:<36}{value:>14.2f}{limit_text:>14}{before_text:>14}{over}"


if __name__ == "__main__":
    sys.exit(main())
