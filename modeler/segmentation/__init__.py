"""Which pixels are the object, and what it stands on, learnt from what stays still and what changes."""

from modeler.segmentation.noise import DepthNoise
from modeler.segmentation.plane_fit import fit_plane
from modeler.segmentation.scene import Scene, telling
from modeler.segmentation.segmenter import Segmenter

__all__ = ["DepthNoise", "Scene", "Segmenter", "fit_plane", "telling"]
