"""Views and their poses to one model of the object: merged cloud and mesh."""

from modeler.fusion.fuser import Fuser
from modeler.fusion.incremental import IncrementalTsdf
from modeler.fusion.matching import Match, Matcher
from modeler.fusion.poses import own_covariances
from modeler.fusion.volume import FusionVolume

__all__ = ["Fuser", "FusionVolume", "IncrementalTsdf", "Match", "Matcher", "own_covariances"]
