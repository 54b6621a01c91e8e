"""Selection of pairs of views to register, and the gate by which their posteriors become edges of the graph."""

from modeler.closure.closer import Closer as Closer
from modeler.closure.closer import Placement as Placement
from modeler.closure.consistency import ConsistencyModel as ConsistencyModel
from modeler.closure.consistency import Thresholds as Thresholds
from modeler.closure.map_view import MapView as MapView
from modeler.closure.map_view import PathNetwork as PathNetwork
