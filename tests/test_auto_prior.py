"""The prior by which an object may stay on its table, and limits that hold only where they were not left already."""

from __future__ import annotations

import numpy as np
import pytest
import tabletop
from prior_cases import views

from modeler import se3
from modeler.closure import Closer
from modeler.graph import Smoother
from modeler.pipeline.attempts import Search, predicted
from modeler.pipeline.state import State
from modeler.priors import AnyMotion, AutoPrior, GeneralPrior, TablePrior
from modeler.types import PoseGaussian, Solution
from modeler.views import Sensor


def test_it_is_an_even_mixture_of_free_motion_and_motion_on_the_table(rng: np.random.Generator) -> None:
    source, target = views(np.eye(4))
    prior = AutoPrior()
    free, table = prior.free.between(source, target), prior.table.between(source, target)
    motions = np.concatenate([free.sample(20, rng), table.sample(20, rng)])
    expected = np.logaddexp(free.log_density(motions), table.log_density(motions)) - np.log(2.0)
    found = prior.between(source, target).log_density(motions)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    # Motion on the table is far denser: a few nats of the images do not lift the object.
    assert np.median(found[20:]) - np.median(found[:20]) > 5.0


def test_without_a_table_motion_is_free() -> None:
    source, target = views(np.eye(4), table=False)
    prior = AutoPrior()
    motion = prior.free.between(source, target).sample(5, np.random.default_rng(0))
    found = prior.between(source, target).log_density(motion)
    np.testing.assert_array_equal(found, prior.free.between(source, target).log_density(motion))


def test_limits_are_left_only_where_both_were_assumed() -> None:
    unlimited = AutoPrior().unlimited()
    assert unlimited is not None
    assert isinstance(unlimited.free, AnyMotion)
    assert AutoPrior(free=GeneralPrior()).unlimited() is None
    assert AutoPrior(table=TablePrior()).unlimited() is None
    assert AutoPrior().relaxed(2.0).free == AutoPrior().free.relaxed(2.0)


@pytest.mark.parametrize(
    ("turn_deg", "assumed", "kept"), [(60.0, True, True), (90.0, True, False), (90.0, False, True)]
)
def test_pairs_are_registered_within_limits_that_hold_their_predicted_motion(
    turn_deg: float, assumed: bool, kept: bool
) -> None:
    body = tabletop.Box((0.06, 0.045, 0.08))
    poses = tabletop.turntable(360)
    seen = [tabletop.view(body, poses[k], k) for k in (0, int(turn_deg))]
    target, source = (Sensor().ray_image(view.frame) for view in seen)
    prior = GeneralPrior(max_offset_m=0.2, limits_assumed=assumed)
    solution = Solution({target.index: np.eye(4), source.index: poses[0] @ se3.inverse(poses[int(turn_deg)])})
    state = State(smoother=Smoother(solution=solution), views={target.index: target, source.index: source})
    motion = PoseGaussian(solution.relative(target.index, source.index), np.eye(6))
    found = predicted(Search(state, prior, Closer(), source, target.index), target.index, prior, motion)
    assert isinstance(found.known, GeneralPrior if kept else AnyMotion)
