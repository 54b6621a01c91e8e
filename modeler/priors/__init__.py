"""What is known of a motion besides the images: one model a file."""

from modeler.priors.axes import AxesPrior as AxesPrior
from modeler.priors.features import FeaturesPrior as FeaturesPrior
from modeler.priors.foreseen import PredictedProposal as PredictedProposal
from modeler.priors.general import GeneralPrior as GeneralPrior
from modeler.priors.held import HeldPrior as HeldPrior
from modeler.priors.poke import Poke as Poke
from modeler.priors.poke import PokePrior as PokePrior
from modeler.priors.product import ProductPrior as ProductPrior
from modeler.priors.table import TablePrior as TablePrior
from modeler.priors.turntable import TurntablePrior as TurntablePrior
from modeler.priors.velocity import VelocityPrior as VelocityPrior
