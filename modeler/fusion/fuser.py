"""Views and their poses to one model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from modeler import se3
from modeler.fusion import grid
from modeler.fusion.crop import SMOOTHED
from modeler.fusion.incremental import IncrementalTsdf
from modeler.fusion.views import posed, spread, stack
from modeler.fusion.volume import FusionVolume
from modeler.types import Array, InputError, ObjectModel, RayImage


@dataclass(frozen=True)
class Fuser:
    """Merge views into a cloud and a mesh.

    The mesh is the zero level of a truncated signed distance (Curless and Levoy 1996, "A volumetric method for building
    complex models from range images") on voxels near the surface.
    """

    voxel_m: float | None = None
    """Side of a voxel in m; None: what a pixel covers, or half the sensor's noise where that is more."""
    truncation_m: float | None = None
    """Half width of the band around the surface in m; None: three voxels and twice what the views disagree by."""
    max_voxels: int = 192**3
    """The voxels grow until the object's box holds no more than so many."""
    preview_voxels: float = 2.0
    """Side of a voxel of a preview, in voxels of the model."""
    preview_limit: int = 128**3
    """The voxels of a preview grow until its box holds no more than so many."""
    preview_moves: int = 8
    """At most so many views whose poses have moved are carried along from one preview to the next."""
    min_cosine: float = 0.15
    """Surface seen at a more grazing angle than this cosine (normal to ray) is not used."""
    edge_weight: float = 0.1
    """Weight of pixels next to a silhouette or a step in depth, against 1: they mix what is before and behind."""
    margin_px: int = 2
    """A pixel carves only as deep as all its neighbours within so many px, so that silhouettes are not eaten away."""
    empty_weight: float = 0.3
    """Weight of a view that sees through a place, against 1 for a view that sees surface there head-on."""
    min_support: float = 0.03
    """Mesh that is seen less is removed. A view counts 1 head-on, less at flat angles, `edge_weight` at silhouettes."""
    closing: int = 3
    """Gaps narrower than about twice so many voxels are closed; what nobody saw beyond stays open."""
    opening: int = 2
    """Spikes and strips along open borders narrower than about twice so many voxels are cut off."""
    fairing: int = 10
    """Passes of smoothing the mesh without shrinking it."""
    min_piece: float = 0.01
    """Loose pieces of the mesh smaller than this share of the largest piece's area are removed."""

    def preview(
        self, views: Mapping[int, RayImage], trajectory: Mapping[int, Array], before: IncrementalTsdf | None = None
    ) -> IncrementalTsdf:
        """Return a coarse model that costs little more than what has changed since the one before.

        Args:
            views: by frame number; those without a pose are left out.
            trajectory: object_from_camera (4, 4) by frame number.
            before: what this returned for fewer views or older poses; None: begin afresh.

        Raises:
            InputError: where no view with surface points has a pose.
        """
        return (before or IncrementalTsdf(self)).to(views, trajectory)

    def fuse(
        self,
        views: Mapping[int, RayImage],
        trajectory: Mapping[int, Array],
        covariances: Mapping[int, Array] | None = None,
    ) -> ObjectModel:
        """Return cloud and mesh, made with care.

        Space that a view saw empty is carved, what nobody saw stays open, and nothing but pixels of the object becomes
        surface.

        Args:
            views: by frame number; those without a pose are left out.
            trajectory: object_from_camera (4, 4) by frame number.
            covariances: (6, 6) of the poses by frame number; the surer a pose, the more its view counts. A pose without
                one counts as exact.

        Raises:
            InputError: where no view with surface points has a pose.
        """
        return self.volume(views, trajectory, covariances).model()

    def volume(
        self,
        views: Mapping[int, RayImage],
        trajectory: Mapping[int, Array],
        covariances: Mapping[int, Array] | None = None,
    ) -> FusionVolume:
        """Return the views laid together in one volume, from which models are made; arguments as of `fuse`."""
        pairs = posed(views, trajectory)
        noise_m = float(np.median([view.sigma_r_m for view, _ in pairs]))
        voxel_m = self.side_m(pairs)
        box = grid.around(
            np.concatenate([se3.transform(pose, view.points_m) for view, pose in pairs]),
            voxel_m=voxel_m,
            border_m=self.truncation_m or 3.0 * voxel_m + 2.0 * noise_m,
            max_voxels=self.max_voxels,
        )
        seen = stack(
            pairs,
            box.corners_m,
            margin_px=self.margin_px,
            min_cosine=self.min_cosine,
            edge_weight=self.edge_weight,
            covariances=covariances,
        )
        # Where poses are off, the band must be wide enough for the views to meet in it.
        limit_m = 0.05 * float(np.linalg.norm(box.shape)) * box.voxel_m
        spread_m, sigma_m = spread(seen, limit_m) or (noise_m, SMOOTHED * noise_m)
        tau_m = self.truncation_m or 3.0 * box.voxel_m + 2.0 * spread_m
        return FusionVolume(self, seen.carving(tau_m), box, tau_m, box.voxel_m + 2.0 * spread_m, sigma_m)

    def side_m(self, pairs: list[tuple[RayImage, Array]]) -> float:
        """Return the side of a voxel, before the box is known.

        Raises:
            InputError: where the one that was given is none.
        """
        if self.voxel_m is not None:
            if not self.voxel_m > 0.0:
                raise InputError(f"voxel size {self.voxel_m} m is not positive; give a length in m, or none")
            return self.voxel_m
        footprint_m = np.concatenate([view.points_m[:, 2] / view.frame.camera.fx for view, _ in pairs])
        return max(float(np.median(footprint_m)), 0.5 * float(np.median([view.sigma_r_m for view, _ in pairs])))
