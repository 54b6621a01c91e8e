"""Memory and time of `modeler build` over thousands of frames.

`python -m studies loops.memory --frames 5000 --out runs/memory` renders an object that turns by 3° a frame, a
folder of images that is reused, and builds it as the command does: with stored pairs, recording and report. With
--true-motions, ground truth replaces registration, to measure the cost of everything else. With --watch, the folder is
written while it is built, as fast as frames are taken, and with faults: files in two halves, cut off for good, or late,
links to nothing, intrinsics that are gone for a moment. With --turns, the object is there for so many turns, spread
over all of the time, as on a stand that is watched all day. Ctrl-C ends it with the frames so far. stdout has a line
for every --every steps: resident memory as the system counts it (what the program allocated, and what it read of
mapped files), and the most so far.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
from PIL import Image

from modeler.cli import build, main
from modeler.cli.console import Console
from modeler.composition import compose
from modeler.sequences import open_sequence, write_bop
from modeler.types import Step
from studies.loops.cases import turned
from studies.loops.known import Known

_FIELDS = ("RssAnon", "RssFile", "VmRSS", "VmHWM")


def memory_mib() -> dict[str, float]:
    """Return the resident memory of this process: allocated, of files, both, and the most of both so far."""
    lines = (line.partition(":") for line in Path("/proc/self/status").read_text().splitlines())
    return {name: int(value.split()[0]) / 1024.0 for name, _, value in lines if name in _FIELDS}


def write_sequence(folder: Path, frames: int, *, shape: str, width: int) -> None:
    """Render frames at 3° each into a folder, one after the other."""
    sequence = turned([3.0 * frame for frame in range(frames)], shape=shape, width=width)
    sigma_wh, sigma_r_m, *_ = sequence.sensor() or (0.0, 0.0)
    sensor = {"sigma_wh": sigma_wh, "sigma_r_m": sigma_r_m}
    write_bop(folder, sequence, sequence.truth(), {"name": folder.name, "sensor": sensor})


def write_repeated(folder: Path, pictures: Path, count: int, frames: int) -> None:
    """Make a sequence of frames whose files are those of another of `count` frames, in turn."""
    for part in (path for path in pictures.iterdir() if path.is_dir()):
        (folder / part.name).mkdir(parents=True)
        for frame in range(frames):
            for path in part.glob(f"{frame % count:06d}*"):
                os.link(path, folder / part.name / path.name.replace(f"{frame % count:06d}", f"{frame:06d}", 1))
    for name in ("scene_camera.json", "scene_gt.json"):
        entries = json.loads((pictures / name).read_text())
        repeated = {str(frame): entries[str(frame % count)] for frame in range(frames)}
        (folder / name).write_text(json.dumps(repeated))
    described = json.loads((pictures / "sequence.json").read_text())
    described["timestamps_s"] = {str(frame): frame / 30.0 for frame in range(frames)}
    (folder / "sequence.json").write_text(json.dumps(described))


def write_slowly(folder: Path, pictures: Path, count: int, frames: int, period: int, taken: Callable[[], int]) -> None:
    """Write depth, masks and intrinsics into a folder that somebody watches, with faults, and the file that ends it.

    Args:
        folder: where.
        pictures: sequence of `count` frames, whose files are written in turn.
        count: its frames.
        frames: to write.
        period: frames from one turn, of `count` frames, to the next; in between the object is not there.
        taken: returns the number of the newest that has been taken: those far ahead of it wait.
    """
    rng = np.random.default_rng(0)
    camera = json.loads((pictures / "scene_camera.json").read_text())["0"]
    fx, _, cx, _, fy, cy, *_ = camera["cam_K"]
    settings = folder / "camera.json"
    settings.write_text(json.dumps({"fx": fx, "fy": fy, "cx": cx, "cy": cy, "depth_scale": camera["depth_scale"]}))
    for part in ("depth", "masks"):
        (folder / part).mkdir()
    empty = folder.with_name(f"{folder.name}.png")
    Image.fromarray(np.zeros((round(2 * cy) + 1, round(2 * cx) + 1), np.uint8)).save(empty)
    order = np.arange(frames)
    for place in rng.choice(max(frames - 2, 0), frames // FAULTY, replace=False):
        order[[place, place + 1]] = order[[place + 1, place]]  # comes late
    for written, number in enumerate(map(int, order)):
        while written - taken() > _AHEAD:
            time.sleep(0.02)
        shown, name = number % period % count, f"{number:06d}.png"
        mask = pictures / "mask_visib" / f"{shown:06d}_000000.png" if number % period < count else empty
        os.link(mask, folder / "masks" / name)
        content, path = (pictures / "depth" / f"{shown:06d}.png").read_bytes(), folder / "depth" / name
        match int(rng.integers(5 * FAULTY)) if written else -1:
            case 0:
                path.write_bytes(content[: len(content) // 2])  # for good
            case 1:
                path.write_bytes(content[: len(content) // 2])
                time.sleep(0.2)
                path.write_bytes(content)
            case 2:
                (folder / "depth" / f".#{name}").symlink_to("nowhere")  # an editor's lock
                path.write_bytes(content)
            case 3:
                settings.rename(folder / "gone")
                time.sleep(0.2)
                path.write_bytes(content)
                (folder / "gone").rename(settings)
            case _:
                path.write_bytes(content)
    (folder / "done").touch()


FAULTY: Final = 20
"""One of so many frames comes late, and as many have another fault."""
_AHEAD: Final = 30  # frames: a second of a camera


class Meter(Console):
    """The terminal's sink of steps, which now and then notes time and memory."""

    every: ClassVar = 250
    costs: ClassVar[list[dict[str, Any]]] = []  # not of every step: what is measured would hold them
    steps: ClassVar = 0
    newest: ClassVar = 0

    def __call__(self, event: Any) -> None:
        """Note a step, if it is one of them."""
        super().__call__(event)
        if not isinstance(event, Step):
            return
        Meter.newest = max(self.newest, event.frame.index)
        Meter.steps += 1
        if event.last or self.steps % self.every == 0 or not self.costs:
            now = {"step": self.steps, "s": time.monotonic(), "cpu_s": time.process_time(), "views": len(event.views)}
            self.costs.append({**now, "edges": len(event.edges_so_far), "last": event.last, **memory_mib()})
            print(_row(self.costs), flush=True)


