"""The layout a recording opens with."""

from __future__ import annotations

from typing import Final

import numpy as np
import rerun.blueprint as rrb

from modeler.types import Array, RayImage
from viz import entities, images

_BACKGROUND: Final = (24, 26, 30)
_ABOVE_LEFT: Final = np.array([-0.36, -0.48, -0.8])  # from the object towards the eye; the camera is at -z, up is -y
_FROM_THE_SIDE: Final = np.array([-0.8, -0.35, -0.5])  # errors along the camera's own axis show from here


def layout(first: RayImage | None) -> rrb.Blueprint:
    """Return the layout: images, model and pose graph, the newest pair, words and readings.

    Args:
        first: the first accepted view, which tells where to look from; None before there is one.
    """
    upper = rrb.Horizontal(_images(first), *_object(first), _pair(first), column_shares=[0.95, 1.15, 1.5, 0.95])
    lower = rrb.Horizontal(_words(), _readings(), column_shares=[1.0, 2.0])
    return rrb.Blueprint(
        rrb.Vertical(upper, lower, row_shares=[2.1, 1.0]),
        rrb.TimePanel(state="collapsed", timeline=entities.FRAME, play_state="following", fps=3.0),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _images(first: RayImage | None) -> rrb.Container:
    """Return the camera's images; depth alone where the first frame has no colour."""
    depth = rrb.Spatial2DView(
        origin=entities.CAMERA,
        contents=[entities.DEPTH, entities.MASK],
        name="Depth around the object",
        visual_bounds=None if first is None else around(first),
    )
    if first is not None and first.frame.colour is None:
        return rrb.Vertical(depth)
    colour = rrb.Spatial2DView(
        origin=entities.CAMERA, contents=[entities.COLOUR, entities.MASK], name="Camera, all but the object dimmed"
    )
    return rrb.Vertical(colour, depth)


def _object(first: RayImage | None) -> tuple[rrb.View, rrb.View]:
    """Return the views of the model alone and among the cameras that saw it."""
    model = _spatial("Object model", entities.WORLD, [f"{entities.WORLD}/model/**"])
    graph = _spatial("Camera poses, edges and uncertainty", entities.WORLD, [f"{entities.WORLD}/**"])
    if first is not None:
        centre, radius_m = first.centroid_m, _radius_m(first)
        distance_m = float(np.linalg.norm(centre))
        model = _spatial(
            "Object model", entities.WORLD, [f"{entities.WORLD}/model/**"], _eye(centre, 4.0 * radius_m, _ABOVE_LEFT)
        )
        graph = _spatial(
            "Camera poses, edges and uncertainty",
            entities.WORLD,
            [f"{entities.WORLD}/**"],
            _eye(centre, 3.3 * distance_m, np.array([-0.45, -0.8, -0.4])),
        )
    return model, graph


def _pair(first: RayImage | None) -> rrb.Container:
    """Return the newest pair before and after alignment, one above the other."""
    eye = None if first is None else _eye(first.centroid_m, 3.7 * _radius_m(first), _FROM_THE_SIDE)
    before = [entities.PAIR_TARGET, entities.PAIR_BEFORE]
    after = [entities.PAIR_TARGET, entities.PAIR_AFTER, entities.PAIR_AXES, entities.PAIR_DRAWS]
    return rrb.Vertical(
        _spatial("Before: target teal, source orange", entities.PAIR, before, eye),
        _spatial("After, with the posterior's spread", entities.PAIR, after, eye),
    )


def _words() -> rrb.Container:
    """Return what happened in words, with the history behind it."""
    return rrb.Tabs(
        rrb.TextDocumentView(origin=entities.NOW, name="What happened"),
        rrb.TextLogView(origin=entities.LOG, name="History"),
        active_tab=0,
    )


def _readings() -> rrb.Container:
    """Return one plot for each reading, and the legend of everything."""
    titles = {
        entities.ROTATION_SD: "Rotation sd [°]",
        entities.TRANSLATION_SD: "Transl. sd [mm]",
        entities.EFFECTIVE_SAMPLES: "Effective samples",
        entities.OVERLAP: "Overlap [%]",
        entities.SECONDS: "Seconds per pair",
    }
    hidden = rrb.PlotLegend(visible=False)
    dark = rrb.archetypes.PlotBackground(color=_BACKGROUND)  # in the browser too, whatever its theme, for white lines
    plots = [
        rrb.TimeSeriesView(origin=path, name=title, plot_legend=hidden, background=dark)
        for path, title in titles.items()
    ]
    return rrb.Horizontal(
        rrb.Vertical(*plots[:2]),
        rrb.Vertical(*plots[2:4]),
        rrb.Vertical(plots[4]),
        rrb.TextDocumentView(origin=entities.LEGEND, name="Legend"),
        column_shares=[1.0, 1.0, 1.0, 1.5],
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


def _eye(target: Array, distance_m: float, direction: Array) -> rrb.EyeControls3D:
    """Return an eye that looks at `target` (3,) from `distance_m` in `direction` (3,), with the camera's up."""
    position = target + distance_m * direction / np.linalg.norm(direction)
    return rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, position=position, look_target=target, eye_up=(0.0, -1.0, 0.0))


def _radius_m(view: RayImage) -> float:
    """Return the distance from the centroid within which most surface points lie."""
    return float(np.percentile(np.linalg.norm(view.points_m - view.centroid_m, axis=1), 95))


def around(view: RayImage) -> rrb.VisualBounds2D:
    """Return the part of the image around the object, with room for it to move."""
    pixels = view.pixels / images.stride_px(view.frame)
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    margin = 0.6 * float((high - low).max())
    return rrb.VisualBounds2D(
        x_range=(float(low[1]) - margin, float(high[1]) + margin),
        y_range=(float(low[0]) - margin, float(high[0]) + margin),
    )
