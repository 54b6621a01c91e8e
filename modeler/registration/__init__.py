"""Registration: the visibility method, a registrar of two views that knows how sure it is."""

from modeler.registration.visibility import VisibilityLikelihood as VisibilityLikelihood
from modeler.registration.visibility import VisibilityRegistrar as VisibilityRegistrar
