"""The pipeline: frames in, events out."""

from modeler.pipeline.modeler import Modeler as Modeler
from modeler.pipeline.newest import NewestFrames as NewestFrames
from modeler.pipeline.pairs import Prepared as Prepared
from modeler.pipeline.pairs import Registrations as Registrations
from modeler.pipeline.pairs import prepare as prepare
from modeler.pipeline.pairs import without_limits as without_limits
from modeler.pipeline.run import Run as Run
