"""The default registration method: `registrar` runs `search`, `sampling` and `refinement` of `likelihood`."""

from modeler.registration.visibility.likelihood import VisibilityLikelihood as VisibilityLikelihood
from modeler.registration.visibility.registrar import VisibilityRegistrar as VisibilityRegistrar
