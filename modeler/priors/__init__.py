"""Nonvisual information about the motion between two views: models of evidence, and proposals that guide the search."""

from modeler.priors.general import AnyMotion as AnyMotion
from modeler.priors.general import GeneralPrior as GeneralPrior
from modeler.priors.held import HeldPrior as HeldPrior
from modeler.priors.mixtures import Gaussian as Gaussian
from modeler.priors.mixtures import defensive_mixture as defensive_mixture
from modeler.priors.poke import Poke as Poke
from modeler.priors.poke import PokePrior as PokePrior
from modeler.priors.product import AutoPrior as AutoPrior
from modeler.priors.product import ProductPrior as ProductPrior
from modeler.priors.proposals import FeaturesPrior as FeaturesPrior
from modeler.priors.proposals import PredictedProposal as PredictedProposal
from modeler.priors.proposals import VelocityPrior as VelocityPrior
from modeler.priors.table import AnyTurn as AnyTurn
from modeler.priors.table import TablePrior as TablePrior
from modeler.priors.turntable import TurntablePrior as TurntablePrior
from modeler.priors.turntable import turntable_in as turntable_in
