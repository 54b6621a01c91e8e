"""The layout a recording opens with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import rerun.blueprint as rrb

from modeler.export.placing import upright
from modeler.types import Array, RayImage
from modeler.viz import entities, graph_view, images
from modeler.viz.drawings import ABOVE_LEFT

_BACKGROUND: Final = (24, 26, 30)
FROM_THE_SIDE: Final = np.array([-0.8, -0.35, -0.5])  # errors along the camera's own axis show from here


def layout(first: RayImage | None, further: Sequence[rrb.Container] = ()) -> rrb.Blueprint:
    """Return the layout: tabs, the first of which has the poses and their uncertainty large.

    Args:
        first: the first accepted view, which sets the viewpoint; None before there is one.
        further: tabs after the first.
    """
    return _bare(rrb.Tabs(_poses(first), *further, _object(first), _pair(first), _edges(first), _words(), active_tab=0))


def tracking_layout(first: RayImage | None) -> rrb.Blueprint:
    """Return the layout of an object that is tracked: the frame with its outline, and the model among the points."""
    words = rrb.TextDocumentView(origin=entities.TRACKED_WORDS, name="In words")
    eye = near(first, FROM_THE_SIDE, 4.2)
    model = spatial("Model in the frame's points", [f"{entities.TRACKED}/**"], eye, origin=entities.TRACKED)
    return _bare(rrb.Horizontal(rrb.Vertical(framed(first), words, row_shares=[3.0, 1.0]), model))


def _bare(contents: rrb.Container) -> rrb.Blueprint:
    """Return a blueprint of views alone, with the panel of time collapsed."""
    return rrb.Blueprint(
        contents,
        rrb.TimePanel(state="collapsed", timeline=entities.FRAME, play_state="following", fps=3.0),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _poses(first: RayImage | None) -> rrb.Container:
    """Return the object and the cameras with their uncertainty, before and after closure, with frame and table."""
    contents = [f"{entities.WORLD}/model/**", entities.CAMERAS, entities.CURRENT, entities.CHAIN, entities.CLOSURE]
    contents += [entities.BEFORE_POSITION_3_SIGMA, entities.POSITION_1_SIGMA, entities.POSITION_3_SIGMA]
    contents += [entities.MAGNIFICATION]
    details = rrb.Vertical(
        framed(first), rrb.TextDocumentView(origin=entities.POSES, name="Every pose"), row_shares=[1.0, 1.7]
    )
    large = spatial("Cameras around the object, before and after loop closure", contents, _far(first))
    return rrb.Horizontal(large, details, column_shares=[2.1, 1.0], name="Poses and uncertainty")


def framed(first: RayImage | None) -> rrb.View:
    """Return the camera's image, in colour unless the first frame has none, with the object outlined."""
    if first is None or first.frame.colour is not None:
        contents = [entities.COLOUR, entities.OUTLINE]
        return rrb.Spatial2DView(origin=entities.CAMERA, contents=contents, name="Frame, object outlined")
    return _depth(first)


def _depth(first: RayImage | None) -> rrb.View:
    """Return the depth image around the object, which is outlined."""
    return rrb.Spatial2DView(
        origin=entities.CAMERA,
        contents=[entities.DEPTH, entities.DEPTH_OUTLINE],
        name="Depth, object outlined",
        visual_bounds=None if first is None else around(first),
    )


def _object(first: RayImage | None) -> rrb.Container:
    """Return the model, and the merged points before and after closure."""
    eye = near(first, ABOVE_LEFT, 3.4)
    return rrb.Horizontal(
        spatial("Object model", [f"{entities.WORLD}/model/**"], eye),
        rrb.Vertical(
            spatial("All points before loop closure", [entities.MERGED_BEFORE], eye),
            spatial("All points after loop closure", [entities.MERGED_AFTER], eye),
        ),
        column_shares=[1.5, 1.0],
        name="Object",
    )


