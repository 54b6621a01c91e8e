"""Registration: the visibility method, posteriors of the motion between two views."""

from modeler.registration.visibility import VisibilityLikelihood as VisibilityLikelihood
from modeler.registration.visibility import VisibilityRegistrar as VisibilityRegistrar
