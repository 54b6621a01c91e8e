"""Wall time in which objects are found and followed: `python -m studies bench.following`.

Recipes are rendered at 640×480, pushed about a table by 2° a frame, and sought with their true meshes: in a first frame
from nothing, then from frame to frame, with masks and without. Medians over the frames, of a tracker that has found the
object once before, on all processors that are allowed.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from statistics import median
from typing import Final

from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.recipe import Tabletop, load_recipe
from modeler.tracking import Tracker
from modeler.views import Sensor
from studies.results.tables import FOLDER, markdown, record
from studies.tracking.clutter import exact_model

SHAPES: Final = ("mug", "drill", "box")
STEP_DEG: Final = 2.0
"""From frame to frame: a turn in six seconds."""
FRAMES: Final = 24
"""At 30 a second."""
TITLES: Final = ("", "found from nothing (s)", "followed (ms)", "frames followed")


def main(arguments: Sequence[str] | None = None) -> int:
    """Time it."""
    parser = argparse.ArgumentParser(prog="python -m studies bench.following", description=__doc__)
    parser.add_argument("--shapes", nargs="+", default=SHAPES, metavar="NAME", help="recipes")
    parser.add_argument("--record", action="store_true", help="put the times into the results")
    options = parser.parse_args(arguments)
    rows = [row(shape, masks=masks) for masks in (True, False) for shape in options.shapes]
    print(markdown(TITLES, rows))
    if options.record:
        record(FOLDER / "speed_tracking.json", rows)
    return 0


def row(shape: str, *, masks: bool) -> list[str]:
    """Return the times of a shape, as the table has them."""
    moved = Tabletop(frames=FRAMES, step_deg=STEP_DEG, step_sigma_deg=0.3, shift_m=0.005)
    sequence = RenderedSequence(replace(load_recipe(shape), trajectory=moved, masks=masks, period_s=1.0 / 30.0))
    surface, frames = sequence.model(), [sequence.frame(index) for index in sequence.indices]
    tracker = Tracker(exact_model(surface.vertices_m, surface.triangles), sensor=Sensor(sequence.sensor()))
    found_s, followed_s, followed = [], [], 0
    for turn in range(3):
        tracker.newest.clear()
        for frame in frames:
            began = time.perf_counter()
            found = tracker.update(frame)
            taken_s = time.perf_counter() - began
            if found.outcome == "followed":
                followed_s.append(taken_s)
                followed += 1
            elif turn:  # the first also renders the viewpoints
                found_s.append(taken_s)
    return [
        f"{shape}, {'with masks' if masks else 'without masks'}",
        f"{median(found_s):.2f}",
        f"{1e3 * median(followed_s):.0f}",
        f"{followed} of {3 * (FRAMES - 1)}",
    ]


if __name__ == "__main__":
    sys.exit(main())
