"""What each frame of a long sequence costs: processor time and memory, drawn."""

from __future__ import annotations

import io
from dataclasses import asdict, dataclass

import numpy as np

from modeler.viz.report.plots import new_figure

_WINDOW = 20  # frames over which time is drawn as a mean: closures come and go


@dataclass(frozen=True)
class Cost:
    """Of one step."""

    frame: int
    seconds: float
    """Processor time."""
    registrations: int
    memory_mib: float
    """That the process holds then."""

    def values(self) -> dict[str, float]:
        """Return the figures as JSON holds them."""
        return asdict(self)


def drawn(costs: list[Cost]) -> bytes:
    """Return time and memory along a sequence as a PNG; the last step, which makes the mesh, is left out."""
    frames, seconds, count, memory = np.array([list(cost.values().values()) for cost in costs[:-1]]).T
    figure = new_figure(7.0, 2.6)
    times, sizes = figure.subplots(1, 2)
    window = min(_WINDOW, len(frames))
    kernel, middle = np.ones(window) / window, frames[window - 1 :] - 0.5 * (window - 1)
    times.plot(frames, seconds, ".", color="#c9ced6", markersize=2.5)
    times.plot(middle, np.convolve(seconds, kernel, "valid"), color="#3b6fb6", label=f"mean of {window} frames")
    each = np.convolve(seconds, kernel, "valid") / np.convolve(np.maximum(count, 1.0), kernel, "valid")
    times.plot(middle, each, color="#e08e2b", label="a registration")
    times.set(xlabel="frame", ylabel="processor time [s]", ylim=(0.0, 1.2 * float(np.quantile(seconds, 0.99))))
    times.legend(frameon=False, fontsize=7)
    sizes.plot(frames, memory, color="#3b6fb6")
    sizes.set(xlabel="frame", ylabel="memory [MiB]", ylim=(0.0, None))
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110, metadata={"Software": None})
    return picture.getvalue()
