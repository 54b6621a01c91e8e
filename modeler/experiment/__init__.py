"""Evaluation of methods and models against ground truth: pairs, errors, tables."""

from modeler.experiment.experiment import Experiment as Experiment
from modeler.experiment.experiment import Pairing as Pairing
from modeler.experiment.experiment import Summary as Summary
from modeler.experiment.experiment import Trial as Trial
from modeler.experiment.experiment import sparse_view as sparse_view
from modeler.experiment.experiment import summaries as summaries
from modeler.experiment.results import Modelled as Modelled
from modeler.experiment.results import ModelScore as ModelScore
from modeler.experiment.results import evaluate as evaluate
from modeler.experiment.results import model_scores as model_scores
from modeler.experiment.results import write_models as write_models