def _row(costs: list[dict[str, Any]]) -> str:
    """Return a line on the newest step, with the time per frame since the line before."""
    new, old = costs[-1], costs[max(len(costs) - 2, 0)]
    spent = ((new[name] - old[name]) / max(new["step"] - old["step"], 1) for name in ("s", "cpu_s"))
    numbers = "  ".join(f"{new[name]:7.0f}" for name in _FIELDS)
    step = "end" if new["last"] else str(new["step"])
    return (
        f"{step:>6}  {numbers} MiB   {new['edges']:6d} edges   " + "  ".join(f"{s:.3f}" for s in spent) + " s a frame"
    )


def run() -> int:
    """Run the study and return the status of the command."""
    parser = argparse.ArgumentParser(prog="python -m studies loops.memory", description=__doc__)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument(
        "--pictures", type=int, help="frames to render, whose files further frames share; whole turns are 120 each"
    )
    parser.add_argument("--every", type=int, default=250, help="steps between lines")
    parser.add_argument("--shape", default="figurine", help="recipe of the rendered object")
    parser.add_argument("--width", type=int, default=320, help="of the images in pixels, whose height is 3/4 of it")
    parser.add_argument("--out", type=Path, default=Path("runs/memory"), help="folder of the sequence and the run")
    parser.add_argument("--watch", action="store_true", help="write the folder while it is built, with faults")
    parser.add_argument("--turns", type=int, help="with --watch: of --pictures frames each that show the object")
    parser.add_argument("--true-motions", action="store_true", help="register by the truth")
    parser.add_argument("options", nargs="*", default=["--prior", "table"], help="of modeler build, after --")
    options = parser.parse_args()
    sequence = options.out / f"{options.shape}-{options.width}-{options.frames}"
    count = min(options.pictures or options.frames, options.frames)
    pictures = options.out / f"{options.shape}-{options.width}-{count}"
    period = options.frames // options.turns if options.turns else count
    if not pictures.exists():
        write_sequence(pictures, count, shape=options.shape, width=options.width)
    if options.watch:
        sequence = options.out / f"{options.shape}-{options.width}-watched"
        shutil.rmtree(sequence, ignore_errors=True)
        sequence.mkdir()
        arguments = (sequence, pictures, count, options.frames, period, lambda: Meter.newest)
        threading.Thread(target=write_slowly, args=arguments, daemon=True).start()
    elif not sequence.exists():
        write_repeated(sequence, pictures, count, options.frames)
    Meter.every = options.every
    build.Console = Meter
    if options.true_motions:
        known = open_sequence(pictures).truth() or {}
        truth = {frame: known[frame % period % count] for frame in range(options.frames)}
        compose.registrar = lambda *_, **__: Known(truth)
    watched = ["--watch", "--idle-s", "60"] if options.watch else []
    print("  step  " + "  ".join(f"{name:>7}" for name in _FIELDS) + "             edges      wall   processor")
    kind = "-true" * options.true_motions + "-watched" * options.watch
    run_folder = options.out / f"run-{options.width}-{options.frames}{kind}"
    status = main(["build", str(sequence), "--out", str(run_folder), "--overwrite", *watched, *options.options])
    (options.out / f"costs-{options.width}-{options.frames}{kind}.json").write_text(json.dumps(Meter.costs) + "\n")
    print(f"status {status}; at the end of the program: {memory_mib()['VmHWM']:.0f} MiB at most")
    return 0 if status in (0, 3) else status


if __name__ == "__main__":
    sys.exit(run())
