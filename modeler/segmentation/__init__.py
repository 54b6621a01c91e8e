"""Segmentation of the object and its support plane, from what is static and what moves in a sequence."""

from modeler.segmentation.depth_images import DepthNoise
from modeler.segmentation.planes import fit_plane
from modeler.segmentation.scene import Scene, scene_frames
from modeler.segmentation.segmenter import Segmenter

__all__ = ["DepthNoise", "Scene", "Segmenter", "fit_plane", "scene_frames"]
