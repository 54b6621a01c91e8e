"""The climb: where the likelihood is high, also where little surface matches."""

from dataclasses import replace

import numpy as np
import pytest
from test_search import views

from modeler.evaluation import rotation_error_deg
from modeler.priors import GeneralPrior
from modeler.registration.climb import Climb
from modeler.registration.search import Search
from modeler.registration.visibility import VisibilityRegistrar

WIDE = GeneralPrior(max_rotation_deg=95.0, max_offset_m=0.08)  # the other way round a box is beyond
BASIN = np.repeat([0.2, 0.01], 3)
FEW = Climb(looks=500)


@pytest.fixture(scope="module")
def box():
    """A box turned by 75°: one of its sides is all that both views show."""
    source, target, truth = views("box", source=3, target=0)
    return VisibilityRegistrar().pair(source, target, np.random.default_rng(0)), WIDE.between(source, target), truth


def climbed(box, climb, seed=0):
    pair, density, _ = box
    return climb.places(pair, density, BASIN, np.random.default_rng(seed), effective_points=80.0)


def heights(box, poses, climb):
    last = climb.stages[-1]
    return box[0].tempered(poses, last.blur * box[0].size_m, effective_points=80.0, stride=last.stride)


def test_climbers_come_up_only_where_the_prior_allows(box):
    poses = climbed(box, FEW)
    assert np.isfinite(box[1].log_density(poses)).all()
    reached = heights(box, poses, FEW)
    assert (np.diff(reached) <= 0.0).all()
    assert reached[0] > heights(box, climbed(box, replace(FEW, rounds=0)), FEW).max()


def test_more_rounds_never_end_lower(box):
    """The first rounds of a stage are the same ones, and a climber steps only up."""
    stage = (replace(FEW.stages[-1], climbers=30),)
    ends = [
        heights(box, climbed(box, replace(FEW, stages=stage, rounds=rounds, apart=1e-9)), FEW) for rounds in (1, 4, 16)
    ]
    assert (np.diff([end.max() for end in ends]) >= 0.0).all()
    assert (np.diff([np.median(end) for end in ends]) > 0.0).all()


def test_places_are_apart_and_come_again_with_the_seed(box):
    poses = climbed(box, FEW)
    np.testing.assert_array_equal(poses, climbed(box, FEW))
    assert len(poses) > 3
    assert min(rotation_error_deg(poses[0], other) for other in poses[1:]) > 1e-3


def test_a_turn_is_found_where_surface_leads_astray(box):
    """Most surface matches with another side of the box, though then it stands in space that was seen to be empty."""
    pair, density, truth = box
    dragged = Search(descent_points=40.0)  # to the middle of the prior, so that few come down near the truth
    astray = replace(dragged, low_overlap_score=-np.inf).candidates(pair, density, np.random.default_rng(1))
    found = dragged.candidates(pair, density, np.random.default_rng(1))
    assert rotation_error_deg(astray.poses[0], truth) > 45.0
    assert rotation_error_deg(found.poses[0], truth) < 5.0  # samples find the rest of the way
    assert not found.low_overlap


def test_an_even_prior_does_not_drag(box):
    """Where little surface holds a motion on its way down, the middle of what is possible is no better than its end."""
    pair, density, truth = box
    found = replace(Search(), low_overlap_score=-np.inf).candidates(
        pair, density, np.random.default_rng(1)
    )  # without a climb
    assert rotation_error_deg(found.poses[0], truth) < 5.0


def test_what_matches_enough_is_not_climbed(box, monkeypatch):
    source, target, _ = views("box", source=1, target=0)
    pair = VisibilityRegistrar().pair(source, target, np.random.default_rng(0))
    monkeypatch.setattr(Climb, "places", None)
    assert not Search().candidates(pair, WIDE.between(source, target), np.random.default_rng(1)).low_overlap
