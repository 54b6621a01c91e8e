"""Views laid together in one volume, and the models made from them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from modeler.fusion import closing, cloud, grid, surface, tones
from modeler.fusion.stack import Stack
from modeler.fusion.testimony import Testimony, heard
from modeler.types import Array, BoolArray, ObjectModel

if TYPE_CHECKING:
    from modeler.fusion.fuser import Fuser

SOFT, SHARP = 4.0, 16.0  # how much more say a frontal view has in colours: cosine to this power
CURL = 8  # rings of triangles along borders that may curl
LONELY = 6  # a point of the cloud with fewer neighbours within a few voxels is an outlier


@dataclass(frozen=True, eq=False)
class Scan:
    """Posed views and the voxels around the object."""

    how: Fuser
    """Parameters."""
    seen: Stack
    """The views."""
    box: grid.Grid
    """The voxels."""
    tau_m: float
    """Half width of the band around the surface within which distances are measured."""
    near_m: float
    """Surface that a view sees further away than this along the normal is another one."""
    sigma_m: float
    """Standard deviation of what one view says of the surface head-on."""

    def model(self, *, watertight: bool = False) -> ObjectModel:
        """Return cloud and mesh.

        Args:
            watertight: close the mesh with made-up surface, whose vertices no view saw and whose deviation is infinite.
        """
        vertices, triangles, seen = self._mesh(watertight=watertight)
        normals = surface.normals_of(vertices, triangles)
        told = self.asked(vertices, normals)
        points, normals_of_points = cloud.thinned(
            self.seen.points_m,
            self.seen.normals,
            self.seen.weights,
            voxel_m=self.box.voxel_m,
            max_voxels=8 * self.how.max_voxels,
        )
        told_of_points = self.asked(points, normals_of_points)
        kept = self._believed(told_of_points) & cloud.crowded(points, 2.0 * self.box.voxel_m, LONELY)
        coloured = bool(self.seen.coloured.any())
        known = told.coloured & seen
        return ObjectModel(
            points_m=points[kept],
            normals=normals_of_points[kept],
            colours=told_of_points.colours[kept] if coloured else None,
            vertices_m=vertices,
            triangles=triangles,
            vertex_normals=normals,
            vertex_colours=surface.spread_colours(told.colours, known, vertices) if coloured else None,
            vertex_views=np.where(seen, told.views, 0),
            vertex_sigmas_m=np.where(seen, told.sigmas_m, np.inf),
        )

    def asked(self, points_m: Array, normals: Array) -> Testimony:
        """Return what the views say of oriented points (n, 3) of the object frame."""
        return self._heard(points_m, normals, self._gains)

    def painted(self, points_m: Array, normals: Array) -> npt.NDArray[np.uint8]:
        """Return the RGB (n, 3) of points of the surface (n, 3): from the most frontal views, sharp ones first."""
        told = self._heard(points_m, normals, self._gains, focus=SHARP)
        return surface.spread_colours(told.colours, told.coloured, points_m)

    @property
    def texel_m(self) -> float:
        """Length on the surface that half a pixel of the views covers."""
        turns, shifts = self.seen.poses[:, :, :3], self.seen.poses[:, :, 3]
        centres_m = -np.einsum("fji,fj->fi", turns, shifts)[self.seen.views]
        depth_m = float(np.median(np.linalg.norm(self.seen.points_m - centres_m, axis=1)))
        return 0.5 * depth_m / float(np.median(self.seen.lenses[:, 0]))

    @cached_property
    def _gains(self) -> Array:
        """Exposure and say of the views, (f, 4)."""
        return tones.gains(self.seen, self.seen.points_m, self.seen.normals, tau_m=self.tau_m, near_m=self.near_m)

    def _heard(self, points_m: Array, normals: Array, gains: Array, *, focus: float = SOFT) -> Testimony:
        return heard(
            self.seen,
            points_m,
            normals,
            tau_m=self.tau_m,
            near_m=self.near_m,
            sigma_m=self.sigma_m,
            gains=gains,
            focus=focus,
        )

    def _believed(self, told: Testimony) -> BoolArray:
        """Return which points (n,) more views see than see through."""
        return told.support > self.how.empty_weight * told.emptiness

    def _mesh(self, *, watertight: bool) -> tuple[Array, surface.Triangles, BoolArray]:
        """Return vertices (v, 3) and triangles (t, 3) of the surface, and which vertices the views support."""
        field = grid.measure(self.box, self.seen, tau_m=self.tau_m, empty_weight=self.how.empty_weight)
        for _ in range(self.how.closing):
            field = grid.filled(field)
        vertices, triangles = surface.extracted(field)
        kept, weak = self._kept(vertices, triangles)
        shown = triangles[np.all(kept[triangles], axis=1)]
        shown = shown[surface.large_pieces(vertices, shown, self.how.min_piece)]
        used, compact = surface.compacted(shown, len(vertices))
        if not watertight:
            smooth = surface.fair(vertices[used], compact, self.how.fairing)
            return surface.fair(smooth, compact, surface.ROUGH, weak[used]), compact, np.ones(len(used), dtype=bool)
        unused = np.ones(len(vertices), dtype=bool)
        unused[used] = False
        field = closing.without(field, vertices[unused], vertices[used], self.tau_m)
        whole = closing.enclosing(field, self.seen, self.tau_m)
        return closing.tidied(
            *surface.extracted(whole), vertices[used], weak[used], voxel_m=self.box.voxel_m, passes=self.how.fairing
        )

    def _kept(self, vertices: Array, triangles: surface.Triangles) -> tuple[BoolArray, BoolArray]:
        """Return which vertices (v,) of the zero level are surface: supported, not seen through, and no frill.

        And which of all (v,) are known badly, so that much of their place is noise.
        """
        normals = surface.normals_of(vertices, triangles)
        told = self._heard(vertices, normals, np.zeros((len(self.seen.index), 4)))
        # Gaps in what is believed are closed, but not with what several views see through.
        empty = told.emptiness * self.how.empty_weight > told.support + self.how.empty_weight
        seen = (told.support > self.how.min_support) & self._believed(told)
        marked = surface.closed(seen, triangles, self.how.closing) & ~empty
        # At silhouettes the zero level turns round, as far behind the surface as views suppose the object.
        loose = surface.curled(vertices, normals, seen, marked & ~seen)
        marked = surface.trimmed(marked, loose, triangles, CURL)
        usual = float(np.median(told.support[marked])) if marked.any() else 0.0
        return surface.opened(marked, triangles, self.how.opening), told.support < surface.WEAK * usual
