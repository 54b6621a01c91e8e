"""Registration methods, one a file, all behind `AbstractRegistrar`."""

from modeler.registration.fpfh import FpfhRegistrar as FpfhRegistrar
from modeler.registration.fpfh_icp import FpfhIcpRegistrar as FpfhIcpRegistrar
from modeler.registration.gicp import GicpRegistrar as GicpRegistrar
from modeler.registration.icp import IcpRegistrar as IcpRegistrar
from modeler.registration.paper import PaperRegistrar as PaperRegistrar
from modeler.registration.visibility import VisibilityRegistrar as VisibilityRegistrar
