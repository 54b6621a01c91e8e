"""Figures of experiments and of calibration as PNG, drawn without a window."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from scipy import stats

from modeler.evaluation import coverage
from modeler.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from modeler.experiment import Trial

LEAST_DEG: Final = 0.01  # errors below this are drawn here, on the axis' lower end
MOST_DEG: Final = 180.0

_COLOURS: Final = ("#3b6fb6", "#e08e2b", "#4f9d69", "#b8474a", "#7d6bb0", "#8a6f57", "#c77fb0", "#6e6e6e")


def rotation_errors(trials: Sequence[Trial]) -> bytes:
    """Return box plots of rotation errors as a PNG: a panel an offset, a group an object, a box a method.

    Boxes span the quartiles, whiskers all errors; each dot is a pair, hollow where the method does not stand by it.
    """
    from matplotlib.figure import Figure  # slow to load

    shown = [trial for trial in trials if np.isfinite(trial.rotation_error_deg)]
    objects = list(dict.fromkeys(trial.sequence for trial in trials))
    methods = list(dict.fromkeys(trial.method for trial in trials))
    offsets = sorted({trial.offset for trial in trials}) or [1]
    width_in = max(5.0, 1.2 + 0.24 * (len(methods) + 1) * len(objects))  # each box with its gap
    figure = Figure(figsize=(width_in, 1.0 + 2.6 * len(offsets)), layout="constrained")
    panels = figure.subplots(len(offsets), 1, sharex=True, squeeze=False)[:, 0]
    for offset, panel in zip(offsets, panels, strict=True):
        _panel(panel, [trial for trial in shown if trial.offset == offset], objects, methods)
        if len(offsets) > 1:
            panel.set_title(f"{offset} {'frame' if offset == 1 else 'frames'} apart", fontsize=9, loc="left")
    handles = [panels[0].plot([], [], "s", color=_colour(k), label=method)[0] for k, method in enumerate(methods)]
    if handles:
        figure.legend(handles=handles, loc="outside upper center", ncols=min(len(handles), 6), frameon=False)
    return png(figure)


def png(figure: Figure, dpi: int = 150, **options: Any) -> bytes:
    """Return a figure as a file, the same bytes for the same figure; options are those of Matplotlib."""
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=dpi, metadata={"Software": None}, **options)
    return picture.getvalue()


def _panel(panel: Axes, trials: Sequence[Trial], objects: Sequence[str], methods: Sequence[str]) -> None:
    for group, name in enumerate(objects):
        for slot, method in enumerate(methods):
            members = [trial for trial in trials if (trial.sequence, trial.method) == (name, method)]
            if members:
                at = (group * (len(methods) + 1) + slot) * 1.0
                _box(panel, at, members, _colour(slot))
    centres = [group * (len(methods) + 1) + 0.5 * (len(methods) - 1) for group in range(len(objects))]
    panel.set_xticks(centres, objects)
    panel.tick_params(axis="x", length=0)
    panel.set_xlim(-1.0, max(1, len(objects) * (len(methods) + 1)) - 1.0)
    panel.set_yscale("log")
    panel.set_ylim(LEAST_DEG * 0.8, MOST_DEG * 1.25)
    panel.set_yticks([0.01, 0.1, 1.0, 10.0, 100.0], ["0.01", "0.1", "1", "10", "100"])
    panel.set_ylabel("rotation error [deg]")
    panel.grid(axis="y", color="#dddddd", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)


def _box(panel: Axes, at: float, trials: Sequence[Trial], colour: str) -> None:
    errors = np.clip([trial.rotation_error_deg for trial in trials], LEAST_DEG, MOST_DEG)
    usable = np.array([trial.usable for trial in trials])
    line = {"color": colour, "linewidth": 1.1}
    panel.boxplot(
        errors,
        positions=[at],
        widths=0.72,
        whis=(0.0, 100.0),
        showfliers=False,
        patch_artist=True,
        manage_ticks=False,
        boxprops={"facecolor": colour + "40", "edgecolor": colour, "linewidth": 1.1},
        medianprops={"color": colour, "linewidth": 2.2},
        whiskerprops=line,
        capprops=line,
    )
    # Dots lie side by side in the order of the pairs, so that equal errors do not hide each other.
    across = at + np.linspace(-0.22, 0.22, len(errors)) if len(errors) > 1 else np.array([at])
    for chosen, face in ((usable, colour), (~usable, "white")):
        panel.scatter(across[chosen], errors[chosen], s=7, facecolors=face, edgecolors=colour, linewidths=0.7, zorder=3)


def _colour(slot: int) -> str:
    return _COLOURS[slot % len(_COLOURS)]


_NOMINAL: Final = np.linspace(0.0, 1.0, 201)  # steps of 0.5 %: a curve of 1,000 estimates has no finer ones to show


@dataclass(frozen=True)
class Curve:
    """Squared errors in units of the estimated covariances."""

    label: str
    """Name in the legend; empty for no entry."""
    nees: Sequence[float]
    """One an estimate."""
    degrees: int
    """Degrees of freedom of each."""
    role: Literal["whole", "axis", "control"] = "whole"
    """Style: its own colour, a thin line behind, or dashed."""


@dataclass(frozen=True)
class Panel:
    """The curves of one plot."""

    title: str
    curves: Sequence[Curve]


def coverage_curves(panels: Sequence[Sequence[Panel]]) -> bytes:
    """Return rows of panels as a PNG: the share of truths inside a region against the region's probability.

    A curve on the diagonal is calibrated, one below overconfident, one above conservative. The band is the 95 %
    sampling interval for as many independent estimates as the panel's first curve has.
    """
    from matplotlib.figure import Figure  # slow to load

    columns = max((len(row) for row in panels), default=1)
    size_in = (4.2 * columns, 4.4 * max(len(panels), 1) + 0.5)
    figure = Figure(figsize=size_in, layout="constrained")
    grid = figure.subplots(max(len(panels), 1), columns, sharex=True, sharey=True, squeeze=False)
    for axes, row in zip(grid, panels, strict=False):
        for axis, panel in zip(axes, row, strict=False):
            _draw_curves(axis, panel)
    for axis in grid[-1]:
        axis.set_xlabel("nominal coverage")
    for axis in grid[:, 0]:
        axis.set_ylabel("observed coverage")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    if handles:
        figure.legend(
            handles, labels, loc="outside upper center", ncols=min(len(handles), 2 * columns), frameon=False, fontsize=9
        )
    return png(figure, bbox_inches="tight")


def _draw_curves(axis: Axes, panel: Panel) -> None:
    axis.set_title(panel.title, fontsize=10, loc="left")
    axis.set_aspect("equal")
    axis.set_xlim(0.0, 1.0)
    axis.set_xticks([0.0, 0.25, 0.5, 0.75, 0.9])  # none at the end, where it would run into the next panel's
    axis.set_ylim(-0.01, 1.01)
    axis.plot([0.0, 1.0], [0.0, 1.0], color="#444444", linewidth=0.8)
    count = len(panel.curves[0].nees) if panel.curves else 0
    if count:
        low, high = stats.binom(count, _NOMINAL).interval(0.95)
        axis.fill_between(_NOMINAL, np.maximum(low, 0.0) / count, high / count, color="#dddddd", linewidth=0.0)
    colours = iter(_COLOURS[:3] * len(panel.curves))
    for curve in panel.curves:
        style = {"axis": ("#9aa3ad", 0.8, "-", 2), "control": ("#b8474a", 1.6, "--", 4)}.get(curve.role)
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
