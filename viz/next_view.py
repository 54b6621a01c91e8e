"""Suggestions in the viewer: the ranked list, observed and unseen surface, and both over time."""

from __future__ import annotations

from typing import Final

import rerun as rr
import rerun.blueprint as rrb

from modeler.suggestion import Belief, Suggestions
from modeler.types import RayImage
from modeler.viz import entities
from modeler.viz.blueprint import FROM_THE_SIDE, framed, near, spatial
from modeler.viz.drawings import Drawing

WORDS: Final = "next/words"
SEEN_CELLS: Final = "world/cells/seen"
UNSEEN_CELLS: Final = "world/cells/unseen"
SEEN: Final = "next/seen_percent"
POSE_SD: Final = "next/pose_sd_deg"
_GREY, _ORANGE = (150, 155, 165), (240, 140, 40)


def draw_next(belief: Belief, found: Suggestions) -> Drawing:
    """Yield drawings of the belief about poses and surface, and of the suggested actions."""
    lines = [f"**{found.summary}**", "", *(f"1. {each.words}" for each in found.best)]
    yield WORDS, rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN)
    cells, size_m = belief.cells, 0.5 * belief.cells.cell_m
    open_ = belief.can_be_seen & ~cells.seen & ~cells.under
    yield SEEN_CELLS, rr.Points3D(cells.points_m[cells.seen], colors=_GREY, radii=size_m)
    yield UNSEEN_CELLS, rr.Points3D(cells.points_m[open_], colors=_ORANGE, radii=size_m)
    yield SEEN, rr.Scalars(100.0 * found.seen)
    yield POSE_SD, rr.Scalars(found.pose_deg)


def tab(first: RayImage | None) -> rrb.Container:
    """Return a layout of observed and unseen surface, the frame, the list, and the values over time."""
    cells = spatial(
        "Observed (grey), and where unseen surface may be (orange)",
        [SEEN_CELLS, UNSEEN_CELLS, entities.CAMERAS, entities.POSITION_3_SIGMA],
        near(first, FROM_THE_SIDE, 10.0),
    )
    words = rrb.TextDocumentView(origin=WORDS, name="What to do next, best first")
    times = rrb.Horizontal(
        rrb.TimeSeriesView(origin=SEEN, name="Observed, % of the visible surface"),
        rrb.TimeSeriesView(origin=POSE_SD, name="Largest standard deviation of a rotation, °"),
    )
    return rrb.Horizontal(
        rrb.Vertical(cells, times, row_shares=[2.0, 1.0]), rrb.Vertical(framed(first), words), name="What to do next"
    )
