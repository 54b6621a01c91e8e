"""A table that turns the other way round than was told: noticed after three pairs, not on a body of revolution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tabletop

from modeler import se3
from modeler.closure import Closer
from modeler.fusion import Fuser
from modeler.pipeline import Modeler
from modeler.priors import ProductPrior, TablePrior, TurntablePrior, VelocityPrior
from modeler.rays import Sensor
from modeler.registration import VisibilityRegistrar
from modeler.segmentation import Scene, Segmenter
from modeler.types import AbstractPrior, Outcome, PoseGaussian, Posterior, Step

COUNT = 15
POSES = tabletop.turntable(COUNT)
STEP_DEG = 360.0 / COUNT
BOX = tabletop.Box((0.06, 0.045, 0.08))
UP = np.array([0.0, -1.0, 0.0])


def run(
    body: tabletop.Body, prior: AbstractPrior, frames: int, *, until_remarked: bool = False
) -> tuple[list[str], list[Step]]:
    """Return what is remarked in the first frames of a turn, each with the frame before which it is, and the steps."""
    views = list(tabletop.views(body, POSES, np.random.default_rng(0)).values())[:frames]
    modeler = Modeler(
        Segmenter(), Sensor(), prior, VisibilityRegistrar(), Closer(max_closures=0, max_spans=0), Fuser(voxel_m=0.01)
    )
    steps: list[Step] = []
    remarks: list[str] = []
    for step in modeler.run(
        (view.frame for view in views),
        Scene(),
        remark=lambda words: remarks.append(f"before frame {len(steps)}: {words}"),
    ):
        steps.append(step)
        if until_remarked and remarks:
            break
    return remarks, steps


def pair(turn_deg: float, outcome: Outcome = Outcome.CONVERGED, source: int = 1) -> Posterior:
    """Return the posterior of a pair in which the object turns right-handed about the camera's up."""
    back = se3.exp(np.concatenate([-np.radians(turn_deg) * UP, np.zeros(3)]))
    return Posterior(source, source - 1, PoseGaussian(back, np.diag(np.repeat([0.01, 0.001], 3) ** 2)), outcome, 0.8)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_wrong_sense_is_told_once_before_the_fourth_frame(sign: float) -> None:
    remarks, _ = run(BOX, TurntablePrior(sign * STEP_DEG, 3.0), 6)
    assert len(remarks) == (1 if sign < 0.0 else 0)
    assert all(remark.startswith("before frame 3: the first views turn the other way round") for remark in remarks)
    assert all("--step-deg -24" in remark and "--step-deg 24" in remark for remark in remarks)


def test_it_is_told_too_where_frames_are_left_out() -> None:
    remarks, steps = run(BOX, TurntablePrior(-STEP_DEG, 0.5), 5, until_remarked=True)
    assert remarks
    assert not all(step.accepted for step in steps)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_body_of_revolution_tells_nothing(sign: float) -> None:
    assert run(tabletop.Sphere(0.07), TurntablePrior(sign * STEP_DEG, 1.0), 8)[0] == []


def test_to_be_asked_changes_nothing() -> None:
    told = TurntablePrior(STEP_DEG, 1.0, axis_direction=(0.0, -1.0, 0.0))

    class Unasked(TurntablePrior):
        def unassuming(self) -> TurntablePrior | None:
            return None

    unasked = Unasked(STEP_DEG, 1.0, axis_direction=(0.0, -1.0, 0.0))
    ends = [run(BOX, prior, 4)[1][-1].solution.trajectory for prior in (told, unasked)]
    assert all(np.array_equal(ends[0][frame], ends[1][frame]) for frame in range(4))


def test_three_sure_pairs_decide_and_unsure_ones_tell_nothing() -> None:
    prior, right, wrong = TurntablePrior(STEP_DEG, 1.0), pair(STEP_DEG), pair(-STEP_DEG)
    assert prior.refuted([]) is None
    assert prior.refuted([wrong] * 2) is None
    assert prior.refuted([wrong] * 3)
    assert prior.refuted([right] * 3) == ""
    assert prior.refuted([wrong] * 3 + [right] * 2) is None
    assert prior.refuted([pair(-STEP_DEG, Outcome.AMBIGUOUS)] * 6) is None


def test_priors_that_hold_a_turntable_ask_as_it_does() -> None:
    turntable, wrong = TurntablePrior(STEP_DEG, 1.0), [pair(-STEP_DEG)] * 3
    product, guess = ProductPrior(TablePrior(), turntable), VelocityPrior(known=turntable)
    free = product.unassuming()
    assert isinstance(free, ProductPrior)
    assert (free.first, free.second) == (product.first, replace(turntable, step_sign="unknown"))
    assert guess.unassuming() == turntable.unassuming()
    assert product.refuted(wrong) == guess.refuted(wrong) == turntable.refuted(wrong)
    assert product.refuted(wrong[:2]) is guess.refuted(wrong[:2]) is None


@pytest.mark.parametrize("prior", [TablePrior(), TurntablePrior(24.0, step_sign="unknown"), VelocityPrior()])
def test_where_nothing_is_taken_for_granted_nothing_is_asked(prior: AbstractPrior) -> None:
    assert prior.unassuming() is None
    assert ProductPrior(TablePrior(), prior).unassuming() is None
