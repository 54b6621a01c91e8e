"""An object found in images with its model, and followed."""

from modeler.tracking.rendering import ModelRenderer as ModelRenderer
from modeler.tracking.tracked import Tracked as Tracked
from modeler.tracking.tracker import Tracker as Tracker
