"""The picture of the README: surface observed by a robot that follows the suggestions, action by action.

.venv/bin/python -m studies active.picture figurine --out docs/next.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from modeler.pipeline import Modeler
from modeler.priors import TablePrior
from modeler.sequences.rendering.recipe import load_recipe
from modeler.suggestion import Belief, Goal, suggest
from modeler.types import Array, BoolArray, Step
from modeler.views import Sensor
from studies.active.robot import SimulatedRobot

SEEN_RGB, UNSEEN_RGB = np.array([0.62, 0.66, 0.72]), np.array([0.93, 0.55, 0.16])
ELEVATION, BEHIND_DEG = 0.5, 150.0  # of the eye: slope, and turn from the first camera, to see what that did not


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m studies active.picture")
    parser.add_argument("shape")
    parser.add_argument("--actions", type=int, default=8)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    recipe = load_recipe(options.shape)
    robot, rng = SimulatedRobot.before(recipe), np.random.default_rng([recipe.seed, 1])
    modeler = Modeler(sensor=Sensor(robot.stage.sequence.sensor()), prior=TablePrior(max_rotation_deg=100.0))
    run = modeler.start(modeler.segmenter.scene([robot.stage.frame()]))
    shown: list[tuple[Belief, str]] = []
    for _ in range(options.actions + 1):
        step = [event for event in run.track([robot.stage.frame()]) if isinstance(event, Step)][-1]
        belief = modeler.belief(step.views, step.solution, step.edges_so_far)
        found = suggest(belief, None, Goal())
        best = next(each for each in found.ranked if each.prediction.candidate.action == "turn")
        action = best.words.split(" (")[0]
        wanted = "good enough" if found.reached else f"next: {action}"
        shown.append((belief, f"{100.0 * found.seen:.0f} % seen, poses to {found.pose_deg:.1f}°\n{wanted}"))
        if found.reached:
            break
        robot = robot.after(best.prediction.candidate, belief, rng)
    draw(shown, options.out)


def draw(shown: list[tuple[Belief, str]], path: Path) -> None:
    """Draw the cells of each state side by side, all from one side of the object as it is known last."""
    figure = Figure(figsize=(2.2 * len(shown), 2.9), dpi=100)
    FigureCanvasAgg(figure)
    last = shown[-1][0]
    up = last.stand.up
    turn = np.radians(BEHIND_DEG)
    first = last.solution.trajectory[min(last.solution.trajectory)][:3, 3] - last.stand.object_from_stand[:3, 3]
    flat = first - (first @ up) * up
    flat = flat / np.linalg.norm(flat)
    away = np.cos(turn) * flat + np.sin(turn) * np.cross(up, flat) + ELEVATION * up
    away = away / np.linalg.norm(away)
    across = np.cross(up, away)
    across = across / np.linalg.norm(across)
    axes = np.stack([across, np.cross(away, across), away]).astype(np.float64)
    for number, (belief, words) in enumerate(shown):
        axis = figure.add_axes((number / len(shown), 0.0, 1.0 / len(shown), 0.84))
        cells = belief.cells
        kept = cells.seen | (belief.can_be_seen & ~cells.under)
        points = (cells.points_m[kept] - last.stand.object_from_stand[:3, 3]) @ axes.T
        colours = shaded(cells.normals[kept] @ axes.T, cells.seen[kept])
        order = np.argsort(points[:, 2])
        side = 72.0 * 2.2 * cells.cell_m / (2.9 * last.stand.radius_m)
        axis.scatter(points[order, 0], points[order, 1], c=colours[order], s=1.6 * side**2, marker="o", linewidths=0)
        reach = 1.45 * last.stand.radius_m
        axis.set_xlim(-reach, reach)
        middle = 0.5 * last.stand.height_m * float(up @ axes[1])
        axis.set_ylim(middle - reach, middle + reach)
        axis.set_aspect("equal")
        axis.axis("off")
        figure.text((number + 0.5) / len(shown), 0.98, words, ha="center", va="top", fontsize=9)
    figure.savefig(path)


def shaded(normals: Array, seen: BoolArray) -> Array:
    """Return colours (n, 3) of cells by normals (n, 3) before the eye, and by whether they were seen (n,)."""
    light = 0.45 + 0.55 * np.clip(normals @ np.array([-0.3, 0.5, 0.8]), 0.0, 1.0)
    return np.clip(np.where(seen[:, None], SEEN_RGB, UNSEEN_RGB) * light[:, None] * 1.15, 0.0, 1.0)


if __name__ == "__main__":
    main()
