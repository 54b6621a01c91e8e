"""The loop: frames in, steps out."""

from modeler.pipeline.glances import glancing as glancing
from modeler.pipeline.modeler import Modeler as Modeler
from modeler.types import ACCEPTED as ACCEPTED
