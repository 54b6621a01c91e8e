"""Methods compared on sequences whose true motions are known: which pairs, which errors, which tables."""

from modeler.experiment.pairing import Pairing as Pairing
from modeler.experiment.runner import evaluate as evaluate
from modeler.experiment.tables import Summary as Summary
from modeler.experiment.tables import summaries as summaries
from modeler.experiment.trials import Experiment as Experiment
from modeler.experiment.trials import Recorded as Recorded
from modeler.experiment.trials import Trial as Trial
from modeler.experiment.trials import sparse_frame as sparse_frame
from modeler.experiment.trials import sparse_view as sparse_view
