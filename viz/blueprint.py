"""The layout a recording opens with."""

from __future__ import annotations

from typing import Final

import numpy as np
import rerun.blueprint as rrb

from modeler.export.standing import upright
from modeler.types import Array, RayImage
from viz import entities, graph_view, images

_BACKGROUND: Final = (24, 26, 30)
_ABOVE_LEFT: Final = np.array([-0.36, -0.48, -0.8])  # from the object to the eye; the camera is towards -z, up is -y
FROM_THE_SIDE: Final = np.array([-0.8, -0.35, -0.5])  # errors along the camera's own axis show from here


def layout(first: RayImage | None) -> rrb.Blueprint:
    """Return the layout: images left, model, graph and readings in the middle, the newest pair right.

    Args:
        first: the first accepted view, which tells where to look from; None before there is one.
    """
    middle = rrb.Vertical(
        rrb.Horizontal(*_object(first), column_shares=[1.0, 1.2]),
        rrb.Horizontal(*_closure(first), _words(), column_shares=[1.0, 1.0, 1.35]),
        row_shares=[1.55, 1.0],
    )
    above = rrb.Horizontal(_images(first), middle, _pair(first), column_shares=[1.0, 3.2, 1.0])
    return rrb.Blueprint(
        rrb.Vertical(above, _readings(), row_shares=[4.6, 1.0]),
        rrb.TimePanel(state="collapsed", timeline=entities.FRAME, play_state="following", fps=3.0),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _images(first: RayImage | None) -> rrb.Container:
    """Return the camera's images, without colour where the first frame has none, and the picture of visibility."""
    near = None if first is None else around(first)
    coloured = first is None or first.frame.colour is not None
    depth = rrb.Spatial2DView(
        origin=entities.CAMERA,
        contents=[entities.DEPTH] if coloured else [entities.DEPTH, entities.MASK],
        name="Depth of the frame" if coloured else "Depth of the frame, object bright",
        visual_bounds=near,
    )
    seen = rrb.Spatial2DView(
        origin=entities.VISIBILITY,
        contents=[f"{entities.VISIBILITY}/**"],
        name="New points in previous view",
        visual_bounds=near,
    )
    if not coloured:
        return rrb.Vertical(depth, seen)
    colour = rrb.Spatial2DView(
        origin=entities.CAMERA, contents=[entities.COLOUR, entities.MASK], name="Frame, object bright"
    )
    return rrb.Vertical(colour, depth, seen)


def _object(first: RayImage | None) -> tuple[rrb.Container, rrb.View]:
    """Return the views of the model alone, with the merged points behind it, and among the cameras that saw it."""
    graph = [f"{entities.WORLD}/{part}/**" for part in ("model", "poses", "edges")]
    graph += [entities.EDGES_1_SIGMA, entities.EDGES_MAGNIFICATION]
    near = _near(first, _ABOVE_LEFT, 4.0)
    tabs = (("Object model", f"{entities.WORLD}/model/**"),)
    tabs += (("Before closure", entities.MERGED_BEFORE), ("After closure", entities.MERGED_AFTER))
    return (
        rrb.Tabs(*(_spatial(name, entities.WORLD, [what], near) for name, what in tabs), active_tab=0),
        _spatial("Pose graph: cameras, edges and their uncertainty", entities.WORLD, graph, _far(first)),
    )


def _closure(first: RayImage | None) -> tuple[rrb.View, rrb.View]:
    """Return the poses' uncertainty without loop closure and with it, seen alike."""
    model = f"{entities.WORLD}/model/**"
    before = [model, f"{entities.WORLD}/before/**", entities.CHAIN]
    after = [model, entities.CAMERAS, entities.ODOMETRY, entities.CLOSURE, entities.MAGNIFICATION]
    after += [entities.POSITION_1_SIGMA, entities.POSITION_3_SIGMA, entities.AXIS_TIPS_1_SIGMA]
    return (
        _spatial("Uncertainty before closure", entities.WORLD, before, _far(first)),
        _spatial("Uncertainty after closure", entities.WORLD, after, _far(first)),
    )


def _pair(first: RayImage | None) -> rrb.Container:
    """Return the newest pair before and after alignment, and the magnified posterior."""
    eye = _near(first, FROM_THE_SIDE, 4.2)
    before = [entities.PAIR_TARGET, entities.PAIR_BEFORE, entities.PAIR_CAPTION]
    after = [entities.PAIR_TARGET, entities.PAIR_AFTER, entities.PAIR_AXES, entities.PAIR_DRAWS]
    ghosts = [entities.GHOSTS, entities.GHOST_MEANS, entities.GHOST_TIPS, entities.GHOST_LABELS]
    ghosts += [entities.GHOST_CENTRE_1_SIGMA, entities.GHOST_CENTRE_3_SIGMA, entities.PAIR_AXES]
    return rrb.Vertical(
        _spatial("Pair before alignment", entities.PAIR, before, eye),
        _spatial("Pair after alignment", entities.PAIR, after, eye),
        _spatial("Posterior, magnified", entities.PAIR, ghosts, eye),
    )


def _words() -> rrb.Container:
    """Return what happened in words, with the run's facts, the history and the legend behind it."""
    return rrb.Tabs(
        rrb.TextDocumentView(origin=entities.NOW, name="Now"),
        rrb.TextDocumentView(origin=entities.RUN, name="Run"),
        rrb.TextLogView(origin=entities.LOG, name="History"),
        rrb.TextDocumentView(origin=entities.LEGEND, name="Legend"),
        active_tab=0,
    )


def _readings() -> rrb.Container:
    """Return one plot for each reading."""
    titles = {
        entities.TURNED: "Turned by [°]",
        entities.ROTATION_SD: "Rotation sd [°]",
        entities.TRANSLATION_SD: "Translation sd [mm]",
        entities.EFFECTIVE_SAMPLES: "Effective samples",
        entities.OVERLAP: "Overlap [%]",
        entities.SECONDS: "Seconds per pair",
    }
    hidden = rrb.PlotLegend(visible=False)
    dark = rrb.archetypes.PlotBackground(color=_BACKGROUND)  # in the browser too, whatever its theme, for white lines
    return rrb.Horizontal(
        *(
            rrb.TimeSeriesView(
                origin=path,
                name=title,
                plot_legend=hidden,
                background=dark,
                axis_y=rrb.ScalarAxis(range=(0.0, 105.0)) if path == entities.OVERLAP else None,
            )
            for path, title in titles.items()
        )
    )


def _spatial(name: str, origin: str, contents: list[str], eye: rrb.EyeControls3D | None = None) -> rrb.Spatial3DView:
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
    """Return an eye that looks at the object from a distance in a direction (3,); its support, if seen, lies level."""
    object_from_upright = upright(first)
    away = object_from_upright @ direction / np.linalg.norm(direction)
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=first.centroid_m + distance_m * away,
        look_target=first.centroid_m,
        eye_up=-object_from_upright[:, 1],
    )


def _near(first: RayImage | None, direction: Array, radii: float) -> rrb.EyeControls3D | None:
    """Return an eye that looks at the object from a multiple of its radius away; None before there is one."""
    return None if first is None else _eye(first, radii * _radius_m(first), direction)


def _far(first: RayImage | None) -> rrb.EyeControls3D | None:
    """Return an eye on the whole graph; None before there is an object."""
    if first is None:
        return None
    return _eye(first, 2.8 * float(np.linalg.norm(first.centroid_m)), graph_view.OVER_THE_RING)


def _radius_m(view: RayImage) -> float:
    """Return the distance from the centroid within which most surface points lie."""
    return float(np.percentile(np.linalg.norm(view.points_m - view.centroid_m, axis=1), 95))


def around(view: RayImage) -> rrb.VisualBounds2D:
    """Return the part of pictures of depth around the object, with room for it to move."""
    pixels = view.pixels / images.depth_stride_px(view.frame)
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    margin = 0.4 * float((high - low).max())
    return rrb.VisualBounds2D(
        x_range=(float(low[1]) - margin, float(high[1]) + margin),
        y_range=(float(low[0]) - margin, float(high[0]) + margin),
    )
