"""Figures of experiments, drawn without a window."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from modeler.experiment import Trial

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LEAST_DEG: Final = 0.01
"""Errors below this are drawn here, on the axis' lower end."""
MOST_DEG: Final = 180.0

_COLOURS: Final = ("#3b6fb6", "#e08e2b", "#4f9d69", "#b8474a", "#7d6bb0", "#8a6f57", "#c77fb0", "#6e6e6e")
_BOX_IN: Final = 0.24  # width of one box with its gap
_PANEL_IN: Final = 2.6  # height of one panel


def rotation_errors(trials: Sequence[Trial]) -> bytes:
    """Return box plots of rotation errors as a PNG: a panel an offset, a group an object, a box a method.

    Boxes span the quartiles, whiskers all errors; each dot is a pair, hollow where the method does not stand by it.
    """
    from matplotlib.figure import Figure  # slow to load

    shown = [trial for trial in trials if np.isfinite(trial.rotation_error_deg)]
    objects = list(dict.fromkeys(trial.sequence for trial in trials))
    methods = list(dict.fromkeys(trial.method for trial in trials))
    offsets = sorted({trial.offset for trial in trials}) or [1]
    width_in = max(5.0, 1.2 + _BOX_IN * (len(methods) + 1) * len(objects))
    figure = Figure(figsize=(width_in, 1.0 + _PANEL_IN * len(offsets)), layout="constrained")
    panels = figure.subplots(len(offsets), 1, sharex=True, squeeze=False)[:, 0]
    for offset, panel in zip(offsets, panels, strict=True):
        _panel(panel, [trial for trial in shown if trial.offset == offset], objects, methods)
        if len(offsets) > 1:
            panel.set_title(f"{offset} {'frame' if offset == 1 else 'frames'} apart", fontsize=9, loc="left")
    handles = [panels[0].plot([], [], "s", color=_colour(k), label=method)[0] for k, method in enumerate(methods)]
    if handles:
        figure.legend(handles=handles, loc="outside upper center", ncols=min(len(handles), 6), frameon=False)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=150, metadata={"Software": None})
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
