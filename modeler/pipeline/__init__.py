"""The loop: frames in, steps out."""

from modeler.pipeline.modeler import ACCEPTED as ACCEPTED
from modeler.pipeline.modeler import Modeler as Modeler
