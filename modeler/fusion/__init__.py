"""Views and their poses to one model of the object: merged cloud and mesh."""

from modeler.fusion.fuser import Fuser

__all__ = ["Fuser"]
