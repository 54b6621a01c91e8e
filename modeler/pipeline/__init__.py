"""The pipeline: frames in, events out."""

from modeler.pipeline.modeler import Modeler as Modeler
from modeler.pipeline.modeler import Run as Run
from modeler.pipeline.newest import NewestFrames as NewestFrames
from modeler.pipeline.pairs import Prepared as Prepared
from modeler.pipeline.pairs import prepare as prepare
from modeler.pipeline.pairs import register as register
from modeler.pipeline.pairs import retry_unlimited as retry_unlimited
from modeler.pipeline.tracking import quick_registrar as quick_registrar
