"""Baselines: ICP, GICP, FPFH with RANSAC, KISS-Matcher, and the paper's sampler as published."""

from modeler.baselines.fpfh import FpfhIcpRegistrar as FpfhIcpRegistrar
from modeler.baselines.fpfh import FpfhRegistrar as FpfhRegistrar
from modeler.baselines.fpfh import KissIcpRegistrar as KissIcpRegistrar
from modeler.baselines.icp import ColouredIcpRegistrar as ColouredIcpRegistrar
from modeler.baselines.icp import GicpRegistrar as GicpRegistrar
from modeler.baselines.icp import IcpRegistrar as IcpRegistrar
from modeler.baselines.paper import PaperRegistrar as PaperRegistrar
