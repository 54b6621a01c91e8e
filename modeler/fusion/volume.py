"""Views laid together in one volume, and the models made from them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from modeler.fusion import closing, cloud, grid, surface, tones
from modeler.fusion.support import ViewSupport, view_support
from modeler.fusion.views import DepthViews
from modeler.types import Array, BoolArray, ObjectModel

if TYPE_CHECKING:
    from modeler.fusion.fuser import Fuser

SOFT, SHARP = 4.0, 16.0  # how much more say a frontal view has in colours: cosine to this power
CURL = 8  # rings of triangles along borders that may curl
LONELY = 6  # a point of the cloud with fewer neighbours within a few voxels is an outlier


@dataclass(frozen=True, eq=False)
class FusionVolume:
    """Posed views and the voxels around the object."""

    fuser: Fuser
    """Parameters."""
    views: DepthViews
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
        support = self.support(vertices, normals)
        points, normals_of_points = cloud.thinned(
            self.views.points_m,
            self.views.normals,
            self.views.weights,
            voxel_m=self.box.voxel_m,
            max_voxels=8 * self.fuser.max_voxels,
        )
        point_support = self.support(points, normals_of_points)
        kept = self._believed(point_support) & cloud.crowded(points, 2.0 * self.box.voxel_m, LONELY)
        coloured = bool(self.views.coloured.any())
        known = support.coloured & seen
        return ObjectModel(
            points_m=points[kept],
            normals=normals_of_points[kept],
            colours=point_support.colours[kept] if coloured else None,
            vertices_m=vertices,
            triangles=triangles,
            vertex_normals=normals,
            vertex_colours=surface.spread_colours(support.colours, known, vertices) if coloured else None,
            vertex_views=np.where(seen, support.views, 0),
            vertex_sigmas_m=np.where(seen, support.sigmas_m, np.inf),
        )

    def support(self, points_m: Array, normals: Array) -> ViewSupport:
        """Return what the views say of oriented points (n, 3) of the object frame."""
        return self._support(points_m, normals, self._gains)

    def painted(self, points_m: Array, normals: Array) -> npt.NDArray[np.uint8]:
        """Return the RGB (n, 3) of points of the surface (n, 3): from the most frontal views, sharp ones first."""
        support = self._support(points_m, normals, self._gains, focus=SHARP)
        return surface.spread_colours(support.colours, support.coloured, points_m)

    @property
    def texel_m(self) -> float:
        """Length on the surface that half a pixel of the views covers."""
        turns, shifts = self.views.poses[:, :, :3], self.views.poses[:, :, 3]
        centres_m = -np.einsum("fji,fj->fi", turns, shifts)[self.views.views]
        depth_m = float(np.median(np.linalg.norm(self.views.points_m - centres_m, axis=1)))
        return 0.5 * depth_m / float(np.median(self.views.lenses[:, 0]))

    @cached_property
    def _gains(self) -> Array:
        """Exposure and say of the views, (f, 4)."""
        return tones.gains(self.views, self.views.points_m, self.views.normals, tau_m=self.tau_m, near_m=self.near_m)

    def _support(self, points_m: Array, normals: Array, gains: Array, *, focus: float = SOFT) -> ViewSupport:
        return view_support(
            self.views,
            points_m,
            normals,
            tau_m=self.tau_m,
            near_m=self.near_m,
            sigma_m=self.sigma_m,
            gains=gains,
            focus=focus,
        )

    def _believed(self, support: ViewSupport) -> BoolArray:
        """Return which points (n,) more views see than see through."""
        return support.support > self.fuser.empty_weight * support.emptiness

    def _mesh(self, *, watertight: bool) -> tuple[Array, surface.Triangles, BoolArray]:
        """Return vertices (v, 3) and triangles (t, 3) of the surface, and which vertices the views support."""
        field = grid.measure(self.box, self.views, tau_m=self.tau_m, empty_weight=self.fuser.empty_weight)
        for _ in range(self.fuser.closing):
            field = grid.filled(field)
        vertices, triangles = surface.extracted(field)
        kept, weak = self._kept(vertices, triangles)
        shown = triangles[np.all(kept[triangles], axis=1)]
        shown = shown[surface.large_pieces(vertices, shown, self.fuser.min_piece)]
        used, compact = surface.compacted(shown, len(vertices))
        if not watertight:
            smooth = surface.fair(vertices[used], compact, self.fuser.fairing)
            return surface.fair(smooth, compact, surface.ROUGH, weak[used]), compact, np.ones(len(used), dtype=bool)
        unused = np.ones(len(vertices), dtype=bool)
        unused[used] = False
        field = closing.without(field, vertices[unused], vertices[used], self.tau_m)
        whole = closing.enclosing(field, self.views, self.tau_m)
        return closing.tidied(
            *surface.extracted(whole), vertices[used], weak[used], voxel_m=self.box.voxel_m, passes=self.fuser.fairing
        )

    def _kept(self, vertices: Array, triangles: surface.Triangles) -> tuple[BoolArray, BoolArray]:
        """Return which vertices (v,) of the zero level are surface: supported, not seen through, and no frill.

        And which of all (v,) are known badly, so that much of their place is noise.
        """
        normals = surface.normals_of(vertices, triangles)
        support = self._support(vertices, normals, np.zeros((len(self.views.index), 4)))
        # Gaps in what is believed are closed, but not with what several views see through.
        empty = support.emptiness * self.fuser.empty_weight > support.support + self.fuser.empty_weight
        seen = (support.support > self.fuser.min_support) & self._believed(support)
        marked = surface.closed(seen, triangles, self.fuser.closing) & ~empty
        # At silhouettes the zero level turns round, as far behind the surface as views suppose the object.
        loose = surface.curled(vertices, normals, seen, marked & ~seen)
        marked = surface.trimmed(marked, loose, triangles, CURL)
        usual = float(np.median(support.support[marked])) if marked.any() else 0.0
        return surface.opened(marked, triangles, self.fuser.opening), support.support < surface.WEAK * usual
