"""`modeler demo-active`: a simulated robot that follows `modeler suggest`."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from modeler.cli.console import say
from modeler.cli.options import SEED, default

if TYPE_CHECKING:
    from modeler.pipeline import Modeler
    from modeler.sequences.rendering.recipe import Recipe
    from modeler.suggestion import Goal, Suggestion, Suggestions
    from modeler.types import Step

_REACH_DEG = 100.0  # of turns, and limit of the table prior: beyond it views hardly share surface


@dataclass(frozen=True)
class DemoActive:
    """Simulate a robot that turns an object as `modeler suggest` suggests until its model is good enough.

    The renderer is its camera; turns have errors of 2°. Creates OUT/scene, the sequence, and OUT/run, its run folder.
    The recording shows at each step the observed surface, where unseen surface may be, and the ranked list.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="OUT")]
    """Folder to create."""
    shape: Annotated[str, tyro.conf.arg(metavar="RECIPE")] = "figurine"
    """Recipe in JSON or TOML, or the name of a built-in one."""
    actions: Annotated[int, tyro.conf.arg(metavar="N")] = 12
    """Maximum number of actions."""
    until_seen: Annotated[float, tyro.conf.arg(metavar="SHARE")] = 0.95
    """Goal: share (0 to 1) of the surface visible by turns on the table that was observed."""
    until_pose_deg: Annotated[float, tyro.conf.arg(metavar="DEG")] = 1.0
    """Goal: largest standard deviation of a pose's rotation."""
    seed: Annotated[int, SEED] = 0
    """Seed of the noise and of the robot's errors."""
    view: bool = False
    """Watch in the Rerun viewer."""
    web: bool = False
    """Watch in the browser, served on 127.0.0.1 only."""
    connect: Annotated[str | None, tyro.conf.arg(metavar="URL"), default("none")] = None
    """Watch in a Rerun viewer that is already open: rerun+http://HOST:PORT/proxy."""

    def run(self) -> int:
        """Run the demonstration; status 3 if the goal was not reached or the model is not to be trusted.

        Raises:
            InputError: if an option cannot be used, or the folder cannot be made.
        """
        import numpy as np

        from modeler.cli.compiling import compile_kernels
        from modeler.cli.outputs import check_folder
        from modeler.export import RunFolder, RunMeta
        from modeler.pipeline import Modeler
        from modeler.priors import TablePrior
        from modeler.sequences.rendering.recipe import load_recipe
        from modeler.suggestion import Goal
        from modeler.types import InputError
        from modeler.views import Sensor
        from modeler.viz.stream import open_stream

        if not (1 <= self.actions <= 100 and 0.0 < self.until_seen <= 1.0 and self.until_pose_deg > 0.0):
            raise InputError(
                "--actions takes 1 to 100, --until-seen a share up to 1, --until-pose-deg a positive angle"
            )
        check_folder(self.out, [Path(self.shape)])
        recipe = replace(load_recipe(self.shape), seed=self.seed)
        compile_kernels()
        from modeler.sequences.rendering.renderer import RenderedSequence

        sensor = Sensor(*RenderedSequence(recipe).sensor())
        modeler = Modeler(sensor=sensor, prior=TablePrior(max_rotation_deg=_REACH_DEG), seed=self.seed)
        folder = RunFolder.open(self.out / "run")
        meta = RunMeta(str(self.out / "scene"), self.seed, "table", settings={"max_rotation_deg": _REACH_DEG})
        stream = open_stream(
            recipe.name,
            save=folder.path / "recording.rrd",
            spawn=self.view,
            web=self.web,
            connect=self.connect,
        )
        goal = Goal(self.until_pose_deg, self.until_seen)
        try:
            demo = _Demo(modeler, folder, meta, stream, goal)
            report, reached = demo.run(recipe, self.actions, np.random.default_rng([self.seed, 1]))
        finally:
            stream.close()
        folder.finish()
        how = "good enough" if reached else "not yet good enough"
        say(f"{how}: modeler view {self.out / 'run'}")
        return 0 if reached and report["trustworthy"] else 3


@dataclass(frozen=True, eq=False)
class _Demo:
    """The loop of the demonstration and where it is shown."""

    modeler: Modeler
    folder: Any
    meta: Any
    stream: Any
    goal: Goal

    def run(self, recipe: Recipe, actions: int, rng: Any) -> tuple[Mapping[str, Any], bool]:
        """Return the report of the run, and whether the goal was reached."""
        from modeler.cli.simulated_robot import SimulatedRobot
        from modeler.sequences import write_bop
        from modeler.suggestion import suggest
        from modeler.types import Step
        from modeler.viz import next_view

        began_s = time.perf_counter()
        robot, done, reached = SimulatedRobot.before(recipe), "the first view", False
        run = self.modeler.start(self.modeler.segmenter.scene([robot.stage.frame()]))
        for count in range(actions + 1):
            step = [event for event in run.track([robot.stage.frame()]) if isinstance(event, Step)][-1]
            self.folder.write(step, self.meta)
            self.stream(step)
            if count == 0 and step.view is not None:
                self.stream.lay_out(next_view.layout(step.view))
            belief = run.modeler.belief(step.views, step.solution, step.edges_so_far)
            found = suggest(belief, None, self.goal)
            self.stream.draw(step, next_view.draw_next(belief, found, done))
            _say(found, done, step)
            best, reached = _best(found), found.reached
            if reached or best is None or count == actions:
                break
            done = best.words
            robot = robot.after(best.prediction.candidate, belief, rng)
        sequence = robot.stage.sequence
        write_bop(
            self.folder.path.parent / "scene",
            sequence,
            sequence.truth(),
            {"name": recipe.name, "sensor": sequence.sensor()._asdict(), "source": "rendered"},
            depth_scale_mm=recipe.depth_unit_mm,
        )
        for _ in run.refine():
            pass
        report: Mapping[str, Any] = {}
        for event in run.finish():
            if isinstance(event, Step):
                meta = replace(self.meta, seconds={"total": time.perf_counter() - began_s})
                report = self.folder.write(event, meta)
                self.stream(event)
        return report, reached


def _best(found: Suggestions) -> Suggestion | None:
    """Return the best turn: the run's prior knows nothing of pokes, and laying the object down begins another run."""
    return next((each for each in found.ranked if each.prediction.candidate.action == "turn"), None)


def _say(found: Suggestions, done: str, step: Step) -> None:
    lost = "" if step.accepted else " (the view could not be placed)"
    say(f"{done}{lost}")
    say(f"    {found.summary}")
