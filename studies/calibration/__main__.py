"""Render pairs, register them, and report how well the posteriors' covariances are calibrated: `make calibrate`.

Shapes have no colour unless `--colour` is given: bodies of revolution and n-fold shapes with a
strong print, with a faint one and with none, under lamps fixed to the camera. With `--blind` as well, the same
pairs are registered without their colour; with `--shifted`, colours are misaligned with depth by as much as a camera's.

The shapes are split: methods may be tuned on one half; the other (`--half held-out`) is for a single evaluation
at the end. The tables go to stdout, progress to stderr, and calibration.json,
calibration.csv and coverage.png into a folder.

The status is 1 if the study does not detect the far too small covariance of the negative control: then it is broken.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from modeler.baselines import ColouredIcpRegistrar
from modeler.export import write_atomically
from modeler.types import InputError
from modeler.viz.figures import Curve, Panel, coverage_curves
from studies.calibration.specimens import PRINTED, SPECIMENS
from studies.calibration.study import CONDITIONS, CONTROL, MEASURES, OURS, SHIFTED, Study, Trial
from studies.calibration.tables import degrees, results_csv, results_json, rows, text

_ORDERS_OF_MAGNITUDE = 100.0  # by which the control's mean squared error must exceed its covariance


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m studies calibration", description=__doc__)
    parser.add_argument("--half", choices=("tuning", "held-out", "both"), default="tuning", help="which shapes")
    parser.add_argument("--colour", action="store_true", help="printed shapes under lamps, instead of bare ones")
    parser.add_argument("--blind", action="store_true", help="leave their colour out")
    parser.add_argument("--shifted", action="store_true", help="with colours that are not aligned to depth")
    parser.add_argument("--shapes", nargs="+", metavar="NAME", help="only these of them")
    parser.add_argument(
        "--frames",
        type=int,
        default=Study.frames,
        metavar="N",
        help="of each shape under each condition, one more than pairs",
    )
    parser.add_argument("--seed", type=int, default=Study.seed, help="of poses, noise and registration")
    parser.add_argument("--out", type=Path, default=Path("runs/calibration"), help="folder of the results")
    options = parser.parse_args(arguments)
    chosen = tuple(
        specimen
        for specimen in (PRINTED if options.colour else SPECIMENS)
        if options.half in ("both", specimen.half) and (not options.shapes or specimen.recipe in options.shapes)
    )
    if not chosen or options.frames < 2 or options.seed < 0:
        parser.error("no pair is left; check --shapes, --half, --frames (2 or more) and --seed (not negative)")
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        conditions = SHIFTED if options.shifted else CONDITIONS
        study = Study(chosen, conditions, frames=options.frames, seed=options.seed, blind=options.blind)
        if options.colour and not options.blind:
            study = replace(study, methods={**study.methods, "coloured-icp": ColouredIcpRegistrar()})
        trials = run(study, options.out)
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    control = [row for row in rows(trials, "all") if row.method == CONTROL and row.judged]
    if not control or min(row.measures["pose"].mean_nees for row in control) < _ORDERS_OF_MAGNITUDE:
        print(f"the negative control ({CONTROL}) passes: the study cannot tell true from false", file=sys.stderr)
        return 1
    return 0


def run(study: Study, out: Path) -> list[Trial]:
    """Run a study, print its tables and write its files into a folder."""
    trials: list[Trial] = []
    began = time.perf_counter()
    for number, specimen in enumerate(study.specimens, 1):
        trials += study.trials(specimen)
        done = f"{number} of {len(study.specimens)} shapes"
        print(f"{done}: {specimen.recipe} ({specimen.half}), {time.perf_counter() - began:.0f} s", file=sys.stderr)
    print(text(trials))
    write_atomically(out / "calibration.json", results_json(study, trials))
    write_atomically(out / "calibration.csv", results_csv(trials))
    write_atomically(out / "coverage.png", coverage_curves(panels(trials)))
    print(f"{study.pairs} pairs; results in {out}", file=sys.stderr)
    return trials


def panels(trials: Sequence[Trial]) -> list[list[Panel]]:
    """Return what is drawn: a row for each half, a column for each prior."""
    return [
        [
            Panel(f"{half}, {prior} prior", curves([t for t in trials if (t.half, t.prior) == (half, prior)]))
            for prior in dict.fromkeys(trial.prior for trial in trials)
        ]
        for half in dict.fromkeys(trial.half for trial in trials)
    ]


def curves(trials: Sequence[Trial]) -> list[Curve]:
    """Return the coverage of the method under test, whole and by axis, and that of the negative control."""
    ours, control = ([t.nees for t in trials if t.usable and t.method == method] for method in (OURS, CONTROL))
    whole = [name for name in MEASURES if degrees(name) > 1]
    axes = [name for name in MEASURES if degrees(name) == 1]
    return [
        *(Curve(f"{OURS}: {name}", [nees[name] for nees in ours], degrees(name)) for name in whole),
        *(
            Curve(f"{OURS}: single axes" if name == axes[0] else "", [nees[name] for nees in ours], 1, "axis")
            for name in axes
        ),
        Curve(f"{CONTROL}: pose", [nees["pose"] for nees in control], degrees("pose"), "control"),
    ]


if __name__ == "__main__":
    sys.exit(main())
