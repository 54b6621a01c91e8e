"""Fusion of posed depth views into one model of the object: point cloud and mesh."""

from modeler.fusion.alignment import Match, Matcher
from modeler.fusion.fuser import Fuser, FusionVolume
from modeler.fusion.incremental import IncrementalTsdf
from modeler.fusion.views import conditional_covariances

__all__ = ["Fuser", "FusionVolume", "IncrementalTsdf", "Match", "Matcher", "conditional_covariances"]
