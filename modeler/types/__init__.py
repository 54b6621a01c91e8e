"""The values that pass between the parts of the package, and its abstract interfaces.

Lengths are metres and angles radians unless a name says otherwise; `se3` holds the conventions of poses and tangents.
All values are frozen.
"""

from modeler.types.base import Array as Array
from modeler.types.base import BoolArray as BoolArray
from modeler.types.base import Float32Array as Float32Array
from modeler.types.base import InputError as InputError
from modeler.types.base import Outcome as Outcome
from modeler.types.interfaces import AbstractPoseDensity as AbstractPoseDensity
from modeler.types.interfaces import AbstractPrior as AbstractPrior
from modeler.types.interfaces import AbstractRegistrar as AbstractRegistrar
from modeler.types.interfaces import SharedAxis as SharedAxis
from modeler.types.model import Event as Event
from modeler.types.model import Fusing as Fusing
from modeler.types.model import ObjectModel as ObjectModel
from modeler.types.model import Refining as Refining
from modeler.types.model import Searching as Searching
from modeler.types.model import Step as Step
from modeler.types.posteriors import Mode as Mode
from modeler.types.posteriors import PoseGaussian as PoseGaussian
from modeler.types.posteriors import Posterior as Posterior
from modeler.types.posteriors import are_separate as are_separate
from modeler.types.posteriors import pooled as pooled
from modeler.types.reasons import ACCEPTED as ACCEPTED
from modeler.types.reasons import ConfirmedBy as ConfirmedBy
from modeler.types.reasons import Consistency as Consistency
from modeler.types.reasons import Degenerate as Degenerate
from modeler.types.reasons import ElsewhereThanSegments as ElsewhereThanSegments
from modeler.types.reasons import Failed as Failed
from modeler.types.reasons import JoinsPrevious as JoinsPrevious
from modeler.types.reasons import JoinsSegments as JoinsSegments
from modeler.types.reasons import LowEvidence as LowEvidence
from modeler.types.reasons import LowOverlap as LowOverlap
from modeler.types.reasons import NearExtrapolation as NearExtrapolation
from modeler.types.reasons import NotJoined as NotJoined
from modeler.types.reasons import NotPlaced as NotPlaced
from modeler.types.reasons import OpenRotation as OpenRotation
from modeler.types.reasons import OptimisationOutlier as OptimisationOutlier
from modeler.types.reasons import PriorRefused as PriorRefused
from modeler.types.reasons import Reason as Reason
from modeler.types.reasons import Relocalised as Relocalised
from modeler.types.reasons import Stated as Stated
from modeler.types.reasons import advice as advice
from modeler.types.reasons import code as code
from modeler.types.reasons import explain as explain
from modeler.types.reasons import summary as summary
from modeler.types.solution import AWAY_DEG as AWAY_DEG
from modeler.types.solution import NEAR_DEG as NEAR_DEG
from modeler.types.solution import Edge as Edge
from modeler.types.solution import EdgeKind as EdgeKind
from modeler.types.solution import LoopOpening as LoopOpening
from modeler.types.solution import Solution as Solution
from modeler.types.solution import joined_without as joined_without
from modeler.types.solution import loop_opening as loop_opening
from modeler.types.solution import loop_openings as loop_openings
from modeler.types.solution import loops_closed as loops_closed
from modeler.types.solution import segments as segments
from modeler.types.views import COLOUR_SHIFT_PX as COLOUR_SHIFT_PX
from modeler.types.views import Camera as Camera
from modeler.types.views import Frame as Frame
from modeler.types.views import Plane as Plane
from modeler.types.views import RayImage as RayImage
from modeler.types.views import Segmentation as Segmentation
from modeler.types.views import SensorNoise as SensorNoise
