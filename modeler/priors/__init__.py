"""What is known of a motion besides the images: one model a file."""

from modeler.priors.general import GeneralPrior as GeneralPrior
from modeler.priors.table import TablePrior as TablePrior

AnyPrior = GeneralPrior | TablePrior