def _pair(first: RayImage | None) -> rrb.Container:
    """Return the newest pair: depth, projection into the target view, both alignments, posterior and text."""
    eye = near(first, FROM_THE_SIDE, 4.2)
    before = [entities.PAIR_TARGET, entities.PAIR_BEFORE, entities.PAIR_CAPTION]
    after = [entities.PAIR_TARGET, entities.PAIR_AFTER, entities.PAIR_AXES, entities.PAIR_DRAWS]
    ghosts = [entities.GHOSTS, entities.GHOST_MEANS, entities.GHOST_TIPS, entities.GHOST_LABELS]
    ghosts += [entities.GHOST_CENTRE_1_SIGMA, entities.GHOST_CENTRE_3_SIGMA, entities.PAIR_AXES]
    seen = rrb.Spatial2DView(
        origin=entities.VISIBILITY,
        contents=[f"{entities.VISIBILITY}/**"],
        name="New points in previous view",
        visual_bounds=None if first is None else around(first),
    )
    return rrb.Grid(
        spatial("Pair before alignment", before, eye, origin=entities.PAIR),
        spatial("Pair after alignment", after, eye, origin=entities.PAIR),
        _depth(first),
        spatial("Posterior, magnified", ghosts, eye, origin=entities.PAIR),
        seen,
        rrb.TextDocumentView(origin=entities.NOW, name="In words"),
        grid_columns=3,
        name="Newest pair",
    )


def _edges(first: RayImage | None) -> rrb.Container:
    """Return the pose graph with the uncertainty of its edges, and a plot of each quantity."""
    graph = [f"{entities.WORLD}/{part}/**" for part in ("model", "poses", "edges")]
    graph += [f"- {entities.CHAIN}", entities.EDGES_1_SIGMA, entities.EDGES_MAGNIFICATION]
    return rrb.Horizontal(
        spatial("Pose graph", graph, _far(first)), rrb.Grid(*_readings(), grid_columns=2), name="Edges"
    )


def _words() -> rrb.Container:
    """Return the legend, the run's facts and its history."""
    return rrb.Horizontal(
        rrb.TextDocumentView(origin=entities.LEGEND, name="Legend"),
        rrb.Vertical(
            rrb.TextDocumentView(origin=entities.RUN, name="Run"),
            rrb.TextLogView(origin=entities.LOG, name="History"),
        ),
        name="Legend and history",
    )


def _readings() -> list[rrb.View]:
    titles = {
        entities.TURNED: "Turned by [°]",
        entities.OVERLAP: "Overlap [%]",
        entities.ROTATION_SD: "Rotation sd [°]",
        entities.TRANSLATION_SD: "Translation sd [mm]",
        entities.EFFECTIVE_SAMPLES: "Effective samples",
        entities.SECONDS: "Seconds per pair",
    }
    hidden = rrb.PlotLegend(visible=False)
    dark = rrb.archetypes.PlotBackground(color=_BACKGROUND)  # in the browser too, whatever its theme, for white lines
    return [
        rrb.TimeSeriesView(
            origin=path,
            name=title,
            plot_legend=hidden,
            background=dark,
            axis_y=rrb.ScalarAxis(range=(0.0, 105.0)) if path == entities.OVERLAP else None,
        )
        for path, title in titles.items()
    ]


def spatial(
    name: str, contents: list[str], eye: rrb.EyeControls3D | None, *, origin: str = entities.WORLD
) -> rrb.Spatial3DView:
    """Return a 3D view without a ground grid, for nothing here stands on one."""
    return rrb.Spatial3DView(
        origin=origin,
        contents=contents,
        name=name,
        background=_BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=eye,
    )


def _eye(first: RayImage, distance_m: float, direction: Array) -> rrb.EyeControls3D:
    """Return an eye that looks at the object from a distance in a direction (3,); its support, if seen, is level."""
    object_from_upright = upright(first)
    away = object_from_upright @ direction / np.linalg.norm(direction)
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=first.centroid_m + distance_m * away,
        look_target=first.centroid_m,
        eye_up=-object_from_upright[:, 1],
    )


def near(first: RayImage | None, direction: Array, radii: float) -> rrb.EyeControls3D | None:
    """Return an eye that looks at the object from a multiple of its radius away; None before there is one."""
    if first is None:
        return None
    radius_m = float(np.percentile(np.linalg.norm(first.points_m - first.centroid_m, axis=1), 95))  # of most points
    return _eye(first, radii * radius_m, direction)


def _far(first: RayImage | None) -> rrb.EyeControls3D | None:
    """Return an eye on the whole graph; None before there is an object."""
    if first is None:
        return None
    return _eye(first, 2.5 * float(np.linalg.norm(first.centroid_m)), graph_view.OVER_THE_RING)


def around(view: RayImage) -> rrb.VisualBounds2D:
    """Return the part of pictures of depth around the object, with room for it to move."""
    pixels = view.pixels / images.depth_stride_px(view.frame)
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    margin = 0.4 * float((high - low).max())
    return rrb.VisualBounds2D(
        x_range=(float(low[1]) - margin, float(high[1]) + margin),
        y_range=(float(low[0]) - margin, float(high[0]) + margin),
    )
