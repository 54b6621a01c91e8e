"""The symmetries of the model in the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from modeler.export import read_model
from modeler.export.standing import model_up
from modeler.fusion import Symmetries, SymmetryFinder
from modeler.types import Array, InputError

_MEANING: Final = (
    "Rotations that map the model onto itself: in any two of these poses it looks the same, so that a pose estimator "
    "cannot tell one from the other. Unobserved surface is not compared."
)

_VERTICAL: Final = "the vertical"


def symmetry_section(path: Path, report: Mapping[str, Any]) -> Sequence[str]:
    """Return the symmetries of the mesh in a file as HTML; nothing where it has none that can be drawn.

    Args:
        path: of the mesh, in the object frame.
        report: `report.json`.
    """
    try:
        model = read_model(path)
    except InputError:
        return []
    up = model_up(report)[0]
    found = SymmetryFinder().find_in(model, up)
    rows = [(f"of the shape, within {1000.0 * found.tolerance_m:.1f} mm", rotation_words(found, up))]
    if found.seen_in_part:
        rows.append(("seen in part", "it looks like a body of revolution, but was not seen all around"))
    if found.with_colour is not None:
        rows.append(("of shape and colour", rotation_words(found.with_colour, up)))
    cells = "".join(f"<tr><th>{words}</th><td>{value}</td></tr>" for words, value in rows)
    return [f"<h2>Symmetries</h2><p class='quiet'>{_MEANING}</p><table>{cells}</table>"]


def rotation_words(found: Symmetries, up: Array) -> str:
    """Return the rotations in words, those about one axis together.

    Args:
        found: the symmetries.
        up: (3,) unit, the vertical.
    """
    if len(found.continuous) > 1:
        return "every rotation about its centre"
    said = [f"any angle about {_axis_words(axis.direction, up)}" for axis in found.continuous]
    by_axis: dict[str, list[float]] = {}
    for pose in found.discrete:
        vector = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
        angle_deg, words = float(np.degrees(np.linalg.norm(vector))), _axis_words(vector, up)
        downwards = words == _VERTICAL and vector @ up < 0.0
        by_axis.setdefault(words, []).append(360.0 - angle_deg if downwards else angle_deg)
    for words, angles_deg in by_axis.items():
        angles = sorted({round(angle) for angle in angles_deg})
        said.append(f"{', '.join(f'{angle}°' for angle in angles)} about {words}")
    return "; ".join(said) or "none"


def _axis_words(direction: Array, up: Array) -> str:
    """Return which way an axis (3,) of any length runs."""
    tilt_deg = float(np.degrees(np.arccos(min(1.0, abs(float(direction @ up)) / np.linalg.norm(direction)))))
    if tilt_deg < 5.0:
        return _VERTICAL
    return "level axes" if tilt_deg > 85.0 else f"axes {tilt_deg:.0f}° off the vertical"
