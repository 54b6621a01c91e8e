"""Fusion of posed depth views into one model of the object: point cloud and mesh."""

from modeler.fusion.alignment import Match, Matcher
from modeler.fusion.depth_views import conditional_covariances
from modeler.fusion.fuser import Fuser, FusionVolume
from modeler.fusion.symmetries import Symmetries, SymmetryFinder

__all__ = [
    "Fuser",
    "FusionVolume",
    "Match",
    "Matcher",
    "Symmetries",
    "SymmetryFinder",
    "conditional_covariances",
]
