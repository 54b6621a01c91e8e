"""Lists the programs that measure, or runs one: `python -m studies [NAME [arguments]]`, in the root of the repository.

What a study writes goes into a folder of `runs/` unless `--out` names another; `python -m studies NAME --help` tells
the options.
"""

from __future__ import annotations

import runpy
import sys

STUDIES: dict[str, tuple[str, str]] = {
    "ablation": ("what each stage and constant of the default registration contributes", "many hours"),
    "ablation.constants": ("what halving and doubling each named number of other rooms changes", "hours"),
    "ablation.evidence": ("marginal likelihoods of wrong registrations against those of a run's edges", "minutes"),
    "active": ("suggested actions: predicted against realised gains, actions until done", "an hour"),
    "active.demo": ("a simulated robot that follows the suggestions", "minutes"),
    "active.picture": ("draw a robot that follows the suggestions", "a minute"),
    "active.pokes": ("spin between two views after pokes, predicted and realised", "minutes"),
    "bench": ("speed against Open3D and the committed baseline", "minutes"),
    "bench.following": ("time in which objects are found and followed with their models", "a minute"),
    "bench.gpu": ("speed on an NVIDIA GPU against two CPU threads of the same machine", "minutes"),
    "bench.multiway": ("make a whole model by Open3D's recipes", "seconds"),
    "bench.stages": ("processor seconds of a build by stage", "seconds"),
    "calibration": ("calibration of covariances on rendered pairs", "half an hour"),
    "calibration.by_camera": ("the same for cameras other than the renderer's", "20 minutes"),
    "colour": ("what colour tells: aligned, displaced, faint, and under difficult light", "half an hour a core"),
    "far_apart": ("registration of views that are far apart", "3 minutes"),
    "far_apart.few_frames": ("whole models from four or six views", "minutes"),
    "followed": ("draw the model of a run into frames in which it is found, with the region of its place", "a minute"),
    "fuzz": ("damaged inputs of every format: read, or refused in one line", "hours"),
    "fuzz.guided": ("the same for one format, led by coverage (needs atheris)", "as long as told"),
    "growing": ("draw a model that grows, with the uncertainty of its poses", "a minute"),
    "hostile": ("commands in hostile environments: no traceback, no hang, nothing left behind", "two hours"),
    "in_hand": ("whole models of objects in a hand", "half an hour"),
    "inputs": ("models of inputs as people have them, right and wrong, drawn at random", "half an hour a core"),
    "kills": ("commands that are killed and given again end with the same bytes", "16 minutes"),
    "live": ("following an object before a camera of 30 Hz in real time", "minutes"),
    "loops": ("trajectory errors before and after loop closure", "half an hour"),
    "loops.axis": ("axes of turntables estimated from whole runs", "minutes"),
    "loops.cameras": ("whole runs of cameras other than the renderer's", "hours"),
    "loops.covariances": ("covariances of whole runs against the truth", "hours"),
    "loops.focal_lengths": ("focal lengths estimated from loops", "minutes"),
    "loops.memory": ("memory and time of builds of thousands of frames", "minutes to hours"),
    "multiplied": ("models of real captures changed in the ways that people change theirs", "an hour a core"),
    "numbers": ("named numbers of the package by room", "seconds"),
    "results": ("write the tables of pages from the files that hold them", "a second"),
    "same_bytes": ("results of this tree and of another commit, byte by byte", "minutes"),
    "scale": ("throughput of batches", "15 minutes"),
    "scenes": ("segmentation of rendered scenes, models behind hands and grippers", "half an hour"),
    "surfacing": ("meshes of rendered shapes against the truth, by us and by Open3D", "minutes"),
    "surfacing.captures": ("surfaces and colours of held-out views of captures", "minutes"),
    "surfacing.masks_and_models": ("draw depth, mask and model of runs", "seconds"),
    "surfacing.vertices": ("whether vertices are as far off as they state, for several depth cameras", "half an hour"),
    "symmetries": ("symmetries of shapes of known class", "minutes"),
    "tracking": ("objects found and followed with their models: on cluttered tables and in captures", "an hour"),
    "trust": ("reliability of exit status 0, with and without faults", "20 minutes a core"),
    "turned_over": ("objects that are turned over within one recording", "half an hour"),
    "whole": ("models of captures that another renderer makes, every factor drawn at random", "half an hour a core"),
    "whole.ceiling": ("the same, with true motions and masks given to runs that were wrong or refused", "half an hour"),
    "whole.things": ("gather the meshes and photographs of packages that `whole` shows", "a minute"),
}
"""What each measures, and roughly how long it takes with its defaults."""


def main(arguments: list[str]) -> int:
    """List the studies, or run one and return its exit status."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(__doc__)
        for name, (measured, duration) in STUDIES.items():
            print(f"    {name:<28}{measured} ({duration})")
        return 0
    name = arguments[0]
    if name not in STUDIES:
        print(f"studies: there is no study {name!r}; `python -m studies` lists them", file=sys.stderr)
        return 2
    sys.argv = arguments
    runpy.run_module(f"studies.{name}", run_name="__main__", alter_sys=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
