"""The loop, with a registrar that knows the truth: what joins, what is left out, and what a step says about it."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
import pytest
import tabletop

from modeler import se3
from modeler.closure import Closer
from modeler.fusion import Fuser
from modeler.pipeline import ACCEPTED, Modeler
from modeler.rays import Sensor
from modeler.segmentation import Scene, Segmenter, telling
from modeler.types import (
    AbstractMotion,
    AbstractPrior,
    AbstractRegistrar,
    Array,
    Frame,
    InputError,
    Outcome,
    PoseGaussian,
    Posterior,
    RayImage,
    Step,
)

BOX = tabletop.Box((0.06, 0.045, 0.08))
POSES = tabletop.turntable(9)
FRAMES = [replace(view.frame) for view in tabletop.views(BOX, POSES, np.random.default_rng(0)).values()]
SIGMAS = np.repeat([0.002, 0.0005], 3)


@final
@dataclass(frozen=True)
class AnyMotion(AbstractMotion):
    evidence = True

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        return np.broadcast_to(np.eye(4), (count, 4, 4))

    def log_density(self, target_from_source: Array) -> Array:
        return np.zeros(len(target_from_source))


@final
@dataclass(frozen=True)
class AnyPrior(AbstractPrior):
    refused: int | None = None

    def between(self, source: RayImage, target: RayImage) -> AbstractMotion:
        if source.index == self.refused:
            raise InputError(f"frame {source.index}: no plane")
        return AnyMotion()


@final
@dataclass(frozen=True)
class Oracle(AbstractRegistrar):
    noise: float = 0.0
    blind: frozenset[int] = frozenset()
    asked: list[tuple[int, int]] = field(default_factory=list)

    def register(
        self, source: RayImage, target: RayImage, motion: AbstractMotion, *, rng: np.random.Generator
    ) -> Posterior:
        self.asked.append((source.index, target.index))
        target_from_source = POSES[target.index] @ se3.inverse(POSES[source.index])
        error = se3.exp(self.noise * SIGMAS * rng.standard_normal(6))
        lost = source.index in self.blind
        pose = PoseGaussian(target_from_source @ error, np.diag(SIGMAS**2))
        outcome = Outcome.NO_OVERLAP if lost else Outcome.CONVERGED
        return Posterior(source.index, target.index, pose, outcome, overlap=0.0 if lost else 0.8)


def modeler(**changes: object) -> Modeler:
    parts: dict[str, object] = {"prior": AnyPrior(), "registrar": Oracle(), "seed": 0, "executor": None} | changes
    fuser = Fuser(voxel_m=0.01)
    return Modeler(segmenter=Segmenter(), sensor=Sensor(), closer=Closer(), fuser=fuser, **parts)  # pyright: ignore[reportArgumentType]


def run(frames: list[Frame] = FRAMES, **changes: object) -> list[Step]:
    return list(modeler(**changes).run(frames, Scene()))


def blank(index: int) -> Frame:
    return replace(FRAMES[index], mask=np.zeros_like(FRAMES[index].mask))


def trajectory_error(step: Step) -> float:
    first = min(step.solution.trajectory)
    wanted = {k: POSES[first] @ se3.inverse(POSES[k]) for k in step.solution.trajectory}
    return max(float(np.abs(step.solution.trajectory[k] - pose).max()) for k, pose in wanted.items())


def test_true_edges_give_the_true_trajectory_in_the_camera_frame_of_the_first_view() -> None:
    last = run()[-1]
    assert list(last.solution.trajectory) == list(range(9))
    assert trajectory_error(last) < 1e-6


def test_each_frame_gives_one_step_and_the_last_one_the_mesh() -> None:
    steps = run()
    assert [step.frame.index for step in steps] == list(range(9))
    assert [step.last for step in steps] == [False] * 8 + [True]
    models = [step.model for step in steps if step.model is not None]
    assert [len(model.triangles) > 0 for model in models] == [False] * 8 + [True]
    assert all(len(model.points_m) > 0 for model in models)


def test_a_full_turn_is_closed_on_the_first_view() -> None:
    last = run()[-1]
    assert [(edge.target, edge.kind, edge.accepted) for edge in last.edges[:2]] == [
        (7, "odometry", True),
        (0, "closure", True),
    ]
    assert last.edges_so_far[-len(last.edges) :] == last.edges


def test_frames_are_read_one_ahead_and_no_more() -> None:
    read = []

    def camera() -> Iterator[Frame]:
        for frame in FRAMES:
            read.append(frame.index)
            yield frame

    steps = modeler().run(camera(), Scene())
    next(steps)
    assert read == [0, 1]
    next(steps)
    assert read == [0, 1, 2]


def test_a_frame_without_object_is_left_out_and_the_next_joins_the_view_before() -> None:
    registrar = Oracle()
    steps = run([FRAMES[0], FRAMES[1], blank(2), FRAMES[3]], registrar=registrar)
    assert [step.outcome == ACCEPTED for step in steps] == [True, True, False, True]
    assert steps[2].outcome.startswith("too few points: ")
    assert steps[2].view is None
    assert registrar.asked == [(1, 0), (3, 1)]
    assert trajectory_error(steps[-1]) < 1e-6


def test_a_frame_that_cannot_be_registered_is_left_out_with_advice() -> None:
    registrar = Oracle(blind=frozenset({2}))
    steps = run(FRAMES[:4], registrar=registrar)
    assert steps[2].outcome == f"no overlap: {Outcome.NO_OVERLAP.advice}"
    assert steps[2].view is not None
    assert list(steps[-1].views) == list(steps[-1].solution.trajectory) == [0, 1, 3]
    assert (3, 1) in registrar.asked


def test_a_frame_to_which_the_prior_does_not_apply_is_left_out() -> None:
    steps = run(FRAMES[:4], prior=AnyPrior(refused=2))
    assert [step.outcome for step in steps] == [ACCEPTED, ACCEPTED, "frame 2: no plane", ACCEPTED]
    assert steps[2].edges == ()


def test_the_first_good_view_makes_the_object_frame() -> None:
    steps = run([blank(0), FRAMES[1], FRAMES[2]])
    assert np.array_equal(steps[-1].solution.trajectory[1], np.eye(4))
    assert trajectory_error(steps[-1]) < 1e-6


@pytest.mark.parametrize("lost", [(3,), (2, 3)])
def test_the_mesh_is_made_though_the_last_frames_are_lost(lost: tuple[int, ...]) -> None:
    last = run([blank(k) if k in lost else FRAMES[k] for k in range(4)])[-1]
    assert last.last
    assert last.outcome != ACCEPTED
    assert last.model is not None
    assert len(last.model.triangles) > 0


def test_without_any_object_there_is_no_model() -> None:
    steps = run([blank(0), blank(1)])
    assert [step.model for step in steps] == [None, None]
    assert steps[-1].last
    assert run([]) == []


def test_a_pair_depends_on_the_seed_and_its_views_alone() -> None:
    whole = run(registrar=Oracle(noise=1.0), seed=7)[4].posteriors[0]
    maker = modeler(registrar=Oracle(noise=1.0), seed=7)
    _, source = maker.view(FRAMES[4], Scene())
    _, target = maker.view(FRAMES[3], Scene())
    assert source is not None
    assert target is not None
    assert np.array_equal(maker.register(source, target).pose.mean, whole.pose.mean)
    other = modeler(registrar=Oracle(noise=1.0), seed=8).register(source, target)
    assert not np.array_equal(other.pose.mean, whole.pose.mean)


def test_same_seed_same_bits_side_by_side_or_one_after_the_other() -> None:
    one = run(registrar=Oracle(noise=1.0))[-1]
    with ThreadPoolExecutor(2) as executor:
        other = run(registrar=Oracle(noise=1.0), executor=executor)[-1]
    assert len(one.posteriors) > 1
    for k, pose in one.solution.trajectory.items():
        assert np.array_equal(pose, other.solution.trajectory[k])
    assert one.model is not None
    assert other.model is not None
    assert np.array_equal(one.model.vertices_m, other.model.vertices_m)


@pytest.mark.parametrize(("frames", "told"), [(1, 1), (3, 3), (15, 15), (16, 15), (1000, 15)])
def test_a_scene_is_told_by_few_frames_spread_over_the_sequence(frames: int, told: int) -> None:
    indices = range(7, 7 + 2 * frames, 2)
    chosen = telling(indices)
    assert len(chosen) == len(set(chosen)) == told
    assert set(chosen) <= set(indices)
    assert chosen[0] == indices[0]
    assert chosen[-1] == indices[-1] or frames == 1
    gaps = np.diff(chosen)
    assert np.ptp(gaps) <= 2 if len(gaps) else told == 1
