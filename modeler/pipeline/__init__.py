"""The loop: frames in, events out."""

from modeler.pipeline.modeler import Modeler as Modeler
from modeler.pipeline.modeler import Run as Run
from modeler.pipeline.pairs import Prepared as Prepared
from modeler.pipeline.pairs import anywhere as anywhere
from modeler.pipeline.pairs import prepare as prepare
from modeler.pipeline.pairs import register as register
from modeler.pipeline.tracking import glancing as glancing
