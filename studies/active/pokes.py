"""Pokes that are more informative than turns: spin between two views, predicted and realised.

.venv/bin/python -m studies active.pokes --shapes 6
"""

from __future__ import annotations

import argparse

import numpy as np

from modeler.pipeline import Modeler
from modeler.priors import PokePrior, TablePrior
from modeler.suggestion import Candidate
from modeler.suggestion.candidates import pokes
from modeler.types import AbstractPrior
from modeler.views import Sensor
from studies.active.robot import SimulatedRobot
from studies.active.trial import REACH_DEG, relative_error_deg, shown, sigma_deg, small
from studies.calibration.specimens import SPECIMENS, load_specimen
from studies.results.tables import FOLDER, markdown, record


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m studies active.pokes")
    parser.add_argument("--shapes", type=int, default=6, help="of each class")
    parser.add_argument("--record", action="store_true", help="put the sd of each shape into the results")
    options = parser.parse_args()
    rows = []
    for kind in ("revolution", "near-symmetric"):
        names = [s.recipe for s in SPECIMENS if s.half == "held-out" and s.symmetry == kind]
        for name in names[: options.shapes]:
            rows.append(row(name))
            print(" | ".join(rows[-1]), flush=True)
    print(
        markdown(
            ("shape", "poke turns", "sd of rotation after it, predicted → stated (error)", "after a turn as far"), rows
        )
    )
    if options.record:
        record(FOLDER / "pokes.json", rows)


def row(name: str) -> tuple[str, ...]:
    """Return the first poke at a shape, and a turn by the same unmeasured angle."""
    robot, rng = SimulatedRobot.before(small(load_specimen(name), 0, 320)), np.random.default_rng(0)
    table = Modeler(sensor=Sensor(robot.stage.sequence.sensor()), prior=TablePrior(max_rotation_deg=REACH_DEG))
    scene = table.segmenter.scene([robot.stage.frame()])
    step = shown(table.start(scene), robot.stage)
    belief = table.belief(step.views, step.solution, step.edges_so_far)
    poke = pokes(belief.last, belief.stand, belief.object_from_last)[0]
    cases: list[tuple[Candidate, AbstractPrior]] = [
        (poke, PokePrior(poke=poke.poke)),
        (Candidate("turn", turn_deg=poke.turn_deg), table.prior),
    ]
    said = []
    for candidate, prior in cases:
        prediction = belief.predict(candidate)
        after = robot.after(candidate, belief, rng)
        run = Modeler(sensor=table.sensor, prior=prior).start(scene)
        shown(run, robot.stage)
        found = shown(run, after.stage)
        predicted = float("nan") if prediction is None else sigma_deg(prediction.edges[0].covariance)
        if found.accepted:
            stated = sigma_deg(found.solution.relative_covariance(0, 1))
            error_deg = relative_error_deg(found, after.stage.truth(), 0, 1)
            said.append(f"{predicted:.1f}° → {stated:.1f}° ({error_deg:.1f}°)")
        else:
            said.append(f"{predicted:.1f}° → left out")
    return name.replace("_", " "), f"{poke.turn_deg:.0f}°", *said


if __name__ == "__main__":
    main()
