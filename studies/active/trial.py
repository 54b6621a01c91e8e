"""One object modelled by a simulated robot under a policy, with predicted and realised gains per step."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from typing import Any, Literal, final

import numpy as np
from scipy.spatial import KDTree

from modeler import se3
from modeler.pipeline import Modeler, Run
from modeler.priors import TablePrior
from modeler.sequences.rendering.recipe import Recipe
from modeler.suggestion import Belief, Candidate, Goal, Prediction, suggest
from modeler.suggestion.pose_gain import edge_information
from modeler.types import Array, Step
from modeler.views import Sensor
from studies.active.robot import SimulatedRobot
from studies.calibration.specimens import load_specimen
from studies.table_stage import Stage

Policy = Literal["suggest", "random", "even"]
EVEN_DEG = 25.0
REACH_DEG = 100.0
"""Limit of the table prior, and so of turns."""
DISTANCE_M = 0.5
"""Of the camera: objects of 10 cm are 115 of 320 pixels wide."""
VOXEL_M = 0.003


@final
@dataclass(frozen=True)
class Outcome:
    """What one action was to bring, and what it brought."""

    action: str
    turn_deg: float
    predicted_pose_nats: float
    predicted_surface_nats: float
    predicted_new: float
    predicted_sigma_deg: float
    right: float
    usable: float
    accepted: bool
    pose_nats: float = 0.0
    surface_nats: float = 0.0
    new: float = 0.0
    sigma_deg: float = float("nan")
    error_deg: float = float("nan")
    """True error of the rotation from the last view to the new one."""
    edge_sigma_deg: float = float("nan")
    """Standard deviation of the edge between them."""


@final
@dataclass(frozen=True)
class Trace:
    """A whole trial, state by state."""

    shape: str
    policy: str
    seed: int
    outcomes: list[Outcome] = field(default_factory=list)
    seen: list[float] = field(default_factory=list)
    """True share of what can be seen that was, after each frame."""
    stated_seen: list[float] = field(default_factory=list)
    pose_sd_deg: list[float] = field(default_factory=list)
    worst_error_deg: list[float] = field(default_factory=list)
    lost: int = 0

    def record(self) -> dict[str, Any]:
        return asdict(self)


def small(recipe: Recipe, seed: int, width_px: int) -> Recipe:
    """Return a recipe at low resolution, turned to where the seed has it."""
    turn = float(np.random.default_rng([seed, recipe.seed]).uniform(0.0, 360.0))
    scale = width_px / recipe.view.width
    view = replace(
        recipe.view,
        distance_m=DISTANCE_M,
        width=width_px,
        height=round(scale * recipe.view.height),
        focal_px=scale * recipe.view.focal_px,
    )
    x, y, z = recipe.rest_rotation_deg
    table = None if recipe.table is None else replace(recipe.table, size_m=(0.7, 0.7))
    return replace(
        recipe,
        seed=seed,
        view=view,
        rest_rotation_deg=(x, y, z + turn),
        colour="none",
        photography=None,
        label=None,
        table=table,
    )


@lru_cache(maxsize=1)
def visible_points(shape: str, seed: int, width_px: int) -> Array:
    """Return points (n, 3) of the true surface that some turn shows, in the model frame, one a voxel."""
    points, stage = [], Stage(small(load_specimen(shape), seed, width_px))
    for step in range(24):
        turned = Stage(stage.recipe, (stage.poses[0],)).moved_on_table(15.0 * step, (0.0, 0.0))
        exact = replace(turned.recipe, sensor=None)
        sequence = Stage(exact, turned.poses).sequence
        view = Sensor(sequence.sensor()).ray_image(sequence.frame(1))
        points.append(se3.transform(se3.inverse(sequence.truth()[1]), view.points_m))
    return thinned(np.concatenate(points))


def thinned(points_m: Array) -> Array:
    _, first = np.unique(np.floor(points_m / VOXEL_M).astype(np.int64), axis=0, return_index=True)
    return points_m[np.sort(first)]


@final
@dataclass(frozen=True)
class Trial:
    """One shape, one policy."""

    shape: str
    policy: Policy
    seed: int = 0
    actions: int = 5
    width_px: int = 320
    until_done: bool = False
    """Whether to end once the goal is reached."""

    def run(self) -> Trace:
        recipe = small(load_specimen(self.shape), self.seed, self.width_px)
        rng = np.random.default_rng([self.seed, zlib.crc32(self.shape.encode()), len(self.policy)])
        stage = Stage(recipe)
        modeler = Modeler(sensor=Sensor(stage.sequence.sensor()), prior=TablePrior(max_rotation_deg=REACH_DEG))
        wanted = KDTree(visible_points(self.shape, self.seed, self.width_px))
        covered = np.zeros(wanted.n, dtype=bool)
        scene = modeler.segmenter.scene([stage.frame()])
        run, trace = modeler.start(scene), Trace(self.shape, self.policy, self.seed)
        step = shown(run, stage)
        covered, belief = self._states(trace, step, stage, wanted, covered, modeler)
        for _ in range(self.actions):
            candidate, prediction = self._chosen(belief, rng)
            stage = SimulatedRobot(stage).after(candidate, belief, rng).stage
            step = shown(run, stage)
            trace.outcomes.append(outcome(belief, candidate, prediction, step, stage))
            covered, belief = self._states(trace, step, stage, wanted, covered, modeler)
            if self.until_done and done(trace.seen[-1], trace.worst_error_deg[-1]):
                break
        return trace

    def _chosen(self, belief: Belief, rng: np.random.Generator) -> tuple[Candidate, Prediction | None]:
        if self.policy == "suggest":
            ranked = suggest(belief, None, Goal()).ranked
            best = next(each.prediction for each in ranked if each.prediction.candidate.action == "turn")
            return best.candidate, best
        turn_deg = EVEN_DEG if self.policy == "even" else float(rng.choice([-1.0, 1.0]) * rng.uniform(10.0, REACH_DEG))
        candidate = Candidate("turn", turn_deg=turn_deg)
        return candidate, belief.predict(candidate)

    def _states(
        self, trace: Trace, step: Step, stage: Stage, wanted: KDTree, covered: Array, modeler: Modeler
    ) -> tuple[Array, Belief]:
        truth = stage.truth()
        newest = len(stage.poses) - 1
        if newest in step.solution.trajectory:
            points = se3.transform(se3.inverse(truth[newest]), step.views[newest].points_m)
            away_m, _ = KDTree(thinned(points)).query(wanted.data, distance_upper_bound=1.5 * VOXEL_M)
            covered = covered | np.isfinite(away_m)
        belief = modeler.belief(step.views, step.solution, step.edges_so_far)
        trace.seen.append(float(covered.mean()))
        trace.stated_seen.append(belief.seen)
        trace.pose_sd_deg.append(belief.pose_deg)
        trace.worst_error_deg.append(max(errors_deg(step, truth).values()))
        return covered, belief


def done(seen: float, worst_error_deg: float) -> bool:
    """Return whether every pose is within 1° of the truth and 95 % of the visible surface was observed."""
    return seen >= 0.95 and worst_error_deg <= 1.0


def shown(run: Run, stage: Stage) -> Step:
    """Return the step of the frame that a stage shows now."""
    return [event for event in run.track([stage.frame()]) if isinstance(event, Step)][-1]


def errors_deg(step: Step, truth: dict[int, Array]) -> dict[int, float]:
    """Return the true rotation error of each pose relative to the first."""
    poses, first = step.solution.trajectory, min(step.solution.trajectory)
    object_from_model = truth[first]
    return {
        k: float(np.degrees(se3.rotation_angle(se3.inverse(pose) @ object_from_model @ se3.inverse(truth[k]))))
        for k, pose in poses.items()
    }


def relative_error_deg(step: Step, truth: dict[int, Array], last: int, new: int) -> float:
    """Return the true error of the rotation between two frames."""
    true = truth[last] @ se3.inverse(truth[new])
    return float(np.degrees(se3.rotation_angle(se3.inverse(step.solution.relative(last, new)) @ true)))


def outcome(belief: Belief, candidate: Candidate, prediction: Prediction | None, step: Step, stage: Stage) -> Outcome:
    """Return what an action brought, by the measure of the belief before it."""
    new = step.frame.index
    nan = float("nan")
    blank = Outcome(
        candidate.action,
        candidate.turn_deg,
        *(
            (nan, nan, nan, nan, 0.0, 0.0)
            if prediction is None
            else (
                prediction.pose_nats,
                prediction.surface_nats,
                prediction.new_surface,
                sigma_deg(prediction.new_covariance),
                prediction.right,
                prediction.usable,
            )
        ),
        accepted=step.accepted,
    )
    if not step.accepted:
        return blank
    pose = step.solution.trajectory[new]
    edges = [e for e in step.edges_so_far if step.solution.takes_part(e) and e.source == new]
    found = [(e.target, edge_information(pose, step.solution.pose_of(e).covariance)) for e in edges]
    gain = belief.poses.gain(found, new)
    surface_nats, share = belief.brought(step.views[new], pose, gain.covariances[new])
    return replace(
        blank,
        pose_nats=gain.nats,
        surface_nats=surface_nats,
        new=share,
        sigma_deg=sigma_deg(gain.covariances[new]),
        error_deg=relative_error_deg(step, stage.truth(), belief.last.index, new),
        edge_sigma_deg=sigma_deg(step.solution.relative_covariance(belief.last.index, new)),
    )


def sigma_deg(covariance: Array) -> float:
    return float(np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])))


def ran(trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """Return the records of trials."""
    return [trial.run().record() for trial in trials]
