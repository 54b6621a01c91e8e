"""Registration methods behind `AbstractRegistrar`: the visibility method and its baselines."""

from modeler.registration.baselines.coloured_icp import ColouredIcpRegistrar as ColouredIcpRegistrar
from modeler.registration.baselines.fpfh import FpfhIcpRegistrar as FpfhIcpRegistrar
from modeler.registration.baselines.fpfh import FpfhRegistrar as FpfhRegistrar
from modeler.registration.baselines.icp import GicpRegistrar as GicpRegistrar
from modeler.registration.baselines.icp import IcpRegistrar as IcpRegistrar
from modeler.registration.baselines.kiss import KissIcpRegistrar as KissIcpRegistrar
from modeler.registration.baselines.paper import PaperRegistrar as PaperRegistrar
from modeler.registration.visibility import VisibilityLikelihood as VisibilityLikelihood
from modeler.registration.visibility import VisibilityRegistrar as VisibilityRegistrar
