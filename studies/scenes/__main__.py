"""Find objects in rendered scenes without masks, or build models behind hands and grippers: `python -m studies scenes`.

`masks` segments scenes of all kinds and compares the masks with the truth; the held-out half is for a single
evaluation. `occluded` builds models of objects partly occluded by a hand or a gripper. Renderings and runs are kept in
the folder, and an interrupted study continues. The table goes to stdout, progress to stderr.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from modeler.sequences.image_files import write_image
from studies.results_file import earlier_results
from studies.scenes import masks, occluded
from studies.scenes.plan import Plan
from studies.trust.plan import HALVES, Half


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a study."""
    parser = argparse.ArgumentParser(prog="python -m studies scenes", description=__doc__)
    parser.add_argument("study", choices=("masks", "occluded"))
    parser.add_argument("--out", type=Path, default=Path("runs/scenes"), help="folder of the results")
    parser.add_argument("--half", choices=HALVES, default="tuning", help="of masks: which shapes and draws")
    parser.add_argument("--scenes", type=int, default=masks.SCENES, metavar="N", help="of masks: how many of the half")
    parser.add_argument("--start", type=int, default=0, metavar="K", help="of masks: number of the first one")
    parser.add_argument(
        "--given", nargs="+", choices=occluded.GIVEN, default=occluded.GIVEN, help="of occluded: given masks"
    )
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    if options.study == "masks":
        print(_masks(options.out, options.half, range(options.start, options.start + options.scenes)))
    else:
        print(_occluded(options.out / "occluded.jsonl", options.given))
    return 0


def _masks(folder: Path, half: Half, numbers: range) -> str:
    """Return the table of masks, and write a picture of every scene."""
    results = []
    for number in numbers:
        plan = Plan(half, number)
        result, shown, found = masks.find(plan, folder / "rendered")
        write_image(folder / f"{half}-{number}.png", masks.picture(shown, found))
        said = [f"{iou:.2f}{'?' * unsure}" for iou, unsure in zip(result.ious, result.unsure, strict=True)]
        print(f"{number:3} {plan.kind:24} {plan.stage().recipe.name:12} {' '.join(said)}", file=sys.stderr, flush=True)
        results.append(result)
    return masks.table(results)


def _occluded(path: Path, wanted: Sequence[occluded.Given]) -> str:
    """Return the table of models behind hands and grippers."""
    outcomes = [occluded.Outcome(**json.loads(line)) for line in earlier_results(path)]
    done = {(one.shape, one.holder, one.given) for one in outcomes}
    for given in wanted:
        for holder in occluded.HOLDERS if given != "no hand" else occluded.HOLDERS[:1]:
            for shape in occluded.SHAPES:
                if (shape, holder, given) in done:
                    continue
                outcomes.append(occluded.outcome(shape, holder, given))
                with path.open("a") as stream:
                    print(json.dumps(asdict(outcomes[-1])), file=stream)
                print(outcomes[-1], file=sys.stderr, flush=True)
    return occluded.table([one for one in outcomes if one.given in wanted])


if __name__ == "__main__":
    import numba

    numba.set_num_threads(1)  # so that times can be compared, whatever else runs
    sys.exit(main())
