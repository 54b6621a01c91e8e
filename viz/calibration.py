"""Observed against nominal coverage, drawn without a window."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, final

import numpy as np
from scipy import stats

from modeler.evaluation import coverage
from modeler.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_NOMINAL: Final = np.linspace(0.0, 1.0, 201)
_BAND: Final = 0.95
_PANEL_IN: Final = 4.2
_COLOURS: Final = ("#3b6fb6", "#e08e2b", "#4f9d69")
_AXIS_COLOUR: Final = "#9aa3ad"
_CONTROL_COLOUR: Final = "#b8474a"


@final
@dataclass(frozen=True)
class Curve:
    """Squared errors in units of the covariances stated."""

    label: str
    """What the legend calls them; empty for no entry."""
    nees: Sequence[float]
    """One an estimate."""
    degrees: int
    """Degrees of freedom of each."""
    role: Literal["whole", "axis", "control"] = "whole"
    """How it is drawn: in a colour of its own, as a thin line behind, or dashed."""


@final
@dataclass(frozen=True)
class Panel:
    """The curves of one plot."""

    title: str
    curves: Sequence[Curve]


def coverage_curves(panels: Sequence[Sequence[Panel]]) -> bytes:
    """Return rows of panels as a PNG: the share of truths inside a region against the region's probability.

    A curve on the diagonal is calibrated, one below is too sure, one above too modest. The band holds 95 % of what
    chance makes of as many independent estimates as the panel's first curve has.
    """
    from matplotlib.figure import Figure  # slow to load

    columns = max((len(row) for row in panels), default=1)
    size_in = (_PANEL_IN * columns, (_PANEL_IN + 0.2) * max(len(panels), 1) + 0.5)
    figure = Figure(figsize=size_in, layout="constrained")
    grid = figure.subplots(max(len(panels), 1), columns, sharex=True, sharey=True, squeeze=False)
    for axes, row in zip(grid, panels, strict=False):
        for axis, panel in zip(axes, row, strict=False):
            _draw(axis, panel)
    for axis in grid[-1]:
        axis.set_xlabel("nominal coverage")
    for axis in grid[:, 0]:
        axis.set_ylabel("observed coverage")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    if handles:
        figure.legend(
            handles, labels, loc="outside upper center", ncols=min(len(handles), 2 * columns), frameon=False, fontsize=9
        )
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=150, bbox_inches="tight", metadata={"Software": None})
    return picture.getvalue()


def _draw(axis: Axes, panel: Panel) -> None:
    axis.set_title(panel.title, fontsize=10, loc="left")
    axis.set_aspect("equal")
    axis.set_xlim(0.0, 1.0)
    axis.set_xticks([0.0, 0.25, 0.5, 0.75, 0.9])  # none at the end, where it would run into the next panel's
    axis.set_ylim(-0.01, 1.01)
    axis.plot([0.0, 1.0], [0.0, 1.0], color="#444444", linewidth=0.8)
    count = len(panel.curves[0].nees) if panel.curves else 0
    if count:
        low, high = stats.binom(count, _NOMINAL).interval(_BAND)
        axis.fill_between(_NOMINAL, np.maximum(low, 0.0) / count, high / count, color="#dddddd", linewidth=0.0)
    colours = iter(_COLOURS * len(panel.curves))
    for curve in panel.curves:
        style = {"axis": (_AXIS_COLOUR, 0.8, "-", 2), "control": (_CONTROL_COLOUR, 1.6, "--", 4)}.get(curve.role)
        colour, width, dashes, order = style if style is not None else (next(colours), 2.0, "-", 3)
        axis.plot(
            _NOMINAL,
            _observed(curve),
            color=colour,
            linewidth=width,
            linestyle=dashes,
            zorder=order,
            label=curve.label or "_",
        )
    for level in (0.5, 0.9, 0.95):
        axis.axvline(level, color="#cccccc", linewidth=0.6, zorder=1)
    axis.spines[["top", "right"]].set_visible(False)


def _observed(curve: Curve) -> Array:
    shares = coverage(curve.nees, curve.degrees, _NOMINAL.tolist())
    return np.fromiter(shares.values(), dtype=np.float64)
