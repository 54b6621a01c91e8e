"""Views and their poses to one model of the object: merged cloud and mesh."""

from modeler.fusion.fuser import Fuser
from modeler.fusion.growing import Growing
from modeler.fusion.matching import Match, Matcher
from modeler.fusion.poses import own_covariances
from modeler.fusion.scan import Scan

__all__ = ["Fuser", "Growing", "Match", "Matcher", "Scan", "own_covariances"]
