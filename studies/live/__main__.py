"""Follow an object that a person turns before a camera of 30 Hz, in real time: `python -m studies live`.

Rendered frames (320 × 240 px, masks of object and hand, a full turn at 60° a second, prior `velocity`) are handed out
one every 33 ms, as a camera does, and recorded and written as by `modeler build`. The status is 1 if a frame is lost.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Final

import numpy as np

from modeler import se3
from modeler.cli.build import DRAWING_SHARE
from modeler.composition import compose
from modeler.composition.options import MethodOptions, ObjectOptions
from modeler.evaluation import rotation_error_deg, true_motion
from modeler.export import RunFolder, RunMeta
from modeler.pipeline import NewestFrames
from modeler.sequences.rendering.recipe import Hand
from modeler.system.processes import in_background
from modeler.types import Frame, Step
from modeler.viz.stream import open_stream
from studies.in_hand.study import stage
from studies.trust.stage import Recorded

RATE_HZ: Final = 30.0
FRAMES: Final = 186
STEP_DEG: Final = 2.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(
        prog="python -m studies live", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shapes", nargs="+", default=["telephone", "drill", "figurine"], help="names of recipes")
    options = parser.parse_args(arguments)
    heads = ("tracked", "Hz", "lag s", "largest", "model s", "filled", "fill s", "lost", "median", "worst")
    print(" " * 12 + "".join(f"{head:>9}" for head in heads))
    lost = 0
    for shape in options.shapes:
        lost += followed(shape)
    return int(lost > 0)


def followed(shape: str) -> int:
    """Follow one object, print a line, and return how many frames were lost."""
    recorded = Recorded(stage(shape, "person", motion=Hand(FRAMES, STEP_DEG, 0.25, 0.001, wander=0.05, height_m=0.0)))
    frames = [replace(recorded.frame(index), time_s=index / RATE_HZ) for index in recorded.indices]
    modeler = compose.modeler(recorded, recorded.stage.options, MethodOptions(seed=0), ObjectOptions())
    run = modeler.start(compose.scene(modeler, recorded))
    began_s = time.monotonic()

    def camera() -> Iterator[Frame]:
        for number, frame in enumerate(frames):
            time.sleep(max(0.0, began_s + number / RATE_HZ - time.monotonic()))
            yield frame

    newest = NewestFrames(camera())
    lags_s, first_model_s, last = [], np.inf, None
    with tempfile.TemporaryDirectory() as place:
        stream = open_stream(shape, save=Path(place) / "recording.rrd")
        folder, meta = RunFolder.open(Path(place) / "run"), RunMeta(shape, 0, "velocity")
        with in_background(
            stream, lambda event: not (isinstance(event, Step) and event.last), share=DRAWING_SHARE
        ) as draw:
            began_s = time.monotonic()
            for event in run.track(newest, live=True):
                if isinstance(event, Step):
                    now_s = time.monotonic() - began_s
                    lags_s.append(now_s - event.frame.time_s)
                    folder.write(event, meta)
                    event.solution.covariances.values()
                    draw(event)
                    if first_model_s == np.inf and event.model is not None:
                        first_model_s = time.monotonic() - began_s
            tracked_s = time.monotonic() - began_s
            phases = (run.fill(newest.skipped), run.revisit(), run.rejoin(), run.refine(), run.correct(), run.finish())
            for event in chain.from_iterable(phases):
                if isinstance(event, Step):
                    folder.write(event, meta)
                    draw(event)
                    last = event
            filled_s = time.monotonic() - began_s - tracked_s
        stream.close()
    assert last is not None
    trajectory, truth = last.solution.trajectory, recorded.truth()
    first, *others = sorted(trajectory)
    errors_deg = [
        rotation_error_deg(se3.inverse(trajectory[first]) @ trajectory[frame], true_motion(truth, first, frame))
        for frame in others
    ]
    gone = len(frames) - len(trajectory)
    cells = f"{len(lags_s)}", f"{len(lags_s) / tracked_s:.1f}", f"{np.median(lags_s):.2f}"
    cells += f"{max(lags_s):.2f}", f"{first_model_s:.2f}"
    cells += f"{len(newest.skipped)}", f"{filled_s:.1f}", f"{gone}"
    cells += f"{np.median(errors_deg):.2f}°", f"{np.max(errors_deg):.2f}°"
    print(f"{shape:12}" + "".join(f"{cell:>9}" for cell in cells), flush=True)
    return gone


if __name__ == "__main__":
    sys.exit(main())
