"""The pose graph: optimised poses and their covariances from accepted edges. The only package that imports GTSAM."""

from modeler.graph.axis import CommonAxis as CommonAxis
from modeler.graph.covariance import shared_noise as shared_noise
from modeler.graph.covariance import variance_factor as variance_factor
from modeler.graph.focal import MovingGraph as MovingGraph
from modeler.graph.focal import estimate_focal_length as estimate_focal_length
from modeler.graph.pose_graph import PoseGraph as PoseGraph
from modeler.graph.pose_graph import dead_reckoning as dead_reckoning
from modeler.graph.smoother import Smoother as Smoother
from modeler.graph.smoother import solve as solve
