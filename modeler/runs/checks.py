"""Exported files, read back: statements about them, and which do not hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from modeler.export.solids import triangle_areas

SMALLEST_M: Final = 1e-3
LARGEST_M: Final = 10.0
"""An object of the hand or of the table has a size between these; of another size, the unit is wrong."""


@dataclass(frozen=True)
class Checks:
    """Statements about a file, and which of them do not hold."""

    held: tuple[str, ...] = ()
    """Passed checks, in words."""
    failed: tuple[str, ...] = ()
    """Failed checks, in words."""

    def also(self, holds: bool, words: str, otherwise: str = "") -> Checks:
        """Return the checks with one more: `words` where it holds, else `otherwise`, or `not` and the words."""
        if holds:
            return Checks((*self.held, words), self.failed)
        return Checks(self.held, (*self.failed, otherwise or f"not {words}"))

    def and_also(self, others: Checks) -> Checks:
        """Return these checks and others."""
        return Checks((*self.held, *others.held), (*self.failed, *others.failed))

    def attempt(self, what: Callable[[], tuple[bool, str]], absent: str) -> Checks:
        """Return the checks with that of a program, if installed.

        Args:
            what: returns whether it passes, and words; ValueError if the program rejects the file.
            absent: words if the program is not installed.
        """
        try:
            return self.also(*what())
        except ImportError:
            return Checks((*self.held, absent), self.failed)
        except ValueError as error:
            return Checks(self.held, (*self.failed, " ".join(str(error).split())))

    @property
    def words(self) -> str:
        """All of it in one line."""
        failed = f"; FAILED: {'; '.join(self.failed)}" if self.failed else ""
        return f"checked: {', '.join(self.held)}{failed}"


def loaded(path: Path) -> Any:
    """Return the one mesh in a file as trimesh reads it, corners at one place merged where the format keeps none."""
    import trimesh

    return trimesh.load_mesh(path, process=path.suffix.lower() == ".stl")


def mesh_checks(path: Path, *, unit_m: float = 1.0, most_triangles: int) -> Checks:
    """Return checks that every exported mesh has to pass: size, number and area of its triangles."""
    mesh = loaded(path)
    corners, triangles = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    size_m = unit_m * np.ptp(corners, axis=0)
    flat = int(np.count_nonzero(triangle_areas(corners, triangles) * unit_m**2 <= 1e-14))
    unit = "m" if unit_m == 1.0 else "mm"
    size = " x ".join(f"{length:.3g}" for length in size_m / unit_m)
    return (
        Checks()
        .also(bool(SMALLEST_M < size_m.max() < LARGEST_M), f"{size} {unit}", f"a size of {size} {unit} is implausible")
        .also(len(triangles) <= most_triangles, f"{len(triangles)} triangles", f"{len(triangles)} triangles: too many")
        .also(not flat, "none degenerate", f"{flat} degenerate triangles")
    )
