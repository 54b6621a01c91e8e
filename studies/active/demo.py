"""A simulated robot that turns an object as `modeler suggest` suggests, until its model is good enough.

    python -m studies active.demo --out runs/active --view

The renderer is its camera; turns have errors of 2°. OUT/scene is the sequence, OUT/run its run folder. The recording
shows at each step the observed surface, where unseen surface may be, and the ranked list. The status is 0 once the goal
is reached and the model can be trusted, and 3 otherwise.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np

from modeler.export import RunFolder, RunMeta
from modeler.pipeline import Modeler
from modeler.priors import TablePrior
from modeler.sequences import write_bop
from modeler.sequences.rendering.recipe import Recipe, load_recipe
from modeler.suggestion import Goal, suggest
from modeler.types import InputError, Step
from modeler.views import Sensor
from modeler.viz.stream import RerunStream, open_stream
from studies.active.robot import SimulatedRobot

REACH_DEG = 100.0  # of turns, and limit of the table prior: beyond it views hardly share surface


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demonstration."""
    parser = argparse.ArgumentParser(
        prog="python -m studies active.demo",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, required=True, help="folder to create")
    parser.add_argument("--shape", default="figurine", help="recipe, or the name of a built-in one")
    parser.add_argument("--actions", type=int, default=12, help="at most")
    parser.add_argument("--until-seen", type=float, default=0.95, help="share of the surface visible by turns")
    parser.add_argument("--until-pose-deg", type=float, default=1.0, help="largest standard deviation of a rotation")
    parser.add_argument("--seed", type=int, default=0, help="of the noise and of the robot's errors")
    parser.add_argument("--view", action="store_true", help="watch in the Rerun viewer")
    parser.add_argument("--web", action="store_true", help="watch in the browser, served on 127.0.0.1 only")
    options = parser.parse_args(arguments)
    goal = Goal(options.until_pose_deg, options.until_seen)
    try:
        recipe = replace(load_recipe(options.shape), seed=options.seed)
        folder = RunFolder.open(options.out / "run")
        save = folder.path / "recording.rrd"
        stream = open_stream(recipe.name, save=save, spawn=options.view, web=options.web, advised=True)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    try:
        good = demonstrate(recipe, folder, stream, goal, actions=options.actions)
    finally:
        stream.close()
    folder.finish()
    print(f"modeler view {folder.path}", file=sys.stderr)
    return 0 if good else 3


def demonstrate(recipe: Recipe, folder: RunFolder, stream: RerunStream, goal: Goal, *, actions: int) -> bool:
    """Run the loop; return whether the goal was reached and the model can be trusted."""
    began_s, rng, robot = time.perf_counter(), np.random.default_rng([recipe.seed, 1]), SimulatedRobot.before(recipe)
    sequence, reached = robot.stage.sequence, False
    prior = TablePrior(max_rotation_deg=REACH_DEG)
    modeler = Modeler(sensor=Sensor(sequence.sensor()), prior=prior, seed=recipe.seed)
    settings = {"max_rotation_deg": REACH_DEG}
    meta = RunMeta(str(folder.path.parent / "scene"), recipe.seed, "table", settings=settings)
    run = modeler.start(modeler.segmenter.scene([robot.stage.frame()]))
    for count in range(actions + 1):
        step = [event for event in run.track([robot.stage.frame()]) if isinstance(event, Step)][-1]
        folder.write(step, meta)
        stream(step)
        belief = run.modeler.belief(step.views, step.solution, step.edges_so_far)
        found = suggest(belief, None, goal)
        stream.advise(step, belief, found)
        reached = found.reached
        print(f"{'' if step.accepted else 'the view could not be placed; '}{found.summary}", file=sys.stderr)
        # The run's prior knows nothing of pokes, and laying the object down begins another run.
        turn = next((each for each in found.ranked if each.prediction.candidate.action == "turn"), None)
        if reached or turn is None or count == actions:
            break
        print(turn.words, file=sys.stderr)
        robot = robot.after(turn.prediction.candidate, belief, rng)
    sequence = robot.stage.sequence
    facts = {"name": recipe.name, "sensor": sequence.sensor()._asdict(), "source": "rendered"}
    write_bop(Path(meta.sequence), sequence, sequence.truth(), facts, depth_scale_mm=recipe.depth_unit_mm)
    for _ in chain(run.refine(), run.correct()):
        pass
    last = [event for event in run.finish() if isinstance(event, Step)][-1]
    stream(last)
    report = folder.write(last, replace(meta, seconds={"total": time.perf_counter() - began_s}))
    return reached and report["trustworthy"]


if __name__ == "__main__":
    sys.exit(main())
